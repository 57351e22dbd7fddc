"""Trials on disk: a folder with `trial.yaml` and `data.csv` or `data.parquet`, or a bare table."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from finssim.core.budget import CELLS
from finssim.core.files import OutputError, atomic_directory
from finssim.core.text_table import number, read_text_table, write_csv
from finssim.core.yaml_file import read_mapping, yaml_text
from finssim.trials.conversion import ordered, sampled, tidy_quaternions, upside_down, without_dead
from finssim.trials.findings import CalibrationError, Finding, finding
from finssim.trials.trial import COLUMNS, INPUT_PREFIXES, PHASES, Header, Trial, column_of
from finssim.vehicles import Vehicle, load_vehicle
from finssim.vehicles.part import did_you_mean, sentence_of

__all__ = [
    "ColumnTable",
    "load_trial",
    "load_trials",
    "new_samples",
    "read_table",
    "trials_at",
    "write_trial",
]

Array = NDArray[np.float64]

MAX_RAGGED = 0.1
"""Fraction of the rows that may have a wrong number of cells; a file with more of them is not a table."""


@dataclass
class ColumnTable:
    """Columns of one file, all of equal length."""

    numbers: dict[str, Array] = field(default_factory=dict)
    """Column -> values in any unit, NaN for empty cells and cells without a number."""
    words: dict[str, list[str]] = field(default_factory=dict)
    """Column -> text, for columns in which no cell is a number (and for `phase`)."""
    findings: list[Finding] = field(default_factory=list)
    """Repairs, and data that was omitted."""

    @property
    def columns(self) -> list[str]:
        """Names of all columns."""
        return [*self.numbers, *self.words]


def read_table(
    path: Path, *, skip: int = 0, names: Sequence[str] | None = None, spaces: bool = False
) -> ColumnTable:
    """Return the columns of a `.csv` (`.txt`, `.tsv`) or `.parquet` file.

    A CSV file needs a header line; cells may be separated by commas, semicolons or tabs, and lines that begin
    with # are comments. A file truncated by a crash is read up to its end.

    Args:
        path: The file.
        skip: Number of lines before the table in a text file.
        names: Names of the columns of a text file without a header line.
        spaces: True if blanks separate the cells of a text file.

    Raises:
        CalibrationError: The file is unreadable, empty, without column names, or not a table.
    """
    if path.suffix.lower() in (".parquet", ".pq"):
        return _read_parquet(path)
    return _read_csv(path, skip=skip, names=names, spaces=spaces)


def write_table(path: Path, numbers: dict[str, Array], phase: NDArray[np.str_] | None = None) -> None:
    """Write columns as CSV or Parquet, by the path's suffix; numbers are read back bitwise equal, NaN is an
    empty cell.

    Args:
        path: Path of the file.
        numbers: Column -> values in any unit, (n,) each.
        phase: Phase of each row, (n,); the column is omitted if None.
    """
    if path.suffix == ".parquet":
        import pyarrow.parquet

        columns: dict[str, Any] = dict(numbers)
        if phase is not None:
            columns["phase"] = pyarrow.array(phase.tolist(), pyarrow.string())
        pyarrow.parquet.write_table(pyarrow.table(columns), path)
        return
    cells = [["" if x != x else repr(x) for x in values.tolist()] for values in numbers.values()]
    names = list(numbers)
    if phase is not None:
        names.append("phase")
        cells.append(phase.tolist())
    write_csv(path, names, zip(*cells, strict=True))


def _read_csv(path: Path, **options: Any) -> ColumnTable:
    text = read_text_table(path, CalibrationError, **options)
    table, names = ColumnTable(), text.names
    if text.zeros:
        table.findings.append(finding("zero_bytes"))
    _check_names(names, path)
    columns: list[list[float | str]] = [[] for _ in names]
    ragged: list[int] = []
    for count, line in enumerate(text.texts, start=1):
        row = text.split(line)
        if len(row) < len(names) or any(row[len(names) :]):
            ragged.append(count)
            continue
        if text.unfinished and count == len(text.texts) and row[-1]:
            row[-1] = ""
            table.findings.append(finding("last_cell_cut"))
        for column, cell in zip(columns, row, strict=False):
            try:
                column.append(float(cell) if cell else math.nan)
            except ValueError:
                value = text.number(cell)
                column.append(cell if value is None else value)
    _report_ragged(ragged, len(text.texts), len(names), text.unfinished, table, path)
    for name, column in zip(names, columns, strict=True):
        _keep(table, name, column)
    return table


def _check_names(names: list[str], path: Path) -> None:
    if not any(names) or any("\ufffd" in name for name in names):
        raise CalibrationError(f"{path}: no line of column names: expected a CSV file that begins with t,...")
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise CalibrationError(f"{path}: column '{twice[0]}' occurs twice: rename or remove one")
    try:
        [float(name) for name in names]
    except ValueError:
        return
    raise CalibrationError(f"{path}: begins with numbers, expected a line of column names such as t,tau_x,u")


def _report_ragged(
    ragged: list[int], count: int, width: int, cut: bool, table: ColumnTable, path: Path
) -> None:
    if ragged == [count] and cut:
        table.findings.append(finding("last_line_cut"))
    elif len(ragged) > max(1.0, MAX_RAGGED * count):
        raise CalibrationError(
            f"{path}: {len(ragged)} of {count} rows do not have {width} cells, one for each column name "
            f"(first: row {ragged[0]}): does it contain exactly one table, with one separator?"
        )
    elif ragged:
        table.findings.append(finding("ragged_rows", rows=len(ragged), expected=width, first=ragged[0]))


def _keep(table: ColumnTable, name: str, column: list[Any]) -> None:
    """Store a column under numbers or words."""
    if not name:
        return
    text_rows = [i for i, cell in enumerate(column) if isinstance(cell, str)]
    if name == "phase" or (text_rows and all(isinstance(c, str) or math.isnan(c) for c in column)):
        table.words[name] = [cell if isinstance(cell, str) else "" for cell in column]
        return
    if text_rows:
        first = text_rows[0]
        about = {"column": name, "cells": len(text_rows), "cell": column[first][:40], "row": first + 1}
        table.findings.append(finding("not_numbers", **about))
        for i in text_rows:
            column[i] = math.nan
    table.numbers[name] = np.array(column, dtype=float)


def _read_parquet(path: Path) -> ColumnTable:
    try:
        import pyarrow.parquet
    except ImportError:
        raise CalibrationError(f"{path}: reading Parquet needs pyarrow: pip install pyarrow") from None
    try:
        about = pyarrow.parquet.read_metadata(path)
        if about.num_rows * about.num_columns > CELLS:
            raise CalibrationError(
                f"{path}: has {about.num_rows} rows of {about.num_columns} columns, expected at most {CELLS >> 20} "
                "million cells: cut it into several files"
            )
        content = pyarrow.parquet.read_table(path)
    except (OSError, pyarrow.ArrowException) as error:
        raise CalibrationError(
            f"{path}: is not a complete Parquet file: {' '.join(str(error).split())[:120]}"
        ) from None
    table = ColumnTable()
    _check_names(content.column_names, path)
    of = pyarrow.types
    for name in content.column_names:
        kind = content.schema.field(name).type
        column = content.column(name)
        if of.is_timestamp(kind):
            table.words[name] = [str(word) for word in column.to_numpy()]
        elif any(is_kind(kind) for is_kind in (of.is_integer, of.is_floating, of.is_boolean, of.is_decimal)):
            if name != "phase":
                table.numbers[name] = np.array(column.cast(pyarrow.float64(), safe=False), dtype=np.float64)
        elif any(is_kind(kind) for is_kind in (of.is_string, of.is_large_string, of.is_dictionary)):
            cells = ["" if cell is None else str(cell) for cell in column.to_pylist()]
            numbers = [number(cell) for cell in cells]
            _keep(table, name, [c if x is None else x for c, x in zip(cells, numbers, strict=True)])
        else:
            table.findings.append(finding("column_kind", column=name, kind=str(kind)))
    return table


# Conversion of a table's columns to a trial.

# Repeated samples in a log: a 10 Hz stream written to every row of a 50 Hz table is still a 10 Hz stream.

FEWEST = 10
"""Least number of runs of equal rows of a repeated stream."""

LEAST = 0.2
"""Least fraction of repeated rows; fewer are harmless."""

REGULAR = 0.9
"""Fraction of the runs that may not be much longer than the median: clocks repeat regularly, resting sensors
do not."""


def without_repeats(channels: dict[str, Array]) -> list[Finding]:
    """Clear the repeated samples of measured streams, in place; return findings.

    Otherwise they would count as independent measurements, and their steps as motion. Inputs are not changed:
    a constant command is a command.
    """
    groups: dict[str, list[str]] = {}
    for name in channels:
        if name in COLUMNS and COLUMNS[name].group != "command":
            groups.setdefault(COLUMNS[name].group, []).append(name)
    findings = []
    for group, names in groups.items():
        values = np.stack([channels[name] for name in names], axis=-1)
        rows = np.flatnonzero(np.isfinite(values).any(axis=1))
        new = new_samples(values[rows])
        if not new.all():
            for name in names:
                channels[name] = channels[name].copy()
                channels[name][rows[~new]] = np.nan
            findings.append(finding("repeated_samples", group=group, rows=len(rows) / new.sum()))
    return findings


def new_samples(values: Array) -> NDArray[np.bool_]:
    """Return a mask of the new rows, (n, c) -> (n,); all rows if they do not repeat regularly.

    Long runs are assumed to be rest: within them, one row per median run counts as new.
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
    """Return whether most changes have the same size: the resolution of a sensor, which repeats values for
    another reason."""
    steps = np.abs(np.diff(changes))
    steps = steps[steps > 0.0]
    return len(steps) > 0 and float(np.mean(steps < 1.001 * steps.min())) > 0.5


