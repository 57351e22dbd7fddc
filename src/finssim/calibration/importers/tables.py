"""Tables: CSV and other separated text, and Parquet."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.importers.assemble import in_our_axes
from finssim.calibration.importers.source_map import ColumnSource, PhaseColumn, SourceMap, TimeColumn
from finssim.calibration.importers.streams import Stream
from finssim.calibration.trials import table_file
from finssim.calibration.trials.trial import Array, column_of
from finssim.calibration.trials.units import TIME_UNITS, factor
from finssim.vehicles.part import did_you_mean

__all__ = ["TABLES", "read_table", "spoken", "values_of"]

TABLES = (".csv", ".tsv", ".txt", ".dat", ".parquet", ".pq")
TIME_NAMES = ("t", "time", "time_s", "time_secs", "timestamp", "stamp")
"""Names under which the time is looked for where no map says it; seconds."""


def read_table(path: Path, source: SourceMap | None) -> Stream:
    """One table as a stream.

    Args:
        path: Text or Parquet file.
        source: How it is read; without it the columns with canonical names are taken.

    Raises:
        CalibrationError: Unreadable, or a column that it has not.
    """
    shown = path.name
    how = source or SourceMap()
    table = table_file.read_table(path, skip=how.skip_rows, names=how.names, spaces=how.spaces)
    findings = tuple(one.about(shown) for one in table.findings)
    if source is None:
        source = _by_names(table, shown)
    if source.time is None:
        raise CalibrationError(f"{shown}: no time: give 'time: COLUMN' of its columns {_listed(table)}")
    if not source.columns and source.phase is None:
        raise CalibrationError(
            f"{shown}: no columns: give 'columns: {{u: NAME, ...}}' of its columns {_listed(table)}"
        )
    t = _time(table, source.time, shown) + source.time_offset
    channels = {}
    for name, spec in source.columns.items():
        raw = np.zeros(len(t)) if spec.column is None else _numbers(table, spec.column, shown)
        channels[name] = values_of(raw, name, spec)
    words = {}
    if source.phase is not None:
        words["phase"] = spoken(_text(table, source.phase.column, shown), source.phase)
    if source.split is not None:
        words["split"] = np.array(_text(table, source.split, shown), dtype=np.str_)
    stream = Stream(source=shown, t=t, channels=channels, words=words, findings=findings)
    return in_our_axes(stream, source.frame)


def values_of(raw: Array, name: str, spec: ColumnSource) -> Array:
    """Values of a canonical column from the numbers of the log: a constant, or scaled, shifted, in our unit, signed."""
    given = np.full(len(raw), spec.value) if spec.column is None else raw
    return np.asarray(spec.sign * (spec.scale * given + spec.offset) * factor(spec.unit, name), dtype=float)


def spoken(words: Iterable[str], phase: PhaseColumn) -> NDArray[np.str_]:
    """Words of the log as phases."""
    return np.array([phase.words.get(word, "") if phase.words else word for word in words], dtype=np.str_)


def _by_names(table: table_file.Table, shown: str) -> SourceMap:
    """A map of the columns that have canonical names."""
    time = next((name for name in TIME_NAMES if name in table.numbers), None)
    known = [name for name in table.numbers if column_of(name) is not None]
    if time is None or not known:
        what = "time" if time is None else "column with the name of a trial's column"
        raise CalibrationError(
            f"{shown}: no {what}; its columns are {_listed(table)}: write a map file and give it with --map"
        )
    phase = "phase" if "phase" in table.words else None
    return SourceMap.model_validate({"time": time, "columns": {name: name for name in known}, "phase": phase})


def _known(table: table_file.Table, name: str, shown: str) -> None:
    if name not in table.columns:
        raise CalibrationError(
            f"{shown}: no column '{name}'{did_you_mean(name, table.columns)} its columns are {_listed(table)}"
        )


def _numbers(table: table_file.Table, name: str, shown: str) -> Array:
    _known(table, name, shown)
    if name not in table.numbers:
        example = next((word for word in table.words[name] if word), "")
        raise CalibrationError(f"{shown}: column '{name}' holds no numbers, for instance '{example}'")
    return table.numbers[name]


def _text(table: table_file.Table, name: str, shown: str) -> list[str]:
    _known(table, name, shown)
    return table.words[name] if name in table.words else [f"{x:g}" for x in table.numbers[name]]


def _time(table: table_file.Table, time: TimeColumn, shown: str) -> Array:
    """Seconds on the clock of the log."""
    _known(table, time.column, shown)
    if time.unit != "date" and time.column in table.numbers:
        return table.numbers[time.column] * TIME_UNITS[time.unit]
    try:
        dates = np.array(
            [_date(word) for word in _text(table, time.column, shown)],
            dtype="datetime64[us]",
        )
    except ValueError:
        raise CalibrationError(
            f"{shown}: column '{time.column}' holds neither numbers nor dates such as 2026-05-31 12:30:00.25: "
            "give a column that does"
        ) from None
    seconds = dates.astype(np.int64) * 1e-6
    return np.where(np.isnat(dates), np.nan, seconds)


def _date(word: str) -> str:
    """A date as NumPy reads it: universal time without saying so, and a day for a time without one."""
    word = re.sub(r"(Z|[+-]00:?00)$", "", word.strip())
    return f"1970-01-01T{word}" if re.match(r"\d\d:\d", word) else word or "NaT"


def _listed(table: table_file.Table) -> str:
    names = table.columns
    return ", ".join(names[:40]) + (f" and {len(names) - 40} more" if len(names) > 40 else "")
