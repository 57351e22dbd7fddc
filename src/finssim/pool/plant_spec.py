"""Plant of the virtual pool: all parameters in which it differs from the vehicle file, as one YAML file."""

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
"""Ratio of a nominal motor's speed at full throttle to its speed range in the vehicle file [-]."""


# Coefficients about some point in tilted axes, so that a matrix that couples all axes remains physical.


Array = NDArray[np.float64]
Six = tuple[float, float, float, float, float, float]
Three = tuple[float, float, float]


class Section(BaseModel):
    """Frozen section of a plant file, which refuses unknown keys and numbers that are not finite."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class PrincipalAxes(Section):
    """Point of the body, and axes at this point."""

    center: Three
    """Position of the point, body frame [m]."""
    tilt_deg: Three
    """Roll, pitch and yaw of the axes relative to the body [deg]."""

    def to_axes(self) -> Array:
        """Return T with x = T nu: the twist at the point, in the tilted axes, from that of the body origin; (6, 6).

        Its entries are cosines [-] and lever arms [m].
        """
        tilt = quat_to_matrix(quat_from_euler(*np.radians(self.tilt_deg)))
        return np.asarray(np.kron(np.eye(2), tilt.T) @ twist_shift(self.center))


class CoupledMatrix(PrincipalAxes):
    """6x6 matrix that is diagonal about some point in some axes."""

    diagonal: Six
    """Diagonal [kg, kg m²] or [N s/m, N m s]; above 0."""

    def matrix(self) -> Array:
        """Return the matrix about the body origin, body axes: Tᵀ diag T; positive definite for a positive diagonal, (6,
        6).

        Its unit is that of the diagonal.
        """
        T = self.to_axes()
        return np.asarray(T.T @ np.diag(self.diagonal) @ T)


# Water and hull forces in a plant file.


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
        """Return M_A about the body origin, (6, 6) [kg, kg m, kg m²]."""
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
    """Drag of the hull mesh's panels (paper, eq. 4), in addition to the damping."""

    form_drag: float = Field(default=0.0, ge=0.0)
    """Form drag coefficient [-]."""
    skin_drag: float = Field(default=0.0, ge=0.0)
    """Skin drag coefficient [-]."""


class BuoyancyDrift(Section):
    """Slow changes of buoyancy by bubbles, warming air and soaking foam, as a sum of sines."""

    grams: tuple[float, ...] = ()
    """Amplitude of each sine [g]."""
    periods: tuple[float, ...] = ()
    """Period of each sine [s]."""
    phases: tuple[float, ...] = ()
    """Phase of each sine [rad]."""

    @model_validator(mode="after")
    def _same_length(self) -> BuoyancyDrift:
        if not len(self.grams) == len(self.periods) == len(self.phases):
            raise ValueError("grams, periods and phases differ in length: give each sine all three")
        if any(period <= 0.0 for period in self.periods):
            raise ValueError("periods must exceed 0 s")
        return self


class SlackTether(Section):
    """Tether that hangs slack and pulls only when it is nearly straight."""

    anchor: Three
    """Point where it leaves the pool's edge, world frame [m]."""
    attachment: Three
    """Point on the vehicle, body frame [m]."""
    length: float = Field(gt=0.0)
    """[m]"""
    stiffness: float = Field(default=15.0, ge=0.0)
    """Stiffness when the tether is straight [N/m]."""
    slack_share: float = Field(default=0.08, gt=0.0, lt=1.0)
    """Fraction of the length: the pull begins at a distance of (1 - slack_share) length [-]."""
    diameter: float = Field(default=0.004, gt=0.0)
    """[m]"""
    drag_coefficient: float = Field(default=0.5, ge=0.0)
    """Drag coefficient of a cylinder [-]; less than 1.2, since only part of a slack line moves with the vehicle."""
    wet_weight: float = 0.0
    """Weight in water per length [N/m]; negative for a buoyant tether."""


class Eddy(Section):
    """One mode of the pool's circulation: `cells` eddies side by side along x."""

    cells: int = Field(ge=1, le=4)
    speed: float = Field(ge=0.0, le=0.5)
    """Largest speed, at the surface [m/s]."""
    unsteadiness: float = Field(ge=0.0, le=1.0)
    """Relative amplitude of the speed's variation [-]."""
    period: float = Field(gt=0.0)
    """Period of the variation [s]."""
    phase: float
    """Phase of the variation [rad]."""
    sense: Literal[-1, 1] = 1
    """Sense of rotation; 1: counterclockwise as seen from above."""


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
    """Current: eddies that vanish at the walls; in open water a uniform current and waves."""

    stream: Three = (0.0, 0.0, 0.0)
    """Uniform current, world frame [m/s]."""
    waves: tuple[Swell, ...] = ()
    water: Water | None = None
    """Additional current, profile, shear, drift and waves, as in a water file; its depth is that of the basin."""
    eddies: tuple[Eddy, ...] = ()
    floor_share: float = Field(default=0.5, ge=0.0, le=1.0)
    """Ratio of the speed at the floor to that at the surface [-]."""