EPOCH = 1.0e8
"""Time above which times count from 1970 [s]; it exceeds three years of operation."""


def trial_from_table(name: str, table: ColumnTable, header: Header, path: Path | None = None) -> Trial:
    """Return a trial from the columns of a table, sorted by time; each repair is a finding.

    Args:
        name: Name of the trial.
        table: Columns as written, in SI and FinsSim's frames.
        header: Content of `trial.yaml`.
        path: File or folder of the table.

    Raises:
        CalibrationError: There is no time column, fewer than two rows, or no usable column.
    """
    findings, numbers, texts = list(table.findings), dict(table.numbers), dict(table.words)
    if "t" not in table.columns:
        raise CalibrationError(_no_time(table.columns))
    t = _seconds(numbers.pop("t", None), texts.pop("t", None), findings)
    phase = _phases(texts.pop("phase", None), findings)
    channels = _canonical(numbers, list(texts), findings)
    for column, values in channels.items():
        infinite = np.isinf(values)
        if infinite.any():
            findings.append(finding("infinite_numbers", column=column, cells=infinite.sum()))
        channels[column] = np.where(infinite, np.nan, values)
    t, channels, phase = _in_order(t, channels, phase, findings)
    findings += without_repeats(channels)
    findings += without_dead(t, channels)
    findings += tidy_quaternions(channels)
    if upside_down(channels):
        findings.append(finding("upside_down"))
    if not any(np.isfinite(values).sum() >= 2 for values in channels.values()):
        raise CalibrationError(
            f"no usable column besides t: expected some of {', '.join(COLUMNS)}, "
            f"{', '.join(f'{p}NAME' for p in INPUT_PREFIXES)} with numbers in them; "
            f"found {', '.join(table.columns[:12])}"
        )
    return Trial(
        name=name, t=t, channels=channels, phase=phase, header=header, findings=tuple(findings), path=path
    )


