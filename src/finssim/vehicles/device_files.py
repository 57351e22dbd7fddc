"""Devices of a vehicle's `perception`: cameras, sonars and rangefinders, from validated YAML files."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from finssim.core.optics import LENS_MODELS, Lens, OpticsError
from finssim.core.rotations import quat_from_euler
from finssim.vehicles.part import (
    NonNegative,
    Number,
    Part,
    Positive,
    Probability,
    Quaternion,
    Vector3,
    did_you_mean,
    refuse_section,
    refuse_value,
    zeros,
)
from finssim.vehicles.part_file import checked_part, locate, names_in, read_tree
from finssim.vehicles.vehicle import Vehicle

Array = NDArray[np.float64]

DEVICES = Path(__file__).parent / "catalogue" / "devices"
PIXELS = 1 << 23
"""Largest number of computed values of a device: pixels, rays, or cells of range and beam."""


class DeviceError(ValueError):
    """Invalid device, or a device that a vehicle does not have; the message is one sentence with the remedy."""


def numbers(count: int | None, expected: str) -> BeforeValidator:
    """Return a validator of a list of finite numbers of the given length, or of any length if None."""

    def check(values: Any) -> Any:
        if not isinstance(values, (list, tuple)) or count not in (None, len(values)):
            raise refuse_value(f"is {values!r}, expected {expected}")
        for value in values:
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < 1e9:
                raise refuse_value(f"contains {value!r}, expected {expected}")
        return tuple(map(float, values))

    return BeforeValidator(check)


def _exposure(value: Any) -> Any:
    if value == "auto" or (type(value) in (int, float) and 0.0 < value < math.inf):
        return value
    raise refuse_value(f"is {value!r}, expected auto or a number > 0")


Count = Annotated[int, Field(strict=True, ge=1, le=4096)]
Pair = Annotated[tuple[float, float], numbers(2, "2 numbers")]
Pixels = Annotated[int, Field(strict=True, ge=1, le=8192)]


class DeviceMount(Part):
    """Pose of a sensor on its vehicle."""

    position: Vector3 = Field(default_factory=lambda: zeros(3))
    """Position from the body origin, body axes [m]."""
    pitch: Number = 0.0
    """Downward pitch of the sensor's x axis, its viewing direction, relative to the body's [rad]."""
    yaw: Number = 0.0
    """Yaw of the sensor's x axis to the left [rad]."""
    orientation: Quaternion | None = None
    """Quaternion q_body<sensor>, xyzw, (4,), which replaces pitch and yaw."""

    @property
    def quaternion(self) -> Array:
        """Return the quaternion q_body<sensor>, xyzw, (4,)."""
        if self.orientation is not None:
            return self.orientation
        return quat_from_euler(0.0, self.pitch, self.yaw)


class SiteDevice(Part):
    """Device on a vehicle that senses the surroundings."""

    about: str
    source: str
    """Source of the specification."""
    rate: Positive
    """Rate [Hz]."""
    mount: DeviceMount = Field(default_factory=lambda: DeviceMount())


class Port(Part):
    """Flat window between a lens in air and the water, perpendicular to the optical axis."""

    distance: Positive
    """Distance from the centre of the lens to the window's inner face [m]."""
    thickness: Positive
    """Thickness [m]."""
    index: Annotated[float, Field(strict=True, ge=1.0, le=3.0)] = 1.49
    """Refractive index; 1.49 for acrylic."""


