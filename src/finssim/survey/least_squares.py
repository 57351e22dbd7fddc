"""Parts of least-squares problems: robust weights, bounds, poses, and unknowns that belong to one group of rows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from finssim.core.rotations import quat_from_rotvec, quat_to_matrix
from finssim.identification.uncertainty import Evidence

Array = NDArray[np.float64]


def rms(errors: Array) -> float:
    """Return the root mean square length of vectors (K, n); NaN without any. The unit is kept."""
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=-1)))) if len(errors) else float("nan")


def huber_weight(size: Array, limit: float) -> Array:
    """Return the weight of residuals: 1 up to a limit, falling as 1 / size beyond."""
    return np.asarray(np.minimum(1.0, limit / np.maximum(size, 1e-300)))


def huber_cost(size: Array, limit: float) -> float:
    """Return the sum of squares of sizes within a limit, which grows linearly beyond.

    Sizes and limit have one unit.
    """
    return float(np.sum(np.where(size <= limit, size**2, limit * (2.0 * size - limit))))


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

    scale = np.sqrt(np.maximum(np.diagonal(normal), 1e-300))
    L = np.linalg.cholesky(normal / np.outer(scale, scale) + 1e-9 * np.eye(len(scale)))
    root = np.linalg.solve(L, right / scale)
    free = np.linalg.solve(L.T, root) / scale
    if ((free >= low) & (free <= high)).all():
        return np.asarray(free)
    solved = lsq_linear(L.T, root, (low * scale, high * scale), method="bvls")
    inside = np.where(solved.active_mask < 0, low, np.where(solved.active_mask > 0, high, solved.x / scale))
    return np.asarray(inside)


class Pose(NamedTuple):
    """Pose of a frame in another one."""

    R: Array
    """Rotation matrix from the inner to the outer frame, (3, 3)."""
    t: Array
    """[m], (3,)"""

    def at(self, points: Array) -> Array:
        """Return points of the inner frame in the outer one, (..., 3) [m]."""
        return np.asarray(points @ self.R.T + self.t)

    def then(self, inner: Pose) -> Pose:
        """Return the pose of a frame that has the pose `inner` in this one."""
        return Pose(self.R @ inner.R, self.R @ inner.t + self.t)

    @property
    def inverse(self) -> Pose:
        """Return the pose of the outer frame in the inner one."""
        return Pose(self.R.T.copy(), -self.R.T @ self.t)

    def stepped(self, step: Array) -> Pose:
        """Return the pose after a small turn about the outer axes [rad] (3) and a shift [m] (3)."""
        return Pose(quat_to_matrix(quat_from_rotvec(step[:3])) @ self.R, self.t + step[3:])


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
    scale = np.sqrt(np.maximum(np.diagonal(total), 1e-300))
    step, *_ = np.linalg.lstsq(total / np.outer(scale, scale), right / scale, rcond=1e-13)
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
    reduced, right, inners = zip(*(_eliminated(block, damping) for block in blocks), strict=True)
    return np.sum(reduced, axis=0), np.sum(right, axis=0), list(inners)


def arrow_evidence(
    blocks: Sequence[Block], names: tuple[str, ...], unit: str, groups: int | None = None
) -> Evidence:
    """Return the evidence of each group on the shared unknowns without its own.

    Args:
        blocks: At the solution.
        names: Of the shared unknowns.
        unit: What a group is.
        groups: Join consecutive blocks into that many; None keeps each for itself.
    """
    normal, score, _ = zip(*(_eliminated(block, 0.0) for block in blocks), strict=True)
    parts = np.array_split(np.arange(len(blocks)), min(groups or len(blocks), len(blocks)))
    return Evidence(
        names=names,
        normal=np.array([np.sum([normal[i] for i in p], axis=0) for p in parts]),
        score=np.array([np.sum([score[i] for i in p], axis=0) for p in parts]),
        unit=unit,
    )


def _eliminated(block: Block, damping: float) -> tuple[Array, Array, Array]:
    """Return the damped normal matrix (P, P) and right side (P,) of the shared unknowns alone, and (bb + damping)⁻¹
    [abᵀ b], (Q, P + 1)."""
    diagonal = np.diagonal(block.bb)
    bb = block.bb + damping * np.diag(diagonal) + 1e-14 * float(diagonal.max()) * np.eye(len(diagonal))
    inner = np.linalg.solve(bb, np.column_stack([block.ab.T, block.b]))
    aa = block.aa + damping * np.diag(np.diagonal(block.aa))
    return aa - block.ab @ inner[:, :-1], block.a - block.ab @ inner[:, -1], inner
