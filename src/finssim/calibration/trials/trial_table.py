"""From the columns of a log to a trial: names, times, units, frames."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.trials.columns import COLUMNS, INPUT_PREFIXES, column_of
from finssim.calibration.trials.conversion import (
    factor_and_offset,
    in_our_frames,
    new_names,
    shifted,
    tidy_quaternions,
    upside_down,
)
from finssim.calibration.trials.header import Header
from finssim.calibration.trials.repeats import without_repeats
from finssim.calibration.trials.table_file import Table
from finssim.calibration.trials.time_base import ordered, sampled
from finssim.calibration.trials.trial import PHASES, Trial
from finssim.vehicles.part import did_you_mean

__all__ = ["trial_from_table"]

Array = NDArray[np.float64]

EPOCH = 1.0e8
"""Times later than this count from 1970 [s]; no vehicle has been on for three years."""


def trial_from_table(name: str, table: Table, header: Header, path: Path | None = None) -> Trial:
    """A trial from the columns of a log: renamed, scaled, in our frames, in order of time, with notes on every repair.

    Args:
        name: Of the trial.
        table: Columns as logged.
        header: Its `convert` section is applied; the trial's header no longer has it.
        path: Where the log was read.

    Raises:
        CalibrationError: No time, fewer than two rows, no usable column, or a conversion of what is not there.
    """
    notes = list(table.notes)
    names = new_names(table.columns, header.convert)
    numbers = {names[old]: values for old, values in table.numbers.items()}
    words = {names[old]: values for old, values in table.words.items()}
    if "t" not in numbers and "t" not in words:
        raise CalibrationError(_no_time(table.columns))
    change = factor_and_offset([*numbers, *words], header.convert)
    t = _seconds(numbers.pop("t", None), words.pop("t", None), change.get("t", (1.0, 0.0)), notes)
    phase = _phases(words.pop("phase", None), notes)
    channels = _canonical(numbers, list(words), notes)
    for column, values in channels.items():
        infinite = np.isinf(values)
        if infinite.any():
            notes.append(f"column '{column}': {infinite.sum()} infinite numbers count as empty")
        factor, offset = change.get(column, (1.0, 0.0))
        channels[column] = np.where(infinite, np.nan, values) * factor + offset
    t, channels, phase = _in_order(t, channels, phase, notes)
    notes += without_repeats(channels)
    channels = in_our_frames(channels, header.convert)
    notes += tidy_quaternions(channels)
    if upside_down(channels):
        notes.append(
            "the attitude has the vehicle on its back most of the time: "
            "are convert.body and convert.world what the log uses?"
        )
    if not any(np.isfinite(values).sum() >= 2 for values in channels.values()):
        raise CalibrationError(
            f"no usable column beside t: expected some of {', '.join(COLUMNS)}, "
            f"{', '.join(f'{p}NAME' for p in INPUT_PREFIXES)} with numbers in them; "
            f"found {', '.join(table.columns[:12])}"
        )
    old = t
    t, channels = shifted(t, channels, header.convert)
    if phase is not None and t is not old:
        phase = phase[np.clip(np.searchsorted(old, t, side="right") - 1, 0, None)]
    header = header.model_copy(update={"convert": type(header.convert)()})
    return Trial(name=name, t=t, channels=channels, phase=phase, header=header, notes=tuple(notes), path=path)


def _no_time(columns: list[str]) -> str:
    like = [c for c in columns if re.search(r"time|stamp|^t\b|^t_|_t$|secs|sec$", c, re.IGNORECASE)]
    hint = f"'{like[0]}'" if like else "the column of times"
    return (
        f"no column 't' (time in s); the log has {', '.join(columns[:12])}: say which it is in trial.yaml, "
        f"'convert: {{rename: {{{like[0] if like else 'NAME'}: t}}}}' makes {hint} the time"
    )


def _seconds(
    numbers: Array | None, words: list[str] | None, change: tuple[float, float], notes: list[str]
) -> Array:
    """Times in s from numbers or dates; those that count from 1970 begin at 0."""
    factor, offset = change
    if numbers is None:
        try:
            dates = np.array([w.removesuffix("Z") or "NaT" for w in words or []], dtype="datetime64[ns]")
        except ValueError:
            raise CalibrationError(
                f"t holds '{(words or [''])[0]}', expected seconds or dates like 2024-05-01T12:00:00.25"
            ) from None
        known = dates[~np.isnat(dates)]
        start = known[0] if len(known) else np.datetime64("NaT", "ns")
        notes.append(f"t holds dates; times count from {start}")
        return np.where(np.isnat(dates), np.nan, (dates - start) / np.timedelta64(1, "s"))
    known = numbers[np.isfinite(numbers)]
    if len(known) and abs(known[0] * factor + offset) > EPOCH:
        notes.append(
            f"t counts from 1970; times count from the first row, {known[0] * factor + offset:.6f} s"
        )
        return (numbers - known[0]) * factor
    return numbers * factor + offset


def _phases(words: list[str] | None, notes: list[str]) -> NDArray[np.str_] | None:
    if words is None:
        return None
    table = {word: word.strip().lower() for word in set(words)}
    unknown = sorted(word for word in table.values() if word not in PHASES and word)
    if unknown:
        notes.append(
            f"phase '{unknown[0]}'{did_you_mean(unknown[0], list(PHASES))} known words are {', '.join(PHASES)}; "
            f"{len(unknown)} unknown words count as empty"
        )
    return np.array([table[w] if table[w] in PHASES else "" for w in words], dtype=np.str_)


def _canonical(numbers: dict[str, Array], words: list[str], notes: list[str]) -> dict[str, Array]:
    """The columns of a trial among those of the log."""
    channels = {column: values for column, values in numbers.items() if column_of(column)}
    for column in words:
        if column_of(column):
            notes.append(f"column '{column}' holds words, not numbers, and was left out")
    unknown = [column for column in [*numbers, *words] if not column_of(column)]
    for column in unknown[:5]:
        close = did_you_mean(column.lower(), [c for c in COLUMNS if c not in channels]).rstrip(";")
        notes.append(f"column '{column}' is not one of a trial and was left out{close}")
    if len(unknown) > 5:
        notes.append(
            f"{len(unknown) - 5} more columns are not of a trial and were left out: {', '.join(unknown[5:17])}"
        )
    return channels


def _in_order(
    t: Array, channels: dict[str, Array], phase: NDArray[np.str_] | None, notes: list[str]
) -> tuple[Array, dict[str, Array], NDArray[np.str_] | None]:
    """Rows with strictly increasing times."""
    timed = np.isfinite(t)
    if not timed.all():
        notes.append(f"{(~timed).sum()} rows have no time and were left out")
        t, channels = t[timed], {column: values[timed] for column, values in channels.items()}
        phase = None if phase is None else phase[timed]
    if len(t) < 2:
        raise CalibrationError(f"{len(t)} rows with a time, expected at least 2")
    t, rows, said = ordered(t, channels)
    notes += said
    phase = None if phase is None else phase[rows]
    t, channels, kept, said = sampled(t, {column: values[rows] for column, values in channels.items()})
    notes += said
    if len(t) < 2:
        raise CalibrationError(f"all rows have the time {t[0]:.6g} s: expected times that increase")
    return t, channels, None if phase is None else phase[kept]