class CameraDevice(SiteDevice):
    """Camera on a vehicle. Pixels and coefficients follow OpenCV; a dome port centred on the lens needs no
    parameters."""

    width: Pixels
    height: Pixels
    focal_length: Positive
    """Focal length of the full picture [px]; behind a flat port, that of the lens in air."""
    model: Literal["plumb_bob", "rational", "fisheye"] = "plumb_bob"
    distortion: Annotated[tuple[float, ...], numbers(None, "a list of numbers")] = ()
    port: Port | None = None
    exposure: Annotated[Any, AfterValidator(_exposure)] = "auto"
    """Fraction of full scale for radiance 1, or `auto`: adapted to the last picture."""
    white_balance: Probability = 0.0
    """Fraction of the colour cast that automatic white balance removes (gray world)."""
    full_well: Positive = 10_000.0
    """Full-well capacity [electrons]."""
    read_noise: NonNegative = 5.0
    """Read noise [electrons]."""
    gamma: Positive = 2.2
    """Gamma: pixel values are (charge)^(1/gamma) [-]."""
    exposure_time: NonNegative = 0.0
    """Exposure time, which causes motion blur if the vehicle's motion is known [s]."""

    @model_validator(mode="after")
    def _optics(self) -> CameraDevice:
        if self.width * self.height > PIXELS:
            raise refuse_section(
                f"{self.width} x {self.height} pixels, expected at most {PIXELS >> 20} million"
            )
        try:
            self.lens()
        except OpticsError as error:
            raise refuse_section(str(error)) from None
        return self

    def lens(self, width: int | None = None) -> Lens:
        """Return the lens, optionally for pictures of another width [px] with the same aspect ratio."""
        scale = (width or self.width) / self.width
        columns, rows, focal = (
            width or self.width,
            max(1, round(self.height * scale)),
            self.focal_length * scale,
        )
        middle = 0.5 * (columns - 1), 0.5 * (rows - 1)
        return Lens(columns, rows, focal, focal, *middle, self.model, self.distortion)

    @property
    def gain(self) -> float:
        """Fraction of full scale for radiance 1; with automatic exposure 1 before the first picture."""
        return 1.0 if self.exposure == "auto" else float(self.exposure)


class SonarDevice(SiteDevice):
    """Sonar whose picture is echo strength by beam and range: imaging, profiling or side-scan."""

    mode: Literal["imaging", "profiling", "side_scan"] = "imaging"
    """Profiling: also returns ranges of the first strong echoes. Side-scan: two beams perpendicular to the
    sensor's x axis."""
    frequency: Positive
    """Frequency [Hz]."""
    beams: Count
    """Number of beams, evenly distributed over the sector."""
    sector: Annotated[float, Field(strict=True, gt=0.0, le=math.pi)]
    """Horizontal field of view [rad]."""
    beam_width: Positive
    """Horizontal width of one beam between its half-power points on reception [rad]."""
    vertical_beam_width: Annotated[float, Field(strict=True, gt=0.0, le=math.pi)]
    """Vertical width between half-power points, one way [rad]."""
    depression: Annotated[float, Field(strict=True, ge=0.0, lt=1.571)] = 0.0
    """Angle of the beam axes below the sensor's x-y plane [rad]."""
    range: Positive
    """Largest range [m]."""
    minimum_range: NonNegative = 0.0
    """Least range [m]."""
    bins: Count
    """Number of range cells from 0 to `range`."""
    elevations: Count = 16
    """Number of rays per beam, over 1.5 vertical beam widths: a setting of the computation, not of the device."""
    noise_level_db: Number = -110.0
    """Noise level in a range cell before gain, as echo strength at 1 m [dB]."""
    gain_spreading: NonNegative = 30.0
    """Time-varying gain [dB per decade of range]; 40 compensates the loss of a small target, 20 that of a wall."""
    display: Pair = (-80.0, -20.0)
    """Echo strengths after gain that map to 0 and 255 in the picture [dB]."""
    detection_db: Number = -60.0
    """Level after gain above which a profiling sonar detects a return [dB]."""

    @model_validator(mode="after")
    def _computable(self) -> SonarDevice:
        if self.beams * max(self.elevations, self.bins) > PIXELS:
            raise refuse_section(f"{self.beams} beams with {self.bins} bins and {self.elevations} elevations, "
                                 f"expected at most {PIXELS >> 20} million rays or cells")  # fmt: skip
        return self

    @model_validator(mode="after")
    def _two_sides(self) -> SonarDevice:
        if self.mode == "side_scan" and self.beams != 2:
            raise refuse_section(f"a side-scan sonar has {self.beams} beams, expected 2: left and right")
        return self

    @model_validator(mode="after")
    def _display_rises(self) -> SonarDevice:
        if not self.display[0] < self.display[1]:
            raise refuse_section(f"display is {list(self.display)}, expected the lower level first")
        return self


