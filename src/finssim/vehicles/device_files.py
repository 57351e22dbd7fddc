"""Devices of a vehicle's `perception` as data: cameras, sonars and rangefinders, from YAML files that are checked."""

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
"""Greatest number of computed values of a device: pixels, rays, or cells of range and beam."""


class DeviceError(ValueError):
    """A device that is not possible, or that a vehicle does not have: one sentence with what to do."""


def numbers(count: int | None, expected: str) -> BeforeValidator:
    """So many finite numbers, or any, in a list."""

    def check(values: Any) -> Any:
        if not isinstance(values, (list, tuple)) or count not in (None, len(values)):
            raise refuse_value(f"is {values!r}, expected {expected}")
        for value in values:
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < 1e9:
                raise refuse_value(f"holds {value!r}, expected {expected}")
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
    """Its x axis, along which it looks, turned down from the body's [rad]."""
    yaw: Number = 0.0
    """And to the left [rad]."""
    orientation: Quaternion | None = None
    """q_body<sensor> in place of both, xyzw, (4,)."""

    @property
    def quaternion(self) -> Array:
        """Return the quaternion q_body<sensor>, xyzw, (4,)."""
        if self.orientation is not None:
            return self.orientation
        return quat_from_euler(0.0, self.pitch, self.yaw)


class SiteDevice(Part):
    """A device on a vehicle that senses the site around it."""

    about: str
    source: str
    """Source of the figures."""
    rate: Positive
    """[Hz]"""
    mount: DeviceMount = Field(default_factory=lambda: DeviceMount())


class Port(Part):
    """A flat window between a lens in air and the water, square to the view."""

    distance: Positive
    """Distance from the centre of the lens to the window's inner face [m]."""
    thickness: Positive
    """[m]"""
    index: Annotated[float, Field(strict=True, ge=1.0, le=3.0)] = 1.49
    """Refractive index; acrylic has 1.49."""


class CameraDevice(SiteDevice):
    """A camera on a vehicle. Pixels and coefficients as OpenCV's; a dome port centred on the lens needs nothing."""

    width: Pixels
    height: Pixels
    focal_length: Positive
    """[px] of the full picture; behind a flat port that of the lens in air."""
    model: Literal["plumb_bob", "rational", "fisheye"] = "plumb_bob"
    distortion: Annotated[tuple[float, ...], numbers(None, "a list of numbers")] = ()
    port: Port | None = None
    exposure: Annotated[Any, AfterValidator(_exposure)] = "auto"
    """Fraction of the full scale that radiance 1 reaches, or fitted to the last picture."""
    white_balance: Probability = 0.0
    """Share of the colour cast that automatic exposure takes out (gray world)."""
    full_well: Positive = 10_000.0
    """[electrons]"""
    read_noise: NonNegative = 5.0
    """[electrons]"""
    gamma: Positive = 2.2
    """Numbers are (charge)^(1/gamma) [-]."""
    exposure_time: NonNegative = 0.0
    """During which a picture that knows the vehicle's motion blurs [s]."""

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
        """The lens, for pictures of another width [px] and the same proportions too."""
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
        """Share of the full scale that radiance 1 reaches; before automatic exposure has seen a picture, 1."""
        return 1.0 if self.exposure == "auto" else float(self.exposure)


