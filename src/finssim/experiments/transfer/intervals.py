"""What a campaign's figures are worth: bootstrap intervals over plants and seeds, alone and as paired differences."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Interval", "mean_of", "median_of", "paired_difference", "with_interval"]

Array = NDArray[np.float64]

RESAMPLES = 2000
SEED = 20260903

Statistic = Callable[[Array], float]


@dataclass(frozen=True)
class Interval:
    """A figure and where its bootstrap puts it."""

    value: float
    low: float
    high: float
    """2.5 and 97.5 %."""
    count: int
    """Trials it rests on."""

    @property
    def excludes_zero(self) -> bool:
        """Whether the sign is supported."""
        return self.low > 0.0 or self.high < 0.0

    def as_json(self) -> dict[str, Any]:
        """Plain data."""
        return {"value": self.value, "ci95": [self.low, self.high], "count": self.count}


def mean_of(values: Array) -> float:
    """Mean."""
    return float(np.mean(values))


def median_of(values: Array) -> float:
    """Median."""
    return float(np.median(values))


def with_interval(
    values: Mapping[Hashable, Sequence[float]], statistic: Statistic = mean_of
) -> Interval | None:
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
    random = np.random.default_rng(SEED)
    draws = [
        statistic(np.concatenate([groups[k] for k in random.integers(len(groups), size=len(groups))]))
        for _ in range(RESAMPLES)
    ]
    everything = np.concatenate(groups)
    low, high = np.percentile(draws, [2.5, 97.5])
    return Interval(statistic(everything), float(low), float(high), len(everything))


def paired_difference(
    ours: Mapping[tuple[int, int, str], float], theirs: Mapping[tuple[int, int, str], float]
) -> Interval | None:
    """Mean of theirs - ours over the trials that both have, clustered by plant and seed.

    Args:
        ours: (plant, seed, target) -> figure of the reference.
        theirs: The same of what is compared with it.
    """
    clusters: dict[Hashable, list[float]] = {}
    for pair in sorted(ours.keys() & theirs.keys()):
        clusters.setdefault(pair[:2], []).append(theirs[pair] - ours[pair])
    return with_interval(clusters)
