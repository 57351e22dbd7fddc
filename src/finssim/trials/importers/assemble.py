"""Trials from mapped columns: axes, velocities of the world, pressure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError, field_validator, model_validator

from finssim.core.frames import FROM_FOSSEN
from finssim.core.rotations import quat_from_euler, quat_inverse_rotate
from finssim.core.yaml_file import read_mapping
from finssim.trials.conversion import (
    EULER,
    EXTRA_COLUMNS,
    GRAVITY,
    QUATERNION,
    SAME_ROW,
    TIME_UNITS,
    constant,
    factor,
    in_our_frames,
    merged,
    ordered,
    pressure_unit,
    refuse_coarse,
    spread,
    tidy_quaternions,
    upside_down,
    without_dead,
    wrapped,
)
from finssim.trials.findings import CalibrationError, Finding, finding
from finssim.trials.importers.ardusub_outputs import STICKS, mixed_pulses
from finssim.trials.trial import COLUMNS, INPUT_PREFIXES, NU, PHASES, Array, Header, Trial, column_of
from finssim.trials.trial_files import vehicle_reference
from finssim.vehicles import load_vehicle
from finssim.vehicles.autopilot import FRAMES
from finssim.vehicles.part import Part, did_you_mean, refuse_section, refuse_value, sentence_of

TRUE = ("1", "true", "yes", "y", "t", "valid", "ok")
FALSE = ("0", "false", "no", "n", "f", "invalid", "")


def _token(cell: Any) -> str:
    """Return a cell as a word in lower case: 1 and 0 for the words of truth, numbers without trailing zeros."""
    if isinstance(cell, (bool, int, float, np.floating)):
        return "" if cell != cell else f"{float(cell):g}"
    word = str(cell).strip().lower()
    return "1" if word in TRUE else "0" if word in FALSE and word else word


class Validity(Part):
    """Column that marks invalid samples: a flag, certain values, or limits."""

    column: str
    value: tuple[str | float, ...] | None = None
    """Values of valid samples in the unit of the column; true, yes, valid, ok or 1 without `value` and limits."""
    above: float | None = None
    """Valid samples are above this number, in the unit of the column."""
    below: float | None = None
    """Valid samples are below this number, in the unit of the column."""

    @model_validator(mode="before")
    @classmethod
    def _short(cls, data: Any) -> Any:
        if isinstance(data, str):
            return {"column": data}
        if not isinstance(data, dict):
            raise refuse_section(f"is {data!r}, expected a column, or column and value, above or below")
        given = data.get("value")
        # YAML's true is a number in Python.
        values = given if isinstance(given, (list, tuple)) else [given]
        return data if given is None else {**data, "value": [_token(value) for value in values]}

    def valid(self, cells: Sequence[Any] | Array, label: str) -> NDArray[np.bool_]:
        """Return which samples are valid, (n,).

        Args:
            cells: Cells of the column, words or numbers in its unit, (n,).
            label: Name of the source in messages.

        Raises:
            CalibrationError: The cells are no flag and no numbers, whichever is needed.
        """
        if self.above is not None or self.below is not None:
            try:
                numbers = np.array([float(cell) for cell in cells])
            except ValueError:
                raise CalibrationError(
                    f"{label}: column '{self.column}' contains words, which have no limits: give its value in the map"
                ) from None
            high = math.inf if self.below is None else self.below
            low = -math.inf if self.above is None else self.above
            return ~((numbers >= high) | (numbers <= low))  # what has no number has no limit
        tokens = np.array([_token(cell) for cell in cells], dtype=np.str_)
        if self.value is not None:
            return np.isin(tokens, [_token(value) for value in self.value])
        other = tokens[~np.isin(tokens, ("1", "0", ""))]
        if len(other):
            raise CalibrationError(
                f"{label}: column '{self.column}' contains '{other[0]}', expected 1 and 0 or true and false: give "
                f"'valid: {{column: {self.column}, value: {other[0]}}}', or above or below with a number"
            )
        return tokens == "1"


class ColumnSource(Part):
    """Source of one canonical column: sign (scale * column + offset) in `unit`."""

    column: str | None = None
    """Name of a column, or dotted path of a field such as `twist.twist.linear.x` or `data[3]`."""
    value: float | None = None
    """A constant in `unit`, in place of a column."""
    scale: float = 1.0
    offset: float = 0.0
    """Offset in `unit`, added after scaling."""
    sign: Literal[1, -1] = 1
    unit: str | None = None
    """Unit of scale * column + offset; the unit of the canonical column if None."""
    valid: Validity | None = None
    """Column that marks invalid samples of this column."""

    @model_validator(mode="before")
    @classmethod
    def _short(cls, data: Any) -> Any:
        if isinstance(data, str):
            return {"column": data}
        if isinstance(data, (int, float)) and not isinstance(data, bool):
            return {"value": data}
        if not isinstance(data, dict):
            raise refuse_section(
                f"is {data!r}, expected the name of a column, a number, or column, unit, scale ..."
            )
        return data

    @model_validator(mode="after")
    def _single_source(self) -> ColumnSource:
        if (self.column is None) == (self.value is None):
            raise refuse_section("expected either 'column: NAME' or 'value: NUMBER'")
        return self


class TimeColumn(Part):
    """The column that holds the time."""

    column: str
    unit: str = "s"
    kind: Literal["stamp", "period", "counter", "coarse"] = "stamp"
    """A clock; the time since the row before; a counter that begins again after `wrap`; or a clock of few steps, over
    each of which its samples are spread."""
    scale: float = Field(default=1.0, gt=0.0)
    """Factor from the column to `unit`, such as 0.02 for a counter of samples of 50 Hz."""
    wrap: float | None = Field(default=None, gt=0.0)
    """Range of a counter, in counts of the column; the next of 2^8, 2^16, 2^24 and 2^32 if None."""

    @model_validator(mode="before")
    @classmethod
    def _short(cls, data: Any) -> Any:
        return {"column": data} if isinstance(data, str) else data

    @field_validator("unit")
    @classmethod
    def _check_names(cls, unit: str) -> str:
        if unit not in TIME_UNITS and unit != "date":
            raise refuse_value(
                f"is '{unit}', expected one of {', '.join(TIME_UNITS)}, or date for written dates"
            )
        return unit

    @model_validator(mode="after")
    def _refuse_unused(self) -> TimeColumn:
        dates = self.unit == "date" and self.kind in ("period", "counter")
        if dates or (self.wrap is not None and self.kind != "counter"):
            raise refuse_section(
                f"kind is {self.kind}: wrap is for a counter, unit: date for no period or counter"
            )
        return self

    def seconds(self, raw: Array) -> Array:
        """Return the times [s] of a column, (n,).

        Args:
            raw: The column as read; seconds if its unit is `date`, (n,).
        """
        unit = 1.0 if self.unit == "date" else TIME_UNITS[self.unit] * self.scale
        good, out = np.isfinite(raw), unit * raw
        if self.kind == "period":
            out[good] = np.cumsum(out[good])
        elif self.kind == "counter":
            largest = float(np.max(raw[good], initial=0.0))
            wrap = self.wrap or next((2.0**bits for bits in (8, 16, 24, 32) if largest < 2.0**bits), 2.0**64)
            out[good] += unit * wrap * np.cumsum(np.diff(raw[good], prepend=raw[good][:1]) < -0.5 * wrap)
        elif self.kind == "coarse" and (np.diff(out[good]) >= 0.0).all():
            out[good] = spread(out[good])
        return out


class PhaseColumn(Part):
    """The column that names the phases of an experiment."""

    column: str
    words: dict[str, str] = Field(default_factory=dict)
    """Word of the log -> baseline, excitation, coast or rest; other words become none."""

    @model_validator(mode="before")
    @classmethod
    def _short(cls, data: Any) -> Any:
        return {"column": data} if isinstance(data, str) else data

    @field_validator("words")
    @classmethod
    def _check_names(cls, labels: dict[str, str]) -> dict[str, str]:
        for word in labels.values():
            if word not in PHASES:
                raise refuse_value(
                    f"holds '{word}'{did_you_mean(word, list(PHASES))} expected {', '.join(PHASES)}"
                )
        return labels


class LogFrame(Part):
    """Axes that the log uses."""

    body: Literal["FLU", "FRD"] = "FLU"
    """Forward-left-up or forward-right-down."""
    world: Literal["z_up", "NED"] = "z_up"

    @model_validator(mode="before")
    @classmethod
    def _short(cls, data: Any) -> Any:
        if not isinstance(data, str):
            return data
        fossen = {"body": "FRD", "world": "NED"}
        forms: dict[str, Any] = {"FLU": {}, "z_up": {}, "FRD": fossen, "NED": fossen}
        if data not in forms:
            raise refuse_section(
                f"is '{data}', expected FLU, FRD, or {{body: FLU or FRD, world: z_up or NED}}"
            )
        return forms[data]


class SourceMap(Part):
    """Map of one file or topic."""

    time: TimeColumn | None = None
    """Needed for files; topics have stamps."""
    columns: dict[str, ColumnSource] = Field(default_factory=dict)
    """Canonical column -> its source; for topics of known types the usual ones where nothing is given."""
    frame: LogFrame = Field(default_factory=LogFrame)
    time_offset: float = 0.0
    """Added to the times [s]."""
    phase: PhaseColumn | None = None
    split: str | None = None
    """Column whose changes of value begin a new trial."""
    spaces: bool = False
    """True if blanks separate the columns of a text table; commas, semicolons and tabs are detected."""
    skip_rows: int = Field(default=0, ge=0)
    """Lines before the line of names."""
    names: tuple[str, ...] | None = None
    """Names of the columns of a file that has no line of names."""
    valid: tuple[Validity, ...] | None = None
    """Columns that mark invalid samples, which are left out; an evident one if None, none if `false`."""
    arming: Validity | None = None
    """Column that is valid while the vehicle is armed, for `split: arming`."""
    stamps: Literal["header", "received"] = "header"
    """Times of a topic: the stamps in its messages, if it has them, or the times at which they were recorded."""

    @model_validator(mode="before")
    @classmethod
    def _short(cls, data: Any) -> Any:
        if isinstance(data, (list, tuple)):
            raise refuse_section("is a list, expected columns: {CANONICAL: FIELD}")
        valid = data.get("valid") if isinstance(data, dict) else None
        if valid is False or (valid is not None and not isinstance(valid, (list, tuple))):
            return {**data, "valid": [valid] if valid else []}
        return {} if data is None else data

    @field_validator("columns", mode="before")
    @classmethod
    def _same_names(cls, columns: Any) -> Any:
        """A list is of columns that the log calls as we do."""
        if isinstance(columns, (list, tuple)) and all(isinstance(name, str) for name in columns):
            return {name: name for name in columns}
        if not isinstance(columns, dict):
            raise refuse_value(f"is {columns!r}, expected {{CANONICAL: COLUMN}}")
        return columns

    @field_validator("columns")
    @classmethod
    def _check_names(cls, columns: dict[str, ColumnSource]) -> dict[str, ColumnSource]:
        allowed = [*COLUMNS, *EXTRA_COLUMNS]
        for name, source in columns.items():
            if name not in EXTRA_COLUMNS and column_of(name) is None:
                inputs = ", ".join(f"{prefix}NAME" for prefix in INPUT_PREFIXES)
                raise refuse_value(
                    f"names '{name}'{did_you_mean(name, allowed)} columns of a trial are {', '.join(allowed)}, {inputs}"
                )
            try:
                factor(source.unit, name)
            except CalibrationError as error:
                raise refuse_value(f"holds a wrong unit: {error}") from None
        return columns


HEADER_KEYS = tuple(Header.model_fields)

GROUPS = tuple(dict.fromkeys(column.group for column in COLUMNS.values()))


class ArduSubMap(Part):
    """Map of an ArduSub log, and settings of the mixer from sticks to pulses."""

    outputs: dict[str, str] = Field(default_factory=dict)
    """Output of the autopilot -> thruster, `{C1: T1, C2: -T2}`; a minus where longer pulses push backwards."""
    velocity: Literal["auto", "ekf", "vision", "none"] = "auto"
    """Source of u v w: the state estimate, or the position deltas of a DVL or visual odometry."""
    imu: int = Field(default=0, ge=0)
    barometer: int | None = Field(default=None, ge=0)
    """The pressure sensor in the water; the primary one where not given."""
    stamps: Literal["header", "received"] = "header"
    """Times of a .tlog: the autopilot's own clock if a message has it, or the times at which messages were received."""
    frame: Literal["VECTORED", "VECTORED_6DOF"] | None = None
    """Frame of the mixer that `stick_*` columns went through."""
    gain: float = Field(default=1.0, gt=0.0, le=1.0)
    """Pilot gain, a factor (PilotGain, JS_GAIN_DEFAULT), of `stick_*` columns, where they are the joystick's, not
    scaled yet."""
    motor_directions: tuple[Literal[1, -1], ...] = ()
    """MOT_n_DIRECTION of motors 1, 2, ..., for `stick_*` columns; 1 where not given."""


