"""Position and velocity in the pool frame (paper, eq. 14), predicted between measurements, over a leading `...` batch.

The functions take any state that begins with position and velocity.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Self, TypeVar

import numpy as np
import numpy.typing as npt

from finssim.localization.fusion.kalman import MatrixState, bounded, isolated
from finssim.localization.fusion.streams import changed

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class PositionState(MatrixState):
    """State of a filter that begins with position and velocity."""

    x: Array
    """Position [m] and velocity [m/s], pool frame, (..., 6)."""
    P: Array
    """Covariance of the errors in their units, those of `x` first, (..., n, n)."""

    def moved(self, error: Array, P: Array) -> Self:
        """Return the state corrected by an error (..., n), with a new covariance (..., n, n).

        Errors have the units of the state.
        """
        return changed(self, x=self.x + error, P=P)


S = TypeVar("S", bound=PositionState)


@dataclass(frozen=True)
class MotionModel:
    """Model of a vehicle's motion between measurements, per axis of the pool frame.

    Position is the integral of velocity, and velocity that of white acceleration of density q, so that over dt

        Q = q [dt³/3  dt²/2; dt²/2  dt].

    With `decay` λ > 0 the velocity decays to zero, v_dot = -λ v + w, as in water: its variance then
    converges to q / 2λ instead of growing without bound.
    """

    density: tuple[float, float, float] = (0.05, 0.05, 0.02)
    """Spectral density q of the acceleration [m²/s³]."""
    decay: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Rate λ at which velocity decays [1/s]."""


_I6 = np.eye(6)
_SHIFT = np.eye(6, k=3)


def transition(dt: float, motion: MotionModel) -> Array:
    """Return the transition matrix A of one step, (6, 6): [I, dt I; 0, I] without decay (paper, eq. 14)."""
    if not any(motion.decay):
        return _I6 + dt * _SHIFT
    rate = np.array(motion.decay)
    A = np.eye(6)
    decay = np.exp(-rate * dt)
    reach = np.where(rate > 0.0, -np.expm1(-rate * dt) / np.where(rate > 0.0, rate, 1.0), dt)
    A[[0, 1, 2], [3, 4, 5]] = reach
    A[[3, 4, 5], [3, 4, 5]] = decay
    return A


def process_noise(dt: float, motion: MotionModel) -> Array:
    """Return the process noise Q of one step, (6, 6); see `MotionModel`."""
    if not any(motion.decay):
        powers = np.array([dt, 0.5 * dt**2, dt**3 / 3.0])
        return np.asarray((powers @ _noise_powers(motion)).reshape(6, 6))
    q, rate = np.array(motion.density), np.array(motion.decay)
    slow = rate * dt < 1e-4  # below it, cancellation makes the closed form inaccurate
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
def _noise_powers(motion: MotionModel) -> Array:
    """Return the coefficients of dt, dt²/2 and dt³/3 in the noise of a step without decay, (3, 36)."""
    first, second, third = powers = np.zeros((3, 6, 6))
    i, j = [0, 1, 2], [3, 4, 5]
    first[j, j] = second[i, j] = second[j, i] = third[i, i] = motion.density
    return powers.reshape(3, 36)


def predict(state: S, dt: float, motion: MotionModel) -> S:
    """Return the state after a time step.

    x <- A x,  P <- A P A' + Q                                                        (paper, eq. 14)

    Args:
        state: State before the step.
        dt: Length of the step [s], not negative.
        motion: Model of the vehicle's motion.
    """
    F, Q = A, added = transition(dt, motion), process_noise(dt, motion)
    n = state.P.shape[-1]
    if n > 6:
        F, Q = np.eye(n), np.zeros((n, n))
        F[:6, :6], Q[:6, :6] = A, added
    return changed(state, x=state.x @ A.T, P=F @ state.P @ F.T + Q)


def restarted(state: S, axes: list[int], value: Array, R: Array, speed_std: float) -> S:
    """Restart some axes at a measurement, with zero velocity of standard deviation `speed_std`.

    Args:
        state: State before the restart.
        axes: Position axes to restart, of 0, 1, 2.
        value: Positions of these axes [m], (..., n).
        R: Covariance of `value` [m²], (..., n, n).
        speed_std: Standard deviation of the velocity per axis [m/s].
    """
    speeds, n = [axis + 3 for axis in axes], len(axes)
    x = state.x.copy()
    x[..., axes], x[..., speeds] = value, 0.0
    block = np.zeros((*x.shape[:-1], 2 * n, 2 * n))
    block[..., :n, :n], block[..., n:, n:] = R, speed_std**2 * np.eye(n)
    return changed(state, x=x, P=isolated(state.P, axes + speeds, block))


def frozen(state: S, axes: list[int]) -> S:
    """Return the state with some axes stopped: their velocity becomes zero, and its square is added to its
    variance."""
    speeds = [axis + 3 for axis in axes]
    x, P = state.x.copy(), state.P.copy()
    P[..., speeds, speeds] += x[..., speeds] ** 2
    x[..., speeds] = 0.0
    return changed(state, x=x, P=P)


def capped(state: S, variance: float) -> S:
    """Return the state with position variances of at most `variance` [m²]."""
    if state.P.diagonal(0, -2, -1)[..., :3].max() <= variance:
        return state
    return changed(state, P=bounded(state.P, np.array([variance] * 3 + [np.inf] * (state.P.shape[-1] - 3))))
