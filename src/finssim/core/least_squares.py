"""Levenberg and Marquardt's method, robust weights, bounds, and unknowns that belong to one group of rows.

`descend` is the one kernel for every least-squares problem with a state or steps of its own.

Problems with a plain vector of parameters and no time limit use `scipy.optimize.least_squares`.
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
"""Function of the damping -> state a damped step away, None where there is none, and the decrease of the cost that the
linearisation promises for it."""

STEADIEST = 1e12
"""Damping at which the search gives up."""


class Descent(NamedTuple, Generic[State]):
    """End of a search."""

    state: State
    """Best state found."""
    cost: float
    """Its cost, in the unit of the cost function."""
    steps: int
    """Number of steps tried."""
    converged: bool
    """True if the last step promised a negligible decrease."""


def descend(
    state: State,
    cost: Callable[[State], float],
    linearise: Callable[[State], Step[State]],
    *,
    steps: int,
    still: float = 0.0,
    share: float = 0.0,
    damping: float = 1e-3,
) -> Descent[State]:
    """Minimise a cost by damped Gauss-Newton steps (Levenberg and Marquardt).

    The damping follows Nielsen (1999), "Damping parameter in Marquardt's method": it stays where a step keeps half of
    what it promised, as in a flat valley.

    Args:
        state: Start.
        cost: Function to be minimised; infinite where a state is impossible.
        linearise: State -> its steps.
        steps: Largest number of steps.
        still: Promised decrease at or below which a step is the last, in the unit of the cost.
        share: The same, as a share of the cost [-].
        damping: First damping [-].
    """
    value, growth, tried, converged = cost(state), 2.0, 0, False
    step = linearise(state)
    while tried < steps and not converged and damping < STEADIEST:
        tried += 1
        trial, promised = step(damping)
        converged = abs(promised) <= max(still, share * value)
        after = math.inf if trial is None else cost(trial)
        if trial is None or not after <= value:
            damping, growth = damping * growth, 2.0 * growth
            continue
        gain = min((value - after) / max(promised, 1e-300), 2.0) if math.isfinite(value) else 1.0
        state, value, growth = trial, after, 2.0
        damping = max(damping * max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3), 1e-12)
        if tried < steps and not converged:
            step = linearise(state)
    return Descent(state, value, tried, converged)


def rms(errors: Array) -> float:
    """Return the root mean square length of vectors (K, n); NaN without any. The unit is kept."""
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=-1)))) if len(errors) else float("nan")


def huber_weight(size: Array, limit: float) -> Array:
    """Return the weight of residuals: 1 up to a limit, falling as 1 / size beyond."""
    return np.asarray(np.minimum(1.0, limit / np.maximum(size, 1e-300)))


def huber_loss(size: Array, limit: float) -> Array:
    """Return the squares of sizes within a limit, which grow linearly beyond.

    Sizes and limit have one unit.
    """
    return np.asarray(np.where(size <= limit, size**2, limit * (2.0 * size - limit)))


def unit_diagonal(normal: Array) -> tuple[Array, Array]:
    """Return a normal matrix (P, P) with each unknown in a unit of its own, so that its diagonal is 1, and the factors
    (P,) by which steps in these units are larger.

    Args:
        normal: In any units [-] and frame, (P, P).
    """
    scale = np.sqrt(np.maximum(np.diagonal(normal), 1e-300))
    return normal / np.outer(scale, scale), scale


def boxed(normal: Array, right: Array, low: Array, high: Array) -> Array:
    """Return the minimum of ½ xᵀ N x - gᵀ x in a box, by bounded-variable least squares; on a bound exactly.

    Bounds and x have the unit of the unknowns.

    Args:
        normal: N, positive definite, in any units [-] and frame, (P, P).
        right: g, (P,), in the unit of N x.
        low: In the unit of x, below `high`, (P,).
        high: In the unit of x, (P,).
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
    """Shared by shared, per product of the units of the unknowns, (P, P)."""
    ab: Array
    """Shared by own, per product of the units of the unknowns, (P, Q)."""
    bb: Array
    """Own by own, per product of the units of the unknowns, (Q, Q)."""
    a: Array
    """Right side of the shared, per unit of the unknown, (P,)."""
    b: Array
    """Right side of the own, per unit of the unknown, (Q,)."""


def block_of(shared: Array, local: Array, residual: Array) -> Block:
    """Return a block from whitened rows.

    Args:
        shared: Derivatives of the prediction, over its standard error, with respect to the shared unknowns, per unit of
            these, (n, P).
        local: And to the group's own, per unit of these, (n, Q).
        residual: Measured less predicted, over its standard error [-], (n,).
    """
    return Block(
        shared.T @ shared, shared.T @ local, local.T @ local, shared.T @ residual, local.T @ residual
    )


def arrow_step(blocks: Sequence[Block], damping: float) -> tuple[Array, list[Array], float]:
    """Return one damped Gauss-Newton step (Marquardt), (P,) and (Q,) each, and the decrease it promises.

    A shared direction that no row determines gets no step. The decrease is that of the sum of squares.

    Steps are in the units of the unknowns.

    Args:
        blocks: Normal equations of the groups.
        damping: What the diagonals grow by, as a part of themselves [-].
    """
    total, right, inners = arrow_reduced(blocks, damping)
    scaled, scale = unit_diagonal(total)
    step, *_ = np.linalg.lstsq(scaled, right / scale, rcond=1e-13)
    step = step / scale
    own = [inner[:, -1] - inner[:, :-1] @ step for inner in inners]
    promised = sum(
        step @ (2.0 * block.a - block.aa @ step - 2.0 * block.ab @ y) + y @ (2.0 * block.b - block.bb @ y)
        for block, y in zip(blocks, own, strict=True)
    )
    return step, own, float(promised)


def arrow_reduced(blocks: Sequence[Block], damping: float) -> tuple[Array, Array, list[Array]]:
    """Return normal matrix (P, P) and right side (P,) of the shared unknowns alone, and [abᵀ b] over bb of each group.

    Args:
        blocks: Normal equations of the groups.
        damping: What the diagonals grow by, as a part of themselves [-].
    """
    reduced, right, inners = zip(*(eliminated(block, damping) for block in blocks), strict=True)
    return np.sum(reduced, axis=0), np.sum(right, axis=0), list(inners)


def eliminated(block: Block, damping: float) -> tuple[Array, Array, Array]:
    """Return the damped normal matrix (P, P) and right side (P,) of the shared unknowns alone, and (bb + damping)⁻¹
    [abᵀ b], (Q, P + 1)."""
    diagonal = np.diagonal(block.bb)
    # Each unknown in a unit of its own, so that one that a prior holds does not stiffen the others.
    scale = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    bb = block.bb / np.outer(scale, scale) + np.diag(damping * (diagonal > 0.0) + 1e-14)
    right = np.column_stack([block.ab.T, block.b]) / scale[:, None]
    inner = np.asarray(np.linalg.solve(bb, right) / scale[:, None], float)
    aa = block.aa + damping * np.diag(np.diagonal(block.aa))
    return aa - block.ab @ inner[:, :-1], block.a - block.ab @ inner[:, -1], inner