class SplitRule(Part):
    """Rule that splits a log into several trials."""

    by: Literal["phase", "gaps", "arming", "column", "windows"]
    longest_gap: float = Field(default=2.0, gt=0.0)
    """Longest pause within a trial, for `gaps` [s]."""
    windows: dict[str, tuple[float, float]] = Field(default_factory=dict)
    """Trial -> start and end [s] after the start of the log, for `windows`."""
    shortest: float = Field(default=1.0, ge=0.0)
    """Shorter pieces are left out [s]."""

    @model_validator(mode="before")
    @classmethod
    def _short(cls, data: Any) -> Any:
        if isinstance(data, str):
            return {"by": data}
        if isinstance(data, dict) and "by" not in data:
            if "windows" in data:
                return {"by": "windows", **data}
            if "gaps" in data:
                others = {key: value for key, value in data.items() if key != "gaps"}
                return {"by": "gaps", "longest_gap": data["gaps"], **others}
        return data

    @model_validator(mode="after")
    def _windows(self) -> SplitRule:
        if (self.by == "windows") != bool(self.windows):
            raise refuse_section("expected 'windows: {NAME: [FROM, TO]}' with windows, and only with them")
        for name, (low, high) in self.windows.items():
            if not high > low:
                raise refuse_section(
                    f"window {name} is [{low:g}, {high:g}], expected the end after the start"
                )
        return self


