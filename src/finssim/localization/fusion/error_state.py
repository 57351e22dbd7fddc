"""Error-state filter with the IMU's acceleration: pure functions over a leading `...` batch.

Nominal state: position and velocity of the IMU in the pool frame, attitude, gyro bias, accelerometer bias. Error state
(15): [δp, δv, δθ, δb_g, δb_a], with the attitude error in pool axes, R = exp([δθ]x) R̂.

With a Doppler log or a compass it has five more (20): [δb_c, δs, δb_v], their offsets and the log's scale.

    p_dot = v,  v_dot = R (f - b_a) + g,  R_dot = R [ω - b_g]x
    δp_dot = δv,  δv_dot = -[R (f - b_a)]x δθ - R δb_a + n_a,  δθ_dot = -R δb_g + n_g
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from finssim.geometry.rotations import cross, quat_from_rotvec, quat_multiply, quat_to_matrix, skew
from finssim.localization.fusion.changed import changed
from finssim.localization.fusion.position_filter import Motion, process_noise, transition

__all__ = [
    "AIDED",
    "ErrorStateNoise",
    "InertialState",
    "correct",
    "depth_model",
    "drift",
    "error_innovation",
    "heading_model",
    "position_model",
    "predict",
    "velocity_model",
    "yaw_model",
]

Array = npt.NDArray[np.float64]

P, V, A, G, B = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12), slice(12, 15)
"""Where δp, δv, δθ, δb_g and δb_a stand in the error state."""
C, S, D = 15, 16, slice(17, 20)
"""Where the offset of the compass, the scale and the offset of the Doppler log stand in the aided one."""
AIDED = 5
"""Numbers that log and compass add."""
_I = {n: np.eye(n) for n in (15, 15 + AIDED)}


@dataclass(frozen=True)
class InertialState:
    """What the filter knows."""

    p: Array
    """Position of the IMU, pool frame [m], (..., 3)."""
    v: Array
    """Its velocity, pool frame [m/s], (..., 3)."""
    q: Array
    """Attitude q_pb, body to pool, xyzw, (..., 4)."""
    gyro_bias: Array
    """Body frame [rad/s], (..., 3)."""
    accel_bias: Array
    """Body frame [m/s²], (..., 3)."""
    covariance: Array
    """Of the error state, (..., n, n): n = 15, or 20 with `extra`."""
    extra: Array = field(default_factory=lambda: np.zeros(0))
    """Offset of the compass [rad], scale error [-] and offset of the Doppler log [m/s], (..., 5); none: (0,)."""


@dataclass(frozen=True)
class ErrorStateNoise:
    """Noise densities of the IMU."""

    gyro: float
    """[rad/s/√Hz]"""
    accel: float
    """[m/s²/√Hz]"""
    gyro_walk: float
    """[rad/s²/√Hz]"""
    accel_walk: float
    """[m/s³/√Hz]"""
    log_walk: float = 0.0
    """Of the Doppler log's offset [m/s²/√Hz]."""


def predict(
    state: InertialState, omega: Array, force: Array, dt: float, noise: ErrorStateNoise, gravity: Array
) -> InertialState:
    """The state a time later, with rate and force constant over the step and the attitude of its middle.

    Args:
        state: Before.
        omega: Angular rate, body frame [rad/s], (..., 3).
        force: Specific force at the IMU, body frame [m/s²], (..., 3).
        dt: Length of the step [s].
        noise: Of the IMU.
        gravity: Pool frame [m/s²], (3,): downwards.
    """
    turn = (omega - state.gyro_bias) * dt
    R = quat_to_matrix(quat_multiply(state.q, quat_from_rotvec(0.5 * turn)))
    pushed = (R @ (force - state.accel_bias)[..., None])[..., 0]
    a = pushed + gravity
    q = quat_multiply(state.q, quat_from_rotvec(turn))
    n = state.covariance.shape[-1]
    F = np.broadcast_to(_I[n], (*turn.shape[:-1], n, n)).copy()
    F[..., P, V] = dt * _I[15][:3, :3]
    swing, turned = dt * skew(pushed), dt * R
    F[..., V, A], F[..., P, A] = -swing, (-0.5 * dt) * swing
    F[..., V, B], F[..., P, B] = -turned, (-0.5 * dt) * turned
    F[..., A, G] = -turned
    covariance = F @ state.covariance @ np.swapaxes(F, -1, -2) + _noise(dt, noise, n)
    return changed(
        state,
        p=state.p + dt * state.v + 0.5 * dt**2 * a,
        v=state.v + dt * a,
        q=q / np.linalg.norm(q, axis=-1, keepdims=True),
        covariance=0.5 * (covariance + np.swapaxes(covariance, -1, -2)),
    )


