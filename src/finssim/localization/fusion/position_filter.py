"""Position and velocity in the pool frame (paper, eq. 14): pure predict and update over a leading `...` batch."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class PositionState:
    """State of the filter."""

    x: Array
    """Position [m] and velocity [m/s], pool frame, (..., 6)."""
    P: Array
    """Covariance, (..., 6, 6)."""


@dataclass(frozen=True)
class Motion:
    """Model of a vehicle's motion between measurements, per axis of the pool frame.

    Position is the integral of velocity, and velocity that of white acceleration of density q, so that over dt

        Q = q [dt³/3  dt²/2; dt²/2  dt].

    With `decay` λ > 0 the velocity returns to zero, v_dot = -λ v + w, as water slows a vehicle: its variance then
    settles at q / 2λ instead of growing for ever.
    """

    density: tuple[float, float, float] = (0.05, 0.05, 0.02)
    """Spectral density q of the acceleration [m²/s³]."""
    decay: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Rate λ at which velocity dies away [1/s]."""


@dataclass(frozen=True)
class Innovation:
    """Difference between a measurement and its prediction."""

    residual: Array
    """Measured minus predicted, (..., m)."""
    S: Array
    """Its covariance, (..., m, m)."""
    mahalanobis: Array
    """Squared Mahalanobis distance, (...)."""
    gain: Array
    """Gain of the Kalman filter, (..., 6, m)."""


_I6 = np.eye(6)
_SHIFT = np.eye(6, k=3)


def transition(dt: float, motion: Motion) -> Array:
    """Matrix A of one step, (6, 6): [I, dt I; 0, I] where nothing decays (paper, eq. 14)."""
    if not any(motion.decay):
        return _I6 + dt * _SHIFT
    rate = np.array(motion.decay)
    A = np.eye(6)
    decay = np.exp(-rate * dt)
    reach = np.where(rate > 0.0, -np.expm1(-rate * dt) / np.where(rate > 0.0, rate, 1.0), dt)
    A[[0, 1, 2], [3, 4, 5]] = reach
    A[[3, 4, 5], [3, 4, 5]] = decay
    return A


def process_noise(dt: float, motion: Motion) -> Array:
    """Covariance Q that one step adds, (6, 6); see `Motion`."""
    if not any(motion.decay):
        powers = np.array([dt, 0.5 * dt**2, dt**3 / 3.0])
        return np.asarray((powers @ _noise_powers(motion)).reshape(6, 6))
    q, rate = np.array(motion.density), np.array(motion.decay)
    slow = rate * dt < 1e-4  # below it the closed form loses digits that the series keeps
    l = np.where(slow, 1.0, rate)
    decayed = -np.expm1(-l * dt)
    vv = np.where(slow, dt, (1.0 - np.exp(-2.0 * l * dt)) / (2.0 * l))
    pv = np.where(slow, 0.5 * dt**2, decayed**2 / (2.0 * l**2))
    pp = np.where(slow, dt**3 / 3.0, (dt - decayed / l - 0.5 * decayed**2 / l) / l**2)
    Q = np.zeros((6, 6))
    i, j = [0, 1, 2], [3, 4, 5]
    Q[i, i] = q * pp
    Q[i, j] = Q[j, i] = q * pv
    Q[j, j] = q * vv
    return Q


@lru_cache(maxsize=16)
def _noise_powers(motion: Motion) -> Array:
    """Return the coefficients of dt, dt²/2 and dt³/3 in the noise of a step without decay, (3, 36)."""
    first, second, third = powers = np.zeros((3, 6, 6))
    i, j = [0, 1, 2], [3, 4, 5]
    first[j, j] = second[i, j] = second[j, i] = third[i, i] = motion.density
    return powers.reshape(3, 36)


def predict(state: PositionState, dt: float, motion: Motion) -> PositionState:
    """The state a time later.

    x <- A x,  P <- A P A' + Q                                                        (paper, eq. 14)

    Args:
        state: Before.
        dt: Time that passes [s], not negative.
        motion: How the vehicle may move meanwhile.
    """
    A = transition(dt, motion)
    return PositionState(state.x @ A.T, A @ state.P @ A.T + process_noise(dt, motion))


def innovation(state: PositionState, H: Array, z: Array, R: Array) -> Innovation:
    """Compare a measurement z = H x + noise with the prediction.

    Args:
        state: The prediction.
        H: Rows of what is measured, (m, 6).
        z: Measurement, (..., m).
        R: Its covariance, (..., m, m).
    """
    residual = z - state.x @ H.T
    PHt = state.P @ H.T
    S = H @ PHt + R
    inverse = _inverse(S)
    weighted = (inverse @ residual[..., None])[..., 0]
    return Innovation(residual, S, np.asarray(np.sum(residual * weighted, axis=-1)), PHt @ inverse)


def _inverse(S: Array) -> Array:
    """Inverse of symmetric matrices, (..., m, m); np.linalg costs four times as much for a small one."""
    if S.shape[-1] == 1:
        return np.asarray(1.0 / S)
    if S.shape != (2, 2):
        return np.asarray(np.linalg.inv(S), np.float64)
    (a, b), (_, c) = S.tolist()
    determinant = a * c - b * b
    return np.asarray(np.array([[c, -b], [-b, a]]) / determinant)


def correct(state: PositionState, correction: Innovation, H: Array, R: Array) -> PositionState:
    """The state after a measurement, in Joseph's form, which keeps P symmetric and positive whatever is rounded.

    x <- x + K ρ,  P <- (I - K H) P (I - K H)' + K R K'
    """
    K = correction.gain
    retained = _I6 - K @ H
    P = retained @ state.P @ retained.swapaxes(-1, -2) + K @ R @ K.swapaxes(-1, -2)
    x = state.x + (K @ correction.residual[..., None])[..., 0]
    return PositionState(x, 0.5 * (P + P.swapaxes(-1, -2)))


def restarted(
    state: PositionState, axes: list[int], value: Array, R: Array, speed_std: float
) -> PositionState:
    """Forget some axes and start them at a measurement, at rest give or take `speed_std`.

    Args:
        state: Before.
        axes: Position axes to restart, of 0, 1, 2.
        value: Their positions [m], (..., n).
        R: Covariance of `value` [m²], (..., n, n).
        speed_std: Standard deviation of the velocity per axis [m/s].
    """
    speeds = [axis + 3 for axis in axes]
    x, P = state.x.copy(), state.P.copy()
    P[..., axes + speeds, :] = 0.0
    P[..., :, axes + speeds] = 0.0
    x[..., axes], x[..., speeds] = value, 0.0
    P[..., np.array(axes)[:, None], np.array(axes)] = R
    P[..., speeds, speeds] = speed_std**2
    return PositionState(x, P)


def frozen(state: PositionState, axes: list[int]) -> PositionState:
    """Stop some axes: their velocity becomes zero, and what it was becomes doubt about it."""
    speeds = [axis + 3 for axis in axes]
    x, P = state.x.copy(), state.P.copy()
    P[..., speeds, speeds] += x[..., speeds] ** 2
    x[..., speeds] = 0.0
    return PositionState(x, P)


def capped(state: PositionState, variance: float) -> PositionState:
    """No position less certain than `variance` [m²]: rows and columns above it are scaled down together."""
    d = state.P.diagonal(axis1=-2, axis2=-1)[..., :3]
    if d.max() <= variance:
        return state
    scale = np.ones(state.x.shape)
    scale[..., :3] = np.sqrt(np.minimum(1.0, variance / np.maximum(d, 1e-300)))
    return PositionState(state.x, state.P * scale[..., :, None] * scale[..., None, :])