Severity = Literal["nominal", "realistic", "hard"]
T = TypeVar("T")


HOME = (33.810313, -118.393867)
"""Latitude and longitude of ArduSub's default test site [deg], the default origin."""


class PlantSpecError(ValueError):
    """A plant file that cannot be used, or a vehicle that does not match the plant."""


def by_severity(kind: Callable[..., T], **columns: tuple[Any, Any, Any]) -> dict[Severity, T]:
    """Return settings for each severity.

    Args:
        kind: Function that creates the settings.
        columns: Values of a setting by name: nominal, realistic, hard.
    """
    severities: tuple[Severity, ...] = get_args(Severity)
    return {
        severity: kind(**{name: column[i] for name, column in columns.items()})
        for i, severity in enumerate(severities)
    }


class Basin(Section):
    """Basin of the pool: a box centred on the world's z axis, with the water surface at z = 0."""

    length: float = Field(default=4.0, gt=0.0)
    """Length along world x [m]."""
    width: float = Field(default=2.0, gt=0.0)
    """Width along world y [m]."""
    depth: float = Field(default=1.0, gt=0.0)
    """[m]"""


def basin_of(vehicle: Vehicle) -> Basin:
    """Return the published pool, or a larger one of the same shape for a vehicle that needs more room."""
    length, width, depth = (room(vehicle.body.size) * side for side in POOL)
    return Basin(length=length, width=width, depth=depth)


class TrueBody(Section):
    """True rigid body, in contrast to the measured one of the vehicle file."""

    mass: float = Field(gt=0.0)
    """[kg]"""
    inertia: tuple[Three, Three, Three]
    """Inertia about the centre of gravity, body axes [kg m²]."""
    center_of_gravity: Three
    """Position, body frame [m]."""
    displaced_volume: float = Field(gt=0.0)
    """[m³]"""
    center_of_buoyancy: Three
    """Position, body frame [m]."""


class TrueThruster(Section):
    """True parameters of one thruster."""

    gain_plus: float = Field(gt=0.0)
    """Ratio of true to nominal thrust, forward [-]."""
    gain_minus: float = Field(gt=0.0)
    """Ratio of true to nominal thrust, reverse [-]."""
    deduction: float = Field(ge=0.0, lt=1.0)
    """Thrust deduction: fraction of the thrust that the force of its jet on the hull cancels [-]."""
    time_constant: float = Field(gt=0.0)
    """Time constant of the shaft speed [s]."""
    delay: float = Field(ge=0.0, le=1.0)
    """Delay from throttle to shaft [s]."""
    dead_rpm_plus: float = Field(ge=0.0)
    """Slowest forward speed of the shaft [rpm]."""
    dead_rpm_minus: float = Field(ge=0.0)
    """Slowest reverse speed, as a magnitude [rpm]."""
    full_rpm: float = Field(gt=0.0)
    """Speed at full throttle with a full battery [rpm]."""


class TrueActuator(Section):
    """True parameters of one actuator other than a thruster; its force law is that of the vehicle file."""

    gain: float = Field(gt=0.0)
    """Ratio of the change of its value to that of its sensor reading [-]."""
    offset: float
    """Value at a sensor reading of 0, divided by the gain [rad, m³ or m]."""
    time_constant: float = Field(ge=0.0)
    """[s]"""


class Propellers(Section):
    """Loss of thrust by inflow: T (1 - V / (J0 n D)), with the inflow V and n revolutions per second."""

    diameter: float = Field(default=0.07, gt=0.0)
    """D [m]."""
    own_share: float = Field(default=0.0, ge=0.0)
    """Fraction of the vehicle's speed along the axis that enters V [-]; 0 if the vehicle file has an `inflow`."""
    advance_at_zero_thrust: float = Field(default=0.8, gt=0.0)
    """J0, advance ratio at zero thrust [-]."""
    induced_share: float = Field(default=0.0, ge=0.0, le=1.0)
    """Fraction of a neighbour's induced speed that enters V, at zero distance [-]."""
    induced_reach: float = Field(default=0.3, gt=0.0)
    """Distance over which this fraction decreases by a factor of e [m]."""


