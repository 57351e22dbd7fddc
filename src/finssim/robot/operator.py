"""A person at the controls of a running robot: presses become arming, stops and a wrench."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
import numpy.typing as npt

from finssim.robot.bridge import Bridge
from finssim.robot.teleop import Hands, Teleop, TeleopCommand

__all__ = ["Device", "Operator"]

Array = npt.NDArray[np.float64]


class Device(Protocol):
    """A gamepad, a keyboard, or what stands in for one."""

    def read(self, now: float) -> Hands:
        """What it shows now [s]; never waits."""


class Operator:
    """Reads a device at each turn of the loop and does what its buttons say.

    A vehicle is armed by a press of the arm button alone. A lost device disarms; its return arms nothing.
    """

    def __init__(
        self, device: Device, teleop: Teleop | None = None, swap: Callable[[], None] | None = None
    ) -> None:
        """
        Args:
            device: What the person holds.
            teleop: Otherwise than by default.
            swap: Hands over between person and controller, at a press; None: there is no controller.
        """
        self.device, self.teleop, self._swap = device, teleop or Teleop(), swap
        self.command = TeleopCommand()
        """The latest."""
        self.said = ""
        """What to tell the person: why arming was refused, or what is wrong."""

    def wrench(self) -> Array:
        """The wanted wrench, body frame [N, N m], (6,); for `pilots.WrenchPilot`."""
        return self.command.wrench

    def turn(self, now: float, bridge: Bridge) -> None:
        """Look at the device at a time [s], and arm, disarm or stop as it says."""
        self.command = command = self.teleop.look(now, self.device.read(now))
        if command.lost:
            if bridge.state in ("armed", "hold"):
                bridge.disarm(now)
                self.said = "the device is lost: disarmed"
            return
        if command.stop:
            if bridge.state != "fault":
                bridge.stop(now, "emergency stop by the operator")
            return
        if command.acknowledge and bridge.state == "fault":
            bridge.acknowledge(now)
            self.said = ""
        if command.arm_toggle:
            self._toggle(now, bridge)
        if command.mode_toggle and self._swap is not None:
            self._swap()

    def _toggle(self, now: float, bridge: Bridge) -> None:
        if bridge.state in ("armed", "hold"):
            bridge.disarm(now)
            self.said = ""
        else:
            self.said = bridge.arm(now, "operator")
