"""One estimate from several trials that were fitted one by one."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

__all__ = ["pooled", "pooled_positive"]

Array = NDArray[np.float64]


def pooled(values: Array, stds: Array, dof: Array) -> tuple[float, float, float]:
    """Mean of estimates of several trials, weighted by their certainty and what they differ by beyond it.

    The variance between trials is that of DerSimonian and Laird (1986).

    Args:
        values: (n,)
        stds: (n,)
        dof: Degrees of freedom of the standard errors, (n,).

    Returns:
        Mean and the two ends of its 95 % interval.
    """
    from scipy.stats import t

    stds = np.maximum(stds, 1e-9 * np.abs(values) + 1e-300)
    w = 1.0 / stds**2
    mean = float(np.sum(w * values) / w.sum())
    freedom = float(np.sum(np.where(np.isfinite(dof), dof, 1e6)))
    excess = float(np.sum(w * (values - mean) ** 2)) - (len(values) - 1)
    if len(values) > 1 and excess > 0.0:
        between = excess / (w.sum() - np.sum(w**2) / w.sum())
        w = 1.0 / (stds**2 + between)
        mean, freedom = float(np.sum(w * values) / w.sum()), float(len(values) - 1)
    half = float(t.ppf(0.975, max(freedom, 1.0)) / math.sqrt(w.sum()))
    return mean, mean - half, mean + half


def pooled_positive(values: Array, stds: Array, dof: Array) -> tuple[float, float, float]:
    """`pooled` on logarithms where all values are positive, as those of what cannot be negative are."""
    if not (values > 0.0).all():
        return pooled(values, stds, dof)
    mean, low, high = np.exp(np.clip(pooled(np.log(values), stds / values, dof), -500.0, 500.0))
    return float(mean), float(low), float(high)
