"""Trial: commands and measurements of a moving vehicle, in canonical columns."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, ConfigDict, Field, model_validator

from finssim.core.page import notebook_html
from finssim.trials.findings import CalibrationError, Finding
from finssim.vehicles.part import Part, refuse_value
from finssim.vehicles.vehicle import Axis

__all__ = ["Array", "Header", "NU", "PHASES", "TAU", "Trial", "TrialWater", "column_of"]

Array = NDArray[np.float64]


def _point(value: Any) -> Any:
    numbers = value if isinstance(value, (list, tuple)) else ()
    finite = [isinstance(x, (int, float)) and not isinstance(x, bool) and math.isfinite(x) for x in numbers]
    if len(finite) != 3 or not all(finite):
        raise refuse_value(f"is {value!r}, expected 3 numbers [x, y, z]")
    return value


def _moment_point(value: Any) -> Any:
    if isinstance(value, str) and value not in ("center_of_gravity", "origin"):
        raise refuse_value(f"is {value!r}, expected 3 numbers [x, y, z], center_of_gravity or origin")
    return value if value is None or isinstance(value, str) else _point(value)


Point = Annotated[tuple[float, float, float], BeforeValidator(_point)]


class _Section(Part):
    model_config = ConfigDict(allow_inf_nan=False)


class TrialWater(_Section):
    """Water of the trial, if it differs from that of the vehicle file."""

    density: float | None = Field(default=None, gt=0.0)
    """Density [kg/m³]."""
    depth: float | None = Field(default=None, gt=0.0)
    """Depth of the pool [m]."""
    current: Point | None = None
    """Current in the world frame [m/s]."""


class Header(_Section):
    """Content of `trial.yaml`. All keys are optional; the page on trials gives their defaults."""

    vehicle: str | None = None
    """Name or file of the vehicle."""
    axis: tuple[Axis, ...] = ()
    """Axes that the trial excites; detected from the data if empty."""
    role: Literal["fit", "held-out"] | None = None
    """Role of the trial in a fit; a fit refuses held-out trials."""
    description: str = ""
    inputs: Literal["applied", "commanded"] | None = None
    """Kind of the input columns: applied (measured, reconstructed) or commanded, before delay and lag. If
    `None`, `rpm_*`, `force_*` and `tau_*` were applied, `pwm_*` and `command_*` were commanded."""
    inputs_between: Literal["held", "linear"] | None = None
    """Inputs between two samples. If `None`, commands are held, and so are inputs that keep exact levels and
    jump from row to row; other applied inputs are linear."""
    inputs_after: Literal["held", "zero", "unknown"] | None = None
    """Inputs after the end of an input stream within the recording. If `None`, a zero last command is held,
    any other is unknown from one sample interval later on."""
    passive: bool = False
    """True if the thrusters were off: no input columns are needed."""
    wrench_at: Annotated[
        tuple[float, float, float] | Literal["center_of_gravity", "origin"] | None,
        BeforeValidator(_moment_point),
    ] = None
    """Body point that is the reference of tau_k, tau_m, tau_n [m]; the vehicle's `wrench_reference` if None."""
    velocity_at: Point = (0.0, 0.0, 0.0)
    """Body point to which the velocity u, v, w refers [m]."""
    position_at: Point = (0.0, 0.0, 0.0)
    """Body point to which the position x, y, z refers [m]."""
    acceleration_at: Point | None = None
    """Body point of the accelerometer [m], for documentation only: no check or fit uses it."""
    depth_at: Point | None = None
    """Body point of the pressure sensor [m]; the vehicle's depth sensor if None."""
    acceleration: Literal["specific_force", "kinematic", "auto"] = "auto"
    """Kind of ax, ay, az: with gravity (an accelerometer: +9.81 up at rest) or without; `auto` detects it."""
    velocity: Literal["ground", "water"] = "ground"
    """Reference of u, v, w: ground or water."""
    voltage: float | None = Field(default=None, gt=0.0)
    """Battery voltage [V], for pulse widths; a column `voltage` has priority."""
    water: TrialWater = Field(default_factory=TrialWater)

    @model_validator(mode="before")
    @classmethod
    def _single_axis(cls, data: Any) -> Any:
        """Accept a single axis without brackets."""
        if isinstance(data, dict) and isinstance(data.get("axis"), str):
            return {**data, "axis": [data["axis"]]}
        return data

    def meaning(self) -> dict[str, Any]:
        """Return the fields that affect the meaning of the numbers, as plain values: all but description,
        role and vehicle."""
        return self.model_dump(mode="json", exclude={"description", "role", "vehicle", "axis"})


