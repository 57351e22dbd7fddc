"""Model of one camera in front of one plane: predicted pixels, priors, and least squares with both."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from finssim.core.least_squares import Step, descend, unit_diagonal
from finssim.core.optics import (
    COEFFICIENTS,
    Camera,
    Interface,
    Layer,
    Lens,
    Status,
    project,
    projection_jacobians,
)
from finssim.core.rotations import matrix_to_quat, quat_from_rotvec, quat_to_matrix, skew
from finssim.survey.points import Observations
from finssim.trials.findings import CalibrationError

Array = NDArray[np.float64]

UP = np.array([0.0, 0.0, 1.0])

POSE_NAMES = ("camera_x", "camera_y", "camera_z", "rotation_x", "rotation_y", "rotation_z")
LENS_NAMES = ("focal", "center_x", "center_y", *(f"distortion_{k}" for k in range(1, 6)))
NAMES = (*POSE_NAMES, "tilt_x", "tilt_y", "depth", "index", *LENS_NAMES)
"""Order of every parameter vector: camera centre [m], rotation about pool axes [rad], tilt of the plane about the
reference point [rad], distance of the plane from the reference point [m], index beyond it, logarithm of the focal
length, optical centre [px], first five coefficients of distortion in the lens's order."""


def mask_of(names: Iterable[str]) -> NDArray[np.bool_]:
    """Return a mask of some of the `NAMES`, (18,)."""
    return np.isin(NAMES, list(names))


def extended_lens(lens: Lens) -> Lens:
    """Return the same lens with zeros for the distortion coefficients that it lacks."""
    missing = len(COEFFICIENTS[lens.model]) - len(lens.distortion)
    return replace(lens, distortion=(*lens.distortion, *([0.0] * missing))) if missing > 0 else lens