def _no_time(columns: list[str]) -> str:
    like = [c for c in columns if re.search(r"time|stamp|^t\b|^t_|_t$|secs|sec$", c, re.IGNORECASE)]
    return (
        f"no column 't' (time in s); the table has {', '.join(columns[:12])}: import it with a map that names the "
        f"time, 'time: {like[0] if like else 'NAME'}' (finssim trials import FILE --map MAP)"
    )


def _seconds(numbers: Array | None, texts: list[str] | None, findings: list[Finding]) -> Array:
    """Return times in s from numbers or dates; those that count from 1970 are shifted to start at 0."""
    if numbers is None:
        try:
            dates = np.array([w.removesuffix("Z") or "NaT" for w in texts or []], dtype="datetime64[ns]")
        except ValueError:
            raise CalibrationError(
                f"t contains '{(texts or [''])[0]}', expected seconds or dates like 2024-05-01T12:00:00.25"
            ) from None
        valid = dates[~np.isnat(dates)]
        start = valid[0] if len(valid) else np.datetime64("NaT", "ns")
        findings.append(finding("dates", start=str(start)))
        return np.where(np.isnat(dates), np.nan, (dates - start) / np.timedelta64(1, "s"))
    valid = numbers[np.isfinite(numbers)]
    if len(valid) and abs(valid[0]) > EPOCH:
        findings.append(finding("epoch", start=valid[0]))
        return numbers - valid[0]
    return numbers