class ColumnMap(Part):
    """One map file."""

    files: dict[str, SourceMap] = Field(default_factory=dict)
    """Name or pattern of a file (`imu.csv`, `*_imu.csv`, `{trial}_imu.csv`) -> how it is read."""
    topics: dict[str, SourceMap] = Field(default_factory=dict)
    ardusub: ArduSubMap = Field(default_factory=ArduSubMap)
    split: SplitRule | None = None
    time_offsets: dict[str, float] = Field(default_factory=dict)
    """Column, or group (command velocity rates acceleration attitude position depth) -> seconds added to its times."""
    surface_pressure: float | None = Field(default=None, ge=0.0)
    """Pressure of the surface as the sensor reads it, for `pressure` columns [Pa]; 0 for a gauge."""
    header: dict[str, Any] = Field(default_factory=dict)
    """Keys of `trial.yaml` of every trial."""
    trials: dict[str, dict[str, Any]] = Field(default_factory=dict)
    """Trial -> further keys of its `trial.yaml`, which replace those of every trial."""

    @model_validator(mode="before")
    @classmethod
    def _short(cls, data: Any) -> Any:
        """Accept keys of `trial.yaml`, and a single source for all files, at the top level."""
        data = dict(data)
        single = {
            key: data.pop(key) for key in list(data) if key in SourceMap.model_fields and key != "split"
        }
        if single:
            if "files" in data:
                raise refuse_section(f"'{next(iter(single))}' is next to 'files': write it inside a file")
            data["files"] = {"*": single}
        header = {key: data.pop(key) for key in list(data) if key in HEADER_KEYS}
        for key in data:
            if key not in cls.model_fields:
                allowed = [*cls.model_fields, *HEADER_KEYS, *SourceMap.model_fields]
                raise refuse_section(
                    f"unknown key '{key}'{did_you_mean(str(key), allowed)} known keys: {', '.join(allowed)}"
                )
        return {**data, "header": {**data.get("header", {}), **header}}

    def header_of(self, trial: str, vehicle: str | None, recorded: Mapping[str, Any] | None = None) -> Header:
        """Return the header of a trial; a vehicle given on the command line has priority, the log's own header is last.

        Raises:
            CalibrationError: A key or value that `trial.yaml` does not take.
        """
        keys = {**(recorded or {}), **self.header, **self.trials.get(trial, {})}
        if vehicle is not None:
            keys["vehicle"] = vehicle
        if isinstance(keys.get("vehicle"), str):
            keys["vehicle"] = vehicle_reference(keys["vehicle"])
        place = f"trials.{trial}" if trial else ""
        for key in keys:
            if key not in HEADER_KEYS:
                raise CalibrationError(
                    f"{place and f'{place}: '}unknown key '{key}'{did_you_mean(str(key), list(HEADER_KEYS))} "
                    f"known keys: {', '.join(HEADER_KEYS)}"
                )
        try:
            return Header.model_validate(keys)
        except ValidationError as error:
            raise CalibrationError(sentence_of(error.errors()[0], place, "add it")) from None


