"""Maps of logs: the columns, units, axes, clocks and segments that form trials."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError, field_validator, model_validator

from finssim.core.yaml_file import read_mapping
from finssim.trials.conversion import EXTRA_COLUMNS, TIME_UNITS, factor, spread
from finssim.trials.findings import CalibrationError
from finssim.trials.trial import COLUMNS, INPUT_PREFIXES, PHASES, Array, Header, column_of
from finssim.trials.trial_files import vehicle_reference
from finssim.vehicles.part import Part, did_you_mean, refuse_section, refuse_value, sentence_of

TRUE = ("1", "true", "yes", "y", "t", "valid", "ok")
FALSE = ("0", "false", "no", "n", "f", "invalid", "")


def _token(cell: Any) -> str:
    """Return a cell as a lower-case token: 1 or 0 for Boolean words, numbers without trailing zeros."""
    if isinstance(cell, (bool, int, float, np.floating)):
        return "" if cell != cell else f"{float(cell):g}"
    word = str(cell).strip().lower()
    return "1" if word in TRUE else "0" if word in FALSE and word else word


class Validity(Part):
    """Column that marks invalid samples, by a flag, certain values, or limits."""

    column: str
    value: tuple[str | float, ...] | None = None
    """Values of valid samples in the unit of the column; without `value` and limits: true, yes, valid, ok or 1."""
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
        """Return a mask of the valid samples, (n,).

        Args:
            cells: Cells of the column, text or numbers in its unit, (n,).
            label: Name of the source in messages.

        Raises:
            CalibrationError: The cells are not flags or not numbers, as required.
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
            return ~((numbers >= high) | (numbers <= low))  # a missing number violates no limit
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
    """Constant in `unit`, instead of a column."""
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


class NamedColumn(Part):
    """Section that may be abbreviated to the name of a column."""

    column: str

    @model_validator(mode="before")
    @classmethod
    def _short(cls, data: Any) -> Any:
        return {"column": data} if isinstance(data, str) else data


class TimeColumn(NamedColumn):
    """Column that contains the time."""

    unit: str = "s"
    kind: Literal["stamp", "period", "counter", "coarse"] = "stamp"
    """Type of the time: a clock (stamp); the time since the previous row (period); a counter that overflows
    at `wrap`; or a clock with coarse steps, over which its samples are distributed."""
    scale: float = Field(default=1.0, gt=0.0)
    """Factor from the column to `unit`, such as 0.02 for a 50 Hz sample counter."""
    wrap: float | None = Field(default=None, gt=0.0)
    """Range of a counter, in counts of the column; the next of 2^8, 2^16, 2^24 and 2^32 if None."""

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
                f"kind is {self.kind}: wrap is for counters only, and unit: date not for periods or counters"
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


class PhaseColumn(NamedColumn):
    """Column that names the phases of an experiment."""

    words: dict[str, str] = Field(default_factory=dict)
    """Word of the log -> baseline, excitation, coast or rest; other words mean no phase."""

    @field_validator("words")
    @classmethod
    def _check_names(cls, labels: dict[str, str]) -> dict[str, str]:
        for word in labels.values():
            if word not in PHASES:
                raise refuse_value(
                    f"contains '{word}'{did_you_mean(word, list(PHASES))} expected {', '.join(PHASES)}"
                )
        return labels


class LogFrame(Part):
    """Axes that the log uses."""

    body: Literal["FLU", "FRD"] = "FLU"
    """Body axes: forward-left-up or forward-right-down."""
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
    """Time column, required for files; topics have stamps."""
    columns: dict[str, ColumnSource] = Field(default_factory=dict)
    """Canonical column -> its source; the default columns for topics of known types if empty."""
    frame: LogFrame = Field(default_factory=LogFrame)
    time_offset: float = 0.0
    """Offset added to the times [s]."""
    phase: PhaseColumn | None = None
    split: str | None = None
    """Column whose changes of value start a new trial."""
    spaces: bool = False
    """True if blanks separate the columns of a text table; commas, semicolons and tabs are detected."""
    skip_rows: int = Field(default=0, ge=0)
    """Number of lines before the header line."""
    names: tuple[str, ...] | None = None
    """Names of the columns of a file without a header line."""
    valid: tuple[Validity, ...] | None = None
    """Columns that mark invalid samples, which are removed; detected automatically if None, none if `false`."""
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
        """Accept a list of columns whose names in the log are canonical."""
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
                raise refuse_value(f"has an invalid unit: {error}") from None
        return columns


