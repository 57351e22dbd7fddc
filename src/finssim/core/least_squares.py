"""Levenberg-Marquardt method, robust weights, bounds, and unknowns that belong to one group of rows.

`descend` solves every least-squares problem whose state is not a plain vector or whose steps are specific to it.

Problems with a plain parameter vector and no time limit use `scipy.optimize.least_squares`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

State = TypeVar("State")
Step = Callable[[float], tuple[State | None, float]]
"""Function of the damping -> the state after a damped step (None if there is none), and the decrease of the cost that
the linearisation predicts for it."""

STEADIEST = 1e12
"""Damping at which the search stops."""


class Descent(NamedTuple, Generic[State]):
    """Result of a search."""

    state: State
    """Best state found."""
    cost: float
    """Its cost, in the unit of the cost function."""
    steps: int
    """Number of attempted steps."""
    converged: bool
    """True if the predicted decrease of the last step was negligible."""


def descend(
    state: State,
    cost: Callable[[State], float],
    linearise: Callable[[State], Step[State]],
    *,
    steps: int,
    tolerance: float = 0.0,
    relative_tolerance: float = 0.0,
    damping: float = 1e-3,
) -> Descent[State]:
    """Minimise a cost by damped Gauss-Newton steps (Levenberg and Marquardt).

    The damping follows Nielsen (1999), "Damping parameter in Marquardt's method": it is unchanged where a
    step achieves half of its predicted decrease, as in a flat valley.

    Args:
        state: Initial state.
        cost: Function to minimise; infinite where a state is impossible.
        linearise: Function that returns the damped steps of a state.
        steps: Largest number of steps.
        tolerance: Predicted decrease at or below which the search ends, in the unit of the cost.
        relative_tolerance: The same limit as a fraction of the cost [-].
        damping: Initial damping [-].
    """
    value, growth, tried, converged = cost(state), 2.0, 0, False
    step = linearise(state)
    while tried < steps and not converged and damping < STEADIEST:
        tried += 1
        trial, predicted = step(damping)
        converged = abs(predicted) <= max(tolerance, relative_tolerance * value)
        after = math.inf if trial is None else cost(trial)
        if trial is None or not after <= value:
            damping, growth = damping * growth, 2.0 * growth
            continue
        gain = min((value - after) / max(predicted, 1e-300), 2.0) if math.isfinite(value) else 1.0
        state, value, growth = trial, after, 2.0
        damping = max(damping * max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3), 1e-12)
        if tried < steps and not converged:
            step = linearise(state)
    return Descent(state, value, tried, converged)


def rms(errors: Array) -> float:
    """Return the root mean square length of vectors (K, n); NaN if there are none. The unit is unchanged."""
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=-1)))) if len(errors) else float("nan")


def huber_weight(size: Array, limit: float) -> Array:
    """Return the weight of residuals: 1 up to a limit, falling as 1 / size beyond."""
    return np.asarray(np.minimum(1.0, limit / np.maximum(size, 1e-300)))


def huber_loss(size: Array, limit: float) -> Array:
    """Return the squares of sizes up to a limit, continued linearly beyond it.

    Sizes and limit have the same unit.
    """
    return np.asarray(np.where(size <= limit, size**2, limit * (2.0 * size - limit)))


def unit_diagonal(normal: Array) -> tuple[Array, Array]:
    """Return a normal matrix (P, P) rescaled to unit diagonal, and the factors (P,) by which steps in the
    rescaled unknowns are larger.

    Args:
        normal: Normal matrix in any units [-] and frame, (P, P).
    """
    scale = np.sqrt(np.maximum(np.diagonal(normal), 1e-300))
    return normal / np.outer(scale, scale), scale


def boxed(normal: Array, right: Array, low: Array, high: Array) -> Array:
    """Return the minimum of ½ xᵀ N x - gᵀ x within bounds, by bounded-variable least squares; active bounds
    are exact.

    Bounds and x have the unit of the unknowns.

    Args:
        normal: N, positive definite, in any units [-] and frame, (P, P).
        right: g, (P,), in the unit of N x.
        low: Lower bounds in the unit of x, below `high`, (P,).
        high: Upper bounds in the unit of x, (P,).
    """
    from scipy.optimize import lsq_linear

    scaled, scale = unit_diagonal(normal)
    L = np.linalg.cholesky(scaled + 1e-9 * np.eye(len(scale)))
    root = np.linalg.solve(L, right / scale)
    free = np.linalg.solve(L.T, root) / scale
    if ((free >= low) & (free <= high)).all():
        return np.asarray(free)
    solved = lsq_linear(L.T, root, (low * scale, high * scale), method="bvls")
    inside = np.where(solved.active_mask < 0, low, np.where(solved.active_mask > 0, high, solved.x / scale))
    return np.asarray(inside)


class Block(NamedTuple):
    """Weighted normal equations of one group, such as a picture with its pose."""

    aa: Array
    """Shared-shared block, per product of the units of the unknowns, (P, P)."""
    ab: Array
    """Shared-own block, per product of the units of the unknowns, (P, Q)."""
    bb: Array
    """Own-own block, per product of the units of the unknowns, (Q, Q)."""
    a: Array
    """Right-hand side of the shared unknowns, per unit of the unknown, (P,)."""
    b: Array
    """Right-hand side of the own unknowns, per unit of the unknown, (Q,)."""


def block_of(shared: Array, local: Array, residual: Array) -> Block:
    """Return the normal equations of a group from whitened rows.

    Args:
        shared: Derivatives of the prediction, over its standard error, with respect to the shared unknowns, per unit of
            these, (n, P).
        local: Derivatives with respect to the group's own unknowns, per unit of these, (n, Q).
        residual: Measured minus predicted value, over its standard error [-], (n,).
    """
    return Block(
        shared.T @ shared, shared.T @ local, local.T @ local, shared.T @ residual, local.T @ residual
    )


def arrow_step(blocks: Sequence[Block], damping: float) -> tuple[Array, list[Array], float]:
    """Return one damped Gauss-Newton step (Marquardt), (P,) and (Q,) each, and its predicted decrease.

    A shared direction that no row determines is not changed. The decrease is that of the sum of squares.

    Steps are in the units of the unknowns.

    Args:
        blocks: Normal equations of the groups.
        damping: Relative increase of the diagonals [-].
    """
    total, right, inners = arrow_reduced(blocks, damping)
    scaled, scale = unit_diagonal(total)
    step, *_ = np.linalg.lstsq(scaled, right / scale, rcond=1e-13)
    step = step / scale
    own = [inner[:, -1] - inner[:, :-1] @ step for inner in inners]
    predicted = sum(
        step @ (2.0 * block.a - block.aa @ step - 2.0 * block.ab @ y) + y @ (2.0 * block.b - block.bb @ y)
        for block, y in zip(blocks, own, strict=True)
    )
    return step, own, float(predicted)


def arrow_reduced(blocks: Sequence[Block], damping: float) -> tuple[Array, Array, list[Array]]:
    """Return the reduced normal matrix (P, P) and right side (P,) of the shared unknowns, and [abᵀ b] over bb
    of each group.

    Args:
        blocks: Normal equations of the groups.
        damping: Relative increase of the diagonals [-].
    """
    reduced, right, inners = zip(*(eliminated(block, damping) for block in blocks), strict=True)
    return np.sum(reduced, axis=0), np.sum(right, axis=0), list(inners)


def eliminated(block: Block, damping: float) -> tuple[Array, Array, Array]:
    """Return the reduced, damped normal matrix (P, P) and right side (P,) of the shared unknowns, and (bb + damping)⁻¹
    [abᵀ b], (Q, P + 1)."""
    diagonal = np.diagonal(block.bb)
    # Scale each unknown, so that one with a tight prior does not stiffen the others.
    scale = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    bb = block.bb / np.outer(scale, scale) + np.diag(damping * (diagonal > 0.0) + 1e-14)
    right = np.column_stack([block.ab.T, block.b]) / scale[:, None]
    inner = np.asarray(np.linalg.solve(bb, right) / scale[:, None], float)
    aa = block.aa + damping * np.diag(np.diagonal(block.aa))
    return aa - block.ab @ inner[:, :-1], block.a - block.ab @ inner[:, -1], inner
