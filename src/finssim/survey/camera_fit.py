"""Estimation of a lens and the poses of all boards, from the pixels of their corners."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.core.least_squares import block_of, rms
from finssim.core.optics import COEFFICIENTS, Lens
from finssim.core.rotations import quat_from_rotvec, quat_to_matrix, skew
from finssim.identification.fit import Correlation, Estimate
from finssim.identification.uncertainty import (
    Covariance,
    Evidence,
    arrow_evidence,
    correlation,
    intervals,
    trial_covariance,
)
from finssim.localization.poses.refinement import plane_pose, refine_pose, through_lens
from finssim.survey.boards import BoardView
from finssim.survey.pose import Pose
from finssim.trials.findings import CalibrationError, Finding, finding

__all__ = [
    "CameraFit",
    "FittedView",
    "adjust",
    "calibrate_camera",
    "check_model",
    "evidence",
    "lens_names",
    "lens_vector",
]

Array = NDArray[np.float64]

FOCAL_SHARES = (1.0 / math.pi, 0.6, 1.2)
"""Initial focal lengths of a fisheye fit, relative to the width of the image [-]."""

FEWEST_VIEWS = 4

NO_LIMIT = 1e9
"""Huber limit for corners of a held-out board, so large that none is treated as an outlier [px]."""

STRAY = 6.0
"""Ratio of a corner's residual to the median of its view above which it is excluded as a false detection [-]."""

OUTLIER = 2.0
"""Ratio of a view's residual to the median of all views above which it may be excluded, if it also exceeds
`SPREAD` [-]."""

SPREAD = 4.0
"""Limit of a view's residual in robust standard deviations of the logarithm of the views' residuals [-]."""

NONSENSE = 0.003
"""Median residual, relative to the width of the image, above which the calibration is refused [-]."""

MAX_EXCLUDED = 0.25
FOLDS = 8

UNSURE_FOCAL = 0.02
"""Relative half width of its 95 % interval above which a focal length is not identifiable [-]."""

UNSURE_CENTRE = 0.02
"""Half width of its 95 % interval, relative to the image width, above which a principal point is not
identifiable [-]."""

COLUMNS, ROWS = 12, 9
"""Number of points along u and v at which the uncertainty of a pixel is computed."""

TWO_SIGMA_PLANE = 5.991
"""95 % quantile of the chi-squared distribution with two degrees of freedom."""

BORDER = 0.10
"""Fraction of the picture's width or height without corners above which the border is reported [-]."""

FLAT, TILTED = math.radians(10.0), math.radians(20.0)
"""Tilts of a board below which it contains almost no, or little, information on the focal length [rad]."""

FEW_VIEWS = 10
LARGE_ERROR = 1.0
"""Uncertainty anywhere in the picture above which it is reported [px]."""


@dataclass(frozen=True, kw_only=True)
class Bundle:
    """Lens and one pose per view."""

    lens: Lens
    poses: tuple[Pose, ...]
    residuals: tuple[Array, ...]
    """Residuals, measured minus predicted, per view (n, 2) [px]."""

    @property
    def sigma(self) -> float:
        """Robust standard deviation of one coordinate of a corner [px]."""
        return max(1.4826 * float(np.median(np.abs(np.concatenate(self.residuals)))), 1e-9)

    @property
    def rms(self) -> Array:
        """Root mean square distance of corners, per view [px]."""
        return np.array([rms(r) for r in self.residuals])


def lens_names(model: str) -> tuple[str, ...]:
    """Return the names of a lens's parameters, in the order of `Lens.parameter_jacobian`."""
    return ("fx", "fy", "cx", "cy", *COEFFICIENTS[model])


def lens_vector(lens: Lens) -> Array:
    """Return the lens's parameters in the order of `lens_names`. Focal lengths and centre are in pixels."""
    return np.array([lens.fx, lens.fy, lens.cx, lens.cy, *lens.distortion])


