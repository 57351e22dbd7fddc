"""Tables as streams: text, Parquet, NumPy archives and tables in memory, read by a map or by their column names."""

from __future__ import annotations

import json
import math
import re
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.core.budget import CELLS
from finssim.core.importer import Importer
from finssim.core.text_table import decoded, text_table
from finssim.core.yaml_file import read_mapping
from finssim.trials.conversion import EULER, TIME_UNITS, UNITS, factor, unit_of
from finssim.trials.findings import CalibrationError, Finding, finding, listed
from finssim.trials.importers.assemble import Stream, in_our_axes
from finssim.trials.importers.column_map import SourceMap, TimeColumn, Validity, present
from finssim.trials.importers.log import Request, TrialStreams
from finssim.trials.trial import COLUMNS, Array, column_of
from finssim.trials.trial_files import ColumnTable, read_table
from finssim.vehicles.part import did_you_mean

TEXTS = (".csv", ".tsv", ".txt", ".dat")
SUFFIXES = (*TEXTS, ".parquet", ".pq", ".npz")
TIME_NAMES = ("t", "time", "time_s", "time_secs", "timestamp", "stamp")
"""Names of the time column without a map; times are in seconds."""

_UNIT_OF_SUFFIX = {
    **{
        suffix: unit
        for units in (*UNITS.values(), TIME_UNITS)
        for unit in units
        for suffix in (unit.lower(), unit.lower().replace("/", "_"))
    },
    "sec": "s", "secs": "s", "degrees": "deg", "dps": "deg/s", "mps": "m/s", "mps2": "m/s2",
}  # fmt: skip
"""Suffix of a column's name, in lower case -> unit."""

_COLUMN_OF_NAME = {
    **dict(zip(COLUMNS, COLUMNS, strict=True)),
    **{f"{word}{axis}": f"a{axis}" for word in ("acc", "acc_", "accel", "accel_") for axis in "xyz"},
    **{
        f"{word}{axis}": rate
        for word in ("g", "w", "gyro", "gyro_", "gyr_", "omega_")
        for axis, rate in zip("xyz", "pqr", strict=True)
    },
    **{f"pos_{axis}": axis for axis in "xyz"},
    "rollrate": "p", "pitchrate": "q", "yawrate": "r", "rollspeed": "p", "pitchspeed": "q", "yawspeed": "r",
    "heading": "yaw", "pressure": "pressure", "battery_voltage": "voltage",
}  # fmt: skip
"""Common name of a quantity, in lower case and without its unit -> canonical column."""

WORST_FOM = 0.4
"""Figure of merit of a Doppler log from which BlueOS' extension for it ignores a velocity [m/s]."""

EVIDENT: dict[str, tuple[str, dict[str, float]]] = {
    "valid": ("", {}),
    "is_valid": ("", {}),
    "velocity_valid": ("velocity", {}),
    "bottom_lock": ("velocity", {}),
    "fom": ("velocity", {"below": WORST_FOM}),
    "position_valid": ("position", {}),
    "fix_valid": ("position", {}),
    "fix_type": ("position", {"above": 1.0}),  # MAVLink: 0 and 1 are no fix
}
"""Column that marks invalid samples -> group of columns (all if empty), and limits; used if a map has no `valid`."""


def read_stream(path: Path, source: SourceMap | None) -> Stream:
    """Return one table as a stream.

    Args:
        path: Text, Parquet or NumPy file.
        source: Map of its columns; without it, columns with canonical names are read.

    Raises:
        CalibrationError: The file is unreadable, or lacks a column.
    """
    mapping = source or SourceMap()
    if path.suffix.lower() == ".npz":
        table = read_npz(path, mapping.time.column if mapping.time else None)
    else:
        table = read_table(path, skip=mapping.skip_rows, names=mapping.names, spaces=mapping.spaces)
    return table_stream(table, source, path.name)


