"""Vehicle: the content of its file, and the matrices derived from it."""

from __future__ import annotations

import hashlib
import json
import re
from collections import Counter
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, SerializeAsAny, ValidationInfo, field_validator, model_validator

from finssim.core.page import notebook_html
from finssim.vehicles.actuators import Actuator, read_actuators
from finssim.vehicles.autopilot import Autopilot, refuse_misfit
from finssim.vehicles.defaults import (
    DEFAULTS,
    default_mcu,
    default_perception,
    default_safety,
    default_sensors,
    default_tags,
)
from finssim.vehicles.equipment import (
    OTHER_NAMES,
    OWN_KINDS,
    SENSOR_NAME,
    Mcu,
    RaySensor,
    Safety,
    Sensors,
    Tags,
)
from finssim.vehicles.hydrodynamics import AnyHydrodynamicSet, HydrodynamicSet, MeshSet
from finssim.vehicles.part import (
    Inertia,
    NonNegative,
    Part,
    Positive,
    Positive3,
    Vector3,
    VehicleError,
    did_you_mean,
    refuse_section,
    refuse_value,
)
from finssim.vehicles.thruster import Thruster

Array = NDArray[np.float64]


class ReferenceWater(Part):
    """Water to which the numbers of the file refer."""

    density: Positive
    """Density [kg/m³]."""
    gravity: Positive
    """Gravity [m/s²]."""


class Body(Part):
    """Rigid body: positions are from the body origin, in body axes (x forward, y left, z up)."""

    mass: Positive
    """Dry mass including flooded-in solids, without entrained water [kg]."""
    inertia: Inertia
    """Inertia about the centre of gravity, body axes, (3, 3) [kg m²]; 3 diagonal entries or 3 rows of 3 in
    the file."""
    center_of_gravity: Vector3
    """Centre of gravity [m], (3,)."""
    displaced_volume: Positive
    """Volume of water displaced when fully submerged [m³]."""
    center_of_buoyancy: Vector3
    """Centre of buoyancy [m], (3,)."""
    size: Positive3
    """Envelope box along x, y, z [m], (3,)."""
    surface_half_height: Positive
    """Half height of the layer at the surface in which buoyancy decreases to zero [m]."""


class Payload(Part):
    """Object fixed to the vehicle, such as a lamp or ballast: a homogeneous box, or a point if it has no size."""

    mass: NonNegative
    """Dry mass [kg]."""
    volume: NonNegative
    """Volume of water displaced when fully submerged [m³]."""
    position: Vector3
    """Centre of gravity and of buoyancy, from the body origin, body frame [m], (3,)."""
    size: Positive3 | None = None
    """Sides of the box along x, y, z [m], (3,); if None the payload has no inertia about its own centre."""

    @model_validator(mode="after")
    def _something(self) -> Payload:
        if self.mass == self.volume == 0.0:
            raise refuse_section(
                "mass and volume are both 0, expected one of them > 0: leave the payload out"
            )
        return self

    @property
    def inertia(self) -> Array:
        """Return its inertia about its centre, in body axes [kg m²], (3, 3)."""
        square = np.zeros(3) if self.size is None else self.mass / 12.0 * self.size**2
        return np.diag(square.sum() - square)


class Hull(Part):
    """Closed surface of the vehicle: a mesh file, or a mesh generated from `body` (envelope, volume, centre)."""

    parametric: bool = False
    """True to generate the mesh from `body.size`, `body.displaced_volume` and `body.center_of_buoyancy`."""
    file: Path | None = None
    """STL file in body axes [m]; a relative path starts at the vehicle file."""
    scale: Positive = 1.0
    """Factor on the coordinates of the file."""

    @model_validator(mode="after")
    def _one_of_two(self) -> Hull:
        if self.parametric == (self.file is not None):
            raise refuse_section("expected either 'parametric: true' or 'file: NAME.stl'")
        return self