HEADER_KEYS = tuple(Header.model_fields)

GROUPS = tuple(dict.fromkeys(column.group for column in COLUMNS.values()))


class ArduSubMap(Part):
    """Map of an ArduSub log, and settings of the mixer from sticks to pulses."""

    outputs: dict[str, str] = Field(default_factory=dict)
    """Output of the autopilot -> thruster, `{C1: T1, C2: -T2}`; a minus if longer pulses push backwards."""
    velocity: Literal["auto", "ekf", "vision", "none"] = "auto"
    """Source of u v w: the state estimate, or the position deltas of a DVL or visual odometry."""
    imu: int = Field(default=0, ge=0)
    barometer: int | None = Field(default=None, ge=0)
    """Index of the pressure sensor in the water; the primary one if None."""
    stamps: Literal["header", "received"] = "header"
    """Times of a .tlog: the autopilot's own clock if a message has it, or the times at which messages were received."""
    frame: Literal["VECTORED", "VECTORED_6DOF"] | None = None
    """Frame of the mixer for `stick_*` columns."""
    gain: float = Field(default=1.0, gt=0.0, le=1.0)
    """Pilot gain, a factor (PilotGain, JS_GAIN_DEFAULT), to be applied to `stick_*` columns if they are
    unscaled joystick values."""
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
    """Shortest duration of a piece; shorter ones are discarded [s]."""

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
    """Map file."""

    files: dict[str, SourceMap] = Field(default_factory=dict)
    """Name or pattern of a file (`imu.csv`, `*_imu.csv`, `{trial}_imu.csv`) -> its map."""
    topics: dict[str, SourceMap] = Field(default_factory=dict)
    ardusub: ArduSubMap = Field(default_factory=ArduSubMap)
    split: SplitRule | None = None
    time_offsets: dict[str, float] = Field(default_factory=dict)
    """Column, or group (command velocity rates acceleration attitude position depth) -> seconds added to its times."""
    surface_pressure: float | None = Field(default=None, ge=0.0)
    """Pressure at the surface as measured by the sensor, for `pressure` columns [Pa]; 0 for a gauge sensor."""
    header: dict[str, Any] = Field(default_factory=dict)
    """Keys of `trial.yaml` of every trial."""
    trials: dict[str, dict[str, Any]] = Field(default_factory=dict)
    """Trial -> additional keys of its `trial.yaml`, which override those of every trial."""

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
        """Return the header of a trial; a vehicle given on the command line has priority, the log's own
        header the lowest.

        Raises:
            CalibrationError: A key or value is not valid in `trial.yaml`.
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
        CalibrationError: The file is unreadable or malformed, or a key or value is invalid.
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
    """Return the sections of a shipped file: name -> map of a topic, report or table that is read without a user map.

    Args:
        file: Name of the YAML file beside this module; sections with text are returned unchanged.
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
    """Return a map restricted to the columns that a log contains; world velocities only if all three exist.

    Args:
        source: Map of all columns that the format may contain.
        names: Columns or fields of the log.
    """
    there = {name: spec for name, spec in source.columns.items() if spec.column in names}
    if not {"vx", "vy", "vz"} <= set(there):
        there = {name: spec for name, spec in there.items() if name not in ("vx", "vy", "vz")}
    return source.model_copy(update={"columns": there})


def split_rule(text: str) -> SplitRule:
    """Return the rule for a word of the command line: phase, gaps, gaps=SECONDS, arming or column.

    Raises:
        CalibrationError: The word is unknown.
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