def read_npz(path: Path, time: str | None) -> ColumnTable:
    """Return the arrays of a NumPy archive as columns; `imu[0]` is the first column of a two-dimensional `imu`.

    Args:
        path: The archive; Python objects in it are refused.
        time: Name of the time array; the first known name if None. Arrays of another length are ignored.

    Raises:
        CalibrationError: The file is not an archive, or contains no time array.
    """
    columns: dict[str, Any] = {}
    others: list[str] = []
    try:
        with np.load(path, allow_pickle=False) as archive:
            if sum(archive.zip.getinfo(name).file_size for name in archive.zip.namelist()) > 8 * CELLS:
                raise CalibrationError(
                    f"{path}: unpacks to more than {8 * CELLS >> 20} MiB: cut it into several files"
                )
            for name in archive.files:
                array = archive[name]
                if array.dtype.names:
                    columns |= {f"{name}.{field}": array[field] for field in array.dtype.names}
                elif array.ndim == 2 and array.shape[1] <= 100:
                    columns |= {f"{name}[{i}]": array[:, i] for i in range(array.shape[1])}
                else:
                    columns[name] = array
    except CalibrationError:
        raise
    except Exception as error:  # depending on the damage, any layer of zipfile and NumPy may raise
        reason = " ".join(str(error).split())[:120]
        raise CalibrationError(f"{path}: cannot be read as a NumPy archive of numbers: {reason}") from None
    time = time or next((name for name in TIME_NAMES if name in columns), None)
    if time not in columns:
        raise CalibrationError(
            f"{path}: no array of times; its arrays are {listed(list(columns), 40)}: give 'time: NAME' in a map"
        )
    for name, array in list(columns.items()):
        if array.shape != columns[time].shape or array.ndim != 1:
            others.append(f"{name} {array.shape}")
            del columns[name]
    table = memory_table(columns)
    table.findings += [finding("not_read", items=", ".join(others))] if others else []
    return table


def memory_table(columns: Mapping[str, Any]) -> ColumnTable:
    """Return columns in memory as a table, with times of NumPy and pandas as written dates.

    Args:
        columns: Name -> array of numbers, dates or text, (n,) each.
    """
    table = ColumnTable()
    for column, array in columns.items():
        if np.issubdtype(array.dtype, np.datetime64):
            table.words[column] = np.datetime_as_string(array.astype("datetime64[us]")).tolist()
        elif array.dtype.kind in "biuf":
            table.numbers[column] = array.astype(np.float64)
        else:
            table.words[column] = ["" if word is None else str(word) for word in array.tolist()]
    return table


def table_stream(table: ColumnTable, source: SourceMap | None, label: str) -> Stream:
    """Return the columns of a table as a stream.

    Args:
        table: Table as read.
        source: Map of its columns; without it, columns with canonical names are read.
        label: Name of the table in messages.

    Raises:
        CalibrationError: The table lacks a column.
    """
    source = _by_names(table, label) if source is None else source
    if source.time is None:
        raise CalibrationError(f"{label}: no time: give 'time: COLUMN' of its columns {_column_list(table)}")
    if not source.columns and source.phase is None and source.arming is None:
        raise CalibrationError(
            f"{label}: no columns: give 'columns: {{u: NAME, ...}}' of its columns {_column_list(table)}"
        )
    stream = stream_of(table, source, _time(table, source.time, label), label)
    used = {source.time.column, *used_columns(source), *(flag.column for flag, _ in _flags(table, source))}
    rest = [name for name in table.columns if name not in used]
    noted = [finding("not_read", items=f"columns {', '.join(rest)}")] if rest else []
    return stream.noting(*(item.about(label) for item in (*table.findings, *noted)))


def used_columns(source: SourceMap) -> list[str]:
    """Return the columns or fields that a map uses, except that of the time."""
    specs = source.columns.values()
    flags = [*(spec.valid for spec in specs), source.arming, *(source.valid or ())]
    names = [
        *(spec.column for spec in specs),
        *worded(source).values(),
        *(flag.column for flag in flags if flag),
    ]
    return [name for name in dict.fromkeys(names) if name is not None]


def worded(source: SourceMap) -> dict[str, str]:
    """Return `phase` and `split` -> the column or field with their words, if the map defines them."""
    phase = {"phase": source.phase.column} if source.phase is not None else {}
    return phase | ({"split": source.split} if source.split is not None else {})


