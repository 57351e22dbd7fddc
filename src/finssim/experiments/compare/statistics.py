"""Robust aggregates over seeds (Agarwal et al. 2021, Deep RL at the Edge of the Statistical Precipice).

Scores are (runs, strata): one row for each training, one column for each setpoint, trajectory or kind of episode. A
score that was not reached is infinitely bad: +inf where less is better, -inf where more is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.experiments.transfer.intervals import Interval

__all__ = ["better", "interquartile_mean", "plain", "probability_of_improvement", "with_bootstrap"]

Array = NDArray[np.float64]

RESAMPLES = 2000
SEED = 20261123
TRIM = 0.25
"""Part of the scores that is left out at each end."""


def interquartile_mean(scores: Array) -> float:
    """Mean of the middle half of all scores, runs and strata together.

    Scores at the quartiles count by the part of them that lies inside, so that 5 scores have a middle half too.
    """
    x = np.sort(np.asarray(scores, dtype=float).ravel())
    n = len(x)
    edges = np.arange(n + 1) / n
    inside = np.clip(np.minimum(edges[1:], 1.0 - TRIM) - np.maximum(edges[:-1], TRIM), 0.0, None)
    counted = inside > 0.0
    return float(np.sum(inside[counted] * x[counted]) / np.sum(inside))


def with_bootstrap(
    scores: Sequence[Array], statistic: Callable[..., float], resamples: int = RESAMPLES
) -> Interval | None:
    """A statistic of one or more sets of scores, and where a bootstrap stratified by column puts it.

    Runs are drawn with replacement in each column by itself.

    Returns:
        None if a set has no runs; an interval without width where every set has one run.
    """
    if any(len(rows) == 0 for rows in scores):
        return None
    rng = np.random.default_rng(SEED)
    drawn = np.array([statistic(*(_redrawn(rows, rng) for rows in scores)) for _ in range(resamples)])
    low, high = _quantile(drawn, 0.025), _quantile(drawn, 0.975)
    return Interval(statistic(*scores), low, high, sum(len(rows) for rows in scores))


def probability_of_improvement(a: Array, b: Array, less_is_better: bool) -> float:
    """Chance that a run of `a` beats one of `b` in a stratum, mean over the strata; a tie counts half.

    It is the Mann-Whitney statistic over the product of the counts.
    """
    left, right = a[:, None, :], b[None, :, :]
    wins = (left < right) if less_is_better else (left > right)
    return float(np.mean(wins + 0.5 * (left == right)))


def better(interval: Interval) -> bool | None:
    """Whether a probability of improvement says better (True), worse (False), or leaves it open (None)."""
    if interval.low > 0.5:
        return True
    return False if interval.high < 0.5 else None


def _redrawn(scores: Array, rng: np.random.Generator) -> Array:
    runs, strata = scores.shape
    rows = rng.integers(0, runs, (runs, strata))
    return np.take_along_axis(scores, rows, axis=0)


def _quantile(values: Array, q: float) -> float:
    """Of values that may be infinite, without interpolating between one that is and one that is not."""
    return float(np.quantile(values, q, method="inverted_cdf"))


def plain(interval: Interval | None) -> dict[str, Any] | None:
    """Plain data; a bound that is infinite is None."""
    if interval is None:
        return None
    low, high = interval.low, interval.high
    value = interval.value if np.isfinite(interval.value) else None
    return {
        "value": value,
        "ci95": [low if np.isfinite(low) else None, high if np.isfinite(high) else None],
        "count": interval.count,
    }
