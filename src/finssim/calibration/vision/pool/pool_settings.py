"""What a calibration of a pool is told beforehand."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.vision.pool.pool_model import NAMES
from finssim.geometry.optics import Layer

__all__ = ["FITTED", "INTERFACES", "Settings", "active_names", "lens_std"]

INTERFACES = ("auto", "surface", "wall")

FITTED = {
    "pose": NAMES[:6],
    "height": ("depth",),
    "tilt": ("tilt_x", "tilt_y"),
    "index": ("index",),
    "focal": ("focal",),
    "center": ("center_x", "center_y"),
    "distortion": NAMES[13:],
}
"""What may be fitted -> its parameters."""

LENS_STD = (0.05, 0.03, 0.03, 0.15, 0.15, 0.02, 0.02, 0.1)
"""How far a camera file that is only roughly right may be off: log focal, centre in widths of the image, distortion."""


THICKEST = 0.5
"""Thickness of a window beyond which another unit than metres is meant [m]."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Options; standard deviations are of what is known before the pictures."""

    interface: str = "auto"
    """`surface` (normal along the survey's z), `wall` (any direction) or `auto`."""
    plane: tuple[float, float, float, float] | None = None
    """Surveyed plane n . X + b = 0 as n_x, n_y, n_z, b [m]; the sense of n does not matter."""
    window: tuple[Layer, ...] = ()
    """Layers between, the first one next to the camera."""
    water_height: float | None = None
    """z of the surface in the survey's frame [m]."""
    water_depth: float | None = None
    """Distance from the middle of the surveyed points to the surface [m], for a survey of one plane."""
    water_height_sigma: float = 0.005
    """Of either, or of the surveyed plane's position [m]."""
    index: float = 1.333
    """Of the water."""
    index_sigma: float = 0.003
    """Of that; 0 holds it."""
    index_near: float = 1.0003
    """On the camera's side."""
    tilt_sigma: float | None = None
    """Of the plane's direction [rad]; None: 0.2 degrees for a surface, 0.5 for a surveyed plane, free for a wall."""
    fit: tuple[str, ...] | None = None
    """Of `FITTED`; None: pose, height, tilt and index, and the lens where held-out points get better by it."""
    focal_sigma: float = 0.0
    """Of the camera file's focal length, relative; 0 holds it unless `fit` names it."""
    center_sigma: float = 0.0
    """Of the camera file's optical centre along each axis [px]; 0 holds it unless `fit` names it."""
    pixel_sigma: float | None = None
    """Of a pixel [px]; None: from the residuals."""
    survey_sigma: float = 0.002
    """Of a surveyed coordinate [m]."""
    survey_yaw_sigma: float = math.radians(0.5)
    """Of a tag's direction [rad]."""
    folds: int = 5
    """Parts that are held out in turn."""
    seed: int = 0
    """Of the parts and of samples."""

    def __post_init__(self) -> None:
        if self.interface not in INTERFACES:
            raise CalibrationError(
                f"unknown interface '{self.interface}'; available: {', '.join(INTERFACES)} (a window or wall of known "
                "place is --plane)"
            )
        for name in self.fit or ():
            if name not in FITTED:
                raise CalibrationError(f"unknown '{name}' to fit; available: {', '.join(FITTED)}")
        if self.fit is not None and "pose" not in self.fit:
            raise CalibrationError("fit leaves the pose out: the camera's pose is always fitted, add pose")
        known = [self.water_height is not None, self.water_depth is not None, self.plane is not None]
        if sum(known) > 1:
            raise CalibrationError(
                "the place of the water is given twice: give one of its height, depth and plane"
            )
        if self.fit is not None and "height" not in self.fit and not any(known):
            raise CalibrationError(
                "fit leaves the height out and none is given: add height, or give --water-height"
            )
        for layer in self.window:
            if layer.thickness > THICKEST:
                raise CalibrationError(
                    f"window is {layer.thickness:g} m thick, expected at most {THICKEST:g}: thickness is in metres, "
                    "10 mm of glass are 0.010:1.52"
                )
        _positive("index", self.index, 1.0, 2.5)
        _positive("index sigma", self.index_sigma, 0.0, 1.0)
        _positive("tilt sigma [deg]", math.degrees(self.tilt_sigma or 0.0), 0.0, 180.0)
        _positive("water height sigma", self.water_height_sigma, 0.0, 10.0)
        _positive("survey sigma", self.survey_sigma, 0.0, 1.0)
        _positive("survey yaw sigma [deg]", math.degrees(self.survey_yaw_sigma), 0.0, 180.0)
        _positive("focal sigma", self.focal_sigma, 0.0, 10.0)
        _positive("center sigma", self.center_sigma, 0.0, 1e4)
        if self.pixel_sigma is not None:
            _positive("pixel sigma", self.pixel_sigma, 1e-3, 100.0)
        if self.folds < 2:
            raise CalibrationError(f"folds is {self.folds}, expected at least 2")
        if self.plane is not None and not np.linalg.norm(self.plane[:3]) > 0.0:
            raise CalibrationError(f"plane has normal {self.plane[:3]}, expected a direction")

    @property
    def known_depth(self) -> bool:
        """Whether a measurement of the plane's place is given."""
        return any(x is not None for x in (self.water_height, self.water_depth, self.plane))


def active_names(settings: Settings, extra: tuple[str, ...] = ()) -> NDArray[np.bool_]:
    """Which of `NAMES` are fitted, (18,)."""
    groups = list(settings.fit or ("pose", "height", "tilt", "index")) + list(extra)
    if settings.focal_sigma > 0.0:
        groups.append("focal")
    if settings.center_sigma > 0.0:
        groups.append("center")
    names = {name for group in groups for name in FITTED[group]}
    if settings.index_sigma <= 0.0:
        names -= {"index"}
    if settings.tilt_sigma is not None and settings.tilt_sigma <= 0.0:
        names -= {"tilt_x", "tilt_y"}
    if settings.known_depth and settings.water_height_sigma <= 0.0:
        names -= {"depth"}
    return np.array([name in names for name in NAMES])


def lens_std(settings: Settings, width: int) -> tuple[float, ...]:
    """Standard deviations of `LENS_NAMES` before the pictures."""
    focal, x, y, *distortion = LENS_STD
    if settings.focal_sigma > 0.0:
        focal = settings.focal_sigma
    if settings.center_sigma > 0.0:
        return (focal, settings.center_sigma, settings.center_sigma, *distortion)
    return (focal, x * width, y * width, *distortion)


def _positive(what: str, value: float, least: float, most: float) -> None:
    if not (math.isfinite(value) and least <= value <= most):
        raise CalibrationError(f"{what} is {value:g}, expected a number from {least:g} to {most:g}")