@dataclass(frozen=True)
class PoolModel:
    """Camera and plane, in the pool frame."""

    camera: Camera
    interface: Interface
    reference: Array
    """Surveyed point under water, about which the plane tilts and from which its distance is measured, (3,) [m]."""
    refractive: bool = True
    """False for straight lines, without any interface between camera and points."""

    @property
    def depth(self) -> float:
        """Distance of the plane from the reference point, positive towards the camera [m]."""
        return -float(self.interface.normal @ self.reference + self.interface.offset)

    @property
    def clearance(self) -> float:
        """Distance of the camera from the plane, positive on its own side [m]."""
        return float(self.interface.normal @ self.camera.position + self.interface.offset)

    def lean(self, normal: Array) -> float:
        """Return the angle between the plane's normal and another unit vector, pool frame (3,) [rad]."""
        return float(np.arccos(np.clip(self.interface.normal @ normal, -1.0, 1.0)))

    @cached_property
    def tangents(self) -> Array:
        """Return the unit directions towards which the tilt parameters move the plane's normal, (2, 3)."""
        return np.stack([np.asarray(e, float) for e in self.interface.tangents()])

    @property
    def lens_values(self) -> Array:
        """Log focal length, centre [px] and five coefficients of distortion, (8,)."""
        lens = self.camera.lens
        return np.array([np.log(lens.fx), lens.cx, lens.cy, *lens.distortion, 0.0, 0.0, 0.0, 0.0, 0.0])[:8]

    def predict(self, points: Array, dry: NDArray[np.bool_]) -> Array:
        """Return the pixels of points, (N, 3) -> (N, 2); NaN if they are not visible.

        Args:
            points: Points, pool frame [m].
            dry: Mask of points on the camera's side of the plane, seen along a straight line, (N,).
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
        """Return the derivatives of `predict` by the parameters, as `NAMES` (N, 2, 18), and by the point (N, 2, 3)."""
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
        """Return the model after a small step, (18,) in the order and the units of `NAMES`."""
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
        """Convert derivatives by fx fy cx cy and distortion to those by log focal, centre and distortion, (N,
        2, 8)."""
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


FITTED = {
    "pose": NAMES[:6],
    "height": ("depth",),
    "tilt": ("tilt_x", "tilt_y"),
    "index": ("index",),
    "focal": ("focal",),
    "center": ("center_x", "center_y"),
    "distortion": NAMES[13:],
}
"""Group of parameters that may be fitted -> their names."""

LENS_STD = (0.05, 0.03, 0.03, 0.15, 0.15, 0.02, 0.02, 0.1)
"""Standard deviations of an approximate camera file: log focal, centre relative to the image width, distortion."""


RANGES = {
    "index": ("index", 1.0, 1.0, 2.5),
    "index_sigma": ("index sigma", 1.0, 0.0, 1.0),
    "tilt_sigma": ("tilt sigma [deg]", np.degrees(1.0), 0.0, 180.0),
    "place_sigma": ("sigma of the surface or window [m]", 1.0, 0.0, 10.0),
    "survey_sigma": ("survey sigma", 1.0, 0.0, 1.0),
    "survey_yaw_sigma": ("survey yaw sigma [deg]", np.degrees(1.0), 0.0, 180.0),
    "focal_sigma": ("focal sigma", 1.0, 0.0, 10.0),
    "center_sigma": ("center sigma", 1.0, 0.0, 1e4),
    "pixel_sigma": ("pixel sigma", 1.0, 1e-3, 100.0),
}
"""Setting -> its name in messages, conversion factor to the unit of the message, least and greatest value."""

THICKEST = 0.5
"""Greatest plausible thickness of a window [m]; a greater number is probably in another unit."""


@dataclass(frozen=True, kw_only=True)
class PoolFitSettings:
    """Priors and options of the fit; standard deviations are those before the fit.

    The interface is the water surface, with its normal along the survey's z, unless a window is given.
    """

    window: Layer | None = None
    """Flat window between camera and water, in any orientation; None: the camera looks through the water surface."""
    plane: tuple[float, float, float, float] | None = None
    """Surveyed face of the window towards the camera, n . X + b = 0 as n_x, n_y, n_z, b [m]; n may have
    either sign."""
    water_height: float | None = None
    """z of the surface in the survey's frame [m]."""
    water_depth: float | None = None
    """Distance from the centroid of the surveyed points to the surface [m], for a survey of one plane."""
    place_sigma: float = 0.005
    """Standard deviation of the measured height or depth of the surface, or of the window's position [m]."""
    index: float = 1.333
    """Refractive index of the water."""
    index_sigma: float = 0.003
    """Standard deviation of the index; 0 fixes it."""
    index_near: float = 1.0003
    """Refractive index on the camera's side."""
    tilt_sigma: float | None = None
    """Standard deviation of the plane's direction [rad]; None: 0.2 degrees for a surface, 0.5 for a surveyed window."""
    fit: tuple[str, ...] | None = None
    """Groups of `FITTED`; None: pose, height, tilt and index, and the lens if that decreases the held-out error."""
    focal_sigma: float = 0.0
    """Relative standard deviation of the camera file's focal length; 0 fixes it unless it is in `fit` [-]."""
    center_sigma: float = 0.0
    """Standard deviation of the camera file's optical centre along each axis [px]; 0 fixes it unless it is in
    `fit`."""
    pixel_sigma: float | None = None
    """Standard deviation of a pixel [px]; None: estimated from the residuals."""
    survey_sigma: float = 0.002
    """Standard deviation of a surveyed coordinate [m]."""
    survey_yaw_sigma: float = math.radians(0.5)
    """Standard deviation of a tag's heading [rad]."""
    folds: int = 5
    """Number of folds of the cross-validation."""
    seed: int = 0
    """Seed of the folds and random samples."""

    def __post_init__(self) -> None:
        for name in self.fit or ():
            if name not in FITTED:
                raise CalibrationError(f"unknown '{name}' to fit; available: {', '.join(FITTED)}")
        if self.fit is not None and "pose" not in self.fit:
            raise CalibrationError("fit leaves the pose out: the camera's pose is always fitted, add pose")
        if self.window is None and self.plane is not None:
            raise CalibrationError("a plane without a window: the plane of a surface is its height or depth")
        if self.window is not None and not (self.water_height is self.water_depth is None):
            raise CalibrationError("the height or depth of a window: its place is a plane")
        if self.water_height is not None and self.water_depth is not None:
            raise CalibrationError("the place of the surface is given twice: give its height or its depth")
        if self.fit is not None and "height" not in self.fit and not self.stated_depth:
            raise CalibrationError(
                "fit leaves the height out and none is given: add height to fit, or give the height of the surface or "
                "the plane of the window"
            )
        if self.window is not None and self.window.thickness > THICKEST:
            raise CalibrationError(
                f"window is {self.window.thickness:g} m thick, expected at most {THICKEST:g}: thickness is in metres, "
                "10 mm of glass are 0.010"
            )
        for field, (name, per, least, greatest) in RANGES.items():
            value = getattr(self, field)
            if value is not None and not least <= per * value <= greatest:
                raise CalibrationError(
                    f"{name} is {per * value:g}, expected a number from {least:g} to {greatest:g}"
                )
        if self.folds < 2:
            raise CalibrationError(f"folds is {self.folds}, expected at least 2")
        if self.plane is not None and not np.linalg.norm(self.plane[:3]) > 0.0:
            raise CalibrationError(f"plane has normal {self.plane[:3]}, expected a direction")

    @property
    def surface(self) -> bool:
        """True if the interface is the water surface."""
        return self.window is None

    @property
    def layers(self) -> tuple[Layer, ...]:
        """Solid layers between camera and water, as expected by `Interface`."""
        return () if self.window is None else (self.window,)

    @property
    def stated_depth(self) -> bool:
        """True if the plane's position was measured."""
        return any(x is not None for x in (self.water_height, self.water_depth, self.plane))

    @property
    def unit_plane(self) -> tuple[Array, float]:
        """Unit normal n, (3,), and b [m] of the surveyed plane."""
        assert self.plane is not None
        length = float(np.linalg.norm(self.plane[:3]))
        return np.array(self.plane[:3]) / length, self.plane[3] / length


