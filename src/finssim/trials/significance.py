"""Significance of a relation between two signals of a log whose errors are correlated in time."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import stdtr

Array = NDArray[np.float64]

CHANCE = 1e-4
"""Probability below which a relation is significant."""


class Relation(NamedTuple):
    """Slope of y over x through zero, and its significance."""

    slope: float
    """Slope in the unit of y over that of x."""
    correlation: float
    """Cosine of the two signals, -1 to 1."""
    chance: float
    """Probability that unrelated signals yield a slope of this sign and size."""

    @property
    def sure(self) -> bool:
        """Return whether the slope is significant."""
        return self.chance < CHANCE


def relation(x: ArrayLike, y: ArrayLike, *, nuisances: ArrayLike | None = None) -> Relation:
    """Return the dependence of a signal on another, with a significance that accounts for errors correlated in time.

    y = b x + e has the standard error σ_e / |x| times the root of 1 + 2 Σ ρ_x(k) ρ_e(k), the sum over all
    lags of the products of both autocorrelations (Bartlett 1935): the number of independent samples counts. A
    single push is significant if its residual is short or small; the output of a strong smoother counts as
    the few independent values that it consists of.

    Args:
        x: Evenly sampled values, in any unit; NaN to exclude a sample, (n,).
        y: The other signal at the same times, in any unit, (n,).
        nuisances: Signals of any unit whose contribution to x and y is removed first, for instance ones for a
            constant, (n, k).
    """
    x, y = np.array(x, float), np.array(y, float)
    known = np.isfinite(x) & np.isfinite(y)
    free = int(known.sum()) - 1
    if nuisances is not None:
        others = np.asarray(nuisances, float)[known]
        free -= others.shape[1]
        for signal in (x, y):
            signal[known] -= others @ np.linalg.lstsq(others, signal[known], rcond=None)[0]
    x, y = np.where(known, x, 0.0), np.where(known, y, 0.0)
    sizes = float(x @ x), float(y @ y)
    if free < 2 or min(sizes) <= 0.0:
        return Relation(0.0, 0.0, 1.0)
    slope = float(x @ y) / sizes[0]
    rest = y - slope * x
    square = float(rest @ rest)
    correlation = float(x @ y) / float(np.sqrt(sizes[0] * sizes[1]))
    if square <= 1e-20 * sizes[1]:
        return Relation(slope, correlation, 0.0)
    shared = float(_autocorrelation(x) @ _autocorrelation(rest))
    repeated = max(1.0, 2.0 * shared - 1.0)  # lag 0 counts once
    error = np.sqrt(square / free / sizes[0] * repeated)
    chance = float(stdtr(max(1.0, free / repeated), -abs(slope) / error))
    return Relation(slope, correlation, chance)


def _autocorrelation(x: Array) -> Array:
    """Return the autocorrelation at non-negative lags, (n,)."""
    n = len(x)
    spectrum = np.abs(np.fft.rfft(x, 2 * n)) ** 2
    return np.asarray(np.fft.irfft(spectrum, 2 * n)[:n] / (x @ x))
