"""Bootstrap intervals of figures over clusters of trials, and of paired differences.

A score that was not reached is infinitely bad: +inf if less is better, -inf if more is.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Statistic = Callable[..., Any]
"""Function of all values that returns one number."""

RESAMPLES = 2000
SEED = 20260903

Figure = dict[str, Any]
"""`value`, `ci95` (95 % interval of the resampled figures) and `count`, the number of trials; None means infinite."""


def _figure(value: float, bounds: Array, count: int) -> Figure:
    value, low, high = (float(x) if math.isfinite(x) else None for x in (value, *bounds))
    return {"value": value, "ci95": [low, high], "count": count}


def bootstrap(redraw: Callable[[np.random.Generator], ArrayLike]) -> Array:
    """Return the interval that contains 95 % of `RESAMPLES` resampled figures.

    Args:
        redraw: Function that draws the data with replacement and returns its figure, or figures.

    Returns:
        2.5 and 97.5 % quantiles, (2, ...), in the unit of the figures; each is one of the resampled figures,
        as there is no value between a finite and an infinite one.
    """
    random = np.random.default_rng(SEED)
    drawn = np.array([redraw(random) for _ in range(RESAMPLES)], float)
    return np.asarray(np.quantile(drawn, (0.025, 0.975), axis=0, method="inverted_cdf"))


def with_interval(
    values: Mapping[Hashable, Sequence[float]], statistic: Statistic = np.mean
) -> Figure | None:
    """Return a statistic over all values, and its interval from resampling complete clusters.

    Trials of one plant and seed share their vehicle, camera, water and network, so they are not independent
    draws: the bootstrap draws complete clusters with replacement.

    Args:
        values: Cluster -> its values, all in the same unit.
        statistic: Function of all values.

    Returns:
        The figure; None if there are no values.
    """
    groups = [np.asarray(group, float) for group in values.values() if len(group)]
    if not groups:
        return None
    alike = len({len(group) for group in groups}) == 1
    table: Any = np.stack(groups) if alike else groups  # many small arrays are slow to concatenate

    def redraw(random: np.random.Generator) -> Any:
        drawn = random.integers(len(groups), size=len(groups))
        return statistic(table[drawn].ravel() if alike else np.concatenate([groups[k] for k in drawn]))

    everything = np.concatenate(groups)
    return _figure(statistic(everything), bootstrap(redraw), len(everything))


def paired_difference(
    ours: Mapping[tuple[int, int, str], float], theirs: Mapping[tuple[int, int, str], float]
) -> Figure | None:
    """Return the mean of theirs - ours over the trials that both have, clustered by plant and seed.

    Args:
        ours: (plant, seed, target) -> figure of the reference.
        theirs: The same for the row that is compared with it, in the same unit.
    """
    clusters: dict[Hashable, list[float]] = {}
    for pair in sorted(ours.keys() & theirs.keys()):
        clusters.setdefault(pair[:2], []).append(theirs[pair] - ours[pair])
    return with_interval(clusters)