def adjust(views: Sequence[BoardView], model: str) -> Bundle:
    """Estimate the lens and the poses by least squares over all corners, with OpenCV.

    Raises:
        CalibrationError: OpenCV's calibration fails.
    """
    import cv2

    size = (views[0].width, views[0].height)
    solve, threads = _fisheye if model == "fisheye" else _perspective, cv2.getNumThreads()
    try:
        cv2.setNumThreads(1)  # with more threads, the order of summation varies
        K, distortion, turns, shifts = solve(views, size, model)
    except cv2.error as error:
        raise CalibrationError(
            f"no {model} lens explains the pictures: is the board as stated, and flat? ({error.err})"
        ) from None
    finally:
        cv2.setNumThreads(threads)
    fx, _, cx, _, fy, cy = map(float, np.ravel(K)[:6])
    lens = Lens(*size, fx, fy, cx, cy, model, tuple(np.ravel(distortion)[: len(COEFFICIENTS[model])]))
    poses = tuple(
        Pose(quat_to_matrix(quat_from_rotvec(np.ravel(turn))), np.ravel(shift))
        for turn, shift in zip(turns, shifts, strict=True)
    )
    residuals = tuple(_residual(lens, pose, view) for pose, view in zip(poses, views, strict=True))
    return Bundle(lens=lens, poses=poses, residuals=residuals)


def _perspective(views: Sequence[BoardView], size: tuple[int, int], model: str) -> tuple[Any, ...]:
    import cv2

    points, pixels = ([np.asarray(getattr(v, n), np.float32) for v in views] for n in ("points", "pixels"))
    flags = cv2.CALIB_RATIONAL_MODEL if model == "rational" else 0
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-12)
    return tuple(cv2.calibrateCamera(points, pixels, size, None, None, flags=flags, criteria=stop)[1:])


def _fisheye(views: Sequence[BoardView], size: tuple[int, int], model: str) -> tuple[Any, ...]:
    import cv2

    points, pixels = ([np.asarray(getattr(v, n), float)[None] for v in views] for n in ("points", "pixels"))
    # Location of the flags in OpenCV 4.
    names = cv2 if hasattr(cv2, "CALIB_RECOMPUTE_EXTRINSIC") else cv2.fisheye
    flags = names.CALIB_RECOMPUTE_EXTRINSIC | names.CALIB_FIX_SKEW | names.CALIB_USE_INTRINSIC_GUESS
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-12)
    ends, refusal = [], None
    for share in FOCAL_SHARES:
        f = share * size[0]
        K = np.array([[f, 0.0, 0.5 * (size[0] - 1)], [0.0, f, 0.5 * (size[1] - 1)], [0.0, 0.0, 1.0]])
        try:
            ends.append(
                cv2.fisheye.calibrate(points, pixels, size, K, np.zeros(4), flags=flags, criteria=stop)
            )
        except cv2.error as error:
            refusal = error
    if refusal is not None and not ends:
        raise refusal
    return tuple(min(ends, key=lambda end: end[0])[1:])


def _residual(lens: Lens, pose: Pose, view: BoardView) -> Array:
    """Return measured minus predicted pixels, NaN where the lens cannot project, (n, 2)."""
    return np.asarray(view.pixels - lens.project(pose.at(view.points))[0])


def board_pose(lens: Lens, view: BoardView) -> Pose | None:
    """Return the pose of a board with least squared residuals; None if there is none in front of the camera."""
    rays, ok = lens.rays(view.pixels)
    start = plane_pose(rays[ok], view.points[ok, :2]) if ok.sum() >= 4 else None
    if start is None:
        return None
    pose = refine_pose(through_lens(lens), view.points, view.pixels, start[1], start[0], NO_LIMIT)
    return None if pose is None else Pose(pose.rotation, pose.position)


def evidence(bundle: Bundle, views: Sequence[BoardView]) -> Evidence:
    """Return the information of each view about the lens, its pose eliminated, for intervals that treat a
    view as one sample."""
    blocks = []
    for view, pose, residual in zip(views, bundle.poses, bundle.residuals, strict=True):
        points_c = pose.at(view.points)
        J = bundle.lens.project_jacobian(points_c)
        pose_jacobian = np.concatenate([-J @ skew(points_c - pose.t), J], axis=-1).reshape(-1, 6)
        shared = bundle.lens.parameter_jacobian(points_c).reshape(len(pose_jacobian), -1)
        blocks.append(block_of(*(x / bundle.sigma for x in (shared, pose_jacobian, residual.ravel()))))
    return arrow_evidence(blocks, lens_names(bundle.lens.model), "views")