def read_map(path: Path) -> ColumnMap:
    """Read and check a map file.

    Raises:
        CalibrationError: Unreadable, malformed, or a key or value that is refused.
    """
    tree = read_mapping(path, CalibrationError, such_as="files: {log.csv: {time: t, columns: {u: vel_x}}}")
    try:
        column_map = ColumnMap.model_validate(tree)
        for trial in ("", *column_map.trials):
            column_map.header_of(trial, None)
    except ValidationError as error:
        raise CalibrationError(sentence_of(error.errors()[0], str(path), "add it")) from None
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from None
    return column_map


def shipped_maps(file: str) -> dict[str, dict[str, Any]]:
    """Return the sections of a shipped file: name -> map of a topic, report or table that needs no map of the user's.

    Args:
        file: Name of the YAML file beside this module; sections of texts are returned as they are.
    """
    tree = read_mapping(Path(__file__).with_name(file), CalibrationError, such_as="topics: {}")
    return {
        section: {
            name: keys if isinstance(keys, str) else SourceMap.model_validate({"valid": False, **keys})
            for name, keys in content.items()
        }
        for section, content in tree.items()
    }


def present(source: SourceMap, names: Sequence[str]) -> SourceMap:
    """Return a map of those of its columns that a log has; velocities in the world only if it has all three.

    Args:
        source: Map of all columns that the format may have.
        names: Columns or fields of the log.
    """
    there = {name: spec for name, spec in source.columns.items() if spec.column in names}
    if not {"vx", "vy", "vz"} <= set(there):
        there = {name: spec for name, spec in there.items() if name not in ("vx", "vy", "vz")}
    return source.model_copy(update={"columns": there})


def split_rule(text: str) -> SplitRule:
    """The rule that a word of the command line names: phase, gaps, gaps=SECONDS, arming or column.

    Raises:
        CalibrationError: Another word.
    """
    word, _, seconds = text.partition("=")
    try:
        return SplitRule.model_validate(
            {"gaps": float(seconds)} if word == "gaps" and seconds else {"by": text}
        )
    except ValueError:
        raise CalibrationError(
            f"split is '{text}', expected phase, gaps, gaps=SECONDS, arming or column; give time windows in a map file"
        ) from None


# One table of a long log into several, one for each trial.

Rows = NDArray[np.bool_]


def split_table(name: str, table: MergedStreams, rule: SplitRule | None) -> dict[str, MergedStreams]:
    """Name of a trial -> its part of the table, with times from 0; one part of that name without a rule.

    Raises:
        CalibrationError: The log has not what the rule goes by, or nothing is left.
    """
    if rule is None:
        return {name: table}
    pieces = (
        _windows(name, table, rule) if rule.by == "windows" else _numbered(name, _labels(name, table, rule))
    )
    long_enough = {
        piece: rows
        for piece, rows in pieces.items()
        if rows.sum() >= 2 and np.ptp(table.t[rows]) >= rule.shortest
    }
    if not long_enough:
        raise CalibrationError(
            f"{name}: splitting by {rule.by} leaves no piece of {rule.shortest:g} s or more"
        )
    return {piece: _part(table, rows) for piece, rows in long_enough.items()}