# The canonical columns of a trial: names, units, frames.


class Column(NamedTuple):
    """Canonical column; the page on trials defines its meaning."""

    group: str
    """Columns of one group come from one sensor: command velocity rates acceleration attitude position depth."""
    unit: str


TAU = ("tau_x", "tau_y", "tau_z", "tau_k", "tau_m", "tau_n")
"""Wrench, body frame; moments about the header's `wrench_at`."""

NU = ("u", "v", "w", "p", "q", "r")
"""Velocity nu, body frame."""

COLUMNS = {
    name: Column(group, unit)
    for group, unit, names in (
        ("command", "N", TAU[:3]),
        ("command", "N m", TAU[3:]),
        ("velocity", "m/s", NU[:3]),
        ("rates", "rad/s", NU[3:]),
        ("acceleration", "m/s²", ("ax", "ay", "az")),
        ("attitude", "rad", ("roll", "pitch", "yaw")),
        ("attitude", "-", ("qx", "qy", "qz", "qw")),
        ("position", "m", ("x", "y", "z")),
        ("depth", "m", ("depth",)),
        ("command", "V", ("voltage",)),
    )
    for name in names
}
"""Columns with fixed names."""

INPUT_PREFIXES = {
    prefix: Column("command", unit)
    for prefix, unit in (
        ("force_", "N"),
        ("rpm_", "rpm"),
        ("pwm_", "µs"),
        ("command_", "N"),
        ("actuator_", "-"),
    )
}
"""Prefixes of columns named PREFIX + name of a thruster or another actuator."""


def column_of(name: str) -> Column | None:
    """Return the canonical column of that name, or None."""
    if name in COLUMNS:
        return COLUMNS[name]
    for prefix, column in INPUT_PREFIXES.items():
        if name.startswith(prefix) and len(name) > len(prefix):
            return column
    return None


PHASES = ("baseline", "excitation", "coast", "rest")
"""Words of the `phase` column; an empty word means no phase."""

SLOWEST = 2.0
"""Largest median interval between the rows of a trial: slower data do not resolve the motion [s]."""


