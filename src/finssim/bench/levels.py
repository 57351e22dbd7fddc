"""Held levels and steps in a log over time."""

from __future__ import annotations

import statistics
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from finssim.trials.findings import Finding, finding

__all__ = ["LevelStep", "find_steps", "levels", "settled_rows"]

Array = NDArray[np.float64]

LAST = 0.4
"""Final fraction of a level that counts as settled, such as the last 2 s of 5 s [-]."""
SHORTEST = 0.5
"""Least duration of a level that can settle [s]."""
LEAST_COVERED = 0.5
"""Least fraction of the time covered by levels; a log with less is a slow sweep and is used row by row [-]."""
SHORTEST_HELD = 0.2
"""Least duration of a held command between two steps [s]."""
SETTLING = 50
"""Number of samples after which a run's median is fixed, so that a slow ramp does not become one run."""
TOLERANCE = 0.02
"""Band around a level within which a measured signal counts as held, relative to its range [-]."""


class LevelStep(NamedTuple):
    """Change of a held signal and the level that follows it."""

    start: float
    """Time of the last sample before the change [s]."""
    time: float
    """Time of the first sample after the change [s]."""
    end: float
    """Time of the last sample before the next change, or of the log [s]."""


def levels(x: Array, tolerance: float) -> list[tuple[int, int]]:
    """Return runs of samples within `tolerance` of their running median, as [first, last), which cover all samples.

    A single outlier does not end a run; two do.

    Signal and tolerance have the same unit.
    """
    runs, first = [], 0
    values = x.tolist()
    centre = values[0] if values else 0.0
    for i in range(1, len(values)):
        if values[i] == centre:
            continue
        outside = abs(values[i] - centre) > tolerance
        if outside and (i + 1 >= len(values) or abs(values[i + 1] - centre) > tolerance):
            runs.append((first, i))
            first, centre = i, values[i]
        elif not outside and i - first < SETTLING:
            centre = statistics.median(values[first : i + 1])
    if values:
        runs.append((first, len(values)))
    return runs


def settled_rows(values: dict[str, Array]) -> tuple[dict[str, Array], Finding]:
    """Return the steady rows of a log over time: means over the last 40 % of each level of the pulse or the speed.

    Args:
        values: `time` [s] and any of speed [rad/s], force [N], pulse [µs] and voltage [V], (n,) each.

    Returns:
        The columns without `time` in their units, one row per level, and a finding; all rows if the log is a slow
        sweep.
    """
    times = values["time"]
    others = {key: value for key, value in values.items() if key != "time"}
    drive = values.get("pulse", values.get("speed"))
    assert drive is not None
    good = np.flatnonzero(np.isfinite(drive) & np.isfinite(times))
    span = float(np.ptp(drive[good])) if good.size else 0.0
    band = TOLERANCE * span if "pulse" not in values else 0.002 * span
    rows, covered = [], 0.0
    for first, last in levels(drive[good], band):
        index = good[first:last]
        length = float(times[index[-1]] - times[index[0]])
        half = len(index) // 2
        if length < SHORTEST or half < 2:
            continue
        settled = index[times[index] >= times[index[-1]] - LAST * length]
        drift = abs(np.mean(drive[index[half:]]) - np.mean(drive[index[half // 2 : half]]))
        if drift <= 0.25 * band:
            rows.append(settled)
            covered += length
    if len(rows) < 3 or covered < LEAST_COVERED * float(times[good[-1]] - times[good[0]]):
        return others, finding("read_as_sweep", rows=len(times))
    steady = {key: np.array([finite_mean(value[row]) for row in rows]) for key, value in others.items()}
    return steady, finding("read_as_levels", levels=len(rows), share=LAST)


def finite_mean(values: Array) -> float:
    """Return the mean of the finite values, NaN if there are none. The unit is kept."""
    good = values[np.isfinite(values)]
    return float(np.mean(good)) if good.size else float("nan")


def find_steps(t: Array, command: Array) -> list[LevelStep]:
    """Return the changes between held levels of a command.

    Args:
        t: Times [s], (n,).
        command: Values of the command in its own unit, finite, (n,).

    Returns:
        Steps in order of time; none if the command never holds a level.
    """
    span = float(np.ptp(command)) if command.size else 0.0
    if span == 0.0:
        return []
    runs = levels(command, 0.01 * span)
    held = [(a, b) for a, b in runs if t[b - 1] - t[a] >= SHORTEST_HELD]
    if len(runs) > 4 * len(held):  # a command that moves all the time
        return []
    return [LevelStep(float(t[a - 1]), float(t[a]), float(t[b - 1])) for a, b in held[1:]]