def active_names(settings: PoolFitSettings, extra: tuple[str, ...] = ()) -> NDArray[np.bool_]:
    """Return a mask of the `NAMES` that are fitted, (18,)."""
    held = {
        "index": settings.index_sigma <= 0.0,
        "tilt": settings.tilt_sigma is not None and settings.tilt_sigma <= 0.0,
        "height": settings.stated_depth and settings.place_sigma <= 0.0,
    }
    groups = {*(settings.fit or ("pose", "height", "tilt", "index")), *extra}
    groups |= {name for name in ("focal", "center") if getattr(settings, f"{name}_sigma") > 0.0}
    return mask_of(name for group in groups if not held.get(group) for name in FITTED[group])


def lens_std(settings: PoolFitSettings, width: int) -> tuple[float, ...]:
    """Return the prior standard deviations of `LENS_NAMES`, in their units."""
    focal, x, y, *distortion = LENS_STD
    center = settings.center_sigma
    across = (center, center) if center > 0.0 else (x * width, y * width)
    return (settings.focal_sigma or focal, *across, *distortion)


LOST = 500.0
"""Residual that is assigned to a point that the model cannot project [px]."""

NEARER = 0.1
"""Fraction of the plane's distance from a point or the camera that must remain after one step [-]."""

MAX_BOUNDS = 60
"""Greatest number of points, nearest to the plane first, that bound one step."""

Whitening = Callable[[Array], Array]


@dataclass(frozen=True, kw_only=True)
class Prior:
    """Gaussian prior; the standard deviation of an unknown quantity is infinite."""

    normal: Array | None = None
    """Normal towards the camera, pool frame, unit, (3,)."""
    tilt_std: float = np.inf
    """Standard deviation of the tilt about each axis [rad]."""
    depth: float = np.nan
    """Distance of the plane from the reference point [m]."""
    depth_std: float = np.inf
    """Standard deviation of `depth` [m]."""
    start: PoolModel
    """Model with the index and lens to which `index_std` and `lens_std` refer."""
    index_std: float = np.inf
    """Standard deviation of the refractive index [-]."""
    lens_std: tuple[float, ...] = (np.inf,) * 8
    """Standard deviations of log focal, centre [px] and distortion."""

    def rows(self, model: PoolModel) -> tuple[Array, Array]:
        """Return the residuals of the priors (M,), each divided by its standard deviation, and their
        derivatives (M, 18).

        Derivatives are per unit of each parameter.
        """
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