def _part(table: MergedStreams, rows: Rows) -> MergedStreams:
    t = table.t[rows]
    return replace(
        table,
        start=table.start + float(t[0]),
        t=np.round(t - t[0], 6),
        channels={column: values[rows] for column, values in table.channels.items()},
        words={column: spoken[rows] for column, spoken in table.words.items()},
        findings=(*table.findings, finding("log_cut", start=t[0], end=t[-1])),
    )


WORDED = {
    "phase": ("phase", "no source of the map names a phase column"),
    "arming": ("arming", "the log has no arming messages"),
    "column": ("split", "no source of the map names a split column"),
}
"""Rule -> the words that it uses, and the message if there are none."""


def _labels(name: str, table: MergedStreams, rule: SplitRule) -> NDArray[np.int64]:
    """Number of the piece that each row belongs to, -1 for none, (n,).

    A trial of `phase` begins with each baseline; without baselines, with each excitation after something else.
    """
    if rule.by == "gaps":
        return np.cumsum(np.diff(table.t, prepend=table.t[0]) > rule.longest_gap)
    column, missing = WORDED[rule.by]
    if column not in table.words:
        raise CalibrationError(f"{name}: cannot be split by {column}: {missing}")
    texts = table.words[column]
    changes = np.concatenate([[True], texts[1:] != texts[:-1]])
    if rule.by == "phase":
        opening = "baseline" if (texts == "baseline").any() else "excitation"
        return np.cumsum(changes & (texts == opening)) - 1
    inside = texts == "armed" if rule.by == "arming" else ~np.isin(texts, ("", "nan", "None"))
    return np.where(inside, np.cumsum(changes & inside) - 1, -1)


def _numbered(name: str, labels: NDArray[np.int64]) -> dict[str, Rows]:
    count = int(labels.max(initial=-1)) + 1
    return {f"{name}_{i + 1:0{len(str(count))}d}": labels == i for i in range(count)}


def _windows(name: str, table: MergedStreams, rule: SplitRule) -> dict[str, Rows]:
    pieces = {window: (table.t >= low) & (table.t <= high) for window, (low, high) in rule.windows.items()}
    empty = [window for window, rows in pieces.items() if not rows.any()]
    if empty:
        raise CalibrationError(
            f"{name}: window {empty[0]} is {list(rule.windows[empty[0]])} s, the log runs to {table.t[-1]:.3f} s"
        )
    return pieces


Texts = NDArray[np.str_]


@dataclass(frozen=True, kw_only=True)
class Stream:
    """Content of one file, topic or kind of message, in canonical columns and SI."""

    source: str
    """Name of the source in messages."""
    t: Array
    """Times on the clock of the log [s], (n,)."""
    channels: dict[str, Array] = field(default_factory=dict)
    """Canonical or extra column -> values in the units of a trial, (n,) each."""
    words: dict[str, Texts] = field(default_factory=dict)
    """`phase`, `split` or `arming` -> a word for every sample, (n,) each; a word holds until the next."""
    findings: tuple[Finding, ...] = ()
    """Repairs, and data that was left out."""
    rank: int = -1
    """Place in the order of sources: of two that have a column the lower is used; -1 if the user chose it."""

    def selected(self, rows: NDArray[np.intp] | NDArray[np.bool_], t: Array | None = None) -> Stream:
        """Some of the samples, in that order; at times `t` where given. Times are in [s]."""
        return replace(
            self,
            t=self.t[rows] if t is None else t,
            channels={name: values[rows] for name, values in self.channels.items()},
            words={name: values[rows] for name, values in self.words.items()},
        )

    def noting(self, *findings: Finding) -> Stream:
        """Return the stream with more findings."""
        return replace(self, findings=(*self.findings, *findings))


@dataclass(frozen=True, kw_only=True)
class MergedStreams:
    """Several streams on the union of their times."""

    start: float
    """Time of the log's clock at t = 0 [s]."""
    t: Array
    """Strictly increasing from 0 [s], (n,)."""
    channels: dict[str, Array]
    """Canonical column -> values in the units of a trial, NaN where a stream has no sample, (n,) each."""
    words: dict[str, Texts]
    """(n,) each."""
    findings: tuple[Finding, ...]