def stream_of(table: ColumnTable, source: SourceMap, t: Array, label: str) -> Stream:
    """Return columns as a stream: valid samples in canonical columns, units and axes.

    Args:
        table: Columns, (n,) each.
        source: Map of the columns.
        t: Times on the clock of the log [s], (n,).
        label: Name of the table in messages.

    Raises:
        CalibrationError: The table lacks a column, or contains no valid sample.
    """
    flags = _flags(table, source)
    channels: dict[str, Array] = {}
    findings: list[Finding] = []
    marked = np.zeros(len(t), bool)
    for column, spec in source.columns.items():
        raw = np.full(len(t), spec.value) if spec.column is None else _numbers(table, spec.column, label)
        values = spec.sign * (spec.scale * raw + spec.offset) * factor(spec.unit, column)
        for flag in (
            *([spec.valid] if spec.valid else []),
            *(flag for flag, names in flags if column in names),
        ):
            valid = _valid(table, flag, label)
            marked |= ~valid
            values = np.where(valid, values, np.nan)
            note = finding("invalid_left_out", samples=(~valid).sum(), total=len(t), column=flag.column)
            findings += [note] if not valid.all() and note not in findings else []
        channels[column] = values
    if marked.any() and not any(np.isfinite(values).any() for values in channels.values()):
        raise CalibrationError(f"{label}: no sample is valid: {findings[0]}")
    words = {}
    for key, name in worded(source).items():
        texts = _text(table, name, label)
        known = source.phase.words if key == "phase" and source.phase is not None else {}
        words[key] = np.array([known.get(word, "") for word in texts] if known else texts, dtype=np.str_)
    if source.arming is not None:
        words["arming"] = np.where(_valid(table, source.arming, label), "armed", "disarmed").astype(np.str_)
    stream = Stream(source=label, t=t + source.time_offset, channels=channels, words=words)
    if marked.any() and not words:
        stream = stream.selected(
            ~marked | np.any([np.isfinite(values) for values in channels.values()], axis=0)
        )
    radians = all(source.columns[name].unit for name in EULER if name in channels)
    return in_our_axes(stream, source.frame, radians=radians).noting(
        *(item.about(label) for item in findings)
    )


def _flags(table: ColumnTable, source: SourceMap) -> list[tuple[Validity, list[str]]]:
    """Return the validity marks with their columns: those of the map, or those detected in the table."""
    columns = list(source.columns)
    if source.valid is not None:
        return [(flag, columns) for flag in source.valid]
    used, flags = set(used_columns(source)), []
    for name in table.columns:
        group, limits = EVIDENT.get(name.lower(), ("", {"above": math.nan}))
        of_group = [column for column in columns if not group or _group(column) == group]
        if name.lower() in EVIDENT and name not in used and of_group and not (limits and name in table.words):
            flags.append((Validity.model_validate({"column": name, **limits}), of_group))
    return flags


def _group(column: str) -> str:
    canonical = column_of(column)
    return canonical.group if canonical else "velocity" if column in ("vx", "vy", "vz") else ""


def _valid(table: ColumnTable, flag: Validity, label: str) -> NDArray[np.bool_]:
    _require_column(table, flag.column, label)
    numbers = table.numbers.get(flag.column)
    return flag.valid(table.words[flag.column] if numbers is None else numbers, label)


def _by_names(table: ColumnTable, label: str) -> SourceMap:
    """Return a map of the columns that have canonical names."""
    time = next((name for name in TIME_NAMES if name in table.columns), None)
    recognised = [name for name in table.numbers if column_of(name) is not None]
    if time is None or not recognised:
        missing = "time" if time is None else "column with the name of a trial's column"
        raise CalibrationError(
            f"{label}: no {missing}; its columns are {_column_list(table)}: describe them in a map file, such as "
            f"'{_draft_map(table, label)}', replace the words in capitals, check units and signs, "
            "and give it with --map"
        )
    phase = "phase" if "phase" in table.words else None
    unit = "s" if time in table.numbers else "date"
    return SourceMap.model_validate(
        {
            "time": {"column": time, "unit": unit},
            "columns": {name: name for name in recognised},
            "phase": phase,
        }
    )


def _draft_map(table: ColumnTable, label: str) -> str:
    """Return a map of the columns with common names as one line of YAML; what names do not state is in capitals."""
    time, columns = "COLUMN", dict[str, str]()
    for name in sorted(table.columns, key=lambda name: column_of(name) is None):  # canonical names first
        base, unit = _without_unit(name)
        column = name if column_of(name) is not None else _COLUMN_OF_NAME.get(base)
        if base in TIME_NAMES and time == "COLUMN" and (unit is None or unit in TIME_UNITS):
            time = _source(name, "date" if name in table.words else unit if unit != "s" else None)
        elif column is not None and column not in columns and name in table.numbers and _fits(unit, column):
            columns[column] = _source(name, unit if unit != unit_of(column) else None)
    pairs = ", ".join(f"{column}: {source}" for column, source in columns.items()) or "u: COLUMN"
    return f"files: {{{json.dumps(label)}: {{time: {time}, columns: {{{pairs}}}, frame: FLU_OR_FRD}}}}"


