"""Least squares with many small groups of unknowns that only share a few: each group is eliminated by itself."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.uncertainty import Evidence

__all__ = ["Block", "arrow_evidence", "arrow_step", "block_of"]

Array = NDArray[np.float64]


class Block(NamedTuple):
    """Weighted normal equations of one group, such as a picture with its pose."""

    aa: Array
    """Shared by shared, (P, P)."""
    ab: Array
    """Shared by own, (P, Q)."""
    bb: Array
    """Own by own, (Q, Q)."""
    a: Array
    """Right side of the shared, (P,)."""
    b: Array
    """Right side of the own, (Q,)."""


def block_of(shared: Array, own: Array, residual: Array) -> Block:
    """From whitened rows.

    Args:
        shared: Derivatives of the prediction with respect to the shared unknowns, (n, P).
        own: And to the group's own, (n, Q).
        residual: Measured less predicted, (n,).
    """
    return Block(shared.T @ shared, shared.T @ own, own.T @ own, shared.T @ residual, own.T @ residual)


def arrow_step(blocks: Sequence[Block], damping: float) -> tuple[Array, list[Array]]:
    """One damped Gauss-Newton step (Marquardt), (P,) and (Q,) each.

    A shared direction that nothing tells gets no step.
    """
    count = len(blocks[0].aa)
    total, right, solved = np.zeros((count, count)), np.zeros(count), []
    for block in blocks:
        inner = _eliminated(block, damping)
        total += block.aa + damping * np.diag(np.diagonal(block.aa)) - block.ab @ inner[:, :-1]
        right += block.a - block.ab @ inner[:, -1]
        solved.append(inner)
    scale = np.sqrt(np.maximum(np.diagonal(total), 1e-300))
    step, *_ = np.linalg.lstsq(total / np.outer(scale, scale), right / scale, rcond=1e-13)
    step = step / scale
    return step, [inner[:, -1] - inner[:, :-1] @ step for inner in solved]


def arrow_evidence(
    blocks: Sequence[Block], names: tuple[str, ...], unit: str, groups: int | None = None
) -> Evidence:
    """What each group says about the shared unknowns once its own are taken out.

    Args:
        blocks: At the solution.
        names: Of the shared unknowns.
        unit: What a group is.
        groups: Join consecutive blocks into that many; None keeps each for itself.
    """
    normal, score = [], []
    for block in blocks:
        inner = _eliminated(block, 0.0)
        normal.append(block.aa - block.ab @ inner[:, :-1])
        score.append(block.a - block.ab @ inner[:, -1])
    parts = [[i] for i in range(len(blocks))]
    if groups is not None:
        parts = [list(p) for p in np.array_split(np.arange(len(blocks)), min(groups, len(blocks)))]
    return Evidence(
        names=names,
        normal=np.array([np.sum([normal[i] for i in p], axis=0) for p in parts]),
        score=np.array([np.sum([score[i] for i in p], axis=0) for p in parts]),
        unit=unit,
    )


def _eliminated(block: Block, damping: float) -> Array:
    """(bb + damping) ⁻¹ [abᵀ b], (Q, P + 1)."""
    diagonal = np.diagonal(block.bb)
    bb = block.bb + damping * np.diag(diagonal) + 1e-14 * float(diagonal.max()) * np.eye(len(diagonal))
    return np.asarray(np.linalg.solve(bb, np.column_stack([block.ab.T, block.b])))