def in_order(stream: Stream, *, alone: bool) -> Stream:
    """The stream with strictly increasing times.

    Samples without a time are left out, late ones are sorted in, of samples with one time the first is kept. Where the
    clock was set back, the rest follows after a gap if the stream is `alone`
    (`finssim.trials.conversion.ordered`).

    Raises:
        CalibrationError: No samples, or a clock set back in one of several streams, which cannot be aligned again.
    """
    timed = np.isfinite(stream.t)
    untimed = [] if timed.all() else [finding("samples_untimed", samples=(~timed).sum())]
    stream = stream.selected(timed)
    if len(stream.t) < 2:
        raise CalibrationError(f"{stream.source}: {len(stream.t)} samples, expected at least two")
    try:
        t, rows, repaired = ordered(stream.t, stream.channels)
        refuse_coarse(t, {name: values[rows] for name, values in stream.channels.items()})
    except CalibrationError as error:
        raise CalibrationError(str(error), stream.source) from None
    jumps = [item.values for item in repaired if item.code == "clock_jump"]
    if not alone and jumps:
        raise CalibrationError(
            f"the clock jumps back from {jumps[0]['before']:.6g} s to {jumps[0]['after']:.6g} s at row "
            f"{jumps[0]['row']}, so its samples cannot be placed among those of the other sources: import the parts on "
            "their own, or cut the log there",
            stream.source,
        )
    stream = stream.selected(rows, t)
    first = np.concatenate([[True], np.diff(t) > SAME_ROW])
    if not first.all():
        repaired = [*repaired, finding("samples_repeat", samples=(~first).sum())]
        stream = stream.selected(first)
    if len(stream.t) < 2:
        raise CalibrationError(
            f"{stream.source}: the time never increases: name the column that holds the time"
        )
    return stream.noting(*(item.about(stream.source) for item in (*untimed, *repaired)))


def moved_in_time(streams: Sequence[Stream], offsets: Mapping[str, float]) -> list[Stream]:
    """The streams with columns, or groups of them, moved in time; their words stay.

    Args:
        streams: Of a trial.
        offsets: Column or group -> what is added to its times [s].

    Raises:
        CalibrationError: A key that is neither a group nor a column of these streams.
    """
    movable = [*GROUPS, *(name for stream in streams for name in stream.channels)]
    for key in offsets:
        if key not in movable:
            raise CalibrationError(
                f"time_offsets: '{key}' is neither a group nor a column of this log{did_you_mean(key, movable)} "
                f"groups are {', '.join(GROUPS)}"
            )
    out = []
    for stream in streams:
        groups = {name: column.group if (column := column_of(name)) else "" for name in stream.channels}
        by = {name: offsets.get(name, offsets.get(group, 0.0)) for name, group in groups.items()}
        for seconds in dict.fromkeys(
            [*([] if stream.channels and not stream.words else [0.0]), *by.values()]
        ):
            part = {name: values for name, values in stream.channels.items() if by[name] == seconds}
            texts = stream.words if seconds == 0.0 else {}
            out.append(replace(stream, t=stream.t + seconds, channels=part, words=texts))
    return out


def merge(streams: Sequence[Stream]) -> MergedStreams:
    """All streams on the union of their times, which start at 0.

    Raises:
        CalibrationError: A column in two streams, or streams that lie apart in time.
    """
    each = [in_order(stream, alone=len(streams) == 1) for stream in without_doubles(streams)]
    _refuse_disjoint(each)
    start = min(float(stream.t[0]) for stream in each)
    # In integer microseconds, so that a written and read trial has the same times.
    each = [replace(stream, t=np.round(stream.t - start, 6)) for stream in each]
    columns = {name: (stream.t, values) for stream in each for name, values in stream.channels.items()}
    spoken = {name: (stream.t, texts) for stream in each for name, texts in stream.words.items()}
    t, channels = merged(columns)
    texts = {}
    for name, (times, labels) in spoken.items():
        held = np.searchsorted(times, t, side="right") - 1
        texts[name] = np.where(held >= 0, labels[np.maximum(held, 0)], "")
    findings = [item for stream in each for item in stream.findings]
    if start > 1e8:
        findings.append(finding("clock_origin", start=start))
    return MergedStreams(
        start=start, t=t, channels=channels, words=texts, findings=tuple(dict.fromkeys(findings))
    )


def without_doubles(streams: Sequence[Stream]) -> list[Stream]:
    """Return the streams with one source for each column: one that moves, then that of the lowest rank.

    Raises:
        CalibrationError: Two sources of one rank for a column, or of words.
    """
    out = list(streams)
    names_of = [name for stream in out for name in (*stream.channels, *stream.words)]
    groups = {name: group for group in (QUATERNION, ("depth", "pressure")) for name in group}
    for names in dict.fromkeys(groups.get(name, (name,)) for name in names_of):
        holders = [i for i, stream in enumerate(out) if any(name in stream.channels for name in names)]
        holders += [i for i, stream in enumerate(out) if names[0] in stream.words]
        moving = [i for i in holders if not _dead(out[i], names)] or holders
        best = min(moving, key=lambda i: out[i].rank)
        for i in set(holders) - {best}:
            if i in moving and out[i].rank == out[best].rank:
                one, other = (out[k].source for k in sorted((i, best)))
                raise CalibrationError(
                    f"{names[0]} is in {one} and in {other}: choose one of them in the map"
                )
            out[i] = _without(out[i], names, out[best].source, dead=i not in moving)
    return [stream for stream in out if stream.channels or stream.words or stream.findings]


def _dead(stream: Stream, names: tuple[str, ...]) -> bool:
    values = [stream.channels[name] for name in names if name in stream.channels]
    return bool(values) and all(constant(column) for column in values)


