"""One camera above one water surface: predicted pixels, what is known beforehand, and least squares for both."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.findings import CalibrationError
from finssim.calibration.vision.least_squares import descent
from finssim.calibration.vision.survey import Observations
from finssim.geometry.optics import Camera, Interface, Lens, Status, project, projection_jacobians
from finssim.geometry.rotations import matrix_to_quat, quat_from_rotvec, quat_to_matrix, skew

Array = NDArray[np.float64]

POSE_NAMES = ("camera_x", "camera_y", "camera_z", "rotation_x", "rotation_y", "rotation_z")
LENS_NAMES = ("focal", "center_x", "center_y", *(f"distortion_{k}" for k in range(1, 6)))
NAMES = (*POSE_NAMES, "tilt_x", "tilt_y", "depth", "index", *LENS_NAMES)
"""Order of every vector of parameters: camera centre [m], rotation by pool axes [rad], tilt of the plane about the
reference point [rad], distance of the plane from the reference point [m], index beyond it, logarithm of the focal
length, optical centre [px], first five coefficients of distortion as the lens lists them."""

_LENGTHS = {"plumb_bob": 5, "rational": 8, "fisheye": 4}


def extended_lens(lens: Lens) -> Lens:
    """The same lens with room for coefficients of distortion that it leaves out."""
    missing = _LENGTHS[lens.model] - len(lens.distortion)
    return replace(lens, distortion=(*lens.distortion, *([0.0] * missing))) if missing > 0 else lens


@dataclass(frozen=True)
class PoolModel:
    """Camera and plane. All in the pool frame."""

    camera: Camera
    interface: Interface
    reference: Array
    """Point of the survey under water that the plane turns about and is told from, (3,) [m]."""
    refractive: bool = True
    """False: straight lines, as if nothing were between the camera and the points."""

    @property
    def depth(self) -> float:
        """Distance of the plane from the reference point, towards the camera [m]."""
        return -float(self.interface.normal @ self.reference + self.interface.offset)

    @property
    def clearance(self) -> float:
        """Distance of the camera from the plane, on its own side [m]."""
        return float(self.interface.normal @ self.camera.position + self.interface.offset)

    @cached_property
    def tangents(self) -> Array:
        """Directions that the plane's normal tilts towards, (2, 3)."""
        return np.stack([np.asarray(e, float) for e in self.interface.tangents()])

    @property
    def lens_values(self) -> Array:
        """Log focal length, centre [px] and five coefficients of distortion, (8,)."""
        lens = self.camera.lens
        return np.array([np.log(lens.fx), lens.cx, lens.cy, *lens.distortion, 0.0, 0.0, 0.0, 0.0, 0.0])[:8]

    def predict(self, points: Array, dry: NDArray[np.bool_]) -> Array:
        """Pixels of points, (N, 3) -> (N, 2); NaN where the camera cannot see them or they are beyond no plane.

        Args:
            points: Pool frame [m].
            dry: Points on the camera's side of the plane, seen in a straight line, (N,).
        """
        pixels = np.full((len(points), 2), np.nan)
        wet = ~dry if self.refractive else np.zeros(len(points), bool)
        if wet.any():
            projection = project(self.camera, self.interface, points[wet])
            good = (projection.status == Status.OK) | (projection.status == Status.OUTSIDE_IMAGE)
            pixels[wet] = np.where(good[:, None], projection.pixels, np.nan)
        if not wet.all():
            direct, ok = self.camera.lens.project(self._optical(points[~wet]))
            pixels[~wet] = np.where(ok[:, None], direct, np.nan)
        return pixels

    def jacobians(self, points: Array, dry: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Derivatives of `predict`: by the parameters in the order of `NAMES` (N, 2, 18), by the point (N, 2, 3)."""
        J, J_point = np.zeros((len(points), 2, len(NAMES))), np.zeros((len(points), 2, 3))
        wet = ~dry if self.refractive else np.zeros(len(points), bool)
        if wet.any():
            of = projection_jacobians(self.camera, self.interface, points[wet])
            tilt = of.interface[..., :2] - of.interface[..., 2:] * (self.tangents @ self.reference)
            parts = (of.pose, tilt, -of.interface[..., 2:], of.index[..., None], self._lens_columns(of.lens))
            J[wet], J_point[wet] = np.concatenate(parts, axis=-1), of.point
        if not wet.all():
            J[~wet], J_point[~wet] = self._direct_jacobians(points[~wet])
        return J, J_point

    def moved(self, step: Array) -> PoolModel:
        """The model a small step away, (18,) in the order of `NAMES`."""
        camera, plane = self.camera, self.interface
        turn = quat_to_matrix(quat_from_rotvec(step[3:6]))
        orientation = matrix_to_quat(turn @ np.asarray(camera.R_pc))
        normal = plane.normal + step[6:8] @ self.tangents
        normal = normal / np.linalg.norm(normal)
        offset = -(self.depth + step[8]) - float(normal @ self.reference)
        return replace(
            self,
            camera=Camera(_lens_moved(camera.lens, step[10:]), camera.position + step[:3], orientation),
            interface=replace(
                plane, normal=normal, offset=offset, index_far=float(plane.index_far + step[9])
            ),
        )

    def _optical(self, points: Array) -> Array:
        return np.asarray((points - self.camera.position) @ np.asarray(self.camera.R_pc))

    def _lens_columns(self, of_lens: Array) -> Array:
        """Derivatives by fx fy cx cy and distortion as those by log focal, centre and distortion, (N, 2, 8)."""
        lens = self.camera.lens
        focal = of_lens[..., 0] * lens.fx + of_lens[..., 1] * lens.fy
        centre_and_distortion = of_lens[..., 4:9]
        zeros = np.zeros((*centre_and_distortion.shape[:-1], 5 - centre_and_distortion.shape[-1]))
        return np.concatenate([focal[..., None], of_lens[..., 2:4], centre_and_distortion, zeros], axis=-1)

    def _direct_jacobians(self, points: Array) -> tuple[Array, Array]:
        optical, R_pc = self._optical(points), np.asarray(self.camera.R_pc)
        by_point = self.camera.lens.project_jacobian(optical) @ R_pc.T
        by_turn = by_point @ skew(points - self.camera.position)
        lens = self._lens_columns(self.camera.lens.parameter_jacobian(optical))
        plane = np.zeros((len(points), 2, 4))
        return np.concatenate([-by_point, by_turn, plane, lens], axis=-1), by_point


def _lens_moved(lens: Lens, step: Array) -> Lens:
    if not step.any():
        return lens
    factor, count = float(np.exp(step[0])), min(5, len(lens.distortion))
    distortion = np.array(lens.distortion)
    distortion[:count] += step[3 : 3 + count]
    return replace(
        lens,
        fx=lens.fx * factor,
        fy=lens.fy * factor,
        cx=lens.cx + float(step[1]),
        cy=lens.cy + float(step[2]),
        distortion=tuple(distortion.tolist()),
    )


LENS_GROUPS = {"focal": ("focal",), "center": ("center_x", "center_y"), "distortion": NAMES[13:]}
"""What of the lens may be fitted -> its parameters."""

LENS_STD = (0.05, 0.03, 0.03, 0.15, 0.15, 0.02, 0.02, 0.1)
"""How far a camera file that is only roughly right may be off: log focal, centre in widths of the image, distortion."""


RANGES = {
    "index": ("index", 1.0, 1.0, 2.5),
    "index_sigma": ("index sigma", 1.0, 0.0, 1.0),
    "tilt_sigma": ("tilt sigma [deg]", np.degrees(1.0), 0.0, 180.0),
    "water_height_sigma": ("water height sigma", 1.0, 0.0, 10.0),
    "survey_sigma": ("survey sigma", 1.0, 0.0, 1.0),
    "focal_sigma": ("focal sigma", 1.0, 0.0, 10.0),
    "center_sigma": ("center sigma", 1.0, 0.0, 1e4),
}
"""Setting -> what it is called, units that one of its own makes, least and most in those."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Options; standard deviations are of what is known before the pictures."""

    water_height: float | None = None
    """z of the surface in the survey's frame [m]."""
    water_height_sigma: float = 0.005
    """Of that [m]."""
    index: float = 1.333
    """Of the water."""
    index_sigma: float = 0.003
    """Of that; 0 holds it."""
    tilt_sigma: float | None = None
    """Of the surface's direction, along the survey's z [rad]; 0 holds it; None: 0.2 degrees, or free where the pixels
    contradict that."""
    refit_lens: bool = True
    """Fit the lens too where held-out points get better by it."""
    focal_sigma: float = 0.0
    """Of the camera file's focal length, relative; 0 holds it unless the lens is fitted."""
    center_sigma: float = 0.0
    """Of the camera file's optical centre along each axis [px]; 0 holds it unless the lens is fitted."""
    survey_sigma: float = 0.002
    """Of a surveyed coordinate [m]."""
    seed: int = 0
    """Of the parts and of samples."""

    def __post_init__(self) -> None:
        for field, (name, per, least, greatest) in RANGES.items():
            value = getattr(self, field)
            if value is not None and not least <= per * value <= greatest:
                raise CalibrationError(
                    f"{name} is {per * value:g}, expected a number from {least:g} to {greatest:g}"
                )


def active_names(settings: Settings, extra: tuple[str, ...] = ()) -> NDArray[np.bool_]:
    """Which of `NAMES` are fitted, with groups of the lens besides those whose errors are given, (18,)."""
    active = {
        **dict.fromkeys(POSE_NAMES, True),
        **dict.fromkeys(("tilt_x", "tilt_y"), settings.tilt_sigma is None or settings.tilt_sigma > 0.0),
        "depth": settings.water_height is None or settings.water_height_sigma > 0.0,
        "index": settings.index_sigma > 0.0,
    }
    for group, names in LENS_GROUPS.items():
        fitted = group in extra or getattr(settings, f"{group}_sigma", 0.0) > 0.0
        active |= dict.fromkeys(names, fitted)
    return np.array([active[name] for name in NAMES])


def lens_std(settings: Settings, width: int) -> tuple[float, ...]:
    """Standard deviations of `LENS_NAMES` before the pictures."""
    focal, x, y, *distortion = LENS_STD
    center = settings.center_sigma
    across = (center, center) if center > 0.0 else (x * width, y * width)
    return (settings.focal_sigma or focal, *across, *distortion)


LOST = 500.0
"""Residual that stands for a point the model cannot see at all [px]."""

Whitening = Callable[[Array], Array]


@dataclass(frozen=True, kw_only=True)
class Prior:
    """What is known beforehand: Gaussian, each standard deviation infinite where nothing is."""

    normal: Array | None = None
    """Into the camera's side, (3,)."""
    tilt_std: float = np.inf
    """[rad]"""
    depth: float = np.nan
    """Distance of the plane from the reference point [m]."""
    depth_std: float = np.inf
    start: PoolModel
    """Holds index and lens that `index_std` and `lens_std` are about."""
    index_std: float = np.inf
    lens_std: tuple[float, ...] = (np.inf,) * 8
    """Of log focal, centre [px], distortion."""

    def rows(self, model: PoolModel) -> tuple[Array, Array]:
        """Residuals (M,) of the priors, each over its standard deviation, and their derivatives (M, 18)."""
        r, J = np.zeros(12), np.eye(len(NAMES))[6:]
        std = np.array([np.inf, np.inf, self.depth_std, self.index_std, *self.lens_std])
        if self.normal is not None:
            across = np.stack([np.asarray(e, float) for e in Interface(self.normal, 0.0).tangents()])
            r[:2], J[:2, 6:8], std[:2] = (
                across @ model.interface.normal,
                across @ model.tangents.T,
                self.tilt_std,
            )
        r[2:4] = model.depth - self.depth, model.interface.index_far - self.start.interface.index_far
        r[4:] = model.lens_values - self.start.lens_values
        informative = np.isfinite(r) & np.isfinite(std) & (std > 0.0)
        return r[informative] / std[informative], J[informative] / std[informative, None]


class Solution(NamedTuple):
    """Where the search ended."""

    model: PoolModel
    cost: float
    """Half the sum of squares of whitened residuals and priors."""


def residuals(model: PoolModel, observed: Observations) -> tuple[Array, NDArray[np.bool_]]:
    """Measured minus predicted pixel (N, 2), and where there is one (N,); `LOST` elsewhere."""
    r = observed.pixels - model.predict(observed.points, observed.dry)
    ok = np.isfinite(r).all(axis=1)
    return np.where(ok[:, None], r, LOST), ok


def solve(
    start: PoolModel,
    observed: Observations,
    whiten: Whitening,
    active: NDArray[np.bool_],
    prior: Prior,
    *,
    iterations: int = 60,
    tolerance: float = 1e-9,
) -> Solution:
    """Minimise |whiten(measured - predicted)|² plus the priors.

    Args:
        start: Where to begin.
        observed: The rows.
        whiten: Turns residuals (N, 2) and derivatives (N, 2, P) into independent rows of unit variance.
        active: Which of `NAMES` move, (18,).
        prior: Of those and of the others.
        iterations: At most.
        tolerance: Relative change of the cost at which the search ends.
    """
    free = np.flatnonzero(active)

    def steps_from(model: PoolModel) -> Callable[[float], PoolModel | None]:
        N, g = normal_equations(model, observed, whiten, free, prior)
        scale = np.sqrt(np.maximum(np.diagonal(N), 1e-300))
        H, b = N / np.outer(scale, scale), g / scale

        def stepped(damping: float) -> PoolModel | None:
            step = np.zeros(len(NAMES))
            step[free] = np.linalg.solve(H + damping * np.eye(len(free)), b) / scale
            if not np.isfinite(step).all() or np.abs(step[3:8]).max() > 1.0 or abs(step[10]) > 0.5:
                return None
            try:
                return model.moved(step)
            except ValueError:
                return None

        return stepped

    def cost(model: PoolModel) -> float:
        if model.refractive and (model.clearance <= 0.0 or not 1.0 < model.interface.index_far < 3.0):
            return np.inf
        e, r = whiten(residuals(model, observed)[0]), prior.rows(model)[0]
        return 0.5 * float(e @ e + r @ r)

    *_, end = descent(start, cost, steps_from, rounds=iterations, tolerance=tolerance)
    return Solution(*end)


def normal_equations(
    model: PoolModel, observed: Observations, whiten: Whitening, free: NDArray[np.intp], prior: Prior
) -> tuple[Array, Array]:
    """Information (P, P) and gradient (P,) at a model, by the parameters `free`, priors included."""
    r, ok = residuals(model, observed)
    J = model.jacobians(observed.points, observed.dry)[0][..., free]
    J = np.where((ok & np.isfinite(J).all(axis=(1, 2)))[:, None, None], J, 0.0)
    A, e = whiten(J), whiten(r)
    r_prior, J_prior = prior.rows(model)
    J_prior = J_prior[:, free]
    return A.T @ A + J_prior.T @ J_prior, A.T @ e - J_prior.T @ r_prior
