"""State without a filter, for the ablation "without EKF": the latest fix, the IMU's heading, differences as speeds."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from finssim.geometry.rotations import wrap_angle

__all__ = ["Unfused"]

Array = npt.NDArray[np.float64]

ALPHA = 0.35
"""Part of a new difference that enters the speed (published velocity filter)."""
LONGEST = 0.5
"""Differences over longer times tell no speed [s]."""


@dataclass(frozen=True)
class _Axis:
    """The latest values of some coordinates, and their speeds."""

    value: Array
    speed: Array
    time: float = math.nan

    def after(self, value: Array, time: float) -> _Axis:
        """With one more measurement, unless it is older."""
        if not math.isnan(self.time) and time <= self.time:
            return self
        step = time - self.time
        if not step <= LONGEST:
            return replace(self, value=value, speed=np.zeros(len(value)), time=time)
        speed = self.speed + ALPHA * ((value - self.value) / step - self.speed)
        return _Axis(value, speed, time)


class Unfused:
    """Position, velocity and heading in the pool frame as the sensors alone have them."""

    def __init__(self) -> None:
        self._xy = _Axis(np.full(2, math.nan), np.zeros(2))
        self._z = _Axis(np.full(1, math.nan), np.zeros(1))
        self._heading = math.nan
        self._offset = math.nan

    def heading(self, yaw: float) -> None:
        """Take in the attitude filter's own heading [rad]."""
        if math.isfinite(yaw):
            self._heading = yaw

    def height(self, z: float, time: float) -> None:
        """Take in the height of the body origin [m]."""
        if math.isfinite(z):
            self._z = self._z.after(np.array([z]), time)

    def fix(self, position: tuple[float, float], yaw: float | None, time: float) -> None:
        """Take in a fix; the first with a yaw says where the attitude filter's zero points.

        Args:
            position: x, y of the body origin, pool frame [m].
            yaw: Left positive, pool frame [rad]; None where it is not known.
            time: Middle of the exposure [s].
        """
        self._xy = self._xy.after(np.array(position), time)
        if math.isnan(self._offset) and yaw is not None:
            self._offset = yaw - self._heading

    @property
    def vision_time(self) -> float | None:
        """Time of the latest fix [s]."""
        return None if math.isnan(self._xy.time) else self._xy.time

    @property
    def x(self) -> Array:
        """Position [m] and velocity [m/s], (6,); NaN where not known."""
        return np.concatenate([self._xy.value, self._z.value, self._xy.speed, self._z.speed])

    @property
    def yaw(self) -> float:
        """[rad]; NaN before the first fix."""
        return float(wrap_angle(self._heading + self._offset))
