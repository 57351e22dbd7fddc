"""A plant of the virtual pool: every number in which it differs from the vehicle file, as one YAML file."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from finssim.core.files import atomic_write
from finssim.core.rotations import quat_from_euler, quat_to_matrix
from finssim.core.yaml_file import first_problem, read_mapping, yaml_text
from finssim.sim import Water
from finssim.sim.plant_arrays import twist_shift
from finssim.sim.water import beside
from finssim.vehicles import Vehicle
from finssim.vehicles.defaults import POOL, room

__all__ = [
    "HEADROOM",
    "AddedMass",
    "Basin",
    "BuoyancyDrift",
    "Circulation",
    "CoupledMatrix",
    "Damping",
    "Eddy",
    "HullDrag",
    "PlantSpec",
    "PlantSpecError",
    "PrincipalAxes",
    "Section",
    "Severity",
    "Six",
    "SlackTether",
    "Three",
    "basin_of",
    "load_plant_spec",
]

HEADROOM = 1.05
"""A motor as the vehicle file describes it reaches so much more at full throttle than its bench drove it to [-]."""


# Coefficients that hold about some point in tilted axes: how a matrix that couples all axes stays physical.


Array = NDArray[np.float64]
Six = tuple[float, float, float, float, float, float]
Three = tuple[float, float, float]


class Section(BaseModel):
    """A frozen part of a plant file: unknown keys and numbers that are not finite are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class PrincipalAxes(Section):
    """A point of the body and axes there."""

    center: Three
    """Body frame [m]."""
    tilt_deg: Three
    """Roll, pitch, yaw of the axes in the body [deg]."""

    def to_axes(self) -> Array:
        """T with x = T nu: the twist at the point, in the tilted axes, from that of the body origin; (6, 6).

        The angles have no unit, the arms are in [m].
        """
        tilt = quat_to_matrix(quat_from_euler(*np.radians(self.tilt_deg)))
        return np.asarray(np.kron(np.eye(2), tilt.T) @ twist_shift(self.center))


class CoupledMatrix(PrincipalAxes):
    """A 6x6 matrix that is diagonal about some point in some axes."""

    diagonal: Six
    """[kg, kg m²] or [N s/m, N m s]; above 0."""

    def matrix(self) -> Array:
        """About the body origin, body axes: Tᵀ diag T; positive definite for a positive diagonal, (6, 6).

        The unit is that of the diagonal.
        """
        T = self.to_axes()
        return np.asarray(T.T @ np.diag(self.diagonal) @ T)


# Water and forces on the hull in a plant's file.


Rows = tuple[Six, Six, Six, Six, Six, Six]


class AddedMass(PrincipalAxes):
    """M_A = Tᵀ A T, with T from the body origin to these axes."""

    matrix: Rows
    """A, symmetric [kg, kg m, kg m²]."""

    @model_validator(mode="after")
    def _physical(self) -> AddedMass:
        A = np.array(self.matrix)
        if not np.allclose(A, A.T, rtol=0.0, atol=1e-9 * np.abs(A).max(initial=1.0)):
            raise ValueError("matrix is not symmetric: added mass is an energy, give a symmetric matrix")
        if np.linalg.eigvalsh(A)[0] < -1e-9:
            raise ValueError("matrix has a negative eigenvalue, expected positive semidefinite")
        return self

    def about_origin(self) -> Array:
        """M_A about the body origin, (6, 6) [kg, kg m, kg m²]."""
        T = self.to_axes()
        return np.asarray(T.T @ np.array(self.matrix) @ T)


class Damping(PrincipalAxes):
    """tau_D = -Tᵀ [D1 x + D2 (|x| x)], x = T nu_r: dissipative for every velocity."""

    linear: Rows
    """D1 [N s/m, N s, N m s]."""
    quadratic: Rows
    """D2 [N s²/m², ..., N m s²]."""

    @model_validator(mode="after")
    def _dissipative(self) -> Damping:
        D1, D2 = np.array(self.linear), np.array(self.quadratic)
        if np.linalg.eigvalsh(D1 + D1.T)[0] < -1e-9:
            raise ValueError("linear adds energy: its symmetric part has a negative eigenvalue")
        # |x_i| x_j² <= (|x_i|³ + 2 |x_j|³) / 3, so these margins suffice for x · D2 (|x| x) >= 0.
        off = np.abs(D2 - np.diag(np.diag(D2)))
        if np.any(np.diag(D2) - off.sum(axis=1) / 3.0 - 2.0 * off.sum(axis=0) / 3.0 < -1e-9):
            raise ValueError("quadratic may add energy: an off-diagonal entry is too large for its diagonal")
        return self