SURFACE_TILT, PLANE_TILT = np.radians(0.2), np.radians(0.5)

ANYWHERE = 0.5
"""Prior mean and standard deviation of an unmeasured water depth, relative to the camera's distance: so weak
that it matters only if the pixels contain no information."""


def stated_plane(model: PoolModel, settings: PoolFitSettings) -> tuple[Array | None, float]:
    """Return the measured normal towards the camera, pool frame (3,), and the distance of the plane from the
    reference point [m]; None and NaN if unknown."""
    towards, depth = model.camera.position - model.reference, settings.water_depth
    if settings.plane is not None:
        normal, offset = settings.unit_plane
        sign = 1.0 if normal @ towards > 0.0 else -1.0
        return sign * normal, float(-sign * (normal @ model.reference + offset))
    if not settings.surface:
        return None, np.nan
    normal = UP if towards[2] > 0.0 else -UP
    if settings.water_height is not None:
        return normal, float(normal[2] * (settings.water_height - model.reference[2]))
    return normal, np.nan if depth is None else depth


def prior_of(model: PoolModel, start: PoolModel, settings: PoolFitSettings, stds: tuple[float, ...]) -> Prior:
    """Return the prior of plane, index and lens.

    Args:
        model: Model whose camera is on the plane's near side.
        start: Model with the given index and lens.
        settings: Options.
        stds: Standard deviations of the lens's parameters in their units, in the order of `LENS_NAMES`.
    """
    normal, depth = stated_plane(model, settings)
    tilt = settings.tilt_sigma
    if tilt is None:
        tilt = float(
            PLANE_TILT if settings.plane is not None else SURFACE_TILT if settings.surface else np.inf
        )
    depth_std = max(settings.place_sigma, 1e-6)
    if not np.isfinite(depth):
        apparent = float(np.linalg.norm(start.camera.position - start.reference))
        depth, depth_std = ANYWHERE * apparent, ANYWHERE * apparent
    return Prior(
        normal=normal,
        tilt_std=tilt if tilt > 0.0 else np.inf,
        depth=depth,
        depth_std=depth_std,
        start=start,
        index_std=settings.index_sigma if settings.index_sigma > 0.0 else np.inf,
        lens_std=stds,
    )


class PoolSolution(NamedTuple):
    """Result of the minimization."""

    model: PoolModel
    cost: float
    """Half the sum of squares of whitened residuals and priors [-]."""


def residuals(model: PoolModel, observed: Observations) -> tuple[Array, NDArray[np.bool_]]:
    """Return measured minus predicted pixels (N, 2) and a mask of predicted ones (N,); others have residual `LOST`."""
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
) -> PoolSolution:
    """Minimise |whiten(measured - predicted)|² plus the priors.

    Args:
        start: Initial model.
        observed: The rows.
        whiten: Function that converts residuals (N, 2) and derivatives (N, 2, P) to independent rows of unit
            variance.
        active: Mask of the `NAMES` to estimate, (18,).
        prior: Prior of all parameters.
        iterations: Greatest number of iterations.
        tolerance: Relative change of the cost at which the search ends [-].
    """
    free = np.flatnonzero(active)

    def linearise(model: PoolModel) -> Step[PoolModel]:
        N, g = normal_equations(model, observed, whiten, free, prior)
        bounds, (H, scale) = _bounds(model, observed, free), unit_diagonal(N)
        b = g / scale

        def stepped(damping: float) -> tuple[PoolModel | None, float]:
            step, x = np.zeros(len(NAMES)), _sliding(H + damping * np.eye(len(free)), b, scale, bounds)
            step[free] = x / scale
            return _stepped(model, step, observed, 8 in free), float(x @ (b - 0.5 * H @ x))

        return stepped

    def cost(model: PoolModel) -> float:
        if model.refractive and (model.clearance <= 0.0 or not 1.0 < model.interface.index_far < 3.0):
            return np.inf
        e, r = whiten(residuals(model, observed)[0]), prior.rows(model)[0]
        return 0.5 * float(e @ e + r @ r)

    end = descend(
        start, cost, linearise, steps=iterations, tolerance=1e-12 * tolerance, relative_tolerance=tolerance
    )
    return PoolSolution(end.state, end.cost)