def _without(stream: Stream, names: tuple[str, ...], better: str, *, dead: bool) -> Stream:
    """Return the stream without some columns, with one finding for all that were left out for one other stream."""
    gone, findings = tuple(name for name in names if name in stream.channels), []
    for item in stream.findings:
        if item.code in ("stream_dead", "columns_left_out") and item.values["better"] == better:
            gone = (*item.values["columns"], *gone)
            dead &= item.code == "stream_dead"
        else:
            findings.append(item)
    channels = {name: values for name, values in stream.channels.items() if name not in names}
    words = {name: texts for name, texts in stream.words.items() if name not in names}
    about = {"columns": gone, "topic": stream.source, "better": better}
    note = finding("stream_dead", **about) if dead else finding("columns_left_out", **about)
    return replace(stream, channels=channels, words=words, findings=(*findings, note))


def _refuse_disjoint(streams: Sequence[Stream]) -> None:
    longest = max(streams, key=lambda stream: stream.t[-1] - stream.t[0])
    for stream in streams:
        if stream.t[0] > longest.t[-1] or stream.t[-1] < longest.t[0]:
            raise CalibrationError(
                f"times of {longest.source} run from {longest.t[0]:.6g} to {longest.t[-1]:.6g} s and those of "
                f"{stream.source} from {stream.t[0]:.6g} to {stream.t[-1]:.6g} s: they do not overlap: give the "
                f"unit of the time, or a time_offset in the map that puts them on one clock"
            )


WORLD_VELOCITY = ("vx", "vy", "vz")
STANDARD_ATMOSPHERE = 101325.0
LONGEST_BRIDGE = 0.5
"""Between two attitudes that a velocity of the world is turned with [s]."""


def in_our_axes(stream: Stream, frame: LogFrame, *, radians: bool = True) -> Stream:
    """Return the stream in x forward, y left, z up and a world with z up, with angles in [-pi, pi).

    Args:
        stream: Of the log's axes.
        frame: Axes of the log.
        radians: False if the angles may be degrees without a unit; they are wrapped within one turn only.
    """
    channels = wrapped(in_our_frames(stream.channels, frame.body, frame.world), everything=radians)
    if frame.world == "NED":
        for name, sign in zip(WORLD_VELOCITY, FROM_FOSSEN.A.diagonal(), strict=True):
            if name in channels:
                channels[name] = sign * channels[name]
    return replace(stream, channels=channels)


def trial_of(name: str, table: MergedStreams, header: Header, column_map: ColumnMap) -> Trial:
    """The trial that a table makes, with u v w and depth in place of world velocities and pressure.

    Raises:
        CalibrationError: World velocities without an attitude, or beside body velocities.
    """
    channels, findings = dict(table.channels), list(table.findings)
    findings += _without_empty(channels)
    world = [c for c in WORLD_VELOCITY if c in channels]
    if 0 < len(world) < len([c for c in WORLD_VELOCITY if c in table.channels]):  # others of them are empty
        findings.append(finding("world_velocity_incomplete", columns=tuple(world)))
        channels = {c: v for c, v in channels.items() if c not in WORLD_VELOCITY}
    elif world:
        channels |= _body_velocity(name, table.t, channels)
        channels = {c: v for c, v in channels.items() if c not in WORLD_VELOCITY}
        findings += _without_empty(channels)
    if (
        {"pressure", "depth"} <= set(channels)
        and constant(channels["pressure"])
        and not constant(channels["depth"])
    ):
        del channels["pressure"]
        findings.append(finding("never_changes", columns=("pressure",), moving=("depth",)))
    if "pressure" in channels:
        depth, assumed = _depth(name, channels.pop("pressure"), header, column_map)
        findings += assumed
        channels["depth"] = depth
    if any(c in channels for c in STICKS):
        pulses, mixed = _pulses(name, channels, header, column_map.ardusub)
        channels = {c: v for c, v in channels.items() if c not in STICKS} | pulses
        findings += mixed
    findings += without_dead(table.t, channels)
    findings += tidy_quaternions(channels)
    if upside_down(channels):
        findings.append(finding("upside_down"))
    if not channels:
        raise CalibrationError(f"{name}: no column of a trial holds a number")
    findings.sort(key=lambda item: item.code == "not_read")  # the last of an import
    return Trial(
        name=name, t=table.t, channels=channels, phase=_phase(table), header=header, findings=tuple(findings)
    )


def _without_empty(channels: dict[str, Array]) -> list[Finding]:
    """Remove columns without a number, in place."""
    empty = [column for column, values in channels.items() if not np.isfinite(values).any()]
    for column in empty:
        del channels[column]
    return [finding("column_empty", column=column) for column in empty]


def _phase(table: MergedStreams) -> np.ndarray | None:
    if "phase" not in table.words:
        return None
    labels = table.words["phase"]
    return np.where(np.isin(labels, PHASES), labels, "").astype(np.str_)