class HullDrag(Section):
    """Drag of the hull mesh's panels (paper, eq. 4), besides the damping."""

    form_drag: float = Field(default=0.0, ge=0.0)
    """Form drag coefficient [-]."""
    skin_drag: float = Field(default=0.0, ge=0.0)
    """Skin drag coefficient [-]."""


class BuoyancyDrift(Section):
    """Bubbles, warming air and soaking foam: slow changes of buoyancy, a sum of sines."""

    grams: tuple[float, ...] = ()
    """Amplitude of each [g]."""
    periods: tuple[float, ...] = ()
    """[s]"""
    phases: tuple[float, ...] = ()
    """[rad]"""

    @model_validator(mode="after")
    def _same_length(self) -> BuoyancyDrift:
        if not len(self.grams) == len(self.periods) == len(self.phases):
            raise ValueError("grams, periods and phases differ in length: give each sine all three")
        if any(period <= 0.0 for period in self.periods):
            raise ValueError("periods must exceed 0 s")
        return self


class SlackTether(Section):
    """A line that hangs slack and pulls only when it is nearly straight."""

    anchor: Three
    """Point where it leaves the pool's edge, world frame [m]."""
    attachment: Three
    """Point on the vehicle, body frame [m]."""
    length: float = Field(gt=0.0)
    """[m]"""
    stiffness: float = Field(default=15.0, ge=0.0)
    """Stiffness of its last stretch before it is straight [N/m]."""
    slack_share: float = Field(default=0.08, gt=0.0, lt=1.0)
    """The pull sets in at (1 - slack_share) length [-]."""
    diameter: float = Field(default=0.004, gt=0.0)
    """[m]"""
    drag_coefficient: float = Field(default=0.5, ge=0.0)
    """Drag coefficient of a cylinder [-]; less than 1.2, since a slack line follows only in part."""
    wet_weight: float = 0.0
    """[N/m]; negative floats."""


class Eddy(Section):
    """One mode of the pool's circulation: `cells` eddies side by side along x."""

    cells: int = Field(ge=1, le=4)
    speed: float = Field(ge=0.0, le=0.5)
    """Largest, at the surface [m/s]."""
    unsteadiness: float = Field(ge=0.0, le=1.0)
    """Part of the speed that comes and goes [-]."""
    period: float = Field(gt=0.0)
    """[s]"""
    phase: float
    """[rad]"""
    sense: Literal[-1, 1] = 1
    """1: anticlockwise from above."""


class Swell(Section):
    """One linear wave."""

    amplitude: float = Field(ge=0.0)
    """Half the height from trough to crest [m]."""
    wavelength: float = Field(gt=0.0)
    """[m]"""
    heading: float = 0.0
    """Direction of travel, from world x towards y [rad]."""
    phase: float = 0.0
    """[rad]"""


class Circulation(Section):
    """The current: eddies that vanish at the walls, and in open water a stream and waves."""

    stream: Three = (0.0, 0.0, 0.0)
    """Uniform current, world frame [m/s]."""
    waves: tuple[Swell, ...] = ()
    water: Water | None = None
    """Further current, profile, shear, drift and waves, as of a water file; its depth is that of the basin."""
    eddies: tuple[Eddy, ...] = ()
    floor_share: float = Field(default=0.5, ge=0.0, le=1.0)
    """Speed at the floor over that at the surface [-]."""


Severity = Literal["nominal", "realistic", "hard"]
T = TypeVar("T")


HOME = (33.810313, -118.393867)
"""Latitude and longitude of ArduSub's own test place [deg], the default origin."""


class PlantSpecError(ValueError):
    """A plant file that cannot be used, or a vehicle that the plant does not fit."""


def by_severity(kind: Callable[..., T], **columns: tuple[Any, Any, Any]) -> dict[Severity, T]:
    """A kind of settings for each severity.

    Args:
        kind: Makes one.
        columns: A setting by name: nominal, realistic, hard.
    """
    severities: tuple[Severity, ...] = get_args(Severity)
    return {
        severity: kind(**{name: column[i] for name, column in columns.items()})
        for i, severity in enumerate(severities)
    }


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
    """Gain in reverse, the ratio of true to nominal thrust."""
    deduction: float = Field(ge=0.0, lt=1.0)
    """Part of the thrust that its own jet takes back from the hull [-]."""
    time_constant: float = Field(gt=0.0)
    """Time constant of the shaft's speed [s]."""
    delay: float = Field(ge=0.0, le=1.0)
    """Delay from throttle to shaft [s]."""
    dead_rpm_plus: float = Field(ge=0.0)
    """Slowest forward speed that turns the shaft [rpm]."""
    dead_rpm_minus: float = Field(ge=0.0)
    """Slowest reverse speed, as a magnitude [rpm]."""
    full_rpm: float = Field(gt=0.0)
    """Speed at full throttle on a full battery [rpm]."""