class SonarDevice(SiteDevice):
    """A sonar whose picture is echo strength by beam and range: imaging, profiling or side-scan."""

    mode: Literal["imaging", "profiling", "side_scan"] = "imaging"
    """Profiling: ranges of the first strong returns too. Side-scan: two beams square to the sensor's x axis."""
    frequency: Positive
    """[Hz]"""
    beams: Count
    """Evenly over the sector."""
    sector: Annotated[float, Field(strict=True, gt=0.0, le=math.pi)]
    """Horizontal field of view [rad]."""
    beam_width: Positive
    """Width of one beam across, between its half-power points on reception [rad]."""
    vertical_beam_width: Annotated[float, Field(strict=True, gt=0.0, le=math.pi)]
    """Between half-power points, one way [rad]."""
    depression: Annotated[float, Field(strict=True, ge=0.0, lt=1.571)] = 0.0
    """Angle of the beams' middles below the sensor's x-y plane [rad]."""
    range: Positive
    """[m]"""
    minimum_range: NonNegative = 0.0
    """[m]"""
    bins: Count
    """Range cells from 0 to `range`."""
    elevations: Count = 16
    """Rays of a beam, over 1.5 vertical beam widths: what is computed, not a figure of the device."""
    noise_level_db: Number = -110.0
    """Noise in a range cell before gain, as echo strength at 1 m [dB]."""
    gain_spreading: NonNegative = 30.0
    """Time-varying gain [dB per decade of range]; 40 undoes the loss of a small target, 20 that of a wall."""
    display: Pair = (-80.0, -20.0)
    """Echo strengths after gain that are 0 and 255 in the picture [dB]."""
    detection_db: Number = -60.0
    """Level after gain that a profiling sonar takes for a return [dB]."""

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
    """An altimeter, a rangefinder, or the beams of a DVL: the distance along each beam."""

    beams: Annotated[int, Field(strict=True, ge=1, le=16)] = 1
    """One along the sensor's x axis, or several evenly around it."""
    beam_angle: Annotated[float, Field(strict=True, ge=0.0, lt=1.571)] = 0.0
    """Angle of each beam from the x axis [rad]."""
    beam_width: Annotated[float, Field(strict=True, ge=0.0, lt=1.571)] = 0.0
    """Between half-power points, one way [rad]; 0 for a single ray."""
    rays: Count = 37
    """Number of rays in a beam: a setting of the computation, not a figure of the device."""
    quantile: Probability = 0.1
    """Share of a beam's echo that has come when the range is taken; 0 for the first."""
    minimum_range: NonNegative
    """[m]"""
    range: Positive
    """[m]"""
    noise: NonNegative = 0.0
    """Standard deviation, as a share of the range."""
    velocity_noise: NonNegative = 0.0
    """Standard deviation of a DVL's velocity along a beam [m/s]."""


Device = CameraDevice | SonarDevice | RangeDevice
KINDS: dict[str, type[CameraDevice] | type[SonarDevice] | type[RangeDevice]] = {
    "camera": CameraDevice,
    "sonar": SonarDevice,
    "range": RangeDevice,
}
"""`kind` of a sensor file -> what it holds."""
assert set(CameraDevice.model_fields["model"].annotation.__args__) == set(LENS_MODELS)  # type: ignore[union-attr]


def devices() -> list[str]:
    """Names of the devices that come with FinsSim."""
    return names_in(DEVICES)


def load_device(name_or_path: str | os.PathLike[str]) -> Device:
    """Read and check a sensor.

    Args:
        name_or_path: A sensor of the catalogue such as `ping`, or the path of a YAML file.

    Raises:
        DeviceError: Unknown name, or a file that is refused; the message says where, what and what to do.
    """
    path, label = locate(name_or_path, DEVICES, "sensor", DeviceError)
    tree = read_tree(path, label, "kind: camera", DeviceError)
    kind = tree.pop("kind", None)
    if not isinstance(kind, str) or kind not in KINDS:
        raise DeviceError(f"{label}: kind is {kind!r}, expected one of {', '.join(KINDS)}")
    return checked_part(KINDS[kind], tree, label, DeviceError)


def device_of(vehicle: Vehicle, name: str) -> Device:
    """A sensor of a vehicle: its device, with the mount, rate, width and range cells of the vehicle's entry.

    Args:
        vehicle: Its `perception` has the entry.
        name: Of the entry, such as `front_camera`.

    Raises:
        DeviceError: The vehicle has no such entry, or its device is refused.
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