@dataclass(frozen=True, kw_only=True)
class Trial:
    """Measurements on one time base; streams with other rates have NaN where they have no sample.

    Frames and units are defined in `finssim.trials.trial`.
    """

    name: str
    """Name, unique among the trials that are used together; the folder's name."""
    t: Array
    """Times [s], strictly increasing, (n,)."""
    channels: dict[str, Array] = field(default_factory=dict)
    """Canonical column -> values in the unit of `COLUMNS`, NaN where there is no sample, (n,) each."""
    phase: NDArray[np.str_] | None = None
    """Word of `PHASES` or "" for every row, (n,); None if the log has no phases."""
    header: Header = field(default_factory=Header)
    """Content of `trial.yaml`."""
    findings: tuple[Finding, ...] = ()
    """Repairs, and data that was omitted on reading."""
    path: Path | None = None
    """Folder or file that the trial was read from."""

    def __post_init__(self) -> None:
        t = self.t
        if t.ndim != 1 or len(t) < 2 or not (np.isfinite(t).all() and (np.diff(t) > 0.0).all()):
            raise CalibrationError(f"{self.name}: t is not at least 2 strictly increasing times in s")
        if (step := float(np.median(np.diff(t)))) > SLOWEST:
            unit = next((unit for unit, n in (("ms", 1e3), ("us", 1e6)) if step <= SLOWEST * n), "ns")
            raise CalibrationError(
                f"{self.name}: t has a row every {step:.3g} s, expected one every {SLOWEST:g} s at least: if its times "
                f"are in {unit}, import it with a map of the time's unit (time: {{column: t, unit: {unit}}}), or give "
                f"Trial.from_frame units={{'t': '{unit}'}}"
            )
        for column, values in self.channels.items():
            if column_of(column) is None:
                raise CalibrationError(f"{self.name}: '{column}' is not a column of a trial")
            if values.shape != t.shape:
                raise CalibrationError(
                    f"{self.name}: {column} has shape {values.shape}, expected {t.shape} like t"
                )
        if self.phase is not None and (self.phase.shape != t.shape or not set(self.phase) <= {*PHASES, ""}):
            raise CalibrationError(
                f"{self.name}: phase must contain {len(t)} words of {', '.join(PHASES)}, or empty ones"
            )

    @classmethod
    def from_frame(
        cls,
        frame: Any,
        *,
        columns: Mapping[str, str] | None = None,
        units: Mapping[str, str] | None = None,
        time: str = "t",
        axes: str = "FLU",
        name: str = "trial",
        surface_pressure: float | None = None,
        **header: Any,
    ) -> Trial:
        """Return the trial in a table in memory; unused columns are listed in its findings.

        Args:
            frame: A pandas DataFrame, or a mapping of names to columns of equal length. A DataFrame with a
                time index needs no time column.
            columns: Column of a trial -> name of the column in `frame`; if None, the columns with names of a
                trial's columns.
            units: Column of a trial, or `t` for the times -> its unit in `frame`, if it differs from that of
                the trial; `date` for written dates and for pandas timestamps.
            time: Name of the column of times.
            axes: Axes of the table: FLU (x forward, y left, z up) or FRD (x forward, y right, z down, and a world with
                z down).
            name: Name of the trial.
            surface_pressure: Reading of the sensor of a column `pressure` at the surface [Pa], 0 for a gauge
                sensor; a standard atmosphere if None, which is noted in the findings.
            header: Additional keys of `trial.yaml`, such as `vehicle`, `voltage` or `role`.

        Raises:
            CalibrationError: A column, unit or key is unknown, or there are no times or no usable columns.
        """
        from finssim.trials.importers.frame import trial_from_frame

        return trial_from_frame(frame, columns, units, time, axes, name, surface_pressure, header)

    def has(self, *columns: str) -> bool:
        """Return whether all of these columns contain at least two finite samples."""
        return all(c in self.channels and np.isfinite(self.channels[c]).sum() >= 2 for c in columns)

    def series(self, column: str) -> tuple[Array, Array]:
        """Return times [s] and values of the finite samples of a column, (k,) each; empty if there are none."""
        values = self.channels.get(column)
        if values is None:
            return np.empty(0), np.empty(0)
        good = np.isfinite(values)
        return self.t[good], values[good]

    @property
    def duration(self) -> float:
        """Time from the first row to the last [s]."""
        return float(self.t[-1] - self.t[0])

    def __repr__(self) -> str:
        columns = " ".join(self.channels) or "no columns"
        return f"<Trial {self.name}: {self.duration:.1f} s, {len(self.t)} rows, {columns}>"

    def _repr_html_(self) -> str:
        rows = []
        for name in self.channels:
            values, column = self.series(name)[1], column_of(name)
            ends = [f"{f(values):.4g}" for f in (np.min, np.max)] if len(values) else ["–", "–"]
            rows.append((name, column.unit if column else "", str(len(values)), *ends))
        title = f"{self.name}: {self.duration:.1f} s, {len(self.t)} rows"
        return notebook_html(title, ("column", "unit", "samples", "least", "greatest"), rows)

    @cached_property
    def sha256(self) -> str:
        """Digest of the numbers, the phases and the header fields that affect their meaning.

        It does not depend on the trial's name, location, file format or role.
        """
        digest = hashlib.sha256(np.ascontiguousarray(self.t).tobytes())
        for column in sorted(self.channels):
            digest.update(column.encode())
            values = self.channels[column] + 0.0  # no -0.0, and one NaN: equal numbers have equal bytes
            digest.update(np.where(np.isnan(values), np.nan, values).tobytes())
        if self.phase is not None:
            digest.update("\n".join(self.phase.tolist()).encode())
        digest.update(json.dumps(self.header.meaning(), sort_keys=True).encode())
        return digest.hexdigest()
