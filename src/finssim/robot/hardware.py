"""A vehicle on a wire as a `Robot`, for scripts and experiments with a loop of their own."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from finssim.localization.pool import Pool
from finssim.robot.bridge import Bridge
from finssim.robot.link.frames import encode_command
from finssim.robot.link.transports import Transport
from finssim.robot.perception import Perception
from finssim.robot.robot import Reading
from finssim.robot.runtime import Counters, Intake
from finssim.vehicles import Vehicle

if TYPE_CHECKING:
    from finssim.robot.pictures import PictureSource

__all__ = ["HardwareRobot"]

Array = npt.NDArray[np.float64]


class HardwareRobot:
    """Read, send, and nothing more: without an `arm` that succeeds, thrusters never turn.

    Call `read` and `send` at least 20 times a second: the motor controller stops the motors half a second after the
    last frame, and so does the bridge after the last command.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        pool: Pool,
        transport: Transport,
        pictures: PictureSource | None = None,
        *,
        perception: Perception | None = None,
        bridge: Bridge | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """
        Args:
            vehicle: As its file has it.
            pool: Camera, water and frames.
            transport: To its motor controller.
            pictures: From the camera; None: there is none, and the position stays unknown.
            perception: Otherwise than by default.
            bridge: Otherwise than by default.
            clock: The robot's [s].
        """
        self._vehicle, self._transport, self._pictures, self._clock = vehicle, transport, pictures, clock
        self._perception = perception or Perception(vehicle, pool)
        self.bridge = bridge or Bridge(vehicle)
        self._intake = Intake(self._perception, self.bridge, Counters())

    @property
    def vehicle(self) -> Vehicle:
        """As its file has it."""
        return self._vehicle

    def arm(self) -> str:
        """Let commands through from now on. Returns "" or why it is refused."""
        return self.bridge.arm(self._clock(), "script")

    def disarm(self) -> None:
        """Thrusters off."""
        now = self._clock()
        self.bridge.disarm(now)
        self._tick(now)

    def read(self) -> Reading:
        """The state now, after everything that has come."""
        now = self._clock()
        frames = [(now, data) for data in self._transport.receive()]
        self._intake.take(now, frames, self._pictures.receive(now) if self._pictures else ())
        reading = self._perception.reading(now)
        self.bridge.reading(now, reading)
        return reading

    def send(self, force: npt.ArrayLike) -> Array:
        """Command thrusts along the thrusters' axes in canonical order [N], (n,).

        Returns them as limited (zeros while not armed).
        """
        now = self._clock()
        limited = self.bridge.command(now, force, "script", stamp=now)
        self._tick(now)
        return limited

    def close(self) -> None:
        """Disarm, send frames without thrust, and let go of wire and camera."""
        self.bridge.disarm(self._clock())
        for _ in range(3):
            self._tick(self._clock())
        self._transport.close()
        if self._pictures is not None:
            self._pictures.close()

    def _tick(self, now: float) -> None:
        self._transport.send(encode_command(self.bridge.tick(now)))
