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
    """Pose of a device that is fixed to the vehicle."""

    position: Vector3
    """Position from the body origin, body frame [m], (3,)."""
    orientation: Quaternion = identity_quaternion()
    """Mounted frame to body frame, xyzw, (4,)."""


class Sensor(Mount):
    """Common fields of every sensor."""

    rate: Positive
    """Rate [Hz]."""
    latency: NonNegative = 0.0
    """Delay between measurement and delivery [s]."""
    dropout: Probability = 0.0
    """Probability that a sample is lost."""


class Imu(Sensor):
    """Gyroscope and accelerometer, per axis."""

    gyro_noise_density: NonNegative
    """Noise density [rad/s/√Hz]."""
    gyro_bias_walk: NonNegative
    """Random walk of the bias [rad/s²/√Hz]."""
    gyro_bias_initial: NonNegative
    """Standard deviation of the bias at power-on [rad/s]."""
    gyro_quantisation: NonNegative = 0.0
    """Step of the output [rad/s]; 0 for none."""
    accel_noise_density: NonNegative
    """Noise density [m/s²/√Hz]."""
    accel_bias_walk: NonNegative
    """Random walk of the bias [m/s³/√Hz]."""
    accel_bias_initial: NonNegative
    """Standard deviation of the bias at power-on [m/s²]."""
    accel_quantisation: NonNegative = 0.0
    """Step of the output [m/s²]; 0 for none."""
    gyro_range: Positive = math.inf
    """Largest reported rate [rad/s]."""
    accel_range: Positive = math.inf
    """Largest reported specific force [m/s²]."""


class DepthSensor(Sensor):
    """Pressure sensor that reports the depth of its port."""

    noise_std: NonNegative
    """Standard deviation of the noise [m]."""
    bias_initial: NonNegative = 0.0
    """Standard deviation of the bias at power-on [m]."""
    bias_walk: NonNegative = 0.0
    """Random walk of the bias [m/s/√Hz]."""
    quantisation: NonNegative = 0.0
    """Step of the output [m]; 0 for none."""


class Dvl(Sensor):
    """Velocity over ground, in the sensor frame."""

    noise_std: NonNegative
    """Standard deviation of the noise per axis [m/s]."""
    bias_initial: NonNegative = 0.0
    """Standard deviation of the bias at power-on [m/s]."""
    bias_walk: NonNegative = 0.0
    """Random walk of the bias [m/s²/√Hz]."""
    quantisation: NonNegative = 0.0
    """Step of the output [m/s]; 0 for none."""
    scale_error: NonNegative = 0.0
    """Standard deviation of the relative scale error at power-on [-]."""
    velocity_range: Positive = math.inf
    """Largest reported speed per axis [m/s]."""
    max_tilt: Positive = math.inf
    """Tilt beyond which the beams lose bottom lock [rad]."""
    altitude_min: NonNegative = 0.0
    """Least height above the floor with a valid echo [m]."""
    altitude_max: Positive = math.inf
    """Largest height above the floor with a valid echo [m]."""


class Compass(Sensor):
    """Tilt-compensated compass: heading of the body's x axis from world x, left positive."""

    noise_std: NonNegative
    """Standard deviation of the noise [rad]."""
    bias_initial: NonNegative = 0.0
    """Standard deviation of the residual hard-iron and declination error after calibration [rad]."""
    quantisation: NonNegative = 0.0
    """Step of the output [rad]; 0 for none."""


SENSOR_NAME = "[a-z][a-z0-9_]{0,31}"
"""Regular expression of the name of a sensor."""

OTHER_NAMES = ("pressure", "base", "camera")
"""Other names that a robot's frames and topics use."""

OWN_KINDS: dict[str, type[Sensor]] = {"imu": Imu, "depth": DepthSensor, "dvl": Dvl, "compass": Compass}
"""Kind -> schema of FinsSim's sensors; those of other packages are in `finssim.core.registry.SENSORS`."""


class Sensors(Part):
    """Sensors aboard by name; FinsSim's own are None if absent.

    A section is named after its kind, or states its kind: `stern_depth: {kind: depth, ...}`.
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
    """Return the section of a sensor with an individual name, or of a kind of another package."""
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
            f"name needs a kind, such as '{name}: {{kind: depth, ...}}', and a kind of your own needs its package: "
            "pip install -e FOLDER"
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
    """Return the schema of a kind; None if the kind is unknown."""
    if kind in OWN_KINDS:
        return OWN_KINDS[kind]
    try:
        batch = SENSORS.get(kind)
    except RegistryError as error:
        raise refuse_section(str(error)) from error
    return None if batch is None else batch.schema


@cache
def _named_kind(schema: type[Sensor], kind: str) -> type[Sensor]:
    """Return a schema with the additional key `kind`, for sections with an individual name."""
    return create_model(schema.__name__, __base__=schema, kind=(Literal[kind], ...))


class RaySensor(Sensor):
    """Camera, imaging sonar, altimeter, rangefinder or DVL beams, which sense the objects of a site."""

    device: str
    """Name of a sensor listed by `finssim worlds`, or a file (`.yaml`) beside the vehicle file."""
    orientation: Quaternion | None = None  # type: ignore[assignment]
    """Sensor frame (x along its view, y left, z up) to body frame, xyzw, (4,); the device's orientation if None."""
    width: Annotated[int, Field(strict=True, ge=2, le=8192)] | None = None
    """Columns of a camera's pictures [px], whose height is scaled accordingly, or beams of a sonar; the
    device's value if None."""
    bins: Annotated[int, Field(strict=True, ge=2, le=4096)] | None = None
    """Range cells of a sonar's pictures; the device's value if None."""


class TagMount(Mount):
    """Pose of a tag."""

    edge: Positive | None = None
    """Edge of this tag's black border, if it differs from the others [m]."""


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
    """Motor controller at the other end of the serial link."""

    rpm_full_scale: Positive
    """Shaft speed at a command of 1 [rpm]."""
    command_timeout: Positive
    """Time after the last command at which the controller stops the motors [s]."""
    outputs: Annotated[int, Field(strict=True, ge=1)]
    """Number of motor outputs in a command frame."""


class Safety(Part):
    """Limits that stop the vehicle."""

    command_timeout: Positive
    """Longest interval without a command before thrust is set to zero [s]."""
    telemetry_timeout: Positive
    """Longest interval without telemetry of the vehicle [s]."""
    state_timeout: Positive
    """Largest age of a state that a controller may use [s]."""
    command_rate: Positive
    """Rate at which commands are repeated and monitored [Hz]."""
    max_tilt: Positive
    """Largest tilt [rad]."""
    max_tilt_duration: NonNegative
    """Tolerated time above `max_tilt` [s]."""
    workspace_lower: Vector3
    """Lower corner of the allowed box, world frame (z = 0 at the surface) [m], (3,)."""
    workspace_upper: Vector3
    """Upper corner [m], (3,)."""
    wrench_scale: Vector6 = Field(default_factory=lambda: np.ones(6))
    """Fraction of `wrench_limits` used on the hardware, surge sway heave roll pitch yaw, each 0 to 1."""

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
