"""What reaches the estimator: samples of the sensors, each with the time at which it was true and when it came."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

__all__ = ["DepthSample", "ImuSample", "Sample", "VisionSample", "refusal"]

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class ImuSample:
    """Angular rate, and what else the unit tells."""

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
    """Of the pressure port below the surface, positive down [m]."""
    arrival: float | None = None
    """When it was delivered [s]; None: with its time."""
    stream: str = field(default="depth", init=False)


@dataclass(frozen=True)
class VisionSample:
    """Where the camera sees the vehicle."""

    time: float
    """Middle of the exposure [s]: the picture's stamp less the camera's latency."""
    position: tuple[float, float]
    """x, y of the body origin, pool frame [m]."""
    yaw: float | None
    """Left positive, pool frame [rad]; None where it is not known."""
    covariance: tuple[tuple[float, float, float], ...] | None = None
    """Of x, y [m] and yaw [rad], (3, 3); None: the settings' own."""
    arrival: float | None = None
    """When it was delivered [s]; None: with its time."""
    stream: str = field(default="vision", init=False)


Sample: TypeAlias = "ImuSample | DepthSample | VisionSample"


def refusal(sample: Sample) -> str | None:
    """Why a sample cannot be used whatever else is known, or None: text for counting, such as "not finite"."""
    if not _finite(sample.time) or not (sample.arrival is None or _finite(sample.arrival)):
        return "time not finite"
    if isinstance(sample, ImuSample):
        values = (*sample.omega, *(sample.force or ()), *(sample.tilt or ()))
        return None if all(map(_finite, values)) else "not finite"
    if isinstance(sample, DepthSample):
        return None if _finite(sample.depth) else "not finite"
    values = (*sample.position, *(() if sample.yaw is None else (sample.yaw,)))
    if not all(map(_finite, values)):
        return "not finite"
    return None if sample.covariance is None or _covariance(sample.covariance) else "covariance not positive"


def _finite(value: float) -> bool:
    return math.isfinite(value)


def _covariance(rows: tuple[tuple[float, float, float], ...]) -> bool:
    """Whether it is a symmetric matrix that can be a covariance with nothing known exactly."""
    R = np.array(rows, float)
    if R.shape != (3, 3) or not np.isfinite(R).all() or np.abs(R - R.T).max() > 1e-6 * np.abs(R).max():
        return False
    return bool(np.linalg.eigvalsh(R)[0] > 0.0)
