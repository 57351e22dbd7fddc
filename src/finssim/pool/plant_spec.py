"""A plant of the virtual pool: every number in which it differs from the vehicle file, as one YAML file."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import yaml
from pydantic import Field, ValidationError, field_validator

from finssim.files import atomic_write
from finssim.pool.coupled import Section, Three
from finssim.pool.water_spec import AddedMass, BuoyancyDrift, Circulation, Damping, HullDrag, SlackTether
from finssim.vehicles import Vehicle
from finssim.vehicles.defaults import POOL, room
from finssim.yaml_file import read_mapping

__all__ = ["Basin", "PlantSpec", "PlantSpecError", "Severity", "basin_of", "load_plant_spec"]

Severity = Literal["nominal", "realistic", "hard"]


class PlantSpecError(ValueError):
    """A plant file that cannot be used, or a vehicle that the plant does not fit."""


class Basin(Section):
    """The pool: a box centred on the world's z axis, the water surface at z = 0."""

    length: float = Field(default=4.0, gt=0.0)
    """Along world x [m]."""
    width: float = Field(default=2.0, gt=0.0)
    """Along world y [m]."""
    depth: float = Field(default=1.0, gt=0.0)
    """[m]"""


def basin_of(vehicle: Vehicle) -> Basin:
    """The published pool; a larger one, of the same shape, for a vehicle that it has no room for."""
    length, width, depth = (room(vehicle.body.size) * side for side in POOL)
    return Basin(length=length, width=width, depth=depth)


class TrueBody(Section):
    """The rigid body as it is, not as it was weighed."""

    mass: float = Field(gt=0.0)
    """[kg]"""
    inertia: tuple[Three, Three, Three]
    """About the centre of gravity, body axes [kg m²]."""
    center_of_gravity: Three
    """Body frame [m]."""
    displaced_volume: float = Field(gt=0.0)
    """[m³]"""
    center_of_buoyancy: Three
    """Body frame [m]."""


class TrueThruster(Section):
    """One thruster as built."""

    gain_plus: float = Field(gt=0.0)
    """Thrust over the file's, forward [-]."""
    gain_minus: float = Field(gt=0.0)
    """The same in reverse."""
    deduction: float = Field(ge=0.0, lt=1.0)
    """Part of the thrust that its own jet takes back from the hull [-]."""
    time_constant: float = Field(gt=0.0)
    """Of the shaft's speed [s]."""
    delay: float = Field(ge=0.0, le=1.0)
    """From throttle to shaft [s]."""
    dead_rpm_plus: float = Field(ge=0.0)
    """Slowest forward speed that turns the shaft [rpm]."""
    dead_rpm_minus: float = Field(ge=0.0)
    """Slowest reverse speed, as a magnitude [rpm]."""
    full_rpm: float = Field(gt=0.0)
    """Speed at full throttle on a full battery [rpm]."""


class Propellers(Section):
    """How water that already moves takes thrust away: T (1 - V / (J0 n D)), V the inflow, n turns a second."""

    diameter: float = Field(default=0.07, gt=0.0)
    """D [m]."""
    own_share: float = Field(default=0.0, ge=0.0)
    """Part of the vehicle's own speed along the axis that enters V [-]."""
    advance_at_zero_thrust: float = Field(default=0.8, gt=0.0)
    """J0 [-]"""
    induced_share: float = Field(default=0.0, ge=0.0, le=1.0)
    """Part of a neighbour's induced speed that enters V, at no distance [-]."""
    induced_reach: float = Field(default=0.3, gt=0.0)
    """Falls by e over this distance [m]."""


class Battery(Section):
    """Voltage falls with time and with load."""

    full_voltage: float = Field(default=16.4, gt=0.0)
    """[V]"""
    fade: float = Field(default=0.0, ge=0.0, lt=0.5)
    """Part of the voltage lost after `fade_time` [-]."""
    fade_time: float = Field(default=900.0, gt=0.0)
    """[s]; the voltage stays there afterwards."""
    resistance: float = Field(default=0.0, ge=0.0)
    """Of cells and wiring [ohm]."""
    motor_power: float = Field(default=45.0, ge=0.0)
    """Of one motor at `full_rpm`; falls with the cube of speed [W]."""
    idle_current: float = Field(default=0.6, ge=0.0)
    """Of everything else [A]."""