def normal_equations(
    model: PoolModel, observed: Observations, whiten: Whitening, free: NDArray[np.intp], prior: Prior
) -> tuple[Array, Array]:
    """Return information matrix (P, P) and gradient (P,) at a model by the parameters `free`, including the priors."""
    r, ok = residuals(model, observed)
    J = model.jacobians(observed.points, observed.dry)[0][..., free]
    J = np.where((ok & np.isfinite(J).all(axis=(1, 2)))[:, None, None], J, 0.0)
    A, e = whiten(J), whiten(r)
    r_prior, J_prior = prior.rows(model)
    J_prior = J_prior[:, free]
    return A.T @ A + J_prior.T @ J_prior, A.T @ e - J_prior.T @ r_prior


def clearances(model: PoolModel, points: Array) -> Array:
    """Return the distances of points from the far side of plane and window, positive in the water, (N,) [m]."""
    return model.depth - (points - model.reference) @ model.interface.normal - model.interface.thickness


def _bounds(model: PoolModel, observed: Observations, free: NDArray[np.intp]) -> tuple[Array, Array]:
    """Return the clearances of the points in the water and of the camera (M,), and their derivatives by the
    parameters (M, P)."""
    if not model.refractive:
        return np.zeros(0), np.zeros((0, len(free)))
    wet, n = observed.points[~observed.dry], model.interface.normal
    distance = clearances(model, wet)
    wet, distance = wet[distance > 0.0], distance[distance > 0.0]
    rows = np.zeros((len(wet) + 1, len(NAMES)))
    rows[:-1, 6:8] = -(wet - model.reference) @ model.tangents.T
    rows[:-1, 8] = 1.0
    rows[-1, :3] = n
    rows[-1, 6:8] = model.tangents @ (model.camera.position - model.reference)
    rows[-1, 8] = -1.0
    return np.append(distance, model.clearance), rows[:, free]


def _sliding(H: Array, b: Array, scale: Array, bounds: tuple[Array, Array]) -> Array:
    """Return the minimum of x H x / 2 - b x among steps that keep at least a tenth of every clearance.

    It is a least-distance problem, solved by non-negative least squares (Lawson and Hanson, Solving Least Squares
    Problems, ch. 23).
    """
    x = np.linalg.solve(H, b)
    distance, rows = bounds
    clearance = distance + (rows / scale) @ x
    if np.all(clearance >= NEARER * distance):
        return x
    near = np.argsort(clearance / np.maximum(distance, 1e-300))[:MAX_BOUNDS]
    values, vectors = np.linalg.eigh(H)
    root = vectors / np.sqrt(np.maximum(values, 1e-14))
    G = (rows[near] / scale) @ root
    length = np.maximum(np.linalg.norm(G, axis=1), 1e-300)
    h = (NEARER * distance[near] - clearance[near]) / length
    size = float(np.abs(h).max())
    E = np.concatenate([(G / length[:, None]).T, h[None] / size])
    try:
        weight, off = nnls(E, np.append(np.zeros(len(x)), 1.0))
    except RuntimeError:
        return x
    r = E @ weight - np.append(np.zeros(len(x)), 1.0)
    return x if off < 1e-9 else np.asarray(x - root @ r[:-1] / r[-1] * size)


def _stepped(model: PoolModel, step: Array, observed: Observations, movable: bool) -> PoolModel | None:
    """Return the model after a step, or None if the step is far too large.

    If a rotation of the plane reduces a clearance beyond first order, its depth is corrected, if it is free.
    """
    if not np.isfinite(step).all() or np.abs(step[3:8]).max() > 1.0 or abs(step[10]) > 0.5:
        return None
    try:
        trial = model.moved(step)
        if model.refractive and movable:
            before = clearances(model, observed.points)
            held = (before > 0.0) & ~observed.dry
            short = 0.5 * NEARER * before - clearances(trial, observed.points)
            if held.any() and (back := float(short[held].max())) > 0.0:
                trial = model.moved(step + back * (np.arange(len(NAMES)) == 8))
        return trial
    except ValueError:
        return None