def _phases(texts: list[str] | None, findings: list[Finding]) -> NDArray[np.str_] | None:
    if texts is None:
        return None
    table = {word: word.strip().lower() for word in set(texts)}
    unknown = sorted(word for word in table.values() if word not in PHASES and word)
    if unknown:
        first, hint = unknown[0], did_you_mean(unknown[0], list(PHASES))
        findings.append(finding("unknown_phases", word=first, hint=hint, known=PHASES, count=len(unknown)))
    return np.array([table[w] if table[w] in PHASES else "" for w in texts], dtype=np.str_)


def _canonical(numbers: dict[str, Array], texts: list[str], findings: list[Finding]) -> dict[str, Array]:
    """Return the columns of the log that are columns of a trial."""
    channels = {column: values for column, values in numbers.items() if column_of(column)}
    for column in texts:
        if column_of(column):
            findings.append(finding("column_kind", column=column, kind="words"))
    unknown = [column for column in [*numbers, *texts] if not column_of(column)]
    for column in unknown[:5]:
        close = did_you_mean(column.lower(), [c for c in COLUMNS if c not in channels]).rstrip(";")
        findings.append(finding("unknown_column", column=column, hint=close))
    if len(unknown) > 5:
        findings.append(finding("unknown_columns", count=len(unknown) - 5, columns=tuple(unknown[5:])))
    return channels


def _in_order(
    t: Array, channels: dict[str, Array], phase: NDArray[np.str_] | None, findings: list[Finding]
) -> tuple[Array, dict[str, Array], NDArray[np.str_] | None]:
    """Return the rows with strictly increasing times."""
    timed = np.isfinite(t)
    if not timed.all():
        findings.append(finding("rows_untimed", rows=(~timed).sum()))
        t, channels = t[timed], {column: values[timed] for column, values in channels.items()}
        phase = None if phase is None else phase[timed]
    if len(t) < 2:
        raise CalibrationError(f"{len(t)} rows with a time, expected at least 2")
    t, rows, remarks = ordered(t, channels)
    findings += remarks
    phase = None if phase is None else phase[rows]
    t, channels, selected, remarks = sampled(t, {column: values[rows] for column, values in channels.items()})
    findings += remarks
    if len(t) < 2:
        raise CalibrationError(f"all rows have the time {t[0]:.6g} s: expected times that increase")
    return t, channels, None if phase is None else phase[selected]