def _without_unit(name: str) -> tuple[str, str | None]:
    """Return a name in lower case without its unit, and the unit: `yaw` and `deg` of `Yaw [deg]`."""
    word = name.strip().lower().replace(" ", "_")
    if column_of(name) is None and word not in TIME_NAMES:
        for suffix in sorted(_UNIT_OF_SUFFIX, key=len, reverse=True):
            for end in (f"_{suffix}", f"[{suffix}]", f"({suffix})"):
                if word.endswith(end) and word != end:
                    return word.removesuffix(end).rstrip("_"), _UNIT_OF_SUFFIX[suffix]
    return word, None


def _source(name: str, unit: str | None) -> str:
    """Return the source of a column in YAML, with the name quoted unless it is a word."""
    name = name if name.isidentifier() and name.isascii() else json.dumps(name)
    return name if unit is None else f"{{column: {name}, unit: {unit}}}"


def _fits(unit: str | None, column: str) -> bool:
    try:
        factor(unit, column)
    except CalibrationError:
        return False
    return True


def _require_column(table: ColumnTable, name: str, label: str) -> None:
    if name not in table.columns:
        raise CalibrationError(
            f"{label}: no column '{name}'{did_you_mean(name, table.columns)} its columns are {_column_list(table)}"
        )


def _numbers(table: ColumnTable, name: str, label: str) -> Array:
    _require_column(table, name, label)
    if name not in table.numbers:
        example = next((word for word in table.words[name] if word), "")
        raise CalibrationError(f"{label}: column '{name}' contains no numbers, for instance '{example}'")
    return table.numbers[name]


def _text(table: ColumnTable, name: str, label: str) -> list[str]:
    _require_column(table, name, label)
    return table.words[name] if name in table.words else [f"{x:g}" for x in table.numbers[name]]


def _time(table: ColumnTable, time: TimeColumn, label: str) -> Array:
    """Return seconds on the clock of the log."""
    _require_column(table, time.column, label)
    if time.unit != "date" and time.column in table.numbers:
        return time.seconds(table.numbers[time.column])
    words = [_date(word) for word in _text(table, time.column, label)]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # a UTC offset, which is applied
            dates = np.array(words, dtype="datetime64[us]")
    except ValueError:
        raise CalibrationError(
            f"{label}: column '{time.column}' contains neither numbers nor dates such as 2026-05-31 12:30:00.25: "
            "give a column with the time"
        ) from None
    seconds = np.where(np.isnat(dates), np.nan, dates.astype(np.int64) * 1e-6)
    return time.model_copy(update={"unit": "date"}).seconds(seconds)


def _date(word: str) -> str:
    """Return a date in NumPy's form: UTC without a suffix, and with a day if only a time is given."""
    word = re.sub(r"(Z|[+-]00:?00)$", "", word.strip()).replace(",", ".")
    return f"1970-01-01T{word}" if re.match(r"\d\d:\d", word) else word or "NaT"


def _column_list(table: ColumnTable) -> str:
    return listed(table.columns, 40)


def _names(path: Path, head: bytes) -> list[str]:
    """Return the column names of a text table, from its first bytes; empty for other files."""
    if path.suffix.lower() not in TEXTS:
        return []
    return text_table(decoded(head)[0]).names


def known_table(file: str) -> Importer:
    """Return the importer of a table format that a shipped file defines by its title, required columns and map.

    Args:
        file: Name of the YAML file beside this module.
    """
    known = read_mapping(Path(__file__).with_name(file), CalibrationError, such_as="map: {}")
    source, needs = SourceMap.model_validate(known["map"]), set(known["needs"])

    def read(path: Path, request: Request) -> TrialStreams:
        table = read_table(path)
        written = source.time is not None and source.time.column in table.words
        time = source.time.model_copy(update={"unit": "date"}) if written and source.time else source.time
        used = present(source, table.columns).model_copy(update={"time": time})
        return TrialStreams([table_stream(table, used, path.name)])

    return Importer("trial", known["title"], lambda path, head: needs <= set(_names(path, head)), read)


ACOUSTIC = known_table("acoustic.yaml")
QGROUNDCONTROL = known_table("qgroundcontrol.yaml")
WATER_LINKED = known_table("water_linked_csv.yaml")
WATER_LINKED_PERIOD = known_table("water_linked_period_csv.yaml")
TABLE = Importer(
    "trial",
    title="a table (.csv, .txt, .parquet, .npz)",
    recognises=lambda path, head: path.is_file() and path.suffix.lower() in SUFFIXES,
    read=lambda path, request: TrialStreams([read_stream(path, None)]),
    general=True,
)
