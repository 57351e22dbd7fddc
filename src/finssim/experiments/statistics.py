"""What figures are worth: bootstrap intervals over clusters, of paired differences, of robust aggregates over seeds.

Aggregates over seeds are those of Agarwal et al. 2021, Deep RL at the Edge of the Statistical Precipice. Their scores
are (runs, strata): one row for each training, one column for each setpoint, trajectory or kind of episode. A score that
was not reached is infinitely bad: +inf where less is better, -inf where more is.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Statistic = Callable[..., Any]
"""Of all values together, one number."""

RESAMPLES = 2000
SEED = 20260903
TRIM = 0.25
"""Part of the scores that is left out at each end."""


Figure = dict[str, Any]
"""`value`, `ci95` (where 95 % of redrawn figures lie) and `count`, the trials or runs it rests on; None: infinite."""


def _figure(value: float, bounds: Array, count: int) -> Figure:
    value, low, high = (float(x) if math.isfinite(x) else None for x in (value, *bounds))
    return {"value": value, "ci95": [low, high], "count": count}


def bootstrap(redraw: Callable[[np.random.Generator], ArrayLike], resamples: int | None = None) -> Array:
    """Where 95 % of redrawn figures lie.

    Args:
        redraw: Draws the data with replacement and returns its figure, or figures.
        resamples: How often; `RESAMPLES` if None.

    Returns:
        2.5 and 97.5 %, (2, ...), each one of the redrawn figures: nothing lies between a finite and an infinite one.
    """
    random = np.random.default_rng(SEED)
    drawn = np.array([redraw(random) for _ in range(resamples or RESAMPLES)], float)
    return np.asarray(np.quantile(drawn, (0.025, 0.975), axis=0, method="inverted_cdf"))


def with_interval(
    values: Mapping[Hashable, Sequence[float]], statistic: Statistic = np.mean
) -> Figure | None:
    """A statistic over all values and its interval from redrawing whole clusters.

    Trials of one plant and seed share their vehicle, camera, water and network, so they are no independent draws: the
    bootstrap draws clusters with replacement and keeps what is in each.

    Args:
        values: Cluster -> its values.
        statistic: Of all values together.

    Returns:
        None without any value.
    """
    groups = [np.asarray(group, float) for group in values.values() if len(group)]
    if not groups:
        return None
    alike = len({len(group) for group in groups}) == 1
    table: Any = np.stack(groups) if alike else groups  # thousands of small arrays are slow to put together

    def redraw(random: np.random.Generator) -> Any:
        drawn = random.integers(len(groups), size=len(groups))
        return statistic(table[drawn].ravel() if alike else np.concatenate([groups[k] for k in drawn]))

    everything = np.concatenate(groups)
    return _figure(statistic(everything), bootstrap(redraw), len(everything))


def paired_difference(
    ours: Mapping[tuple[int, int, str], float], theirs: Mapping[tuple[int, int, str], float]
) -> Figure | None:
    """Mean of theirs - ours over the trials that both have, clustered by plant and seed.

    Args:
        ours: (plant, seed, target) -> figure of the reference.
        theirs: The same of what is compared with it.
    """
    clusters: dict[Hashable, list[float]] = {}
    for pair in sorted(ours.keys() & theirs.keys()):
        clusters.setdefault(pair[:2], []).append(theirs[pair] - ours[pair])
    return with_interval(clusters)


def interquartile_mean(scores: Array) -> float:
    """Mean of the middle half of all scores, runs and strata together.

    Scores at the quartiles count by the part of them that lies inside, so that 5 scores have a middle half too.
    """
    x = np.sort(np.asarray(scores, dtype=float).ravel())
    edges = np.arange(len(x) + 1) / len(x)
    inside = np.clip(np.minimum(edges[1:], 1.0 - TRIM) - np.maximum(edges[:-1], TRIM), 0.0, None)
    counted = inside > 0.0
    return float(np.sum(inside[counted] * x[counted]) / np.sum(inside))


def with_bootstrap(scores: Sequence[Array], statistic: Statistic, resamples: int | None = None) -> Figure:
    """A statistic of one or more sets of scores, and where a bootstrap stratified by column puts it.

    Runs are drawn with replacement in each column by itself; where every set has one run, the interval has no width.
    """

    def redraw(random: np.random.Generator) -> float:
        rows = (random.integers(0, len(score), score.shape) for score in scores)
        drawn = [np.take_along_axis(score, row, axis=0) for score, row in zip(scores, rows, strict=True)]
        return float(statistic(*drawn))

    return _figure(statistic(*scores), bootstrap(redraw, resamples), sum(map(len, scores)))


def probability_of_improvement(a: Array, b: Array, less_is_better: bool) -> float:
    """Chance that a run of `a` beats one of `b` in a stratum, mean over the strata; a tie counts half.

    It is the Mann-Whitney statistic over the product of the counts.
    """
    a_runs, right = a[:, None, :], b[None, :, :]
    wins = (a_runs < right) if less_is_better else (a_runs > right)
    return float(np.mean(wins + 0.5 * (a_runs == right)))
