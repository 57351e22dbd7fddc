"""Roll and pitch from a gyro and an accelerometer, for logs without an orientation; yaw from the gyro and fixes.

Roll and pitch come from the explicit complementary filter (Mahony, Hamel and Pflimlin 2008), reduced to the
direction of "up" in the body frame: it leaves yaw unchanged. Pure functions over a leading `...` batch.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from finssim.core.rotations import cross, quat_from_rotvec, quat_rotate, quat_to_matrix
from finssim.localization.fusion.kalman import Innovation, Number

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class TiltGains:
    """Gains of the correction by the accelerometer."""

    proportional: float = 0.4
    """Gain of the tilt correction [1/s]; its inverse is the time constant with which tilt errors decay."""
    integral: float = 0.02
    """Gain of the gyro bias correction [1/s²]."""
    gravity: float = 9.81
    """Acceleration of gravity [m/s²]."""
    tolerance: float = 0.5
    """Standard deviation of the specific force from gravity [m/s²] in the Gaussian weight of a sample."""
    longest_gap: float = 0.5
    """Gap between samples after which the filter restarts from the accelerometer [s]."""


@dataclass(frozen=True)
class Tilt:
    """State of the filter."""

    up: Array
    """Unit vector upwards, body frame, (..., 3)."""
    bias: Array
    """Bias of the gyro, body frame [rad/s], (..., 3); only its horizontal part is estimated."""


def in_body_axes(vector_s: npt.ArrayLike, orientation: npt.ArrayLike) -> Array:
    """Return the reading of an IMU in body axes, in its own unit.

    Args:
        vector_s: Angular rate [rad/s] or specific force [m/s²], sensor frame, (..., 3).
        orientation: Sensor frame to body frame, xyzw: `sensors.imu.orientation` of the vehicle file.
    """
    return quat_rotate(orientation, vector_s)


def up_of(roll: npt.ArrayLike, pitch: npt.ArrayLike) -> Array:
    """Return the unit vector upwards in the body frame from roll φ and pitch θ [rad], (..., 3): the last row
    of R_y(θ) R_x(φ)."""
    roll, pitch = np.asarray(roll, float), np.asarray(pitch, float)
    return np.stack([-np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)], axis=-1)


def height_above_origin(point: tuple[float, float, float], roll: float, pitch: float) -> float:
    """Return the height of a point of the body above the body's origin [m]: `up_of` times it, in plain numbers."""
    x, y, z = point
    return math.cos(pitch) * (math.sin(roll) * y + math.cos(roll) * z) - math.sin(pitch) * x


def roll_pitch(up: Array) -> tuple[Array, Array]:
    """Return the roll and pitch [rad] at which "up" has the body frame direction `up`, (..., 3) -> (...)
    each; positive pitch is nose down."""
    return (
        np.asarray(np.arctan2(up[..., 1], up[..., 2])),
        np.asarray(np.arctan2(-up[..., 0], np.hypot(up[..., 1], up[..., 2]))),
    )


def tilt_from(accel: npt.ArrayLike) -> Tilt:
    """Return the initial state from an accelerometer at rest, which measures gravity upwards.

    Args:
        accel: Specific force, body frame [m/s²], (..., 3), not zero.
    """
    accel = np.asarray(accel, float)
    return Tilt(accel / np.linalg.norm(accel, axis=-1, keepdims=True), np.zeros(accel.shape))


def follow(tilt: Tilt, omega: npt.ArrayLike, accel: npt.ArrayLike, dt: float, gains: TiltGains) -> Tilt:
    """Return the tilt after one sample.

    up_dot = -(ω - b + k_p e) x up,  b_dot = -k_i e,  e = w (f/|f| x up),  w = exp(-(|f| - g)² / 2 tolerance²)

    Args:
        tilt: Tilt before the step.
        omega: Angular rate over the step, body frame [rad/s], (..., 3).
        accel: Specific force, body frame [m/s²], (..., 3); NaN if there is none.
        dt: Length of the step [s].
        gains: Gains of the correction by the accelerometer.
    """
    accel = np.asarray(accel, float)
    force = np.sqrt((accel * accel).sum(axis=-1, keepdims=True))
    usable = np.isfinite(force) & (force > 1e-6)
    weight = np.where(usable, np.exp(-0.5 * ((force - gains.gravity) / gains.tolerance) ** 2), 0.0)
    up_measured = np.where(usable, accel / np.where(usable, force, 1.0), tilt.up)
    error = weight * cross(up_measured, tilt.up)
    turn = np.asarray(omega, float) - tilt.bias + gains.proportional * error
    up = (quat_to_matrix(quat_from_rotvec(-dt * turn)) @ tilt.up[..., None])[..., 0]
    length = np.sqrt((up * up).sum(axis=-1, keepdims=True))
    return Tilt(up / length, np.asarray(tilt.bias - gains.integral * error * dt))


# Yaw from the gyro, corrected by the camera (paper, eq. 15), with the gyro's bias as a second state.
#
# Pure functions of plain numbers or, except restarts and caps, of arrays. Yaw is about the vertical, positive
# to the left.