def skew(r: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return S(r) with S(r) x = r × x. The unit is unchanged."""
    return np.array([[0.0, -r[2], r[1]], [r[2], 0.0, -r[0]], [-r[1], r[0], 0.0]])


def moved_to_origin(matrix: NDArray[np.float64], point: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a 6x6 mass or damping matrix, given about `point` [m, body], for the twist at the body origin.

    H(r)ᵀ M H(r) with H(r) = [[I, -S(r)], [0, I]]                       (Fossen 2021, eq. 3.31)
    """
    H = np.eye(6)
    H[:3, 3:] = -skew(point)
    return H.T @ matrix @ H


class CalibrationRecord(Part):
    """Entry of `calibrations` in a vehicle file; it contains no timestamp, so that equal fits write equal files."""

    kind: Literal["thruster", "motor", "hydrodynamics", "mounts"]
    """Kind of the calibration."""
    method: str
    """Estimator, such as `simulation`."""
    trials: dict[str, str]
    """Name of each trial or table -> SHA-256 of its numbers."""
    settings: dict[str, Any] = Field(default_factory=dict)
    """Options of the method and its seed, as plain values."""
    start: str = ""
    """`sha256` of the initial vehicle."""
    finssim: str = ""
    """Version of FinsSim."""
    revision: str | None = None
    """Git commit of FinsSim, if it ran from a checkout."""
    interrupted: bool = False
    """True if it was stopped before it converged."""

    def sentence(self) -> str:
        """Return a summary such as `hydrodynamics by simulation on 24 trials`, for lists and notes."""
        count = len(self.trials)
        noun = {"thruster": "table", "mounts": "recording"}.get(self.kind, "trial")
        text = f"{self.kind} by {self.method} on {count} {noun}{'' if count == 1 else 's'}"
        return f"{text} (interrupted)" if self.interrupted else text


Axis = Literal["surge", "sway", "heave", "roll", "pitch", "yaw"]
AXES: tuple[Axis, ...] = ("surge", "sway", "heave", "roll", "pitch", "yaw")

Origin = Literal["measured", "published", "derived", "guessed"]
ORIGINS: tuple[Origin, ...] = ("measured", "published", "derived", "guessed")


class Provenance(NamedTuple):
    """Origin of a number."""

    origin: Origin
    source: str = ""
    note: str = ""


class Vehicle(Part):
    """Vehicle. Frames: body x forward, y left, z up; wrenches and twists are linear then angular."""

    title: str
    """Title that names the vehicle and the set of numbers, in one line."""
    description: str
    """Description of the vehicle, with remarks on the use of its numbers."""
    water: ReferenceWater
    body: Body
    """Rigid body including its payloads: `load_vehicle` adds them to the numbers of the file."""
    payloads: dict[str, Payload] = Field(default_factory=dict)
    """Payloads that `body` includes, by name; not part of `values` and `sha256`, whose `body` includes them."""
    hull: Hull | None = None
    hydrodynamics: dict[str, AnyHydrodynamicSet]
    """Hydrodynamic sets by name: `calibrated`, `simplified`, `mesh`; only those that the sources provide."""
    thrusters: dict[str, Thruster]
    """Thrusters by name; their order is the canonical order of every thruster vector."""
    actuators: dict[str, SerializeAsAny[Actuator]] = Field(default_factory=dict)
    """Fins, buoyancy engines and other actuators by name; their channels follow those of the thrusters."""
    controlled_axes: tuple[Axis, ...] = AXES
    """Axes controlled by the thrusters; the others are uncontrolled (an underactuated vehicle)."""
    wrench_reference: Vector3 = Field(default_factory=lambda given: given["body"].center_of_gravity)
    """Body point about which wrenches are commanded [m], (3,); the centre of gravity by default."""
    sensors: Sensors = Field(default_factory=default_sensors)
    perception: dict[str, RaySensor] = Field(default_factory=default_perception)
    """Sensors of the site by name, such as cameras and sonars; see `finssim.extensions.perception.device_of`."""
    tags: Tags | None = Field(default_factory=default_tags)
    """Tags; None only if a file removes them: `tags: null`."""
    mcu: Mcu = Field(default_factory=default_mcu)
    autopilot: Autopilot | None = None
    """Autopilot of a vehicle that is commanded by axes instead of shaft speeds."""
    safety: Safety = Field(default_factory=default_safety)
    calibrations: tuple[CalibrationRecord, ...] = ()
    """Calibrations of its numbers, oldest first; not part of `sha256`."""
    name: str = Field(exclude=True)
    """Name of the file without its suffix."""
    path: Path | None = Field(default=None, exclude=True)
    """File that the vehicle was read from."""
    provenance: dict[str, Provenance] = Field(default_factory=dict, exclude=True)
    """Origin of the numbers by dotted path; see `origin_of`."""

    @field_validator("actuators", mode="before")
    @classmethod
    def _by_kind(cls, value: Any) -> Any:
        return read_actuators(value)

    @field_validator("controlled_axes", mode="before")
    @classmethod
    def _as_tuple(cls, value: Any, info: ValidationInfo) -> Any:
        empty = isinstance(value, (list, tuple)) and not value and bool(info.data.get("thrusters", True))
        if not isinstance(value, (list, tuple)) or not set(map(str, value)) <= set(AXES) or empty:
            raise refuse_value(f"is {value!r}, expected a list drawn from {', '.join(AXES)}")
        return tuple(axis for axis in AXES if axis in value)

    @field_validator("perception")
    @classmethod
    def _plain_names(cls, value: dict[str, RaySensor], info: ValidationInfo) -> dict[str, RaySensor]:
        for name in value:
            if not re.fullmatch(SENSOR_NAME, name):
                raise refuse_section(
                    f"'{name}' is no name of a sensor: give up to 32 small letters, digits and _, as in front_camera"
                )
            aboard = (*OWN_KINDS, *info.data["sensors"].by_name) if "sensors" in info.data else OWN_KINDS
            if name in (*OTHER_NAMES, *aboard, *info.data.get("thrusters", ())):
                raise refuse_section(
                    f"'{name}' is already used by another part of a robot: choose another name"
                )
        return value

    @field_validator("hydrodynamics")
    @classmethod
    def _not_empty(cls, value: dict[str, Any], info: ValidationInfo) -> dict[str, Any]:
        if not value:
            raise refuse_value("is empty, expected at least one entry")
        return value

    @model_validator(mode="after")
    def _solvable(self) -> Vehicle:
        for name, hydrodynamic_set in self.hydrodynamics.items():
            smallest = float(np.linalg.eigvalsh(self.mass_matrix(name))[0])
            if smallest <= 0.0:
                raise refuse_section(
                    f"hydrodynamics.{name}: added_mass makes M_RB + M_A not positive definite "
                    f"(smallest eigenvalue {smallest:.4g}): the acceleration would be undefined"
                )
            if isinstance(hydrodynamic_set, MeshSet) and self.hull is None:
                raise refuse_section(
                    f"hydrodynamics.{name}: needs a hull: give 'hull: {{parametric: true}}' or a mesh file"
                )
        return self

    @model_validator(mode="after")
    def _channels(self) -> Vehicle:
        if not self.thrusters and not self.actuators:
            raise refuse_section("thrusters is empty, expected at least one entry, or other actuators")
        if not self.thrusters and self.controlled_axes:
            raise refuse_section(
                f"controlled_axes is {list(self.controlled_axes)}, expected [] of a vehicle without thrusters"
            )
        for name, actuator in self.actuators.items():
            if name in self.thrusters:
                raise refuse_section(f"actuators: '{name}' is the name of a thruster: choose another")
            named = [*getattr(actuator, "wake", {}), *filter(None, [getattr(actuator, "thruster", None)])]
            for thruster in named:
                if thruster not in self.thrusters:
                    raise refuse_section(
                        f"actuators.{name}: no thruster '{thruster}'{did_you_mean(thruster, list(self.thrusters))} "
                        f"expected one of {', '.join(self.thrusters)}"
                    )
            for thruster in getattr(actuator, "wake", {}):
                if self.thrusters[thruster].diameter is None:
                    raise refuse_section(
                        f"actuators.{name}: is in the wake of '{thruster}', whose diameter is missing: add it"
                    )
        return self

    @model_validator(mode="after")
    def _mixed_right(self) -> Vehicle:
        if self.autopilot is not None:
            refuse_misfit(self.autopilot, self.thrusters, self.control_matrix)
        return self

    @property
    def defaults(self) -> tuple[str, ...]:
        """Sections that the file omits and `finssim.vehicles.defaults` provides; not part of `sha256`."""
        return tuple(name for name in DEFAULTS if name not in self.model_fields_set)

    @property
    def file_tags(self) -> Tags | None:
        """Tags in the file, which a real camera may search for; None if there are none or they are defaults."""
        return None if "tags" in self.defaults else self.tags

    def values(self) -> dict[str, Any]:
        """Return the explicitly set values as a plain nested dict, which can be validated again; payloads are
        in the body."""
        return self.model_dump(exclude_unset=True, exclude={"payloads"})

    # -- derived numbers ------------------------------------------------------------------------------------

    @property
    def thruster_names(self) -> tuple[str, ...]:
        """Names in canonical order."""
        return tuple(self.thrusters)

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the channels of a command: thrusters, then other actuators."""
        return (*self.thrusters, *self.actuators)

    @property
    def channel_limits(self) -> tuple[Array, Array]:
        """Least and greatest value of each channel, thrust [N] or in the unit of the actuator, (n,) each."""
        lower, upper = self.force_limits
        others = list(self.actuators.values())
        return (
            np.concatenate([lower, [a.minimum for a in others]]),
            np.concatenate([upper, [a.maximum for a in others]]),
        )

    @property
    def force_limits(self) -> tuple[Array, Array]:
        """Lower and upper thrust in canonical order [N], (n,) each."""
        lower = np.array([thruster.force_min for thruster in self.thrusters.values()])
        upper = np.array([thruster.force_max for thruster in self.thrusters.values()])
        return lower, upper

    def thruster_matrix(self, point: Any = (0.0, 0.0, 0.0)) -> Array:
        """Return B of tau = B f, for unit thrust in canonical order.

        B = [a_1 ... a_n; (r_1 - point) × a_1 + q_1 a_1 ... ]                             (paper, eq. 17)

        The reaction q of a propeller's torque is 0 if the vehicle file defines no torque constant.

        Args:
            point: Body point that is the reference of moments [m], (3,).

        Returns:
            Matrix B in the body frame, [-] and [m], (6, n).
        """
        axes = np.reshape([thruster.axis for thruster in self.thrusters.values()], (-1, 3))
        arms = np.reshape([thruster.position for thruster in self.thrusters.values()], (-1, 3)) - np.asarray(
            point
        )
        reactions = np.array([thruster.reaction for thruster in self.thrusters.values()])
        return np.vstack([axes.T, np.cross(arms, axes).T + reactions * axes.T])

    @property
    def control_matrix(self) -> Array:
        """Return the matrix B of wrench = B f about `wrench_reference` [-, m], (6, n)."""
        return self.thruster_matrix(self.wrench_reference)

    @cached_property
    def wrench_limits(self) -> Array:
        """Largest wrench on each axis alone that the thrusters reach in both directions [N, N m], (6,).

        See `finssim.vehicles.capability.wrench_capability`; zero on axes that are not controlled.
        """
        from finssim.vehicles.capability import wrench_capability

        return np.asarray(wrench_capability(self).symmetric)

    def rigid_body_mass_matrix(self) -> Array:
        """Return M_RB about the body origin, (6, 6) [kg, kg m, kg m²]                       (Fossen 2021, eq.
        3.49)."""
        m, S = self.body.mass, skew(self.body.center_of_gravity)
        return np.block([[m * np.eye(3), -m * S], [m * S, self.body.inertia - m * S @ S]])

    def added_mass_matrix(self, name: str = "calibrated") -> Array:
        """Return M_A of a set about the body origin, (6, 6) [kg, kg m, kg m²]."""
        chosen = self.hydrodynamic_set(name)
        return moved_to_origin(chosen.added_mass, chosen.reference_point)

    def mass_matrix(self, name: str = "calibrated") -> Array:
        """Return M_RB + M_A about the body origin, (6, 6) [kg, kg m, kg m²]."""
        return self.rigid_body_mass_matrix() + self.added_mass_matrix(name)

    def hydrodynamic_set(self, name: str) -> HydrodynamicSet | MeshSet:
        """Return the hydrodynamic set of a name.

        Raises:
            VehicleError: The file has no such set.
        """
        if name not in self.hydrodynamics:
            raise VehicleError(
                f"{self.name} has no hydrodynamic set '{name}'; available: {', '.join(self.hydrodynamics)}"
            )
        return self.hydrodynamics[name]

    @property
    def weight(self) -> float:
        """Weight [N]."""
        return self.body.mass * self.water.gravity

    @property
    def buoyancy(self) -> float:
        """Buoyancy when fully submerged [N]."""
        return self.water.density * self.water.gravity * self.body.displaced_volume

    def hull_mesh(self) -> tuple[Array, NDArray[np.int64]]:
        """Return vertices (n, 3) [m, body frame] and faces (m, 3) of the closed hull, with outward normals.

        Raises:
            VehicleError: The file defines no hull, or its mesh cannot be used.
        """
        from finssim.core import mesh  # SciPy, which it uses, is slow to import

        hull, body = self.hull, self.body
        if hull is None:
            raise VehicleError(
                f"{self.name} has no hull: give 'hull: {{parametric: true}}' or 'hull: {{file: NAME.stl}}'"
            )
        if hull.file is None:
            try:
                return mesh.parametric_hull(body.size, body.displaced_volume, body.center_of_buoyancy)
            except mesh.MeshError as error:
                raise VehicleError(f"parametric hull of {self.name}: {error}") from None
        if not hull.file.is_file():
            raise VehicleError(f"file {hull.file} does not exist: give a path relative to the vehicle file")
        try:
            vertices, faces = mesh.load_stl(hull.file)
            mesh.check_closed(vertices, faces)
        except mesh.MeshError as error:
            raise VehicleError(f"file {hull.file.name}: {error}") from None
        return hull.scale * vertices, faces

    # -- display ----------------------------------------------------------------------------------------------

    def __repr__(self) -> str:
        return f"<Vehicle {self.name}: {', '.join(text for _, text in self._summary())}>"

    __str__ = __repr__

    def _repr_html_(self) -> str:
        return notebook_html(f"{self.name}: {self.title}", ("", ""), self._summary())

    def _others(self) -> str:
        """Return the other actuators by kind, as in `, 4 fin, 1 buoyancy`."""
        counts = Counter(actuator.kind for actuator in self.actuators.values())
        return "".join(f", {count} {kind}" for kind, count in counts.items())

    def _summary(self) -> list[tuple[str, str]]:
        return [
            ("mass", f"{self.body.mass:g} kg"),
            ("actuators", f"{len(self.thrusters)} thrusters{self._others()}"),
            ("controlled axes", " ".join(self.controlled_axes)),
            ("hydrodynamics", f"hydrodynamics {' '.join(self.hydrodynamics)}"),
        ]

    # -- identity ---------------------------------------------------------------------------------------------

    @cached_property
    def sha256(self) -> str:
        """Digest of every number of the vehicle and of its hull mesh, without titles, comments or calibration
        records."""
        values = self.values()
        for prose in ("title", "description", "calibrations"):
            values.pop(prose, None)
        if self.hull is not None and self.hull.file is not None:
            values["hull"]["file"] = hashlib.sha256(self.hull.file.read_bytes()).hexdigest()
        for name, sensor in self.perception.items():
            if "perception" in values and Path(sensor.device).is_absolute():
                digest = hashlib.sha256(Path(sensor.device).read_bytes()).hexdigest()
                values["perception"][name]["device"] = digest
        values["thruster_names"] = self.thruster_names  # their order is significant
        return hashlib.sha256(json.dumps(values, sort_keys=True, default=str).encode()).hexdigest()

    def fitted_on(self, sha256: str) -> bool:
        """Return whether one of its calibrations used the trial or table with this digest."""
        return any(sha256 in record.trials.values() for record in self.calibrations)

    def origin_of(self, path: str) -> Provenance:
        """Return the provenance of the number at a dotted path, `body.mass` or
        `hydrodynamics.calibrated.linear_damping.3`.

        Raises:
            VehicleError: No number at this path has an origin.
        """
        parts = path.split(".")
        for length in range(len(parts), 0, -1):
            origin = self.provenance.get(".".join(parts[:length]))
            if origin is not None:
                return origin
        raise VehicleError(f"{self.name}: no number at '{path}'{did_you_mean(path, list(self.provenance))}")

    def replace(self, changes: Mapping[str, Any], provenance: Provenance | None = None) -> Vehicle:
        """Return a new vehicle with some values changed, validated like a file.

        Args:
            changes: Values by dotted path: `{"body.mass": 11.6, "thrusters.*.force_max": 5.0}`. `*` matches
                every entry, a
                number is the index of a row or element of an array.
            provenance: Origin of the new values; `guessed` if None.

        Raises:
            VehicleError: A path does not exist or a value is invalid.
        """
        from finssim.vehicles.loader import with_changes

        return with_changes(self, changes, provenance or Provenance("guessed", "", "changed in a program"))
