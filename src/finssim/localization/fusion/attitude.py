"""Roll and pitch from a gyro and an accelerometer, for logs that hold no orientation.

The explicit complementary filter (Mahony, Hamel and Pflimlin 2008), reduced to the direction of "up" in the body: yaw
is not touched. Pure functions over a leading `...` batch.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from finssim.geometry.rotations import quat_from_rotvec, quat_rotate, quat_to_matrix, skew

__all__ = [
    "Tilt",
    "TiltGains",
    "follow",
    "height_above_origin",
    "in_body_axes",
    "roll_pitch",
    "tilt_from",
    "up_of",
]

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class TiltGains:
    """How quickly the accelerometer is believed."""

    proportional: float = 0.4
    """[1/s]: errors of tilt die away with its inverse."""
    integral: float = 0.02
    """[1/s²]: of the gyro's bias."""
    gravity: float = 9.81
    """[m/s²]"""
    tolerance: float = 0.5
    """Specific force that differs this much from gravity [m/s²] counts exp(-1/2) as much, more of it still less."""
    longest_gap: float = 0.5
    """After this long without samples the filter starts again from the accelerometer [s]."""


@dataclass(frozen=True)
class Tilt:
    """Memory of the filter."""

    up: Array
    """Unit vector upwards, body frame, (..., 3)."""
    bias: Array
    """Of the gyro, body frame [rad/s], (..., 3); only its horizontal part is ever learnt."""


def in_body_axes(vector_s: npt.ArrayLike, orientation: npt.ArrayLike) -> Array:
    """What an IMU reads, written in body axes.

    Args:
        vector_s: Angular rate or specific force, sensor frame, (..., 3).
        orientation: Sensor frame to body frame, xyzw: `sensors.imu.orientation` of the vehicle file.
    """
    return quat_rotate(orientation, vector_s)


def up_of(roll: npt.ArrayLike, pitch: npt.ArrayLike) -> Array:
    """Unit vector upwards in the body frame from roll φ and pitch θ [rad], (..., 3): the last row of R_y(θ) R_x(φ)."""
    roll, pitch = np.asarray(roll, float), np.asarray(pitch, float)
    return np.stack([-np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)], axis=-1)


def height_above_origin(point: tuple[float, float, float], roll: float, pitch: float) -> float:
    """How much higher than the body's origin a point of the body is [m]: `up_of` times it, in plain numbers."""
    x, y, z = point
    return math.cos(pitch) * (math.sin(roll) * y + math.cos(roll) * z) - math.sin(pitch) * x


def roll_pitch(up: Array) -> tuple[Array, Array]:
    """Roll and pitch [rad] that show the body that "up", (..., 3) -> (...) each; positive pitch is nose down."""
    return (
        np.asarray(np.arctan2(up[..., 1], up[..., 2])),
        np.asarray(np.arctan2(-up[..., 0], np.hypot(up[..., 1], up[..., 2]))),
    )


def tilt_from(accel: npt.ArrayLike) -> Tilt:
    """Start from an accelerometer at rest, which reads gravity upwards.

    Args:
        accel: Specific force, body frame [m/s²], (..., 3), not zero.
    """
    accel = np.asarray(accel, float)
    return Tilt(accel / np.linalg.norm(accel, axis=-1, keepdims=True), np.zeros(accel.shape))


def follow(tilt: Tilt, omega: npt.ArrayLike, accel: npt.ArrayLike, dt: float, gains: TiltGains) -> Tilt:
    """The tilt a sample later.

    up_dot = -(ω - b + k_p e) x up,  b_dot = -k_i e,  e = w (f/|f| x up),  w = exp(-(|f| - g)² / 2 tolerance²)

    Args:
        tilt: Before.
        omega: Angular rate over the step, body frame [rad/s], (..., 3).
        accel: Specific force, body frame [m/s²], (..., 3); NaN where there is none.
        dt: Length of the step [s].
        gains: How quickly the accelerometer is believed.
    """
    accel = np.asarray(accel, float)
    force = np.sqrt(np.sum(accel * accel, axis=-1, keepdims=True))
    known = np.isfinite(force) & (force > 1e-6)
    weight = np.where(known, np.exp(-0.5 * ((force - gains.gravity) / gains.tolerance) ** 2), 0.0)
    up_measured = np.where(known, accel / np.where(known, force, 1.0), tilt.up)
    error = weight * (skew(up_measured) @ tilt.up[..., None])[..., 0]
    turn = np.asarray(omega, float) - tilt.bias + gains.proportional * error
    up = (quat_to_matrix(quat_from_rotvec(-dt * turn)) @ tilt.up[..., None])[..., 0]
    length = np.sqrt(np.sum(up * up, axis=-1, keepdims=True))
    return Tilt(up / length, np.asarray(tilt.bias - gains.integral * error * dt))