@dataclass(frozen=True)
class YawState:
    """State of the filter."""

    yaw: Number
    """Yaw [rad], in [-pi, pi)."""
    bias: Number
    """Bias of the gyro's yaw rate [rad/s]."""
    variance: Number
    """Variance of yaw [rad²]."""
    cross: Number
    """Covariance of yaw and bias [rad²/s]."""
    bias_variance: Number
    """Variance of the bias [rad²/s²]."""

    @property
    def P(self) -> Array:
        """Return the covariance of yaw [rad] and bias [rad/s], (..., 2, 2)."""
        rows = np.array([self.variance, self.cross, self.cross, self.bias_variance]).T
        return rows.reshape(*rows.shape[:-1], 2, 2)

    def innovation(self, residual: Array, H: Array, R: Array) -> Innovation:
        """Return the innovation of a measured yaw, computed with plain numbers.

        Args:
            residual: Measured minus predicted, wrapped to the shorter direction [rad], (..., 1).
            H: Jacobian of yaw, [[1, 0]].
            R: Variance of the measurement [rad²], (1, 1).
        """
        rho = residual.item() if residual.ndim == 1 else residual[..., 0]
        S = self.variance + R.item()
        return Innovation(residual, H, R, rho**2 / S, (self.variance / S, self.cross / S))

    def corrected(self, found: Innovation) -> YawState:
        """Return the state after a measurement, in Joseph's form.

        ψ <- ψ + K (ψ_vis - ψ),  K = P / (P + R), and likewise the bias                 (paper, eq. 15)
        """
        rho = found.residual.item() if found.residual.ndim == 1 else found.residual[..., 0]
        (K, L), R = found.gain, found.R.item()
        # P <- [1-K 0; -L 1] P [1-K 0; -L 1]' + R [K L]' [K L]
        retained, cross = 1.0 - K, self.cross - L * self.variance
        return YawState(
            wrapped(self.yaw + K * rho),
            self.bias + L * rho,
            retained * retained * self.variance + R * K * K,
            retained * cross + R * K * L,
            self.bias_variance - L * (self.cross + cross) + R * L * L,
        )


@dataclass(frozen=True)
class YawNoise:
    """Errors of the yaw rate."""

    rate: float = 1e-3
    """Noise density of the rate [rad/s/√Hz]."""
    bias_walk: float = 2e-5
    """Random walk of its bias [rad/s²/√Hz]."""


def yaw_rate(q: float, r: float, roll: float, pitch: float) -> float:
    """Return the rate of yaw from body rates [rad/s].

    psi_dot = (q sin φ + r cos φ) / cos θ

    Body rates are p = φ_dot - ψ_dot sin θ, q = θ_dot cos φ + ψ_dot sin φ cos θ, r = -θ_dot sin φ + ψ_dot cos
    φ cos θ for R = R_z(ψ) R_y(θ) R_x(φ), whether z points up or down: the formula is the same in Fossen's
    axes; in ours, positive r, q and ψ are left, nose down and left. The rate p about body x does not enter.

    Args:
        q: Angular rate about body y [rad/s].
        r: Angular rate about body z [rad/s].
        roll: φ [rad].
        pitch: θ [rad]; not near ±90 degrees, where yaw is not defined.
    """
    return (q * math.sin(roll) + r * math.cos(roll)) / math.cos(pitch)


def predict(state: YawState, rate: Number, dt: float, noise: YawNoise) -> YawState:
    """Return the yaw state after a time step.

    ψ <- ψ + (ω_z - b) dt,  P <- F P F' + Q,  F = [1 -dt; 0 1]                         (paper, eq. 15)

    Args:
        state: State before the step.
        rate: Measured rate of yaw [rad/s].
        dt: Length of the step [s].
        noise: Errors of the rate.
    """
    w, doubt = noise.bias_walk**2, state.bias_variance
    return YawState(
        wrapped(state.yaw + (rate - state.bias) * dt),
        state.bias,
        state.variance + dt * (dt * doubt - 2.0 * state.cross + noise.rate**2) + w * dt**3 / 3.0,
        state.cross - dt * doubt - 0.5 * w * dt**2,
        doubt + w * dt,
    )


def restarted(state: YawState, yaw: float, variance: float, bias_std: float) -> YawState:
    """Restart yaw at a measurement; the bias is kept, with at least its variance at power-on if `bias_std` > 0.

    Args:
        state: State before.
        yaw: Measured yaw [rad].
        variance: Variance of `yaw` [rad²].
        bias_std: Standard deviation of the gyro's bias at power-on [rad/s].
    """
    return YawState(wrapped(yaw), state.bias, variance, 0.0, max(state.bias_variance, bias_std**2))


def capped(state: YawState, variance: float) -> YawState:
    """Return the state with a yaw variance of at most `variance` [rad²], with its covariance scaled accordingly."""
    scale = math.sqrt(min(1.0, variance / state.variance))
    return YawState(
        state.yaw, state.bias, state.variance * scale * scale, state.cross * scale, state.bias_variance
    )


def wrapped(angle: Number) -> Number:
    """Return an angle in [-pi, pi) [rad]."""
    return (angle + math.pi) % math.tau - math.pi
