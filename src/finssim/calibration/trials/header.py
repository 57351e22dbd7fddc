"""What `trial.yaml` says about a trial's data."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from finssim.vehicles.vehicle import Axis

__all__ = ["Conversion", "Header", "TrialWater"]

Point = tuple[float, float, float]


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Conversion(_Section):
    """From the log's conventions to ours; applied once, when the trial is read, in the order given here."""

    rename: dict[str, str] = Field(default_factory=dict)
    """Column of the log -> canonical column."""
    scale: dict[str, float] = Field(default_factory=dict)
    """Canonical column -> factor to SI, after renaming; -1 turns a sign, 0.0174533 makes radians of degrees.
    `force_*` stands for every column that begins so."""
    offset: dict[str, float] = Field(default_factory=dict)
    """Canonical column -> added after scaling; `force_*` as in `scale`."""
    body: Literal["FLU", "FRD"] = "FLU"
    """Body axes of velocities, wrenches, accelerations and attitudes in the log."""
    world: Literal["z_up", "NED"] = "z_up"
    """World axes of position and attitude in the log."""
    time_offset: dict[str, float] = Field(default_factory=dict)
    """Canonical column, or group (`command velocity rates acceleration attitude position depth`) -> seconds added to
    its times."""


class TrialWater(_Section):
    """The water of the trial, where it differs from the vehicle file's."""

    density: float | None = Field(default=None, gt=0.0)
    """[kg/m³]"""
    depth: float | None = Field(default=None, gt=0.0)
    """Of the pool [m]."""
    current: Point | None = None
    """World frame [m/s]."""


class Header(_Section):
    """Everything is optional; what is left out is as the trial format's page says."""

    vehicle: str | None = None
    """Name or file of the vehicle."""
    axis: tuple[Axis, ...] = ()
    """Axes that the trial excites; found from the data where empty."""
    role: Literal["fit", "held-out"] | None = None
    """Whether a fit may use it; a fit refuses held-out trials."""
    description: str = ""
    inputs: Literal["applied", "commanded"] | None = None
    """Whether the input columns are what acted (measured, reconstructed) or what was asked for, before delay and lag.
    `None`: `rpm_*`, `force_*` and `tau_*` acted, `pwm_*` and `command_*` were asked for."""
    inputs_between: Literal["held", "linear"] | None = None
    """What inputs did between two samples. `None`: what was asked for is held, and so is what keeps exact levels and
    jumps from row to row; anything else that acted goes in a straight line."""
    inputs_after: Literal["held", "zero", "unknown"] | None = None
    """What acts after an input stream that ends before the recording does. `None`: a last command of no thrust is held,
    any other is unknown from one sample later on."""
    passive: bool = False
    """Thrusters off: no input columns are needed."""
    wrench_at: Point | Literal["center_of_gravity", "origin"] | None = None
    """Body point about which tau_k, tau_m, tau_n are moments [m]; the vehicle's `wrench_reference` where not given."""
    velocity_at: Point = (0.0, 0.0, 0.0)
    """Body point whose velocity u, v, w are [m]."""
    position_at: Point = (0.0, 0.0, 0.0)
    """Body point whose position x, y, z are [m]."""
    acceleration_at: Point | None = None
    """Body point of the accelerometer [m]; the vehicle's IMU where not given."""
    depth_at: Point | None = None
    """Body point of the pressure sensor [m]; the vehicle's depth sensor where not given."""
    acceleration: Literal["specific_force", "kinematic", "auto"] = "auto"
    """Whether ax, ay, az hold gravity (an accelerometer: +9.81 up at rest) or not; found from the data if `auto`."""
    velocity: Literal["ground", "water"] = "ground"
    """What u, v, w are relative to."""
    voltage: float | None = Field(default=None, gt=0.0)
    """Of the battery [V], for pulse widths; a column `voltage` comes first."""
    water: TrialWater = Field(default_factory=TrialWater)
    convert: Conversion = Field(default_factory=Conversion)

    def meaning(self) -> dict[str, Any]:
        """The parts that change what the numbers mean, as plain values: all but description, role and vehicle."""
        return self.model_dump(mode="json", exclude={"description", "role", "vehicle", "convert", "axis"})
