"""The tables that wrench allocation looks up, computed once per vehicle in float64."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from finssim.control.errors import ControlError
from finssim.physics.types import MAX_THRUSTERS

__all__ = ["REGULARISATION", "Tables", "regularisation_weight", "tables"]

Array = npt.NDArray[np.float64]

REGULARISATION = 1e-4
"""Default lambda, as a fraction of the mean non-zero eigenvalue of B' W^2 B: wrenches within reach are met to 1e-4."""


def regularisation_weight(
    B: npt.ArrayLike, weights: npt.ArrayLike, regularisation: float = REGULARISATION
) -> float:
    """lambda [1/N^2] of the objective: `regularisation` times the mean non-zero eigenvalue of B' W^2 B."""
    WB = np.asarray(weights, float)[:, None] * np.asarray(B, float)
    return regularisation * float(np.sum(WB**2)) / float(np.linalg.matrix_rank(WB))


class Tables(NamedTuple):
    """Fields of `allocation.AllocationData` for one vehicle type, padded with absent thrusters (no gain, no thrust)."""

    gain: npt.NDArray[np.float32]
    """Columns of H^-1 B' W^2, (6, 8)."""

    clamped: npt.NDArray[np.float32]
    """Columns of the map d -> (f_F - f0_F, mu) for each set of thrusters at a limit, (256, 8, 8)."""

    hessian: npt.NDArray[np.float32]
    """Columns of H / h, h the mean of its diagonal, (8, 8)."""

    lower: npt.NDArray[np.float32]
    """Least thrust [N], (8,)."""

    upper: npt.NDArray[np.float32]
    """Greatest thrust [N], (8,)."""


def tables(
    B: npt.ArrayLike,
    lower: npt.ArrayLike,
    upper: npt.ArrayLike,
    weights: npt.ArrayLike,
    regularisation: float = REGULARISATION,
) -> Tables:
    """Tables of one vehicle type; arguments as one entry of `allocation.allocation_data`.

    Raises:
        ControlError: Wrong shapes, limits that exclude zero, or numbers that make the problem singular.
    """
    B, W = np.asarray(B, float), np.asarray(weights, float)
    low, high = np.asarray(lower, float), np.asarray(upper, float)
    n = B.shape[-1]
    if B.shape != (6, n) or n > MAX_THRUSTERS or low.shape != (n,) or high.shape != (n,) or W.shape != (6,):
        raise ControlError(
            f"allocation got B {B.shape}, limits {low.shape} and {high.shape}, weights {W.shape}: "
            f"expected (6, n), (n,), (n,), (6,) with n <= {MAX_THRUSTERS}"
        )
    if not (np.isfinite([*B.ravel(), *low, *high, *W]).all() and (low <= 0.0).all() and (high >= 0.0).all()):
        raise ControlError("allocation needs finite numbers and limits with lower <= 0 <= upper")
    if not ((W >= 0.0).all() and np.any(W[:, None] * B) and 1e-8 <= regularisation <= 1.0):
        raise ControlError(
            "allocation needs weights >= 0, one of them on an axis with thrust, and regularisation in 1e-8 to 1"
        )

    WB = W[:, None] * B
    H = WB.T @ WB + regularisation_weight(B, W, regularisation) * np.eye(n)
    h = np.trace(H) / n
    gain = np.zeros((6, MAX_THRUSTERS))
    gain[:, :n] = np.linalg.solve(H, WB.T * W).T
    hessian = np.zeros((MAX_THRUSTERS, MAX_THRUSTERS))
    hessian[:n, :n] = H / h

    clamped = np.zeros((1 << MAX_THRUSTERS, MAX_THRUSTERS, MAX_THRUSTERS))
    for mask in range(1, 1 << n):
        at_limit = (mask >> np.arange(n)) & 1 == 1
        C, F = np.flatnonzero(at_limit), np.flatnonzero(~at_limit)
        response = -np.linalg.solve(H[np.ix_(F, F)], H[np.ix_(F, C)])
        clamped[mask][np.ix_(C, F)] = response.T
        clamped[mask][np.ix_(C, C)] = (H[np.ix_(C, C)] + H[np.ix_(C, F)] @ response) / h
    return Tables(
        gain.astype(np.float32),
        clamped.astype(np.float32),
        hessian.astype(np.float32),
        _toward_zero(low),
        _toward_zero(high),
    )


def _toward_zero(limits: npt.NDArray[np.float64]) -> npt.NDArray[np.float32]:
    """Limits as eight float32, rounded so that none lies outside its float64 value."""
    rounded = np.zeros(MAX_THRUSTERS, np.float32)
    nearest = limits.astype(np.float32)
    beyond = np.abs(nearest.astype(float)) > np.abs(limits)
    rounded[: len(limits)] = np.where(beyond, np.nextafter(nearest, np.float32(0.0)), nearest)
    return rounded