class TrueActuator(Section):
    """One actuator besides the thrusters, as built; its force law is that of the vehicle file."""

    gain: float = Field(gt=0.0)
    """Change of its value over that of its sensor [-]."""
    offset: float
    """Value at which its sensor shows 0, over the gain [rad, m³ or m]."""
    time_constant: float = Field(ge=0.0)
    """[s]"""


class Propellers(Section):
    """Loss of thrust by moving water: T (1 - V / (J0 n D)), V the inflow, n turns a second."""

    diameter: float = Field(default=0.07, gt=0.0)
    """D [m]."""
    own_share: float = Field(default=0.0, ge=0.0)
    """Part of the vehicle's own speed along the axis that enters V [-]; 0 where the vehicle file has an `inflow`."""
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
    """Resistance of cells and wiring [ohm]."""
    motor_power: float = Field(default=45.0, ge=0.0)
    """Power of one motor at `full_rpm`; falls with the cube of speed [W]."""
    idle_current: float = Field(default=0.6, ge=0.0)
    """Current of everything else [A]."""


class Instruments(Section):
    """Differences of the instruments from the vehicle file."""

    noise: float = Field(default=1.0, ge=0.0)
    """Factor on the file's noise, bias and drift [-]."""
    pressure_drift: float = Field(default=0.0, ge=0.0)
    """Random walk of the depth's bias, besides the file's [m/√s]."""


class FirmwareSpec(Section):
    """The motor controller: its speed loop, clock and attitude filter, and the wire behind it."""

    loop_period: float = Field(default=0.002, ge=0.001, le=0.005)
    """Period of the rpm loop [s]."""
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
    """Error of its clock's rate [ppm]."""
    clock_start: int = Field(default=0, ge=0, lt=2**32)
    """Reading of its clock when the pool starts [ms]; 0 after a reboot."""
    reboot_time: float = Field(default=1.5, ge=0.0)
    """Silence after a reboot [s]."""
    version: Literal["4.1", "4.5", "4.7"] = "4.5"
    """Version of ArduSub, where the vehicle has an autopilot."""
    aiding_delay: float = Field(default=30.0, ge=0.0)
    """Time of velocities by a Doppler log after which an autopilot has a position [s]; recorded: 28 to 36 s."""
    origin: tuple[float, float] | None = None
    """Latitude and longitude that an autopilot has been given as its origin before the start [deg]; None: none."""
    log_shared: bool = True
    """True if the robot receives the reports of an autopilot's Doppler log too, as over the vehicle's network."""
    declination: float = Field(default=0.0, ge=-math.pi, le=math.pi)
    """Magnetic declination, east positive [rad]: without an origin an autopilot gives the magnetic heading."""
    attitude_gain: float = Field(default=0.5, ge=0.0)
    """Gain of the accelerometer in the attitude filter [1/s]."""
    attitude_integral: float = Field(default=0.01, ge=0.0)
    """[1/s²]"""
    uplink: tuple[float, float] = (0.001, 0.003)
    """Shortest and longest way of a telemetry frame to the robot [s]."""
    downlink: tuple[float, float] = (0.0008, 0.0014)
    """Delay of a command [s]."""

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
    """True thrusters by name, as in the vehicle file."""
    actuators: dict[str, TrueActuator] = {}
    """True actuators besides the thrusters, by name."""
    terms: dict[str, Annotated[float, Field(gt=0.0)]] = {}
    """Factor on the forces of each hydrodynamic term of the vehicle [-]."""
    propellers: Propellers = Propellers()
    battery: Battery = Battery()
    buoyancy: BuoyancyDrift = BuoyancyDrift()
    tether: SlackTether | None = None
    circulation: Circulation = Circulation()
    instruments: Instruments = Instruments()
    firmware: FirmwareSpec = FirmwareSpec()

    def write(self, path: Path) -> None:
        """Write the plant file, completely or not at all."""
        text = yaml_text(self.model_dump(mode="json"), width=118)
        with atomic_write(path) as temporary:
            temporary.write_text(
                f"# A plant of FinsSim's virtual pool: finssim pool --plant {Path(path).name}\n"
                "# Units are SI unless a name says otherwise; docs/reference/plant.md explains every key.\n"
                + text,
                encoding="utf-8",
            )


def load_plant_spec(path: str | Path) -> PlantSpec:
    """The plant in a file.

    Raises:
        PlantSpecError: The file cannot be used; names file, key and expectation.
    """
    data = read_mapping(Path(path), PlantSpecError, such_as="severity: realistic")
    if isinstance(data.get("circulation"), dict) and "water" in data["circulation"]:
        data["circulation"]["water"] = beside(data["circulation"]["water"], Path(path).parent)
    try:
        return PlantSpec.model_validate(data)
    except ValidationError as error:
        raise PlantSpecError(f"{path}: {first_problem(error)}") from None
