"""The map file: which column, field or message of a log is which column of a trial."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, ValidationError, model_validator

from finssim.calibration.errors import CalibrationError
from finssim.calibration.importers.source_map import SourceMap
from finssim.calibration.trials.header import Header
from finssim.vehicles.part import Part, did_you_mean, refuse_section
from finssim.yaml_file import read_mapping

__all__ = ["ArduSubMap", "ColumnMap", "SplitRule", "read_map", "split_rule"]

HEADER_KEYS = tuple(name for name in Header.model_fields if name != "convert")


class ArduSubMap(Part):
    """What is taken from an ArduSub log, and how its mixer turns sticks into pulses."""

    outputs: dict[str, str] = Field(default_factory=dict)
    """Output of the autopilot -> thruster, `{C1: T1, C2: -T2}`; a minus where longer pulses push backwards."""
    velocity: Literal["auto", "ekf", "vision", "none"] = "auto"
    """Source of u v w: the state estimate, or the position deltas of a DVL or visual odometry."""
    imu: int = Field(default=0, ge=0)
    barometer: int | None = Field(default=None, ge=0)
    """The pressure sensor in the water; the primary one where not given."""
    stamps: Literal["header", "received"] = "header"
    """Of a .tlog: the autopilot's own clock where a message has it, or the times at which messages were received."""
    frame: Literal["VECTORED", "VECTORED_6DOF"] | None = None
    """Of the mixer that `stick_*` columns went through."""
    gain: float = Field(default=1.0, gt=0.0, le=1.0)
    """Pilot gain (PilotGain, JS_GAIN_DEFAULT) of `stick_*` columns, where they are the joystick's, not scaled yet."""
    motor_directions: tuple[Literal[1, -1], ...] = ()
    """MOT_n_DIRECTION of motors 1, 2, ..., for `stick_*` columns; 1 where not given."""


class SplitRule(Part):
    """What makes several trials of one log."""

    by: Literal["phase", "gaps", "arming", "column", "windows"]
    longest_gap: float = Field(default=2.0, gt=0.0)
    """Of `gaps`: a longer pause begins a new trial [s]."""
    windows: dict[str, tuple[float, float]] = Field(default_factory=dict)
    """Of `windows`: trial -> from and to [s] after the start of the log."""
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
                return {
                    "by": "gaps",
                    "longest_gap": data["gaps"],
                    **{k: v for k, v in data.items() if k != "gaps"},
                }
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
    surface_pressure: float | None = Field(default=None, ge=0.0)
    """Of the surface as the sensor reads it, for `pressure` columns [Pa]; 0 for a gauge."""
    header: dict[str, Any] = Field(default_factory=dict)
    """What `trial.yaml` of every trial says."""
    trials: dict[str, dict[str, Any]] = Field(default_factory=dict)
    """Trial -> what its `trial.yaml` says beside or instead of that."""

    @model_validator(mode="before")
    @classmethod
    def _short(cls, data: Any) -> Any:
        """`trial.yaml` keys stand at the top level; one source for all files may stand there too."""
        data = dict(data)
        single = {
            key: data.pop(key) for key in list(data) if key in SourceMap.model_fields and key != "split"
        }
        if single:
            if "files" in data:
                raise refuse_section(f"'{next(iter(single))}' stands beside 'files': write it inside a file")
            data["files"] = {"*": single}
        header = {key: data.pop(key) for key in list(data) if key in HEADER_KEYS}
        for key in data:
            if key not in cls.model_fields:
                known = [*cls.model_fields, *HEADER_KEYS, *SourceMap.model_fields]
                raise refuse_section(
                    f"unknown key '{key}'{did_you_mean(str(key), known)} known keys: {', '.join(known)}"
                )
        return {**data, "header": {**data.get("header", {}), **header}}

    def header_of(self, trial: str, vehicle: str | None, recorded: Mapping[str, Any] | None = None) -> Header:
        """The header of a trial; a vehicle given on the command line comes first, what the log says itself last.

        Raises:
            CalibrationError: A key or value that `trial.yaml` does not take.
        """
        keys = {**(recorded or {}), **self.header, **self.trials.get(trial, {})}
        if vehicle is not None:
            keys["vehicle"] = vehicle
        for key in keys:
            if key not in HEADER_KEYS:
                raise CalibrationError(
                    f"trials.{trial}: unknown key '{key}'{did_you_mean(str(key), list(HEADER_KEYS))} "
                    f"known keys: {', '.join(HEADER_KEYS)}"
                )
        try:
            return Header.model_validate(keys)
        except ValidationError as error:
            raise CalibrationError(_sentence(error)) from None


def read_map(path: Path) -> ColumnMap:
    """Read and check a map file.

    Raises:
        CalibrationError: Unreadable, malformed, or a key or value that is refused.
    """
    tree = read_mapping(path, CalibrationError, such_as="files: {log.csv: {time: t, columns: {u: vel_x}}}")
    try:
        found = ColumnMap.model_validate(tree)
        found.header_of("", None)
    except ValidationError as error:
        raise CalibrationError(f"{path}: {_sentence(error)}") from None
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from None
    return found


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
            f"split is '{text}', expected phase, gaps, gaps=SECONDS, arming or column; time windows stand in a map file"
        ) from None


def _sentence(error: ValidationError) -> str:
    first = error.errors()[0]
    where = ".".join(str(x) for x in first["loc"] if "[" not in str(x) or "*" in str(x))
    message = first["msg"].removeprefix("Value error, ")
    if first["type"] in ("section", "value"):
        return f"{where}: {message}" if where else message
    given = "" if first["type"] == "missing" else f" is {first['input']!r},"
    return f"{where}:{given} {message[0].lower()}{message[1:]}"