# Reading and writing `trial.yaml`.


def read_header(path: Path) -> Header:
    """Return the header in a `trial.yaml`; an empty file is an empty header.

    Raises:
        CalibrationError: The file is unreadable, or a key or value is invalid; one sentence per key.
    """
    if path.is_file() and path.stat().st_size < 65536 and not _content(path):
        return Header()
    tree = read_mapping(path, CalibrationError, such_as="vehicle: finsrov")
    try:
        return Header.model_validate(tree)
    except ValidationError as error:
        raise CalibrationError(
            "\n".join(sentence_of(detail, str(path)) for detail in error.errors())
        ) from None


def _content(path: Path) -> str:
    """Return the content of a file without comments and blank lines."""
    lines = path.read_bytes().decode("utf-8", errors="replace").splitlines()
    return "".join(line for line in lines if line.strip() and not line.lstrip().startswith("#"))


HEADER = "trial.yaml"
DATA = ("data.csv", "data.parquet")
SUFFIXES = (".csv", ".parquet")


def load_trial(path: str | os.PathLike[str]) -> Trial:
    """Read one trial.

    Args:
        path: A folder with `data.csv` or `data.parquet` and optionally `trial.yaml`; or a single table.

    Raises:
        CalibrationError: There is no trial, or it cannot be used; the message states location and reason.
            Repairs are reported in the trial's `findings` instead.
    """
    path = Path(path)
    name, data, header_path = _locate(path)
    header = read_header(header_path) if header_path else Header()
    table = read_table(data)
    try:
        return trial_from_table(name, table, header, path)
    except CalibrationError as error:
        raise CalibrationError(f"{data}: {error}") from None


def load_trials(paths: Iterable[str | os.PathLike[str]]) -> list[Trial]:
    """Read several trials under unique names, in the order given.

    Args:
        paths: Paths of trials, or of folders that contain trials.

    Raises:
        CalibrationError: A trial cannot be used, there are no trials, or one is given twice.
    """
    locations = [trial for path in paths for trial in trials_at(Path(path))]
    trials = [load_trial(path) for path in locations]
    first_paths: dict[str, Path] = {}
    for path, trial in zip(locations, trials, strict=True):
        first = first_paths.setdefault(trial.sha256, path)
        if first is not path:
            raise CalibrationError(
                f"{path}: contains the same numbers as {first}: a trial given twice would count as two measurements; "
                "omit one of them"
            )
    if not trials:
        raise CalibrationError(
            "no trial given: give folders that contain data.csv or data.parquet, or such files"
        )
    names = _unique_names(trials, locations)
    return [
        replace(trial, name=name) if name != trial.name else trial
        for trial, name in zip(trials, names, strict=True)
    ]


ABOVE = 3
"""Number of folders, from the trial's own upwards, in which a missing vehicle file is searched."""


def vehicle_reference(name: str) -> str:
    """Return the vehicle reference of a trial: a name of the catalogue, or the absolute path of an existing file."""
    path = Path(name)
    is_file = (path.suffix != "" or path.name != name) and path.is_file()
    return str(path.resolve()) if is_file else name


def vehicle_of(trial: Trial) -> Vehicle:
    """Return the vehicle that the header of a trial names.

    A relative path is relative to the trial's folder, or otherwise to the working directory. If the file does
    not exist there, its name is searched in the trial's folder and the two above, so that trials and vehicle
    can be moved together.

    Raises:
        VehicleError: There is no such vehicle, or its file is invalid.
    """
    named = str(trial.header.vehicle)
    beside = Path(trial.path or ".") / named
    if beside.is_file():
        return load_vehicle(beside)
    path = Path(named)
    if trial.path and path.suffix in (".yaml", ".yml") and not path.is_file():
        folder = Path(trial.path).resolve()
        for place in [folder, *folder.parents][:ABOVE]:
            if (place / path.name).is_file():
                return load_vehicle(place / path.name)
    return load_vehicle(named)


