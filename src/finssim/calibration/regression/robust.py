"""Outliers and bounds: local medians, Huber weights, least squares that says which bounds are active."""

from __future__ import annotations

from itertools import chain, combinations

import numpy as np
from numpy.typing import NDArray

__all__ = ["bounded", "huber_weights", "local_outliers", "robust_std"]

Array = NDArray[np.float64]

GAUSSIAN_MAD = 1.4826
"""Standard deviation of a Gaussian in units of its median absolute deviation."""

HUBER = 1.345
"""Residual in standard deviations above which a sample loses weight; 95 % efficient on Gaussian noise."""


def robust_std(x: Array) -> float:
    """1.4826 times the median absolute deviation; 0 for fewer than 8 samples."""
    if len(x) < 8:
        return 0.0
    return GAUSSIAN_MAD * float(np.median(np.abs(x - np.median(x))))


def local_outliers(x: Array, *, half_window: int = 5, factor: float = 6.0) -> NDArray[np.bool_]:
    """Samples far from the median of their neighbours.

    |x - median| > factor · 1.4826 · MAD over ± half_window samples. The MAD counts as at least that of the whole series
    and a hundredth of its range, so that a repeated value or a quick turn makes no outlier.

    Args:
        x: Equally spaced, finite, (n,).
        half_window: Samples to each side.
        factor: In standard deviations.

    Returns:
        (n,), all False where there are fewer than 5 neighbours.
    """
    from scipy.ndimage import median_filter

    if 2 * half_window < 5 or len(x) <= 2 * half_window:
        return np.zeros(len(x), bool)
    size = 2 * half_window + 1
    distance = np.abs(x - median_filter(x, size=size, mode="nearest"))
    local = median_filter(distance, size=size, mode="nearest")
    low, high = np.percentile(x, [2.0, 98.0])
    least = max(float(np.median(distance)), 0.01 * float(high - low), 1e-12)
    return np.asarray(distance > factor * GAUSSIAN_MAD * np.maximum(local, least))


def huber_weights(residual: Array, *, reject: float = 8.0) -> Array:
    """1 within `HUBER` standard deviations, falling as 1/|r| beyond, 0 beyond `reject` (a global MAD rule), (n,)."""
    scale = robust_std(residual)
    if scale <= 0.0:
        return np.ones_like(residual)
    size = np.abs(residual - np.median(residual)) / scale
    return np.where(size > reject, 0.0, np.minimum(1.0, HUBER / np.maximum(size, 1e-12)))


def bounded(N: Array, theta: Array, lower: Array) -> tuple[Array, NDArray[np.bool_]]:
    """The point within bounds nearest to the free optimum, in the metric of the normal matrix.

    min (x - theta)ᵀ N (x - theta) with x >= lower, by enumeration of the active sets; exact for the few bounds here.

    Args:
        N: Normal matrix, positive definite, (P, P).
        theta: Free optimum, (P,).
        lower: Bounds, -inf where there is none, (P,).

    Returns:
        Solution, and which bounds are active, (P,) each.
    """
    candidates = np.flatnonzero(np.isfinite(lower))
    best, chosen, cost = theta, np.zeros(len(theta), bool), np.inf
    for active in chain.from_iterable(combinations(candidates, k) for k in range(len(candidates) + 1)):
        fixed = np.zeros(len(theta), bool)
        fixed[list(active)] = True
        x = theta.copy()
        x[fixed] = lower[fixed]
        if fixed.any() and not fixed.all():
            pull = N[np.ix_(~fixed, fixed)] @ (x - theta)[fixed]
            x[~fixed] = theta[~fixed] - np.linalg.solve(N[np.ix_(~fixed, ~fixed)], pull)
        if (x < lower - 1e-12).any():
            continue
        step = x - theta
        value = float(step @ N @ step)
        if value < cost:
            best, chosen, cost = x, fixed, value
        if not active:
            break
    return best, chosen
