"""Samples of the sensors that reach the estimator, each with the time at which it was true and its arrival."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from math import isfinite
from typing import Any, Protocol, TypeVar

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


# Records with some fields changed, hundreds of times a second.

T = TypeVar("T")


def changed(record: T, **fields: Any) -> T:
    """Return a changed frozen dataclass, faster than `dataclasses.replace`, if its constructor checks nothing.

    Args:
        record: The record, which stays as it is.
        fields: New values by field name.
    """
    new = object.__new__(type(record))
    new.__dict__.update(record.__dict__, **fields)
    return new


@dataclass(frozen=True)
class ImuSample:
    """Angular rate, and the other readings of the unit."""

    time: float
    """When it was measured [s]."""
    omega: tuple[float, float, float]
    """Angular rate, body frame [rad/s]."""
    force: tuple[float, float, float] | None = None
    """Specific force at the accelerometer, body frame [m/s²]; +9.81 upwards at rest."""
    tilt: tuple[float, float] | None = None
    """Roll and pitch from the unit's own filter [rad]; positive pitch is nose down."""
    arrival: float | None = None
    """When it was delivered [s]; None: with its time."""
    stream: str = field(default="imu", init=False)


@dataclass(frozen=True)
class DepthSample:
    """Pressure depth."""

    time: float
    """When it was measured [s]."""
    depth: float
    """Depth of the pressure port below the surface, positive down [m]."""
    arrival: float | None = None
    """When it was delivered [s]; None: with its time."""
    stream: str = field(default="depth", init=False)


@dataclass(frozen=True)
class VisionSample:
    """Pose of the vehicle by the camera, motion capture or an acoustic positioning system."""

    time: float
    """Middle of the exposure [s]: the picture's stamp less the camera's latency."""
    position: tuple[float, float]
    """x, y of the body origin, pool frame [m]."""
    yaw: float | None
    """Left positive, pool frame [rad]; None where it is not known."""
    covariance: tuple[tuple[float, float, float], ...] | None = None
    """Covariance of x, y [m] and yaw [rad], (3, 3); None: that of the settings."""
    arrival: float | None = None
    """When it was delivered [s]; None: with its time."""
    stream: str = field(default="vision", init=False)


@dataclass(frozen=True)
class VelocitySample:
    """Velocity over the floor, of a Doppler velocity log."""

    time: float
    """When it was measured [s]."""
    velocity: tuple[float, float, float]
    """Velocity at the log's position, body axes [m/s]."""
    arrival: float | None = None
    """When it was delivered [s]; None: with its time."""
    std: float = 0.0
    """Standard deviation per axis [m/s], where it is greater than that of the vehicle's log."""
    stream: str = field(default="velocity", init=False)


@dataclass(frozen=True)
class HeadingSample:
    """Heading of a compass."""

    time: float
    """When it was measured [s]."""
    yaw: float
    """Left positive, pool frame [rad]."""
    arrival: float | None = None
    """When it was delivered [s]; None: with its time."""
    stream: str = field(default="heading", init=False)


class Sample(Protocol):
    """Sample of any sensor: a dataclass of numbers and tuples of numbers."""

    @property
    def time(self) -> float:
        """Time of the measurement [s]."""

    @property
    def arrival(self) -> float | None:
        """Time of delivery [s]; None: with its time."""

    @property
    def stream(self) -> str:
        """Stream to which it belongs."""


def refusal(sample: Sample) -> str | None:
    """Return why a sample cannot be used in any case, or None: text for counting, such as "not finite"."""
    for name, value in vars(sample).items():
        if value is None or value.__class__ is str or name == "covariance":
            continue
        if not isfinite(sum(value) if value.__class__ is tuple else value):
            return "time not finite" if name in ("time", "arrival") else "not finite"
    covariance = vars(sample).get("covariance")
    return None if covariance is None or _covariance(covariance) else "covariance not positive"


def _covariance(rows: tuple[tuple[float, float, float], ...]) -> bool:
    """Return whether rows are a symmetric matrix that can be a covariance with nothing known exactly."""
    if len(rows) != 3 or any(len(row) != 3 for row in rows):
        return False
    (a, d, e), (D, b, f), (E, F, c) = rows
    largest = max(map(abs, (a, b, c, d, D, e, E, f, F)))
    if not math.isfinite(sum(map(abs, (a, b, c, d, D, e, E, f, F)))):
        return False
    if max(abs(d - D), abs(e - E), abs(f - F)) > 1e-6 * largest:
        return False
    # Sylvester: positive where the leading minors are.
    second = a * b - d * d
    return a > 0.0 and second > 0.0 and c * second - a * f * f - b * e * e + 2.0 * d * e * f > 0.0


# What comes out: what became of a sample, and where the vehicle is.


USED = ("accepted", "initialized", "reacquired")
"""Verdicts on samples that update the state."""


@dataclass(frozen=True)
class Outcome:
    """Result of one sample."""

    stream: str
    """`vision` (x and y), `yaw`, `depth` or `imu`."""
    verdict: str
    """`accepted`, `initialized` or `reacquired`; else why it was refused: `gate`, `duplicate`, `too late`, ..."""
    mahalanobis: float = math.nan
    """Squared Mahalanobis distance from the prediction [-]."""
    dimension: int = 0

    @property
    def used(self) -> bool:
        """Return whether the state was updated by it."""
        return self.verdict in USED


@dataclass(frozen=True)
class PoseEstimate:
    """Pose of the vehicle at one time. NaN: not known yet."""

    time: float
    """Time of the pose [s]."""
    x: Array
    """Position [m] and velocity [m/s] of the body origin, pool frame, (6,)."""
    P: Array
    """Covariance of `x` [m, m/s], (6, 6)."""
    yaw: float
    """[rad]"""
    yaw_variance: float
    """Variance of yaw [rad²]."""
    yaw_rate: float
    """[rad/s]"""
    roll: float
    """[rad]"""
    pitch: float
    """[rad]"""
    vision_time: float | None
    """Time of the latest position fix that was believed [s]."""
    depth_time: float | None
    """Time of the latest depth [s]."""
    imu_time: float | None
    """Time of the latest IMU sample [s]."""
    velocity_time: float | None = None
    """Time of the latest Doppler velocity that was believed [s]."""

    def std(self) -> Array:
        """Return the standard deviations of position [m], velocity [m/s] and yaw [rad], (7,)."""
        return np.asarray(np.sqrt(np.array([*self.P.diagonal().tolist(), self.yaw_variance])))