def write_trial(
    trial: Trial, folder: str | os.PathLike[str], *, format: Literal["csv", "parquet"] = "csv"
) -> None:
    """Write a trial as a folder of `trial.yaml` and data, which has the same `sha256` when read.

    Args:
        trial: Trial in canonical columns.
        folder: New or empty folder, or one with an earlier FinsSim trial, which is replaced.
        format: Format of the data.

    Raises:
        CalibrationError: The format is unknown.
        OutputError: The folder contains other files, or cannot be written.
    """
    if format not in ("csv", "parquet"):
        raise CalibrationError(f"format is '{format}', expected csv or parquet")
    target = Path(folder)
    if target.is_dir():
        other = sorted({file.name for file in target.iterdir()} - {HEADER, *DATA})
        if other:
            raise OutputError(
                f"cannot write {folder}: the directory contains other files ({other[0]}): give a new one"
            )
    with atomic_directory(target, replaces=HEADER) as temporary:
        header = trial.header.model_dump(mode="json", exclude_defaults=True)
        (temporary / HEADER).write_text(yaml_text(header) if header else "{}\n", encoding="utf-8")
        write_table(temporary / f"data.{format}", {"t": trial.t, **trial.channels}, trial.phase)


def _locate(path: Path) -> tuple[str, Path, Path | None]:
    """Return name, data file and header file of the trial at a path."""
    if path.name in (HEADER, *DATA) and path.is_file():
        path = path.parent
    if path.is_dir():
        data = [path / file for file in DATA if (path / file).is_file()]
        if len(data) != 1:
            holding = "both data.csv and data.parquet" if data else "neither data.csv nor data.parquet"
            raise CalibrationError(f"{path}: contains {holding}, expected one of them")
        header = path / HEADER
        return path.resolve().name, data[0], header if header.exists() else None
    if not path.exists():
        raise CalibrationError(
            f"{path}: no such file or folder: give a trial's folder, .csv or .parquet file"
        )
    if path.suffix.lower() not in SUFFIXES:
        raise CalibrationError(
            f"{path}: is not a trial: expected a folder with data.csv or data.parquet, or such a file; "
            "other logs are converted by 'finssim trials import'"
        )
    return path.stem, path, None


def trials_at(path: Path) -> list[Path]:
    """Return the trial at a path, or those in the folder there, in natural order of their names."""
    if not path.is_dir() or any((path / file).is_file() for file in DATA):
        return [path]
    inside = [item for item in path.iterdir() if not item.name.startswith(".")]
    trials = [
        item
        for item in inside
        if (item.is_dir() and any((item / file).is_file() for file in DATA))
        or (item.is_file() and item.suffix.lower() in SUFFIXES)
    ]
    if not trials:
        raise CalibrationError(
            f"{path}: contains no trial: expected data.csv or data.parquet in it or in its subfolders"
        )
    return sorted(
        trials, key=lambda item: [int(w) if w.isdigit() else w for w in re.split(r"(\d+)", item.name)]
    )


def _unique_names(trials: list[Trial], paths: list[Path]) -> list[str]:
    """Return the names of the trials; equal names are extended by as many parent folders as needed."""
    names = [trial.name for trial in trials]
    parents = [list(path.resolve().parts[-2::-1]) for path in paths]
    depth = 0
    while len(set(names)) < len(names) and depth < max(len(p) for p in parents):
        twice = {name for name in names if names.count(name) > 1}
        names = [
            f"{p[depth]}/{name}" if name in twice and depth < len(p) else name
            for name, p in zip(names, parents, strict=True)
        ]
        depth += 1
    return [
        name if name not in names[:i] else f"{name} ({names[:i].count(name) + 1})"
        for i, name in enumerate(names)
    ]
