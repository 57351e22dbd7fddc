"""Samples of the sensors, each with the time of its measurement and of its arrival, and results of the estimator."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from math import isfinite
from typing import Any, Protocol, TypeVar

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


# Fast copies of records with some fields changed, made hundreds of times per second.

T = TypeVar("T")


def changed(record: T, **fields: Any) -> T:
    """Return a changed copy of a frozen dataclass, faster than `dataclasses.replace`, without running its
    constructor.

    Args:
        record: The record, which is not modified.
        fields: New values by field name.
    """
    new = object.__new__(type(record))
    new.__dict__.update(record.__dict__, **fields)
    return new


@dataclass(frozen=True)
class ImuSample:
    """Angular rate, and the other measurements of an IMU."""

    time: float
    """Time of the measurement [s]."""
    omega: tuple[float, float, float]
    """Angular rate, body frame [rad/s]."""
    force: tuple[float, float, float] | None = None
    """Specific force at the accelerometer, body frame [m/s²]; +9.81 upwards at rest."""
    tilt: tuple[float, float] | None = None
    """Roll and pitch from the IMU's own filter [rad]; positive pitch is nose down."""
    arrival: float | None = None
    """Time of delivery [s]; None: equal to its time."""
    stream: str = field(default="imu", init=False)


@dataclass(frozen=True)
class DepthSample:
    """Depth from pressure."""

    time: float
    """Time of the measurement [s]."""
    depth: float
    """Depth of the pressure port below the surface, positive down [m]."""
    arrival: float | None = None
    """Time of delivery [s]; None: equal to its time."""
    stream: str = field(default="depth", init=False)


@dataclass(frozen=True)
class VisionSample:
    """Pose of the vehicle from the camera, motion capture or an acoustic positioning system."""

    time: float
    """Middle of the exposure [s]: the picture's stamp minus the camera's latency."""
    position: tuple[float, float]
    """x, y of the body origin, pool frame [m]."""
    yaw: float | None
    """Yaw, positive to the left, pool frame [rad]; None if unknown."""
    covariance: tuple[tuple[float, float, float], ...] | None = None
    """Covariance of x, y [m] and yaw [rad], (3, 3); None: that of the settings."""
    arrival: float | None = None
    """Time of delivery [s]; None: equal to its time."""
    stream: str = field(default="vision", init=False)


@dataclass(frozen=True)
class VelocitySample:
    """Velocity over ground, from a Doppler velocity log."""

    time: float
    """Time of the measurement [s]."""
    velocity: tuple[float, float, float]
    """Velocity at the log's position, body axes [m/s]."""
    arrival: float | None = None
    """Time of delivery [s]; None: equal to its time."""
    std: float = 0.0
    """Standard deviation per axis [m/s], used if greater than that of the vehicle's log."""
    stream: str = field(default="velocity", init=False)


@dataclass(frozen=True)
class HeadingSample:
    """Heading from a compass."""

    time: float
    """Time of the measurement [s]."""
    yaw: float
    """Yaw, positive to the left, pool frame [rad]."""
    arrival: float | None = None
    """Time of delivery [s]; None: equal to its time."""
    stream: str = field(default="heading", init=False)


class Sample(Protocol):
    """Sample of any sensor: a dataclass of numbers and tuples of numbers."""

    @property
    def time(self) -> float:
        """Time of the measurement [s]."""

    @property
    def arrival(self) -> float | None:
        """Time of delivery [s]; None: equal to its time."""

    @property
    def stream(self) -> str:
        """Stream to which the sample belongs."""


def refusal(sample: Sample) -> str | None:
    """Return the reason why a sample can never be used, such as "not finite", or None."""
    for name, value in vars(sample).items():
        if value is None or value.__class__ is str or name == "covariance":
            continue
        if not isfinite(sum(value) if value.__class__ is tuple else value):
            return "time not finite" if name in ("time", "arrival") else "not finite"
    covariance = vars(sample).get("covariance")
    return None if covariance is None or _covariance(covariance) else "covariance not positive"


def _covariance(rows: tuple[tuple[float, float, float], ...]) -> bool:
    """Return whether rows form a symmetric, positive definite matrix."""
    if len(rows) != 3 or any(len(row) != 3 for row in rows):
        return False
    (a, d, e), (D, b, f), (E, F, c) = rows
    largest = max(map(abs, (a, b, c, d, D, e, E, f, F)))
    if not math.isfinite(sum(map(abs, (a, b, c, d, D, e, E, f, F)))):
        return False
    if max(abs(d - D), abs(e - E), abs(f - F)) > 1e-6 * largest:
        return False
    # Sylvester's criterion: positive definite if the leading minors are positive.
    second = a * b - d * d
    return a > 0.0 and second > 0.0 and c * second - a * f * f - b * e * e + 2.0 * d * e * f > 0.0


# Results: the outcome of a sample, and the pose of the vehicle.


USED = ("accepted", "initialized", "reacquired")
"""Verdicts on samples that update the state."""


@dataclass(frozen=True)
class Outcome:
    """Result of one sample."""

    stream: str
    """Sensor: `vision` (x and y), `yaw`, `depth`, `imu`, `heading` or `velocity`."""
    verdict: str
    """`accepted`, `initialized` or `reacquired`; else the reason of the refusal: `gate`, `duplicate`, `too
    late`, ..."""
    mahalanobis: float = math.nan
    """Squared Mahalanobis distance from the prediction [-]."""
    dimension: int = 0

    @property
    def used(self) -> bool:
        """Return whether the sample updated the state."""
        return self.verdict in USED


@dataclass(frozen=True)
class PoseEstimate:
    """Pose of the vehicle at one time. NaN: not yet known."""

    time: float
    """Time of the pose [s]."""
    x: Array
    """Position [m] and velocity [m/s] of the body origin, pool frame, (6,)."""
    P: Array
    """Covariance of `x` [m, m/s, squared], (6, 6)."""
    yaw: float
    """Yaw [rad]."""
    yaw_variance: float
    """Variance of yaw [rad²]."""
    yaw_rate: float
    """Rate of yaw [rad/s]."""
    roll: float
    """Roll [rad]."""
    pitch: float
    """Pitch [rad]."""
    vision_time: float | None
    """Time of the latest accepted position fix [s]."""
    depth_time: float | None
    """Time of the latest depth [s]."""
    imu_time: float | None
    """Time of the latest IMU sample [s]."""
    velocity_time: float | None = None
    """Time of the latest accepted Doppler velocity [s]."""

    def std(self) -> Array:
        """Return the standard deviations of position [m], velocity [m/s] and yaw [rad], (7,)."""
        return np.asarray(np.sqrt(np.array([*self.P.diagonal().tolist(), self.yaw_variance])))