class RangeDevice(SiteDevice):
    """Altimeter, rangefinder, or the beams of a DVL: the distance along each beam."""

    beams: Annotated[int, Field(strict=True, ge=1, le=16)] = 1
    """Number of beams: one along the sensor's x axis, or several evenly distributed around it."""
    beam_angle: Annotated[float, Field(strict=True, ge=0.0, lt=1.571)] = 0.0
    """Angle of each beam from the x axis [rad]."""
    beam_width: Annotated[float, Field(strict=True, ge=0.0, lt=1.571)] = 0.0
    """Width between half-power points, one way [rad]; 0 for a single ray."""
    rays: Count = 37
    """Number of rays per beam: a setting of the computation, not of the device."""
    quantile: Probability = 0.1
    """Fraction of a beam's echo that has arrived at the measured range; 0 for the first echo."""
    minimum_range: NonNegative
    """Least range [m]."""
    range: Positive
    """Largest range [m]."""
    noise: NonNegative = 0.0
    """Standard deviation, as a fraction of the range."""
    velocity_noise: NonNegative = 0.0
    """Standard deviation of a DVL's velocity along a beam [m/s]."""


Device = CameraDevice | SonarDevice | RangeDevice
KINDS: dict[str, type[CameraDevice] | type[SonarDevice] | type[RangeDevice]] = {
    "camera": CameraDevice,
    "sonar": SonarDevice,
    "range": RangeDevice,
}
"""`kind` of a sensor file -> its schema."""
assert set(CameraDevice.model_fields["model"].annotation.__args__) == set(LENS_MODELS)  # type: ignore[union-attr]


def devices() -> list[str]:
    """Return the names of the devices that are shipped with FinsSim."""
    return names_in(DEVICES)


def load_device(name_or_path: str | os.PathLike[str]) -> Device:
    """Read and check a sensor.

    Args:
        name_or_path: A sensor of the catalogue such as `ping`, or the path of a YAML file.

    Raises:
        DeviceError: Unknown name, or an invalid file; the message states location, error and remedy.
    """
    path, label = locate(name_or_path, DEVICES, "sensor", DeviceError)
    tree = read_tree(path, label, "kind: camera", DeviceError)
    kind = tree.pop("kind", None)
    if not isinstance(kind, str) or kind not in KINDS:
        raise DeviceError(f"{label}: kind is {kind!r}, expected one of {', '.join(KINDS)}")
    return checked_part(KINDS[kind], tree, label, DeviceError)


def device_of(vehicle: Vehicle, name: str) -> Device:
    """Return a sensor of a vehicle: its device, with the mount, rate, width and range cells of the vehicle's entry.

    Args:
        vehicle: Vehicle whose `perception` contains the entry.
        name: Name of the entry, such as `front_camera`.

    Raises:
        DeviceError: The vehicle has no such entry, or its device is invalid.
    """
    label = f"{vehicle.name}: perception.{name}"
    if name not in vehicle.perception:
        names = list(vehicle.perception)
        raise DeviceError(
            f"{vehicle.name} has no sensor '{name}'{did_you_mean(name, names)} its perception has "
            f"{', '.join(names) or 'none'}"
        )
    entry = vehicle.perception[name]
    try:
        device = load_device(entry.device)
    except DeviceError as error:
        raise DeviceError(f"{label}: device: {error}") from None
    orientation = device.mount.quaternion if entry.orientation is None else entry.orientation
    changes: dict[str, Any] = {
        "mount": DeviceMount(position=entry.position, orientation=orientation),
        "rate": entry.rate,
    }
    if isinstance(device, CameraDevice) and entry.width is not None:
        scale = entry.width / device.width
        changes["height"] = max(1, round(device.height * scale))
        changes["width"], changes["focal_length"] = entry.width, device.focal_length * scale
    elif isinstance(device, SonarDevice):
        changes["beams"], changes["bins"] = entry.width or device.beams, entry.bins or device.bins
    for key, kinds in {"width": (CameraDevice, SonarDevice), "bins": (SonarDevice,)}.items():
        if getattr(entry, key) is not None and not isinstance(device, kinds):
            raise DeviceError(f"{label}: {entry.device} has no {key}: remove it")
    return device.model_copy(update=changes)
