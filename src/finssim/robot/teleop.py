"""A person's hands to a wrench: gears, dead zones and the dead-man switch, and what their presses do to a robot."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np
import numpy.typing as npt

from finssim.robot.bridge import Bridge

__all__ = [
    "GEARS",
    "Device",
    "Hands",
    "Operator",
    "Teleop",
    "TeleopCommand",
    "TeleopError",
    "TeleopSettings",
    "shaped",
]


Array = npt.NDArray[np.float64]

Gear = Literal["precision", "cruise", "boost"]

GEARS: dict[Gear, tuple[float, float, float, float]] = {
    "precision": (2.0, 1.5, 1.5, 0.25),
    "cruise": (6.0, 4.0, 5.0, 0.8),
    "boost": (10.0, 7.0, 8.0, 1.2),
}
"""Full deflection of surge, sway, heave [N] and yaw [N m], as published."""


class TeleopError(ValueError):
    """A device for teleoperation is not there, or cannot be used."""


@dataclass(frozen=True)
class TeleopSettings:
    """How hands become a wrench."""

    dead_band: float = 0.1
    """Deflections below do nothing, those above count from it."""
    expo: float = 0.3
    """Share of the cube in the answer to a deflection: small ones become finer, the full one stays."""
    lost: float = 0.5
    """Without news of the device for so long it counts as lost [s]."""


@dataclass(frozen=True)
class Hands:
    """What a device shows at one time. Axes are in [-1, 1]: forward, left, up, turn left."""

    surge: float = 0.0
    sway: float = 0.0
    heave: float = 0.0
    yaw: float = 0.0
    dead_man: bool = False
    """Whether somebody holds on: without it there is no thrust."""
    precision: bool = False
    boost: bool = False
    arm: bool = False
    """The button that arms and disarms is down."""
    stop: bool = False
    """The emergency stop is down."""
    acknowledge: bool = False
    """The button that ends a fault is down."""
    mode: bool = False
    """The button that hands over to the other pilot is down."""
    present: bool = True
    """Whether the device is there."""


@dataclass(frozen=True)
class TeleopCommand:
    """What a person wants now."""

    wrench: Array = field(default_factory=lambda: np.zeros(6))
    """Body frame [N, N m], (6,)."""
    gear: Gear = "cruise"
    arm_toggle: bool = False
    """Arm if disarmed, disarm if armed; true once for each press."""
    stop: bool = False
    acknowledge: bool = False
    """True once for each press."""
    mode_toggle: bool = False
    """True once for each press."""
    lost: bool = False
    """The device is lost: disarm."""


class Teleop:
    """Turns what a device shows into what a person wants; remembers which buttons were down.

    A lost device, a released dead-man and the emergency stop each mean no thrust. The first look after the start or
    after a loss only learns which buttons are down, so that none that hangs can arm.
    """

    def __init__(self, settings: TeleopSettings | None = None) -> None:
        self.settings = settings or TeleopSettings()
        self._before: Hands | None = None
        self._heard = -math.inf

    def look(self, now: float, hands: Hands | None) -> TeleopCommand:
        """What is wanted now.

        Args:
            now: [s]
            hands: What the device shows; None where it has not been heard since the last look.
        """
        if hands is not None and hands.present:
            self._heard = now
        before = self._before
        if (hands is not None and not hands.present) or now - self._heard > self.settings.lost:
            self._before = None
            return TeleopCommand(lost=True)
        if hands is None:
            hands = before or Hands()
        self._before = hands
        if before is None:
            return TeleopCommand(gear=gear_of(hands), stop=hands.stop)
        return TeleopCommand(
            wrench=self._wrench(hands),
            gear=gear_of(hands),
            arm_toggle=hands.arm and not before.arm,
            stop=hands.stop,
            acknowledge=hands.acknowledge and not before.acknowledge,
            mode_toggle=hands.mode and not before.mode,
        )

    def _wrench(self, hands: Hands) -> Array:
        if not hands.dead_man or hands.stop:
            return np.zeros(6)
        deflections = np.array([hands.surge, hands.sway, hands.heave, hands.yaw])
        x, y, z, n = shaped(deflections, self.settings) * GEARS[gear_of(hands)]
        return np.array([x, y, z, 0.0, 0.0, n])


def gear_of(hands: Hands) -> Gear:
    """Precision before boost, for it is the careful one."""
    return "precision" if hands.precision else "boost" if hands.boost else "cruise"


def shaped(deflection: Array, settings: TeleopSettings) -> Array:
    """Answer to deflections: e d³ + (1 - e) d with d counted from the dead band, within [-1, 1]; NaN counts as none."""
    x = np.clip(np.nan_to_num(deflection, nan=0.0), -1.0, 1.0)
    beyond = np.maximum(np.abs(x) - settings.dead_band, 0.0) / (1.0 - settings.dead_band)
    return np.asarray(np.sign(x) * (settings.expo * beyond**3 + (1.0 - settings.expo) * beyond), float)


# A person at the controls of a running robot: presses become arming, stops and a wrench.


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
