"""Sensors, cameras and sonars, tags, motor controller and safety limits of a vehicle file."""

from __future__ import annotations

import math
import re
from functools import cache
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import ConfigDict, Field, ValidationError, create_model, model_validator

from finssim.core.registry import SENSORS, RegistryError
from finssim.vehicles.part import (
    NonNegative,
    Part,
    Positive,
    Probability,
    Quaternion,
    Vector3,
    Vector6,
    did_you_mean,
    identity_quaternion,
    refuse_section,
    sentence_of,
)


class Mount(Part):
    """Pose of something fixed to the vehicle."""

    position: Vector3
    """Position from the body origin, body frame [m], (3,)."""
    orientation: Quaternion = identity_quaternion()
    """Mounted frame to body frame, xyzw, (4,)."""


class Sensor(Mount):
    """Common fields of every sensor."""

    rate: Positive
    """[Hz]"""
    latency: NonNegative = 0.0
    """Age of a sample when it is delivered [s]."""
    dropout: Probability = 0.0
    """Chance that a sample is lost."""


class Imu(Sensor):
    """Gyroscope and accelerometer, per axis."""

    gyro_noise_density: NonNegative
    """[rad/s/√Hz]"""
    gyro_bias_walk: NonNegative
    """[rad/s²/√Hz]"""
    gyro_bias_initial: NonNegative
    """Standard deviation of the bias at power-on [rad/s]."""
    gyro_quantisation: NonNegative = 0.0
    """Step of the output [rad/s]; 0 for none."""
    accel_noise_density: NonNegative
    """[m/s²/√Hz]"""
    accel_bias_walk: NonNegative
    """[m/s³/√Hz]"""
    accel_bias_initial: NonNegative
    """Standard deviation of the bias at power-on [m/s²]."""
    accel_quantisation: NonNegative = 0.0
    """Step of the output [m/s²]; 0 for none."""
    gyro_range: Positive = math.inf
    """Largest rate that is reported [rad/s]."""
    accel_range: Positive = math.inf
    """Largest specific force that is reported [m/s²]."""


class DepthSensor(Sensor):
    """Pressure sensor reporting the depth of its port."""

    noise_std: NonNegative
    """[m]"""
    bias_initial: NonNegative = 0.0
    """Standard deviation of the bias at power-on [m]."""
    bias_walk: NonNegative = 0.0
    """[m/s/√Hz]"""
    quantisation: NonNegative = 0.0
    """[m]; 0 for none."""


class Dvl(Sensor):
    """Velocity over ground, in the sensor frame."""

    noise_std: NonNegative
    """Per axis [m/s]."""
    bias_initial: NonNegative = 0.0
    """Standard deviation of the bias at power-on [m/s]."""
    bias_walk: NonNegative = 0.0
    """[m/s²/√Hz]"""
    quantisation: NonNegative = 0.0
    """[m/s]; 0 for none."""
    scale_error: NonNegative = 0.0
    """Standard deviation of the relative scale error at power-on [-]."""
    velocity_range: Positive = math.inf
    """Largest speed per axis that is reported [m/s]."""
    max_tilt: Positive = math.inf
    """Tilt beyond which the beams lose the floor [rad]."""
    altitude_min: NonNegative = 0.0
    """Least height above the floor with an echo [m]."""
    altitude_max: Positive = math.inf
    """Greatest height above the floor with an echo [m]."""


class Compass(Sensor):
    """Heading of the body's x axis from world x, left positive, of a compass that knows its tilt."""

    noise_std: NonNegative
    """[rad]"""
    bias_initial: NonNegative = 0.0
    """Standard deviation of what calibration leaves of hard iron and declination [rad]."""
    quantisation: NonNegative = 0.0
    """[rad]; 0 for none."""


SENSOR_NAME = "[a-z][a-z0-9_]{0,31}"
"""Regular expression of the name of a sensor."""

OTHER_NAMES = ("pressure", "base", "camera")
"""Names that frames and topics of a robot have besides those of its sensors."""

OWN_KINDS: dict[str, type[Sensor]] = {"imu": Imu, "depth": DepthSensor, "dvl": Dvl, "compass": Compass}
"""Kind -> schema of the sensors of FinsSim; those of other packages are in `finssim.core.registry.SENSORS`."""


