"""Samples that a log repeats: a stream of 10 Hz written into every row of a table of 50 Hz is still one of 10 Hz."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.trials.columns import COLUMNS

__all__ = ["new_samples", "without_repeats"]

Array = NDArray[np.float64]

FEWEST = 10
"""Runs of equal rows that it takes to call a stream repeated."""

LEAST = 0.2
"""Part of the rows that are repeats; fewer do no harm."""

REGULAR = 0.9
"""Part of the runs that may not be much longer than the usual one: clocks repeat regularly, resting sensors do not."""


def without_repeats(channels: dict[str, Array]) -> list[str]:
    """Turn the repeated samples of measured streams into empty ones, in place; notes on what was found.

    Left in, they would count as measurements of their own, and their steps as motion. Inputs are left alone: a command
    that stays is a command.
    """
    groups: dict[str, list[str]] = {}
    for name in channels:
        if name in COLUMNS and COLUMNS[name].group != "command":
            groups.setdefault(COLUMNS[name].group, []).append(name)
    notes = []
    for group, names in groups.items():
        values = np.stack([channels[name] for name in names], axis=-1)
        rows = np.flatnonzero(np.isfinite(values).any(axis=1))
        new = new_samples(values[rows])
        if not new.all():
            for name in names:
                channels[name] = channels[name].copy()
                channels[name][rows[~new]] = np.nan
            notes.append(
                f"{group}: every new sample is repeated, {len(rows) / new.sum():.1f} rows on average; "
                "repeats count as empty"
            )
    return notes


def new_samples(values: Array) -> NDArray[np.bool_]:
    """Which rows are new, (n, c) -> (n,); all where the rows do not repeat in a regular way.

    Long runs are taken for rest: in them a row counts as new every usual run.
    """
    n = len(values)
    everything = np.ones(n, bool)
    if n < 2 * FEWEST:
        return everything
    same = ((values[1:] == values[:-1]) | (np.isnan(values[1:]) & np.isnan(values[:-1]))).all(axis=1)
    starts = np.flatnonzero(np.concatenate([[True], ~same]))
    lengths = np.diff(np.concatenate([starts, [n]]))
    usual = int(np.median(lengths))
    short = lengths[lengths <= usual + 1]
    repeated = 1.0 - len(short) / short.sum()
    regular = usual >= 2 and len(short) >= max(FEWEST, REGULAR * len(lengths)) and repeated >= LEAST
    if not regular or all(_coarse(column) for column in values[starts].T):
        return everything
    since = np.arange(n) - np.repeat(starts, lengths)
    return np.asarray(since % usual == 0) & ((since == 0) | np.repeat(lengths > usual + 1, lengths))


def _coarse(changes: Array) -> bool:
    """Whether most changes are of one size: the last digit of a sensor, which repeats for another reason."""
    steps = np.abs(np.diff(changes))
    steps = steps[steps > 0.0]
    return len(steps) > 0 and float(np.mean(steps < 1.001 * steps.min())) > 0.5
