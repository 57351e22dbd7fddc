"""Normal equations of parameters shared by many segments, each with unknowns of its own.

Unknowns: theta, shared by all; phi_g, shared by the segments of one trial; z_s, of one segment. The normal matrix is
bordered: z_s meets theta and its trial's phi only, so it is eliminated segment by segment (Schur complement), and what
is left is small and dense.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["CUT", "Blocks", "Linear", "bounded_step", "collect", "eliminate", "huber", "scatter"]

Array = NDArray[np.float64]

CUT = 2.5
"""Whitened residual above which Huber's loss grows linearly."""


class Linear(NamedTuple):
    """Residuals at a point, sorted by segment, and their negative derivatives."""

    residual: Array
    """Measured minus predicted, (N,)."""
    shared: Array
    """d predicted / d (theta, phi of the segment's own trial), (N, P + b)."""
    own: Array
    """d predicted / d z of the sample's own segment, (N, q)."""


@dataclass(frozen=True)
class Blocks:
    """The bordered normal equations by segment; x stands for (theta, phi of the trial)."""

    xx: Array
    """(S, K, K)"""
    xz: Array
    """(S, K, q)"""
    zz: Array
    """With the prior, (S, q, q)."""
    x: Array
    """Right-hand sides, (S, K)."""
    z: Array
    """(S, q)"""


def huber(whitened: Array, cut: float = CUT) -> tuple[Array, Array]:
    """Loss and weight of whitened residuals: quadratic to `cut`, linear beyond (Huber 1964).

    Returns:
        ρ(x) and ρ'(x)/x, the shape of the argument.
    """
    a = np.abs(whitened)
    far = a > cut
    near = np.minimum(a, cut)
    return near * (a - 0.5 * near), np.where(far, near / np.where(far, a, 1.0), 1.0)


def collect(
    linear: Linear, std: Array, edges: NDArray[np.int64], z: Array, prior_std: Array, cut: float = CUT
) -> Blocks:
    """Normal equations of every segment, with Huber's weights and the prior of z."""
    weight = huber(linear.residual / std, cut)[1] / std**2
    S, K, q = len(edges) - 1, linear.shared.shape[1], linear.own.shape[1]
    both = np.concatenate([linear.shared, linear.own], axis=1)
    normal, right = np.empty((S, K + q, K + q)), np.empty((S, K + q))
    for s in range(S):
        rows = slice(edges[s], edges[s + 1])
        weighted = both[rows].T * weight[rows]
        normal[s] = weighted @ both[rows]
        right[s] = weighted @ linear.residual[rows]
    stiff = 1.0 / prior_std**2
    normal[:, np.arange(K, K + q), np.arange(K, K + q)] += stiff
    right[:, K:] -= stiff * z
    return Blocks(
        xx=normal[:, :K, :K], xz=normal[:, :K, K:], zz=normal[:, K:, K:], x=right[:, :K], z=right[:, K:]
    )


def eliminate(blocks: Blocks) -> tuple[Array, Array, Array]:
    """Schur complement of each segment's z.

    Returns:
        Normal matrices (S, K, K) and right-hand sides (S, K) for x alone, and zz⁻¹ zx, (S, q, K).
    """
    right = np.concatenate([np.swapaxes(blocks.xz, 1, 2), blocks.z[..., None]], axis=2)
    both = np.linalg.solve(blocks.zz, right)
    gain = both[..., :-1]
    normal = blocks.xx - blocks.xz @ gain
    rest = blocks.x - np.einsum("skq,sq->sk", blocks.xz, both[..., -1])
    return 0.5 * (normal + np.swapaxes(normal, 1, 2)), rest, gain


def scatter(
    matrices: Array, right: Array, groups: NDArray[np.int64], shape: tuple[int, int, int]
) -> tuple[Array, Array]:
    """One dense system in (theta, phi_1, ..., phi_G) from the segments' in (theta, phi of their trial).

    Args:
        matrices: Normal matrices of the segments, (S, P + b, P + b).
        right: Their right-hand sides, (S, P + b).
        groups: Trial of each segment, (S,).
        shape: P, G, b.

    Returns:
        (P + G b, P + G b) and (P + G b,).
    """
    P, G, b = shape
    A, g = np.zeros((P + G * b, P + G * b)), np.zeros(P + G * b)
    for s, group in enumerate(groups):
        at = np.concatenate([np.arange(P), P + group * b + np.arange(b)])
        A[np.ix_(at, at)] += matrices[s]
        g[at] += right[s]
    return A, g


def bounded_step(A: Array, g: Array, low: Array, high: Array) -> Array:
    """Minimum of ½ d A d - g d in a box around 0, by an active set.

    Args:
        A: Positive definite, (n, n).
        g: (n,)
        low: At most 0, (n,).
        high: At least 0, (n,).
    """
    d = np.zeros(len(g))
    fixed = ((low >= 0.0) & (g < 0.0)) | ((high <= 0.0) & (g > 0.0))
    for _ in range(3 * len(g) + 1):
        free = ~fixed
        if free.any():
            rest = g[free] - A[np.ix_(free, fixed)] @ d[fixed]
            d[free] = np.linalg.solve(A[np.ix_(free, free)], rest)
        outside = free & ((d < low - 1e-12 * np.abs(low)) | (d > high + 1e-12 * np.abs(high)))
        if outside.any():
            fixed |= outside
            d = np.where(outside, np.clip(d, low, high), d)
            continue
        # A bound holds only where the cost falls towards it.
        slope = g - A @ d
        wrong = fixed & (
            ((d <= low) & (slope > 1e-9 * np.abs(g).max()))
            | ((d >= high) & (slope < -1e-9 * np.abs(g).max()))
        )
        wrong &= low < high
        if not wrong.any():
            break
        worst = int(np.argmax(np.where(wrong, np.abs(slope) / np.sqrt(np.diag(A)), -1.0)))
        fixed[worst] = False
    return np.clip(d, low, high)
