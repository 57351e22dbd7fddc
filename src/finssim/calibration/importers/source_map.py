"""How one file or topic is read: its time, columns, units and axes."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, field_validator, model_validator

from finssim.calibration.errors import CalibrationError
from finssim.calibration.trials.trial import COLUMNS, INPUT_PREFIXES, PHASES, column_of
from finssim.calibration.trials.units import EXTRA_COLUMNS, TIME_UNITS, factor
from finssim.vehicles.part import Part, did_you_mean, refuse_section, refuse_value

__all__ = ["ColumnSource", "Frame", "PhaseColumn", "SourceMap", "TimeColumn"]


class ColumnSource(Part):
    """Where the numbers of one canonical column come from: sign (scale * column + offset) in `unit`."""

    column: str | None = None
    """Name of a column, or dotted path of a field such as `twist.twist.linear.x` or `data[3]`."""
    value: float | None = None
    """A constant in place of a column."""
    scale: float = 1.0
    offset: float = 0.0
    """In `unit`, added after scaling."""
    sign: Literal[1, -1] = 1
    unit: str | None = None
    """Of scale * column + offset; the unit of the canonical column where not given."""

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
    def _one_source(self) -> ColumnSource:
        if (self.column is None) == (self.value is None):
            raise refuse_section("expected either 'column: NAME' or 'value: NUMBER'")
        return self


class TimeColumn(Part):
    """The column that holds the time."""

    column: str
    unit: str = "s"

    @model_validator(mode="before")
    @classmethod
    def _short(cls, data: Any) -> Any:
        return {"column": data} if isinstance(data, str) else data

    @field_validator("unit")
    @classmethod
    def _known(cls, unit: str) -> str:
        if unit not in TIME_UNITS and unit != "date":
            raise refuse_value(
                f"is '{unit}', expected one of {', '.join(TIME_UNITS)}, or date for written dates"
            )
        return unit


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
    def _known(cls, words: dict[str, str]) -> dict[str, str]:
        for word in words.values():
            if word not in PHASES:
                raise refuse_value(
                    f"holds '{word}'{did_you_mean(word, list(PHASES))} expected {', '.join(PHASES)}"
                )
        return words


class Frame(Part):
    """Axes that the log uses."""

    body: Literal["FLU", "FRD"] = "FLU"
    """Forward-left-up or forward-right-down."""
    world: Literal["z_up", "NED"] = "z_up"

    @model_validator(mode="before")
    @classmethod
    def _short(cls, data: Any) -> Any:
        if not isinstance(data, str):
            return data
        forms = {
            "FLU": {},
            "z_up": {},
            "FRD": {"body": "FRD", "world": "NED"},
            "NED": {"body": "FRD", "world": "NED"},
        }
        if data not in forms:
            raise refuse_section(
                f"is '{data}', expected FLU, FRD, or {{body: FLU or FRD, world: z_up or NED}}"
            )
        return forms[data]


class SourceMap(Part):
    """How one file or topic is read."""

    time: TimeColumn | None = None
    """Needed for files; topics have stamps."""
    columns: dict[str, ColumnSource] = Field(default_factory=dict)
    """Canonical column -> its source; for topics of known types the usual ones where nothing is given."""
    frame: Frame = Field(default_factory=Frame)
    time_offset: float = 0.0
    """Added to the times [s]."""
    phase: PhaseColumn | None = None
    split: str | None = None
    """Column whose changes of value begin a new trial."""
    spaces: bool = False
    """Whether blanks separate the columns of a text table; commas, semicolons and tabs are found out."""
    skip_rows: int = Field(default=0, ge=0)
    """Lines before the line of names."""
    names: tuple[str, ...] | None = None
    """Names of the columns of a file that has no line of names."""
    stamps: Literal["header", "received"] = "header"
    """Of a topic: the stamps in its messages, where it has them, or the times at which they were recorded."""

    @model_validator(mode="before")
    @classmethod
    def _short(cls, data: Any) -> Any:
        if isinstance(data, (list, tuple)):
            raise refuse_section("is a list, expected columns: {CANONICAL: FIELD}")
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
    def _known(cls, columns: dict[str, ColumnSource]) -> dict[str, ColumnSource]:
        known = [*COLUMNS, *EXTRA_COLUMNS]
        for name, source in columns.items():
            if name not in EXTRA_COLUMNS and column_of(name) is None:
                inputs = ", ".join(f"{prefix}NAME" for prefix in INPUT_PREFIXES)
                raise refuse_value(
                    f"names '{name}'{did_you_mean(name, known)} columns of a trial are {', '.join(known)}, {inputs}"
                )
            try:
                factor(source.unit, name)
            except CalibrationError as error:
                raise refuse_value(f"holds a wrong unit: {error}") from None
        return columns
