"""Sums over the rows of each trial, and the instrumental-variable estimate that follows from them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.uncertainty import Evidence

__all__ = ["Moments", "moments", "offset_ratio", "solve"]

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Moments:
    """Of the stacked columns [X Z y] by group."""

    product: Array
    """Σ w [X Z y]ᵀ [X Z y], (G, 2p + 1, 2p + 1)."""
    mean: Array
    """Σ w [X Z y] / Σ w, (G, 2p + 1)."""
    weight: Array
    """Σ w, (G,)."""

    @property
    def columns(self) -> int:
        """p"""
        return (self.product.shape[-1] - 1) // 2

    def without_offsets(self, ratio: float) -> Array:
        """`product` of rows from which trial offsets of variance `ratio` (to that of a row) are taken out in part.

        The generalised least squares of a random offset for each trial: S_g - c_g w_g m_g m_gᵀ with
        c_g = ratio w_g / (1 + ratio w_g).
        """
        share = ratio * self.weight / (1.0 + ratio * self.weight)
        return np.asarray(
            self.product
            - (share * self.weight)[:, None, None] * self.mean[:, :, None] * self.mean[:, None, :]
        )

    def of(self, kept: NDArray[np.bool_]) -> Moments:
        """With some of the p columns only."""
        index = np.flatnonzero(np.concatenate([kept, kept, [True]]))
        return Moments(
            product=self.product[:, index[:, None], index], mean=self.mean[:, index], weight=self.weight
        )


def moments(X: Array, Z: Array, y: Array, weight: Array, group: NDArray[np.int64]) -> Moments:
    """Sums by group.

    Args:
        X: Regressors, (n, p).
        Z: Instruments, (n, p).
        y: Left side, (n,).
        weight: Of the rows, (n,).
        group: Ascending group of each row, (n,).
    """
    Q = np.concatenate([X, Z, y[:, None]], axis=1)
    begins = np.flatnonzero(np.diff(group, prepend=-1))
    parts = list(zip(np.split(Q, begins[1:]), np.split(weight, begins[1:]), strict=True))
    total = np.array([w.sum() for _, w in parts])
    product = np.array([(q * w[:, None]).T @ q for q, w in parts])
    mean = np.array([w @ q for q, w in parts]) / np.maximum(total, 1e-300)[:, None]
    return Moments(product=product, mean=mean, weight=total)


def solve(found: Moments, ratio: float = 0.0) -> tuple[Array, Array, Array, Array]:
    """Two-stage least squares, theta = (Zᵀ X)⁻¹ Zᵀ y, and what each group says about it.

    Args:
        found: Sums.
        ratio: Variance of the trial offsets over that of a row.

    Returns:
        theta (p,); N_g = Z_p,gᵀ Z_p,g of the regressors projected on the instruments (G, p, p); scores
        Z_p,gᵀ (y - X theta) (G, p); Σ w (y - X theta)² by group (G,). Unknown directions get the least-norm answer.
    """
    p = found.columns
    S = found.without_offsets(ratio)
    x, z, y = slice(0, p), slice(p, 2 * p), 2 * p
    total = S.sum(axis=0)
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(total[z, z]), 1e-300))
    zz = total[z, z] * np.outer(scale, scale)
    project = scale[:, None] * np.linalg.lstsq(zz, scale[:, None] * total[z, x], rcond=1e-11)[0]
    N_g = project.T @ S[:, z, z] @ project
    N = N_g.sum(axis=0)
    unit = 1.0 / np.sqrt(np.maximum(np.diagonal(N), 1e-300))
    theta = unit * np.linalg.lstsq(N * np.outer(unit, unit), unit * (project.T @ total[z, y]), rcond=1e-11)[0]
    r = np.concatenate([-theta, np.zeros(p), [1.0]])
    scores = (S[:, z, :] @ r) @ project
    return theta, N_g, scores, np.einsum("i,gij,j->g", r, S, r)


def offset_ratio(found: Moments, correlated: float) -> float:
    """Variance of trial offsets over that of an independent row, by maximum likelihood; 0 where they do not show.

    Args:
        found: Sums over trials, with weights that count rows.
        correlated: Rows that one independent row stands for.
    """
    weights = found.weight / correlated
    n = weights.sum()
    if len(weights) < 3:
        return 0.0
    independent = Moments(product=found.product / correlated, mean=found.mean, weight=weights)
    best, ratio = np.inf, 0.0
    for candidate in np.concatenate([[0.0], np.logspace(-3, 2, 26)]):
        rss = float(solve(independent, candidate)[3].sum())
        cost = (
            n * np.log(max(rss, 1e-300) / n) + np.log1p(candidate * weights).sum() + 2.0 * (candidate > 0.0)
        )
        if cost < best:
            best, ratio = cost, float(candidate)
    return ratio


def evidence(names: tuple[str, ...], N_g: Array, scores: Array, variance: float, unit: str) -> Evidence:
    """For `trial_covariance`, in units of the variance of an independent row."""
    return Evidence(names=names, normal=N_g / variance, score=scores / variance, unit=unit)
