"""The clocks of a record and of a truth file, laid over each other by the motion that both show."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from finssim.viewer.frame import ViewError
from finssim.viewer.sources.series import PoseSeries

Array = npt.NDArray[np.float64]

COARSE, FINE = 0.2, 0.01
"""Steps of the search [s]."""
SAMPLES = 400
"""Of the estimate, that are compared."""
OVERLAP = 0.5
"""Part of the estimate that the truth must cover."""


def offset_between(estimate: PoseSeries, time: Array, position: Array) -> float:
    """What to add to the truth's times so that it lies over the estimate [s].

    The one with the least mean square distance, of all under which at least half of the estimate is covered.

    Args:
        estimate: As recorded, robot's clock.
        time: Of the truth, pool's clock [s], (k,).
        position: Of the truth [m], (k, 3).

    Raises:
        ViewError: The truth is too short.
    """
    chosen = np.unique(np.linspace(0, len(estimate) - 1, SAMPLES).round().astype(int))
    t, x = estimate.time[chosen], estimate.position[chosen]
    known = np.isfinite(x).all(axis=1)
    t, x = t[known], x[known]
    first, last = t[0] - time[-1], t[-1] - time[0]

    def error(offset: float) -> float:
        inside = (t - offset >= time[0]) & (t - offset <= time[-1])
        if inside.mean() < OVERLAP:
            return np.inf
        there = np.stack([np.interp(t[inside] - offset, time, column) for column in position.T], axis=1)
        return float(np.mean(np.sum((there - x[inside]) ** 2, axis=1)))

    best = min(np.arange(first, last + COARSE, COARSE), key=error)
    best = min(np.arange(best - COARSE, best + COARSE, FINE), key=error)
    if not np.isfinite(error(float(best))):
        raise ViewError("the truth covers less than half of the record: it is not of this run")
    return float(best)
