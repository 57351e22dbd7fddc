"""Path following in space with vehicles that must move to steer: waypoints, line of sight, and terrain following."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from finssim.control import ControlError
from finssim.control.guidance import Guide, Reference
from finssim.core.rotations import wrap_angle

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]


class PathErrors(NamedTuple):
    """Positions of n vehicles relative to the leg that each follows."""

    course: Array
    """Direction of the leg, counter-clockwise from the world's x axis [rad], (n,)."""
    slope: Array
    """Pitch of the leg, positive downwards [rad], (n,)."""
    along: Array
    """Distance along the leg from its start [m], (n,)."""
    across: Array
    """Horizontal distance to the left of the leg [m], (n,)."""
    above: Array
    """Distance above the leg, perpendicular to it [m], (n,)."""
    remaining: Array
    """Distance along the leg to its end [m], (n,)."""


@dataclass(frozen=True)
class Waypoints:
    """Straight legs between successive points.

    The next leg starts within the radius of acceptance of a leg's end, or beyond the plane perpendicular to
    the leg at its end.
    """

    points: Array
    """Points in the world frame [m], (k, 3)."""
    radius: float = 2.0
    """Radius of acceptance [m]."""

    def __post_init__(self) -> None:
        points = np.asarray(self.points, float)
        if points.ndim != 2 or points.shape[1:] != (3,) or len(points) < 2 or not np.isfinite(points).all():
            raise ControlError(
                f"waypoints have shape {points.shape}, expected two or more rows of finite x, y, z in metres"
            )
        equal = np.flatnonzero(np.linalg.norm(np.diff(points, axis=0), axis=1) == 0.0)
        if len(equal):
            raise ControlError(
                f"waypoints {equal[0] + 1} and {equal[0] + 2} are the same point: omit one of them"
            )
        if not self.radius > 0.0:
            raise ControlError(
                f"the radius of acceptance is {self.radius}, expected a positive length in metres"
            )
        object.__setattr__(self, "points", points)

    @classmethod
    def along(cls, trajectory: Guide, spacing: float = 1.0) -> Waypoints:
        """Return the path of a guide with finite duration, without its times, as legs of about a `spacing` [m].

        The radius of acceptance is so small that legs are completed at their ends.
        """
        t = np.linspace(0.0, trajectory.duration, 4001)
        x = trajectory.at(t).position
        way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(x, axis=0), axis=1))])
        stops = np.linspace(0.0, way[-1], max(2, 1 + math.ceil(way[-1] / spacing)))
        points = np.stack([np.interp(stops, way, x[:, i]) for i in range(3)], axis=1)
        return cls(points, radius=1e-3 * spacing)

    @property
    def legs(self) -> int:
        """Number of legs."""
        return len(self.points) - 1

    def reset(self, n: int = 1) -> Indices:
        """Return the initial leg, 0, of n vehicles, (n,)."""
        return np.zeros(n, dtype=np.int64)

    def errors(
        self, leg: Indices, position: npt.ArrayLike
    ) -> tuple[PathErrors, Indices, npt.NDArray[np.bool_]]:
        """Return the path errors, the leg of each vehicle, and whether it has completed the last leg.

        Args:
            leg: Legs from `reset` or the previous call, (n,).
            position: Positions in the world frame [m], (n, 3).
        """
        x = np.atleast_2d(np.asarray(position, float))
        for _ in range(self.legs):
            near = np.linalg.norm(self.points[leg + 1] - x, axis=1) <= self.radius
            left = near | (self._beside(leg, x).remaining <= 0.0)
            if not (left & (leg < self.legs - 1)).any():
                break
            leg = np.where(left, np.minimum(leg + 1, self.legs - 1), leg)
        return self._beside(leg, x), leg, left & (leg == self.legs - 1)

    def _beside(self, leg: Indices, x: Array) -> PathErrors:
        way = self.points[leg + 1] - self.points[leg]
        level = np.hypot(way[:, 0], way[:, 1])
        course, slope = np.arctan2(way[:, 1], way[:, 0]), np.arctan2(-way[:, 2], level)
        off = x - self.points[leg]
        ahead = off[:, 0] * np.cos(course) + off[:, 1] * np.sin(course)
        along = ahead * np.cos(slope) - off[:, 2] * np.sin(slope)
        across = off[:, 1] * np.cos(course) - off[:, 0] * np.sin(course)
        above = ahead * np.sin(slope) + off[:, 2] * np.cos(slope)
        return PathErrors(course, slope, along, across, above, np.linalg.norm(way, axis=1) - along)


