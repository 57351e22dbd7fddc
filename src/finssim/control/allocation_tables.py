"""The tables that wrench allocation looks up, computed once per vehicle in float64."""

# mypy: disable-error-code="no-untyped-call"

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from finssim.control.allocation import AllocationData
from finssim.control.errors import ControlError
from finssim.physics.types import MAX_THRUSTERS, vec8

__all__ = ["REGULARISATION", "allocation_data", "axis_weights", "regularisation_weight"]

Array = npt.NDArray[np.float64]

REGULARISATION = 1e-4
"""Default lambda, as a fraction of the mean non-zero eigenvalue of B' W^2 B: wrenches within reach are met to 1e-4."""


def allocation_data(
    B: Sequence[npt.ArrayLike],
    lower: Sequence[npt.ArrayLike],
    upper: Sequence[npt.ArrayLike],
    weights: Sequence[npt.ArrayLike],
    regularisation: float = REGULARISATION,
    device: Any = "cpu",
) -> AllocationData:
    """Tables of one or more vehicle types for `allocate`; every sequence has one entry per type.

    Args:
        B: Thruster matrices, wrench = B f about the commanded point in the body frame, (6, n) with n <= 8 each.
        lower: Least thrusts f- [N], (n,) each, at most zero.
        upper: Greatest thrusts f+ [N], (n,) each, at least zero.
        weights: Diagonals of W [1/N, 1/(N m)], (6,) each: 1/wrench limit, and zero for an axis that does not matter.
        regularisation: lambda as a fraction of the mean non-zero eigenvalue of B' W^2 B (so it has no unit).
        device: Warp device that holds the tables.

    Raises:
        ControlError: Wrong shapes, limits that exclude zero, or numbers that make the problem singular.
    """
    if not len(B) == len(lower) == len(upper) == len(weights) > 0:
        raise ControlError(
            f"allocation has {len(B)} matrices, {len(lower)} lower and {len(upper)} upper limits, "
            f"{len(weights)} weights: give one of each per vehicle type"
        )
    types = [_tables(*one, regularisation) for one in zip(B, lower, upper, weights, strict=True)]
    gain, clamped, hessian, low, high = (np.stack(parts) for parts in zip(*types, strict=True))
    data = AllocationData()
    data.gain = wp.array(gain, dtype=vec8, device=device)
    data.clamped = wp.array(clamped, dtype=vec8, device=device)
    data.hessian = wp.array(hessian, dtype=vec8, device=device)
    data.lower = wp.array(low, dtype=vec8, device=device)
    data.upper = wp.array(high, dtype=vec8, device=device)
    return data


def regularisation_weight(
    B: npt.ArrayLike, weights: npt.ArrayLike, regularisation: float = REGULARISATION
) -> float:
    """lambda [1/N^2] of the objective: `regularisation` times the mean non-zero eigenvalue of B' W^2 B."""
    WB = np.asarray(weights, float)[:, None] * np.asarray(B, float)
    return regularisation * float(np.sum(WB**2)) / float(np.linalg.matrix_rank(WB))


def _tables(
    B: npt.ArrayLike,
    lower: npt.ArrayLike,
    upper: npt.ArrayLike,
    weights: npt.ArrayLike,
    regularisation: float,
) -> tuple[npt.NDArray[np.float32], ...]:
    """Fields of `AllocationData` for one vehicle type, padded with absent thrusters (zero gain, limits of zero)."""
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
    return (
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


def axis_weights(wrench_limits: npt.ArrayLike) -> Array:
    """Diagonal of W [1/N, 1/(N m)], (6,): one over each wrench limit, and zero on an axis with no authority."""
    limits = np.asarray(wrench_limits, float)
    weights: Array = np.divide(1.0, limits, out=np.zeros_like(limits), where=limits > 0.0)
    return weights