class Sensors(Part):
    """Sensors aboard by name; None for those of FinsSim that are absent.

    A section has the name of its kind, or names its kind: `stern_depth: {kind: depth, ...}`.
    """

    model_config = ConfigDict(frozen=True, extra="allow", arbitrary_types_allowed=True)

    @model_validator(mode="before")
    @classmethod
    def _known_keys_only(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            return data
        return {
            key: value if key in cls.model_fields else _additional(str(key), value)
            for key, value in data.items()
        }

    imu: Imu | None = None
    depth: DepthSensor | None = None
    dvl: Dvl | None = None
    compass: Compass | None = None

    @property
    def by_name(self) -> dict[str, Sensor]:
        """Name -> section of each sensor that the vehicle carries, in the order imu, depth, dvl, compass, others."""
        entries = {name: getattr(self, name) for name in (*OWN_KINDS, *sorted(self.model_extra or {}))}
        return {name: entry for name, entry in entries.items() if entry is not None}

    def kind_of(self, name: str) -> str:
        """Return the kind of a sensor by its name."""
        return str(getattr(getattr(self, name), "kind", name))


def _additional(name: str, value: Any) -> Sensor:
    """Return the section of a sensor that has a name of its own, or a kind of another package."""
    if isinstance(value, Sensor):
        return value
    named = isinstance(value, dict) and "kind" in value
    kind = str(value["kind"]) if named else name
    schema = _schema_of(kind)
    if schema is None:
        known = [*OWN_KINDS, *(key for key in SENSORS if key not in OWN_KINDS)]
        if named:
            raise refuse_section(
                f"{name}: kind is '{kind}'{did_you_mean(kind, known)} known kinds: {', '.join(known)}"
            )
        raise refuse_section(
            f"unknown key '{name}'{did_you_mean(name, known)} known keys: {', '.join(known)}; a sensor of another "
            f"name gives its kind, such as '{name}: {{kind: depth, ...}}', and a kind of your own is known once its "
            "package is installed: pip install -e FOLDER"
        )
    if not re.fullmatch(SENSOR_NAME, name) or name in OTHER_NAMES:
        raise refuse_section(
            f"'{name}' cannot be the name of a sensor: give up to 32 lower-case letters, digits and _, such as "
            f"stern_depth, other than {', '.join(OTHER_NAMES)}"
        )
    try:
        return (_named_kind(schema, kind) if named else schema).model_validate(value)
    except ValidationError as error:
        raise refuse_section("; ".join(sentence_of(detail, name) for detail in error.errors())) from None


def _schema_of(kind: str) -> type[Sensor] | None:
    """Return the schema of a kind; None where there is none."""
    if kind in OWN_KINDS:
        return OWN_KINDS[kind]
    try:
        batch = SENSORS.get(kind)
    except RegistryError as error:
        raise refuse_section(str(error)) from error
    return None if batch is None else batch.schema


@cache
def _named_kind(schema: type[Sensor], kind: str) -> type[Sensor]:
    """Return a schema with the key `kind`, for sections that have another name."""
    return create_model(schema.__name__, __base__=schema, kind=(Literal[kind], ...))


class RaySensor(Sensor):
    """A camera, imaging sonar, altimeter, rangefinder or a DVL's beams, which sense the objects of a site."""

    device: str
    """A sensor of `finssim worlds`, or a file (`.yaml`) beside the vehicle file."""
    orientation: Quaternion | None = None  # type: ignore[assignment]
    """Sensor frame (x along its view, y left, z up) to body frame, xyzw, (4,); its device's own where not given."""
    width: Annotated[int, Field(strict=True, ge=2, le=8192)] | None = None
    """Columns of a camera's pictures [px], their height follows; beams of a sonar. The device's own where not given."""
    bins: Annotated[int, Field(strict=True, ge=2, le=4096)] | None = None
    """Range cells of a sonar's pictures; the device's own where not given."""


class TagMount(Mount):
    """Pose of a tag."""

    edge: Positive | None = None
    """Edge of this tag's black border, where it is not that of the others [m]."""


class Tags(Part):
    """Fiducial tags on the vehicle, seen by an overhead camera.

    Tag frame: x to the right and y up in the printed image, z out of the printed side.
    """

    family: str
    """AprilTag family, such as `tag25h9`."""
    edge: Positive
    """Edge of the black border [m]."""
    mounts: dict[Annotated[int, Field(ge=0)], TagMount]
    """Pose of each tag, by tag id."""

    def edge_of(self, tag: int) -> float:
        """Return the edge of a tag's black border [m]."""
        return self.mounts[tag].edge or self.edge


class Mcu(Part):
    """The motor controller at the other end of the wire."""

    rpm_full_scale: Positive
    """Shaft speed of a command of 1 [rpm]."""
    command_timeout: Positive
    """The controller stops the motors this long after the last command [s]."""
    outputs: Annotated[int, Field(strict=True, ge=1)]
    """Number of motor outputs in a command frame."""


class Safety(Part):
    """Limits that stop the vehicle."""

    command_timeout: Positive
    """Longest silence of the commander before thrust is zeroed [s]."""
    telemetry_timeout: Positive
    """Longest silence of the vehicle [s]."""
    state_timeout: Positive
    """Oldest state a controller may act on [s]."""
    command_rate: Positive
    """Rate at which commands are repeated and watched [Hz]."""
    max_tilt: Positive
    """[rad]"""
    max_tilt_duration: NonNegative
    """Time above `max_tilt` that is tolerated [s]."""
    workspace_lower: Vector3
    """Lower corner of the allowed box, world frame (z = 0 at the surface) [m], (3,)."""
    workspace_upper: Vector3
    """Upper corner [m], (3,)."""
    wrench_scale: Vector6 = Field(default_factory=lambda: np.ones(6))
    """Share of `wrench_limits` used on the hardware, surge sway heave roll pitch yaw, each 0 to 1."""

    @model_validator(mode="after")
    def _ordered(self) -> Safety:
        if np.any(self.workspace_lower >= self.workspace_upper):
            raise refuse_section(
                f"workspace_lower {self.workspace_lower.tolist()} must be below "
                f"workspace_upper {self.workspace_upper.tolist()} on every axis"
            )
        if np.any(self.wrench_scale < 0.0) or np.any(self.wrench_scale > 1.0):
            raise refuse_section(f"wrench_scale {self.wrench_scale.tolist()} must lie between 0 and 1")
        return self