def _body_velocity(name: str, t: Array, channels: dict[str, Array]) -> dict[str, Array]:
    """u v w from world velocities and the attitude interpolated to their times."""
    from scipy.spatial.transform import Rotation, Slerp

    missing = [c for c in WORLD_VELOCITY if c not in channels]
    if missing or any(c in channels for c in NU[:3]):
        raise CalibrationError(
            f"{name}: expected all of vx, vy, vz (in the world) or u, v, w (in the body), not both"
            + (f": {', '.join(missing)} missing" if missing else "")
        )
    if all(c in channels for c in QUATERNION):
        q = np.stack([channels[c] for c in QUATERNION], axis=-1)
    elif all(c in channels for c in EULER):
        q = quat_from_euler(*(channels[c] for c in EULER))
    else:
        raise CalibrationError(
            f"{name}: vx, vy, vz are velocities in the world, and without an attitude they cannot become u, v, w: "
            "map roll pitch yaw or qx qy qz qw"
        )
    valid = np.isfinite(q).all(axis=-1) & (np.linalg.norm(np.nan_to_num(q), axis=-1) > 0.5)
    velocity = np.stack([channels[c] for c in WORLD_VELOCITY], axis=-1)
    if valid.sum() < 2:
        raise CalibrationError(f"{name}: the attitude that turns vx, vy, vz holds fewer than two samples")
    times = t[valid]
    after = np.clip(np.searchsorted(times, t), 1, len(times) - 1)
    near = (t >= times[0]) & (t <= times[-1]) & (times[after] - times[after - 1] <= LONGEST_BRIDGE)
    near |= np.isin(t, times)
    usable = near & np.isfinite(velocity).all(axis=-1)
    body = np.full_like(velocity, np.nan)
    if usable.any():
        attitude = Slerp(times, Rotation.from_quat(q[valid]))(t[usable]).as_quat()
        body[usable] = quat_inverse_rotate(attitude, velocity[usable])
    return dict(zip(NU[:3], body.T, strict=True))


def _pulses(
    name: str, channels: dict[str, Array], header: Header, requested: ArduSubMap
) -> tuple[dict[str, Array], list[Finding]]:
    """Pulse widths of the vehicle's thrusters [µs] from the sticks, by ArduSub's mixer; and findings."""
    if requested.frame is None or header.vehicle is None:
        raise CalibrationError(
            f"{name}: stick_* columns go through ArduSub's mixer: give its frame in the map, "
            "'ardusub: {frame: VECTORED_6DOF}' or VECTORED, and the vehicle"
        )
    pulses = [c for c in channels if c.startswith("pwm_")]
    if pulses:
        raise CalibrationError(
            f"{name}: expected stick_* or pwm_* columns, not both: {pulses[0]} is there as well"
        )
    sticks = [channels[c] for c in STICKS if c in channels]
    valid = np.all([np.isfinite(v) for v in sticks], axis=0)
    demands = np.stack([channels.get(c, np.zeros(len(valid))) for c in STICKS], axis=-1)
    beyond = float(np.abs(demands[valid]).max(initial=0.0))
    if beyond > 1.01:
        raise CalibrationError(
            f"{name}: stick_* reach {beyond:g}, expected demands in [-1, 1]: "
            "give scale and offset in the map, scale: 0.0025 and offset: -3.75 for channels of 1100 to 1900 µs"
        )
    vehicle = load_vehicle(header.vehicle)
    config = next(number for number, (frame, _) in FRAMES.items() if frame == requested.frame)
    parameters = {"FRAME_CONFIG": float(config)}
    parameters |= {f"MOT_{motor + 1}_DIRECTION": 1.0 for motor in range(len(FRAMES[config][1]))}
    findings, mapped = mixed_pulses(
        vehicle, requested.gain * demands, parameters, requested.motor_directions, requested.outputs
    )
    return findings, [finding("sticks_mixed", frame=requested.frame, gain=requested.gain), mapped]


def _depth(name: str, pressure: Array, header: Header, column_map: ColumnMap) -> tuple[Array, list[Finding]]:
    """Depth of the pressure sensor [m]: (p - p_surface) / (rho g)."""
    vehicle = load_vehicle(header.vehicle) if header.vehicle is not None else None
    density = header.water.density or (vehicle.water.density if vehicle else 1000.0)
    gravity = vehicle.water.gravity if vehicle else GRAVITY
    surface = column_map.surface_pressure
    findings = [finding("depth_of_pressure", density=density)]
    if surface != 0.0:
        unit, finite = pressure_unit(pressure), pressure[np.isfinite(pressure)]
        low, high = float(finite.min()), float(finite.max())
        if unit is None:
            raise CalibrationError(
                f"{name}: pressures of {low:.6g} to {high:.6g} are no absolute pressures in water in Pa, hPa or kPa: "
                "give 'unit:' of the column in a map, and 'surface_pressure: 0' for a gauge"
            )
        if unit != "Pa":
            findings.append(finding("pressure_unit", low=low, high=high, unit=unit))
        pressure = pressure * factor(unit, "pressure")
    if surface is None:
        surface = STANDARD_ATMOSPHERE
        findings.append(finding("surface_pressure_assumed", pressure=surface))
    return (pressure - surface) / (density * gravity), findings