def drift(state: InertialState, dt: float, motion: Motion, turning: float) -> InertialState:
    """The state a time later without the IMU: it moves as the position filter has it, and may turn any way.

    Args:
        state: Before.
        dt: Time that passes [s].
        motion: How the vehicle may move.
        turning: Noise density of its rates [rad/s/√Hz].
    """
    n = state.covariance.shape[-1]
    F = np.eye(n)
    F[:6, :6] = transition(dt, motion)
    Q = np.zeros((n, n))
    Q[:6, :6] = process_noise(dt, motion)
    Q[A, A] = turning**2 * dt * np.eye(3)
    moved = np.concatenate([state.p, state.v], axis=-1) @ F[:6, :6].T
    covariance = F @ state.covariance @ F.T + Q
    return changed(state, p=moved[..., :3], v=moved[..., 3:], covariance=covariance)


def _noise(dt: float, noise: ErrorStateNoise, n: int) -> Array:
    """Covariance that one step adds, (n, n): the same in every direction, so that no axes need to turn."""
    first, second, third = _noise_powers(noise, n)
    return dt * first + (0.5 * dt**2) * second + (dt**3 / 3.0) * third


@lru_cache(maxsize=8)
def _noise_powers(noise: ErrorStateNoise, n: int) -> tuple[Array, Array, Array]:
    """What goes with dt, dt²/2 and dt³/3 in the noise of a step, (n, n) each."""
    first, second, third = np.zeros((3, n, n))
    if n > 15:
        first[D, D] = noise.log_walk**2 * np.eye(3)
    i = np.arange(3)
    third[i, i] = second[i, i + 3] = second[i + 3, i] = first[i + 3, i + 3] = noise.accel**2
    first[i + 6, i + 6] = noise.gyro**2
    first[i + 9, i + 9] = noise.gyro_walk**2
    first[i + 12, i + 12] = noise.accel_walk**2
    return first, second, third


def position_model(state: InertialState, lever: Array) -> tuple[Array, Array]:
    """Where a body point is, and how the errors move it.

    Args:
        state: The state.
        lever: The point from the IMU, body frame [m], (3,).

    Returns:
        Position, pool frame [m], (..., 3), and its Jacobian, (..., 3, 15).
    """
    arm = (quat_to_matrix(state.q) @ lever[:, None])[..., 0]
    H = np.zeros((*arm.shape[:-1], 3, state.covariance.shape[-1]))
    H[..., range(3), range(3)] = 1.0
    H[..., A] = -skew(arm)
    return state.p + arm, H


def depth_model(state: InertialState, lever: Array, up: Array, offset: float) -> tuple[Array, Array]:
    """Height of a body point above the surface.

    Args:
        state: The state.
        lever: The point from the IMU, body frame [m], (3,).
        up: Normal of the surface, pool frame, (3,).
        offset: Height of p is up . p + offset [m].

    Returns:
        Height [m], (..., 1), and its Jacobian, (..., 1, 15).
    """
    point, H = position_model(state, lever)
    return np.asarray(point @ up[:, None] + offset), np.asarray(up[None, :] @ H)