class Battery(Section):
    """Battery whose voltage decreases with time and load."""

    full_voltage: float = Field(default=16.4, gt=0.0)
    """[V]"""
    fade: float = Field(default=0.0, ge=0.0, lt=0.5)
    """Fraction of the voltage that is lost after `fade_time` [-]."""
    fade_time: float = Field(default=900.0, gt=0.0)
    """Time over which the voltage decreases [s]; it is constant afterwards."""
    resistance: float = Field(default=0.0, ge=0.0)
    """Resistance of cells and wiring [ohm]."""
    motor_power: float = Field(default=45.0, ge=0.0)
    """Power of one motor at `full_rpm` [W]; proportional to the cube of the speed."""
    idle_current: float = Field(default=0.6, ge=0.0)
    """Current of all other consumers [A]."""


class Instruments(Section):
    """Differences of the instruments from the vehicle file."""

    noise: float = Field(default=1.0, ge=0.0)
    """Factor on the noise, bias and drift of the vehicle file [-]."""
    pressure_drift: float = Field(default=0.0, ge=0.0)
    """Additional random walk of the depth bias [m/√s]."""


class FirmwareSpec(Section):
    """Motor controller: its speed loop, clock, attitude filter and link."""

    loop_period: float = Field(default=0.002, ge=0.001, le=0.005)
    """Period of the rpm loop [s]."""
    feed_forward: float = Field(default=1.0, gt=0.0)
    """Ratio of the feed-forward throttle to that from the file's speed range [-]."""
    gain: float = Field(default=0.4, ge=0.0)
    """Proportional gain: throttle per normalised speed error [-]."""
    integral_gain: float = Field(default=1.5, ge=0.0)
    """[1/s]"""
    derivative_gain: float = Field(default=0.004, ge=0.0)
    """[s]"""
    rpm_noise: float = Field(default=12.0, ge=0.0)
    """Standard deviation of one speed measurement [rpm]."""
    rpm_quantum: float = Field(default=8.0, ge=0.0)
    """Resolution of one speed measurement [rpm]."""
    crystal_ppm: float = Field(default=0.0, ge=-500.0, le=500.0)
    """Error of the clock rate [ppm]."""
    clock_start: int = Field(default=0, ge=0, lt=2**32)
    """Clock reading when the pool starts [ms]; 0 after a reboot."""
    reboot_time: float = Field(default=1.5, ge=0.0)
    """Time without frames after a reboot [s]."""
    version: Literal["4.1", "4.5", "4.7"] = "4.5"
    """Version of ArduSub, if the vehicle has an autopilot."""
    aiding_delay: float = Field(default=30.0, ge=0.0)
    """Duration of Doppler log velocities until an autopilot has a position [s]; recorded: 28 to 36 s."""
    origin: tuple[float, float] | None = None
    """Latitude and longitude of the origin that an autopilot has at the start [deg]; None for no origin."""
    log_shared: bool = True
    """True if the robot also receives the reports of an autopilot's Doppler log, as over the vehicle's network."""
    declination: float = Field(default=0.0, ge=-math.pi, le=math.pi)
    """Magnetic declination, east positive [rad]; without an origin an autopilot reports the magnetic heading."""
    attitude_gain: float = Field(default=0.5, ge=0.0)
    """Gain of the accelerometer in the attitude filter [1/s]."""
    attitude_integral: float = Field(default=0.01, ge=0.0)
    """Integral gain of the attitude filter [1/s²]."""
    uplink: tuple[float, float] = (0.001, 0.003)
    """Shortest and longest delay of a telemetry frame to the robot [s]."""
    downlink: tuple[float, float] = (0.0008, 0.0014)
    """Shortest and longest delay of a command [s]."""

    @field_validator("uplink", "downlink")
    @classmethod
    def _ordered(cls, value: tuple[float, float]) -> tuple[float, float]:
        if not 0.0 <= value[0] <= value[1]:
            raise ValueError("expected the shortest time first, none below 0 s")
        return value


class PlantSpec(Section):
    """All hidden parameters of one plant; the vehicle file provides thruster positions, envelope and instruments."""

    title: str
    severity: Severity
    seed: int = Field(ge=0)
    vehicle: str
    """Name of the vehicle for which the plant was drawn."""
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
    """Return the plant in a file.

    Raises:
        PlantSpecError: The file cannot be used; the message names file, key and expectation.
    """
    data = read_mapping(Path(path), PlantSpecError, such_as="severity: realistic")
    if isinstance(data.get("circulation"), dict) and "water" in data["circulation"]:
        data["circulation"]["water"] = beside(data["circulation"]["water"], Path(path).parent)
    try:
        return PlantSpec.model_validate(data)
    except ValidationError as error:
        raise PlantSpecError(f"{path}: {first_problem(error, PlantSpec)}") from None