@dataclass(frozen=True)
class PathGuide:
    """Straight legs between successive points as a guide, each in one second, for controllers that follow the
    path without its times."""

    points: Array
    """Points in the world frame [m], (k, 3)."""
    name: str = "path"

    @property
    def duration(self) -> float:
        """Duration [s]."""
        return float(len(self.points) - 1)

    def at(self, t: npt.ArrayLike) -> Reference:
        """Return the position at times since the start [s], (...), with a heading along the world's x axis."""
        time = np.clip(np.asarray(t, float), 0.0, self.duration)
        k = np.minimum(time.astype(int), len(self.points) - 2)
        way = self.points[k + 1] - self.points[k]
        position = self.points[k] + (time - k)[..., None] * way
        return Reference(position, way, np.zeros(time.shape), time / self.duration)


@dataclass(frozen=True)
class LineOfSight:
    """Course and slope towards a point ahead on the path, with integral action against a current.

        course = course of the path - atan((y + s Y) / D),   Y' = D y / ((y + s Y)² + D²)

    and the slope accordingly (Børhaug, Pavlov and Pettersen 2008). Far from the path the integral hardly
    changes, which prevents windup.
    """

    look_ahead: float
    """Look-ahead distance D [m]."""
    gain: float = 0.2
    """Integral gain s [1/s]: small for an autopilot of the course over ground, which already compensates the
    drift."""
    steepest: float = math.radians(25.0)
    """Greatest slope [rad]."""

    def reset(self, n: int = 1) -> Array:
        """Return the initial integrals [m s], (n, 2)."""
        return np.zeros((n, 2))

    def aim(self, memory: Array, errors: PathErrors, period: float) -> tuple[tuple[Array, Array], Array]:
        """Return the commanded course and slope [rad], (n,) each, and the new integrals.

        Args:
            memory: Integrals Y of both [m s], (n, 2).
            errors: Errors from `Waypoints.errors`.
            period: Time since the previous call [s].
        """
        off = np.column_stack([errors.across, errors.above])
        leading = off + self.gain * memory
        after = memory + period * self.look_ahead * off / (leading**2 + self.look_ahead**2)
        turned = np.arctan2(leading, self.look_ahead)
        course = wrap_angle(errors.course - turned[:, 0])
        slope = np.clip(errors.slope + turned[:, 1], -self.steepest, self.steepest)
        return (course, slope), after


@dataclass(frozen=True)
class SeabedFollower:
    """Depth command that keeps an altitude over a seabed measured by an altimeter.

    The depth of the seabed, vehicle depth plus range, and its slope along the path are estimated by an
    alpha-beta filter.
    """

    altitude: float
    """Altitude to keep [m]."""
    time_constant: float = 1.5
    """Time constant of the filter [s]."""
    ahead: float = 1.0
    """Time for which the slope is extrapolated [s]."""

    def reset(self, n: int = 1) -> Array:
        """Return the initial depth of the seabed [m] and its rate [m/s]: unknown, (n, 2)."""
        return np.full((n, 2), np.nan)

    def depth(
        self, memory: Array, depth: npt.ArrayLike, altitude: npt.ArrayLike, period: float
    ) -> tuple[Array, Array, Array]:
        """Return the commanded depth [m] and its rate [m/s], (n,) each, and the new memory.

        It is the vehicle's depth until the first measurement of the seabed.

        Args:
            memory: Memory from `reset` or the previous call [m, m/s], (n, 2).
            depth: Depth of the vehicle below the surface [m], (n,).
            altitude: Altitude measured above the seabed [m], (n,); not finite without a measurement.
            period: Time since the previous call [s].
        """
        own = np.asarray(depth, float)
        seen = np.where(np.isfinite(altitude), own + np.asarray(altitude, float), np.nan)
        before = np.where(np.isnan(memory), np.column_stack([seen, np.zeros_like(seen)]), memory)
        share = 1.0 - math.exp(-period / self.time_constant)
        expected = before[:, 0] + period * before[:, 1]
        miss = np.where(np.isfinite(seen), seen - expected, 0.0)
        bed = expected + (1.0 - (1.0 - share) ** 2) * miss
        rate = before[:, 1] + share**2 / period * miss
        wanted = bed + self.ahead * rate - self.altitude
        return np.where(np.isnan(bed), own, wanted), np.nan_to_num(rate), np.column_stack([bed, rate])