def yaw_model(state: InertialState) -> tuple[Array, Array]:
    """Yaw of the body x axis, and how the errors turn it.

    With c = R e_x:  dψ = δθ_z - c_z (c_x δθ_x + c_y δθ_y) / (c_x² + c_y²)

    Returns:
        Yaw [rad], (..., 1), and its Jacobian, (..., 1, 15).
    """
    c = quat_to_matrix(state.q)[..., :, 0]
    level = c[..., 0] ** 2 + c[..., 1] ** 2
    H = np.zeros((*c.shape[:-1], 1, state.covariance.shape[-1]))
    H[..., 0, 6] = -c[..., 2] * c[..., 0] / level
    H[..., 0, 7] = -c[..., 2] * c[..., 1] / level
    H[..., 0, 8] = 1.0
    return np.arctan2(c[..., 1], c[..., 0])[..., None], H


def heading_model(state: InertialState) -> tuple[Array, Array]:
    """What a compass reads: yaw and its own offset.

    Returns:
        Heading [rad], (..., 1), and its Jacobian, (..., 1, 20).
    """
    yaw, H = yaw_model(state)
    H[..., 0, C] = 1.0
    return yaw + state.extra[..., :1], H


def velocity_model(state: InertialState, omega: Array, lever: Array) -> tuple[Array, Array]:
    """What a Doppler log reads: (1 + s) [R' v + (ω - b_g) x l] + b_v.

    Args:
        state: The state.
        omega: Angular rate as measured, body frame [rad/s], (..., 3).
        lever: The log from the IMU, body frame [m], (3,).

    Returns:
        Velocity, body frame [m/s], (..., 3), and its Jacobian, (..., 3, 20).
    """
    back = np.swapaxes(quat_to_matrix(state.q), -1, -2)
    own = (back @ state.v[..., None])[..., 0] + cross(omega - state.gyro_bias, lever)
    gain = 1.0 + state.extra[..., 1]
    H = np.zeros((*own.shape[:-1], 3, state.covariance.shape[-1]))
    H[..., V] = gain * back
    H[..., A] = gain * (back @ skew(state.v))
    H[..., G] = gain * skew(lever)
    H[..., S] = own
    H[..., D] = _I[15][:3, :3]
    return gain * own + state.extra[..., 2:], H


def error_innovation(state: InertialState, residual: Array, H: Array, R: Array) -> tuple[Array, Array]:
    """Squared Mahalanobis distance of a residual, and the gain.

    Args:
        state: The prediction.
        residual: Measured minus predicted, (..., m).
        H: Jacobian of the prediction, (..., m, 15).
        R: Covariance of the measurement, (..., m, m).

    Returns:
        Distance (...) and gain (..., 15, m).
    """
    PHt = state.covariance @ np.swapaxes(H, -1, -2)
    S = H @ PHt + R
    inverse = 1.0 / S if S.shape[-1] == 1 else np.linalg.inv(S)
    weighted = (inverse @ residual[..., None])[..., 0]
    return np.asarray(np.sum(residual * weighted, axis=-1)), PHt @ inverse


def correct(state: InertialState, residual: Array, H: Array, R: Array, gain: Array) -> InertialState:
    """The state after a measurement, in Joseph's form; the error is moved into the nominal state.

    Args:
        state: The prediction.
        residual: Measured minus predicted, (..., m).
        H: Jacobian of the prediction, (..., m, 15).
        R: Covariance of the measurement, (..., m, m).
        gain: As `error_innovation` gives it.
    """
    d = (gain @ residual[..., None])[..., 0]
    kept = _I[gain.shape[-2]] - gain @ H
    covariance = kept @ state.covariance @ np.swapaxes(kept, -1, -2)
    covariance = covariance + gain @ R @ np.swapaxes(gain, -1, -2)
    q = quat_multiply(quat_from_rotvec(d[..., A]), state.q)
    return InertialState(
        state.p + d[..., P],
        state.v + d[..., V],
        q / np.linalg.norm(q, axis=-1, keepdims=True),
        state.gyro_bias + d[..., G],
        state.accel_bias + d[..., B],
        0.5 * (covariance + np.swapaxes(covariance, -1, -2)),
        state.extra + d[..., 15:],
    )