class Instruments(Section):
    """How the instruments differ from the vehicle file."""

    noise: float = Field(default=1.0, ge=0.0)
    """Factor on the file's noise, bias and drift [-]."""
    pressure_drift: float = Field(default=0.0, ge=0.0)
    """Random walk of the depth's bias, besides the file's [m/√s]."""


class FirmwareSpec(Section):
    """The motor controller: its speed loop, clock and attitude filter, and the wire behind it."""

    loop_period: float = Field(default=0.002, ge=0.001, le=0.005)
    """Of the rpm loop [s]."""
    feed_forward: float = Field(default=1.0, gt=0.0)
    """Throttle over what the file's speed range would need [-]."""
    gain: float = Field(default=0.4, ge=0.0)
    """Proportional: throttle per normalised speed error [-]."""
    integral_gain: float = Field(default=1.5, ge=0.0)
    """[1/s]"""
    derivative_gain: float = Field(default=0.004, ge=0.0)
    """[s]"""
    rpm_noise: float = Field(default=12.0, ge=0.0)
    """Standard deviation of one measurement [rpm]."""
    rpm_quantum: float = Field(default=8.0, ge=0.0)
    """[rpm]"""
    crystal_ppm: float = Field(default=0.0, ge=-500.0, le=500.0)
    """How fast its clock runs [ppm]."""
    clock_start: int = Field(default=0, ge=0, lt=2**32)
    """Reading of its clock when the pool starts [ms]; 0 after a reboot."""
    reboot_time: float = Field(default=1.5, ge=0.0)
    """Silence after a reboot [s]."""
    attitude_gain: float = Field(default=0.5, ge=0.0)
    """Of the accelerometer in the attitude filter [1/s]."""
    attitude_integral: float = Field(default=0.01, ge=0.0)
    """[1/s²]"""
    uplink: tuple[float, float] = (0.001, 0.003)
    """Shortest and longest way of a telemetry frame to the robot [s]."""
    downlink: tuple[float, float] = (0.0008, 0.0014)
    """The same for a command."""

    @field_validator("uplink", "downlink")
    @classmethod
    def _ordered(cls, value: tuple[float, float]) -> tuple[float, float]:
        if not 0.0 <= value[0] <= value[1]:
            raise ValueError("expected the shortest time first, none below 0 s")
        return value


class PlantSpec(Section):
    """Everything hidden about one plant; the vehicle file gives thruster places, envelope and instruments."""

    title: str
    severity: Severity
    seed: int = Field(ge=0)
    vehicle: str
    """Name of the vehicle it was drawn around."""
    basin: Basin = Basin()
    body: TrueBody
    added_mass: AddedMass
    damping: Damping
    hull: HullDrag = HullDrag()
    thrusters: dict[str, TrueThruster]
    """By name, as in the vehicle file."""
    propellers: Propellers = Propellers()
    battery: Battery = Battery()
    buoyancy: BuoyancyDrift = BuoyancyDrift()
    tether: SlackTether | None = None
    circulation: Circulation = Circulation()
    instruments: Instruments = Instruments()
    firmware: FirmwareSpec = FirmwareSpec()

    def write(self, path: Path) -> None:
        """Write the plant file, whole or not at all."""
        text = yaml.safe_dump(self.model_dump(mode="json"), sort_keys=False, width=118)
        with atomic_write(path) as temporary:
            temporary.write_text(
                f"# A plant of FinsSim's virtual pool: finssim pool --plant {Path(path).name}\n"
                "# Units are SI unless a name says otherwise; docs/virtual_pool.md explains every key.\n"
                + text,
                encoding="utf-8",
            )


def load_plant_spec(path: str | Path) -> PlantSpec:
    """The plant in a file.

    Raises:
        PlantSpecError: The file cannot be used; names file, key and expectation.
    """
    data = read_mapping(Path(path), PlantSpecError, such_as="severity: realistic")
    try:
        return PlantSpec.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(x) for x in first["loc"])
        raise PlantSpecError(f"{path}: {where}: {first['msg'].removeprefix('Value error, ')}") from None