@dataclass(frozen=True, kw_only=True)
class FittedView:
    """One view after the fit."""

    name: str
    pixels: Array
    """Pixels of the corners, (n, 2)."""
    residuals: Array
    """Residuals, measured minus predicted [px], (n, 2)."""
    pose: Pose
    left_out: str = ""
    """Reason why the view was not used; empty if it was."""

    @property
    def rms(self) -> float:
        """Root mean square distance of its corners [px]."""
        return rms(self.residuals)

    @property
    def tilt(self) -> float:
        """Angle between the board's normal and the optical axis [rad], 0 to pi/2."""
        return float(np.arccos(np.clip(abs(self.pose.R[2, 2]), 0.0, 1.0)))


@dataclass(frozen=True, kw_only=True)
class CameraFit:
    """Calibrated lens."""

    lens: Lens
    estimates: dict[str, Estimate]
    """Estimates of fx, fy, cx, cy and the distortion, by name."""
    correlation: Correlation
    views: tuple[FittedView, ...]
    """Every view in which the board was detected, in the given order."""
    rms: float
    """Root mean square distance of corners over the views used [px]."""
    held_out_rms: float
    """Residual of held-out views, of which only the pose is fitted; NaN if there are too few views [px]."""
    error95: tuple[float, float]
    """Largest radius of a pixel's 95 % uncertainty circle, where corners were detected and anywhere in the
    picture [px]."""
    covariance: Covariance
    """Covariance of the lens's parameters, in the order of `lens_names`."""
    findings: tuple[Finding, ...]
    settings: dict[str, Any] = field(default_factory=dict)

    @property
    def used(self) -> tuple[FittedView, ...]:
        """Views that the lens was fitted to."""
        return tuple(view for view in self.views if not view.left_out)


def calibrate_camera(views: Sequence[BoardView], *, model: str = "plumb_bob", seed: int = 0) -> CameraFit:
    """Fit a lens to views of a board.

    Args:
        views: Views from `see_board`; all of one size.
        model: Lens model: plumb_bob, rational or fisheye.
        seed: Seed of the folds for the held-out error.

    Raises:
        CalibrationError: The model is unknown, there are fewer than four views, the pictures have several
            sizes, or no lens fits the corners.
    """
    check_model(model)
    _check(views)
    bundle = adjust(views, model)
    _refuse_nonsense(bundle, views)
    used, bundle = _without_outliers(views, bundle)
    some = [_without_strays(view, bundle.residuals[i]) for i, view in enumerate(used)]
    if sum(len(view.pixels) for view in some) < sum(len(view.pixels) for view in used):
        bundle = adjust(some, model)
    covariance = trial_covariance(evidence(bundle, some))
    every = _views(views, {view.name: i for i, view in enumerate(used)}, bundle)
    pixels = np.concatenate([view.pixels for view in some])
    error95 = tuple(
        float(np.nanmax(pixel_error(bundle.lens, at, pixels, covariance)))
        for at in (pixels, picture_grid(bundle.lens))
    )
    half = intervals(np.zeros(len(covariance.names)), covariance)[:, 1]
    estimates = _estimates(bundle.lens, half)
    return CameraFit(
        lens=bundle.lens,
        estimates=estimates,
        correlation=correlation(covariance.names, covariance.local),
        views=every,
        rms=rms(np.concatenate(bundle.residuals)),
        held_out_rms=_held_out(some, model, seed),
        error95=error95,
        covariance=covariance,
        findings=camera_findings(bundle.lens, [v for v in every if not v.left_out], estimates, error95),
        settings={"model": model, "seed": seed},
    )


def check_model(model: str) -> None:
    """Refuse an unknown lens model with a CalibrationError."""
    if model not in COEFFICIENTS:
        raise CalibrationError(f"unknown lens model '{model}'; available: {', '.join(COEFFICIENTS)}")


def _check(views: Sequence[BoardView]) -> None:
    if len(views) < FEWEST_VIEWS:
        raise CalibrationError(
            f"{len(views)} pictures show the board, expected at least {FEWEST_VIEWS}: take 15 to 30, the board tilted "
            "by 20 to 50 degrees each way and in every corner of the picture"
        )
    sizes: dict[tuple[int, int], list[str]] = {}
    for view in views:
        sizes.setdefault((view.width, view.height), []).append(view.name)
    if len(sizes) > 1:
        usual = max(sizes, key=lambda size: len(sizes[size]))
        others = [f"{name} ({w}x{h})" for (w, h), names in sizes.items() if (w, h) != usual for name in names]
        raise CalibrationError(
            f"pictures of several sizes: most are {usual[0]}x{usual[1]}, but not {', '.join(others[:6])}: "
            "give pictures of one camera in one mode"
        )


