"""What happens to an error state besides prediction and correction: restarts, stops, bounds. One state each."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from finssim.geometry.rotations import quat_from_rotvec, quat_multiply
from finssim.localization.fusion.error_state import InertialState

__all__ = ["capped", "parted", "restarted", "stopped", "turned"]

Array = npt.NDArray[np.float64]


def restarted(
    state: InertialState, axes: list[int], value: Array, R: Array, speed_std: float
) -> InertialState:
    """Forget position and velocity of some axes, 0 to 2, and start them at a measurement.

    Args:
        state: Before.
        axes: Position axes to restart.
        value: Their positions [m], (n,).
        R: Covariance of `value` [m²], (n, n).
        speed_std: Standard deviation of the velocity per axis [m/s].
    """
    rows = axes + [axis + 3 for axis in axes]
    p, v, covariance = state.p.copy(), state.v.copy(), state.covariance.copy()
    covariance[rows, :] = 0.0
    covariance[:, rows] = 0.0
    p[axes], v[axes] = value, 0.0
    covariance[np.ix_(axes, axes)] = R
    covariance[rows[len(axes) :], rows[len(axes) :]] = speed_std**2
    return replace(state, p=p, v=v, covariance=covariance)


def stopped(state: InertialState, axes: list[int]) -> InertialState:
    """Stop some axes: their velocity becomes zero, and what it was becomes doubt about it."""
    rows = [axis + 3 for axis in axes]
    v, covariance = state.v.copy(), state.covariance.copy()
    covariance[rows, rows] += v[axes] ** 2
    v[axes] = 0.0
    return replace(state, v=v, covariance=covariance)


def parted(state: InertialState, axes: list[int], walk: float) -> InertialState:
    """Some positions told apart from all other errors, and their variances grown by `walk` [m²]."""
    covariance = state.covariance.copy()
    own = covariance[np.ix_(axes, axes)] + walk * np.eye(len(axes))
    covariance[axes, :] = 0.0
    covariance[:, axes] = 0.0
    covariance[np.ix_(axes, axes)] = own
    return replace(state, covariance=covariance)


def turned(state: InertialState, angle: float, variance: float) -> InertialState:
    """Turn the attitude about the pool's z by `angle` [rad], and forget what was known of it."""
    covariance = state.covariance.copy()
    covariance[8, :] = 0.0
    covariance[:, 8] = 0.0
    covariance[8, 8] = variance
    return replace(
        state, q=quat_multiply(quat_from_rotvec(np.array([0.0, 0.0, angle])), state.q), covariance=covariance
    )


def capped(state: InertialState, variance: float, tilt: float) -> InertialState:
    """The state with bounded doubt: rows and columns beyond are scaled down together.

    Args:
        state: Before.
        variance: Largest of a position [m²].
        tilt: Largest standard deviation of roll and pitch [rad].
    """
    d = np.diagonal(state.covariance)
    limit = np.array([variance] * 3 + [np.inf] * 3 + [tilt**2] * 2 + [10.0] + [np.inf] * (len(d) - 9))
    if np.all(d <= limit):
        return state
    scale = np.sqrt(np.minimum(1.0, limit / np.maximum(d, 1e-300)))
    return replace(state, covariance=state.covariance * scale[:, None] * scale[None, :])
