"""Offset between the clocks of a record and of a truth file, from their common motion."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


class ClockError(ValueError):
    """Motions whose clocks cannot be compared."""


COARSE, FINE = 0.2, 0.01
"""Coarse and fine step of the search [s]."""
SAMPLES = 400
"""Number of samples of the estimate that are compared."""
LONGEST = 86_400.0
"""Longest total duration of truth and estimate [s]; the search takes 0.1 ms per step."""
OVERLAP = 0.5
"""Fraction of the estimate that the truth must cover."""


def clock_offset(estimate_time: Array, estimate: Array, time: Array, position: Array) -> float:
    """Return the time to add to the truth's times so that it matches the estimate [s].

    It is the offset with the least mean square distance among those for which at least half of the estimate
    is covered.

    Args:
        estimate_time: Times of the estimate, robot's clock [s], (n,).
        estimate: Estimated positions, world frame [m], (n, 3).
        time: Times of the truth, pool's clock [s], (k,).
        position: True positions, world frame [m], (k, 3).

    Raises:
        ClockError: The truth is too short, or too long for the search.
    """
    chosen = np.unique(np.linspace(0, len(estimate_time) - 1, SAMPLES).round().astype(int))
    t, x = estimate_time[chosen], estimate[chosen]
    finite = np.isfinite(x).all(axis=1)
    t, x = t[finite], x[finite]
    first, last = t[0] - time[-1], t[-1] - time[0]
    if last - first > LONGEST:
        raise ClockError(
            f"it lasts {last - first:g} s, expected at most {LONGEST:g} s with the record: give times in s"
        )

    def error(offset: float) -> float:
        inside = (t - offset >= time[0]) & (t - offset <= time[-1])
        if inside.mean() < OVERLAP:
            return np.inf
        there = np.stack([np.interp(t[inside] - offset, time, column) for column in position.T], axis=1)
        return float(np.mean(np.sum((there - x[inside]) ** 2, axis=1)))

    best = min(np.arange(first, last + COARSE, COARSE), key=error)
    best = min(np.arange(best - COARSE, best + COARSE, FINE), key=error)
    if not np.isfinite(error(float(best))):
        raise ClockError("the truth covers less than half of the record: it belongs to another run")
    return float(best)