def _outliers(rms: Array) -> NDArray[np.bool_]:
    log = np.log(np.maximum(rms, 1e-12))
    middle = np.median(log)
    spread = max(1.4826 * float(np.median(np.abs(log - middle))), 0.1)
    return np.asarray((log > middle + SPREAD * spread) & (log > middle + math.log(OUTLIER)))


def _refuse_nonsense(bundle: Bundle, views: Sequence[BoardView]) -> None:
    usual, limit = float(np.median(bundle.rms)), max(1.0, NONSENSE * views[0].width)
    if not usual <= limit:
        raise CalibrationError(
            f"corner residuals are {usual:.1f} px in the median image, expected below {limit:.1f} px: no "
            "lens fits them: check the count of the board's corners, that it is flat, and that the "
            "model suits the lens"
        )


def _without_outliers(views: Sequence[BoardView], bundle: Bundle) -> tuple[list[BoardView], Bundle]:
    """Exclude the worst view and refit, as long as it is an outlier; return the other views and their fit."""
    used = list(views)
    for _ in range(min(int(MAX_EXCLUDED * len(views)), len(views) - FEWEST_VIEWS)):
        if not _outliers(bundle.rms).any():
            break
        del used[int(np.argmax(bundle.rms))]
        bundle = adjust(used, bundle.lens.model)
    return used, bundle


def _without_strays(view: BoardView, residual: Array) -> BoardView:
    """Return the view without outlying corners."""
    size = np.linalg.norm(residual, axis=-1)
    keep = size <= STRAY * max(float(np.median(size)), 1e-6)
    return replace(view, pixels=view.pixels[keep], points=view.points[keep])


def _held_out(views: Sequence[BoardView], model: str, seed: int) -> float:
    """Return the residual of held-out views: for each fold, the lens is fitted to the others and only the
    poses to its views."""
    folds = min(FOLDS, len(views))
    if len(views) - math.ceil(len(views) / folds) < FEWEST_VIEWS - 1:
        return math.nan
    fold = np.random.default_rng(seed).permutation(len(views)) % folds
    residuals = []
    for k in range(folds):
        lens = adjust([view for view, part in zip(views, fold, strict=True) if part != k], model).lens
        for view in (view for view, part in zip(views, fold, strict=True) if part == k):
            if (pose := board_pose(lens, view)) is not None:
                residuals.append(_residual(lens, pose, view))
    return rms(np.concatenate(residuals)) if residuals else math.nan


def _views(views: Sequence[BoardView], used: Mapping[str, int], bundle: Bundle) -> tuple[FittedView, ...]:
    median, every = float(np.median(bundle.rms)), []
    for view in views:
        pose = bundle.poses[used[view.name]] if view.name in used else board_pose(bundle.lens, view)
        if pose is None:
            continue
        residual = _residual(bundle.lens, pose, view)
        reason = f"its corners miss by {rms(residual):.2f} px, those of the others by {median:.2f} px"
        exclusion = "" if view.name in used else reason
        every.append(
            FittedView(name=view.name, pixels=view.pixels, residuals=residual, pose=pose, left_out=exclusion)
        )
    return tuple(every)


def _estimates(lens: Lens, half: Array) -> dict[str, Estimate]:
    """Return estimates by name, from half widths of the 95 % intervals in the order of `lens_names`."""
    estimates = {}
    for name, value, width in zip(lens_names(lens.model), lens_vector(lens), half, strict=True):
        unit, limit, note = {
            "f": ("px", UNSURE_FOCAL * value, "not distinguishable from the distance of the board"),
            "c": ("px", UNSURE_CENTRE * lens.width, "not distinguishable from a rotation of the board"),
        }.get(name[0], ("-", math.inf, "not determined"))
        estimate = Estimate.within(name, value, width, unit, width < limit, note)
        if unit == "-" and abs(value) < width < limit:
            estimate = replace(estimate, note="not distinguishable from 0")
        estimates[name] = estimate
    return estimates


# Uncertainty of a calibrated lens over the picture, and gaps in the pictures' coverage.


def picture_grid(lens: Lens) -> Array:
    """Return the centres of `COLUMNS` by `ROWS` cells of the picture [px], (rows, columns, 2)."""
    u, v = (size * (np.arange(n) + 0.5) / n - 0.5 for size, n in ((lens.width, COLUMNS), (lens.height, ROWS)))
    return np.stack(np.meshgrid(u, v), axis=-1)


def pixel_error(lens: Lens, at: Array, corners: Array, covariance: Covariance) -> Array:
    """Return the radius of the 95 % uncertainty circle of pixels of known direction [px], (...); NaN outside
    the lens's range.

    d pixel = A d lens + B turn, where the rotation `turn` of the camera minimizes the error at the corners,
    since any pose estimate would absorb it.

    Args:
        lens: The lens.
        at: Pixels, (..., 2).
        corners: Pixels of the corners that were used, (n, 2).
        covariance: Covariance of the lens's parameters, in the order of `Lens.parameter_jacobian`.
    """

    def derivatives(pixels: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        rays, ok = lens.rays(pixels)
        safe = np.where(ok[..., None], rays, np.array([0.0, 0.0, 1.0]))
        return lens.parameter_jacobian(safe), -lens.project_jacobian(safe) @ skew(safe), ok

    A, B, ok = derivatives(corners)
    turn = -np.linalg.pinv(B[ok].reshape(-1, 3)) @ A[ok].reshape(-1, A.shape[-1])
    A, B, ok = derivatives(at)
    J = A + B @ turn
    if not np.isfinite(covariance.local).all():
        return np.full(at.shape[:-1], np.nan)
    # The information matrix gives the shape, the scatter of the views the scale: the scatter alone is rank deficient.
    ratio = covariance.std**2 / np.maximum(np.diagonal(covariance.local), 1e-300)
    S = max(float(np.mean(ratio)), 1.0) * J @ covariance.local @ np.swapaxes(J, -1, -2)
    radius = np.sqrt(TWO_SIGMA_PLANE * np.maximum(np.linalg.eigvalsh(S)[..., -1], 0.0))
    return np.asarray(np.where(ok, radius, np.nan))


def camera_findings(
    lens: Lens, views: Sequence[FittedView], estimates: Mapping[str, Estimate], error95: tuple[float, float]
) -> tuple[Finding, ...]:
    """Return findings on coverage, tilt and undetermined parameters, with what to photograph; none if all is well.

    The radii `error95` are in pixels.
    """
    tilts, findings = np.array([view.tilt for view in views]), []
    tilted = int(np.sum(tilts > TILTED))
    if tilts.max() < FLAT:
        findings.append(finding("views_flat", tilt=math.degrees(tilts.max())))
    elif tilted < 3:
        findings.append(finding("few_tilted", views=tilted))
    empty = {side: share for side, share in empty_edges(lens, views).items() if share > BORDER}
    if empty:
        shares = tuple(f"{100.0 * share:.0f} % of the {side} edge" for side, share in empty.items())
        findings.append(finding("edges_empty", sides=tuple(empty), shares=shares))
    if len(views) < FEW_VIEWS:
        findings.append(finding("few_views", views=len(views)))
    unsure = [e for e in estimates.values() if not e.identifiable]
    if unsure:
        names = tuple(e.name for e in unsure)
        findings.append(finding("lens_undetermined", parameters=names, reason=unsure[0].note))
    nothing = [e.name for e in estimates.values() if e.identifiable and e.note]
    if lens.model == "rational" and len(nothing) >= 3:
        findings.append(finding("coefficients_zero", parameters=tuple(nothing)))
    if np.isfinite(error95[1]) and error95[1] >= LARGE_ERROR:
        findings.append(finding("pixels_uncertain", inside=error95[0], anywhere=error95[1]))
    return tuple(findings)


def empty_edges(lens: Lens, views: Sequence[FittedView]) -> dict[str, float]:
    """Return the border without corners at left, right, top and bottom, relative to the picture's width or
    height [-]."""
    pixels, size = np.concatenate([view.pixels for view in views]), np.array([lens.width, lens.height])
    low, high = (pixels.min(axis=0) + 0.5) / size, (size - 0.5 - pixels.max(axis=0)) / size
    shares = zip(("left", "right", "top", "bottom"), (low[0], high[0], low[1], high[1]), strict=True)
    return {side: float(share) for side, share in shares}
