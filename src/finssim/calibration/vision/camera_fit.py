"""A camera's lens from pictures of a board: estimates, intervals, what the pictures do and do not cover."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.degeneracy import correlation
from finssim.calibration.errors import CalibrationError
from finssim.calibration.findings import Finding, finding
from finssim.calibration.fit import Correlation, Estimate
from finssim.calibration.uncertainty import Covariance, Evidence, intervals, trial_covariance
from finssim.calibration.vision.boards import BoardView
from finssim.calibration.vision.least_squares import (
    Block,
    Pose,
    arrow_evidence,
    arrow_step,
    block_of,
    descent,
    huber_cost,
    huber_weight,
    linear_map,
    pose_of_plane,
)
from finssim.geometry.optics import Lens, OpticsError
from finssim.geometry.rotations import skew

__all__ = ["COLUMNS", "MODELS", "ROWS", "CameraFit", "calibrate_camera"]

Array = NDArray[np.float64]

DISTORTION_NAMES = {
    "plumb_bob": ("k1", "k2", "p1", "p2", "k3"),
    "rational": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "fisheye": ("k1", "k2", "k3", "k4"),
}

MODELS = tuple(DISTORTION_NAMES)

FOCAL_SHARES = np.geomspace(0.2, 4.0, 25)
"""Focal lengths that are tried at the start, in widths of the image."""

LEAST_FOCAL = 0.1
"""Widths of the image below which a focal length makes no sense: level boards would let it shrink for ever."""

HUBER = 2.0
"""Residuals beyond this many standard deviations count linearly."""

STEPS, POSE_STEPS, RESCALINGS = 100, 40, 6
"""Most steps of a lens and of a pose, and how often the standard deviation is made anew."""

STEADY = 0.01
"""Relative change of that standard deviation with which it is good: it only decides which corners weigh less."""

FEWEST_VIEWS = 4

OUTLIER = 2.0
"""Times the median residual of all views, at least, for a view to be left out; and beyond their usual spread."""

SPREAD = 4.0
"""Robust standard deviations of the logarithm of the views' residuals."""

NONSENSE = 0.003
"""Residual of the usual picture, in widths of the image, with which nothing can be right."""

MOST_LEFT_OUT = 0.25
FOLDS = 8

UNSURE_FOCAL = 0.02
"""Half width of its interval, relative, beyond which a focal length does not count as identified."""

UNSURE_CENTRE = 0.02
"""The same for the principal point, in widths of the image."""

COLUMNS, ROWS = 12, 9
"""Cells of the picture in which corners are counted."""

TWO_SIGMA_PLANE = 5.991
"""95 % point of chi-squared with two degrees of freedom."""

BORDER = 0.10
"""Empty share of the picture's width or height that is spoken of."""

FLAT, TILTED = math.radians(10.0), math.radians(20.0)
"""Tilts below which a board tells next to nothing of the focal length, and little."""

FEW_VIEWS = 10
LARGE_ERROR = 1.0
"""Uncertainty somewhere in the picture that is spoken of [px]."""


# Where a board stands before a camera: a closed form from viewing rays, then least squares on the pixels.


def pose_from_rays(rays_c: Array, points_b: Array) -> Pose | None:
    """Pose of a board in the optical frame (x right, y down, z along the view) from the rays its points are seen on.

    Args:
        rays_c: Optical frame, any length, (n, 3), n >= 4; more than 90 degrees off the axis is no trouble.
        points_b: On z = 0 [m], (n, 3).

    Returns:
        The pose, or None if the points lie on one line.
    """
    centre = points_b[:, :2].mean(axis=0)
    size = float(np.abs(points_b[:, :2] - centre).max())
    H = linear_map(np.column_stack([(points_b[:, :2] - centre) / size, np.ones(len(points_b))]), rays_c)
    if H is None:
        return None
    R, t = pose_of_plane(H)
    return Pose(R, t * size - R[:, :2] @ centre)


def pose_residuals(lens: Lens, pose: Pose, points_b: Array, pixels: Array) -> tuple[Array, Array]:
    """Measured less predicted pixels (n, 2), NaN where the lens cannot, and the points in the optical frame (n, 3)."""
    points_c = pose.at(points_b)
    predicted, ok = lens.project(points_c)
    return np.where(ok[:, None], pixels - predicted, np.nan), points_c


def pose_jacobian(lens: Lens, pose: Pose, points_c: Array) -> Array:
    """d pixel / d step of `Pose.stepped`, (n, 2, 6)."""
    J = lens.project_jacobian(points_c)
    return np.concatenate([-J @ skew(points_c - pose.t), J], axis=-1)


def board_pose(lens: Lens, points_b: Array, pixels: Array, start: Pose | None = None) -> Pose | None:
    """The pose with least squared pixel residuals.

    Args:
        lens: The lens.
        points_b: On z = 0 [m], (n, 3).
        pixels: Where they are seen, (n, 2).
        start: Where to begin; from the rays if None.

    Returns:
        None if neither the rays nor the start lead to a pose before the camera.
    """
    if start is None:
        rays, ok = lens.rays(pixels)
        start = pose_from_rays(rays[ok], points_b[ok]) if ok.sum() >= 4 else None
        if start is None:
            return None

    def cost(pose: Pose) -> float:
        value = float(np.sum(pose_residuals(lens, pose, points_b, pixels)[0] ** 2))
        return value if math.isfinite(value) else math.inf

    def steps_from(pose: Pose) -> Callable[[float], Pose]:
        residual, points_c = pose_residuals(lens, pose, points_b, pixels)
        J = pose_jacobian(lens, pose, points_c).reshape(-1, 6)
        N, g = J.T @ J, J.T @ residual.ravel()
        return lambda damping: pose.stepped(np.linalg.solve(N + damping * np.diag(np.diagonal(N)), g))

    if not math.isfinite(cost(start)):
        return None
    *_, (pose, _) = descent(start, cost, steps_from, rounds=POSE_STEPS, tolerance=1e-10)
    return pose


# A lens and the poses of all boards at once, from the pixels of their corners.


@dataclass(frozen=True, kw_only=True)
class Bundle:
    """A lens and one pose per view."""

    lens: Lens
    poses: tuple[Pose, ...]
    residuals: tuple[Array, ...]
    """Measured less predicted, per view (n, 2) [px]."""
    interrupted: bool = False

    @property
    def sigma(self) -> float:
        """Robust standard deviation of one coordinate of a corner [px]."""
        return max(1.4826 * float(np.median(np.abs(np.concatenate(self.residuals)))), 1e-9)

    @property
    def rms(self) -> Array:
        """Root of the mean squared distance of corners, per view [px]."""
        return np.array([_rms(r) for r in self.residuals])


def _rms(residuals: Array) -> float:
    """Root of the mean squared length of vectors (n, 2)."""
    return float(np.sqrt(np.mean(np.sum(residuals**2, axis=-1))))


def lens_names(model: str) -> tuple[str, ...]:
    """Names of a lens's numbers, in the order of `Lens.parameter_jacobian`."""
    return ("fx", "fy", "cx", "cy", *DISTORTION_NAMES[model])


def lens_vector(lens: Lens) -> Array:
    """The lens's numbers in that order."""
    return np.array([lens.fx, lens.fy, lens.cx, lens.cy, *lens.distortion])


def start(views: Sequence[BoardView], model: str) -> Lens:
    """A lens without distortion, its centre in the middle, whose focal length suits the views best.

    Raises:
        CalibrationError: No focal length explains any view.
    """
    width, height = views[0].width, views[0].height
    some = views[:: max(1, len(views) // 8)]
    best, lowest = None, np.inf
    for f in width * FOCAL_SHARES:
        middle, straight = (0.5 * (width - 1), 0.5 * (height - 1)), (0.0,) * len(DISTORTION_NAMES[model])
        lens = Lens(width, height, float(f), float(f), *middle, model, straight)
        misfit = float(np.median([_misfit(lens, view) for view in some]))
        if misfit < lowest:
            best, lowest = lens, misfit
    if best is None:
        raise CalibrationError("no focal length explains the pictures: is the board as stated, and flat?")
    return best


def _misfit(lens: Lens, view: BoardView) -> float:
    rays, ok = lens.rays(view.pixels)
    pose = pose_from_rays(rays, view.points) if ok.all() else None
    if pose is None:
        return math.inf
    rms = _rms(pose_residuals(lens, pose, view.points, view.pixels)[0])
    return rms if math.isfinite(rms) else math.inf


def adjust(views: Sequence[BoardView], lens: Lens, poses: Sequence[Pose] | None = None) -> Bundle:
    """Least squares over lens and poses, corners far from the others weighing less (Huber).

    Without poses it begins from the lens's focal length alone, and frees the centre and the distortion one after the
    other. Ctrl-C ends it with the best until then.

    Raises:
        CalibrationError: A view has no pose before the camera, which is named.
    """
    names = lens_names(lens.model)
    stages = [names] if poses is not None else [("fx", "fy"), ("fx", "fy", "cx", "cy", "k1"), names]
    bundle = _bundle(lens, poses if poses is not None else [_pose(lens, view) for view in views], views)
    assert bundle is not None
    for stage in stages:
        free = np.array([name in stage for name in names])
        for _ in range(RESCALINGS):
            sigma = bundle.sigma
            bundle = _minimise(bundle, views, free)
            if bundle.interrupted:
                return bundle
            if stage != names or abs(bundle.sigma - sigma) < STEADY * sigma:
                break
    return bundle


def _pose(lens: Lens, view: BoardView) -> Pose:
    pose = board_pose(lens, view.points, view.pixels)
    if pose is None:
        raise CalibrationError(
            f"{view.name}: no pose of the board explains its corners: leave the picture out"
        )
    return pose


def _bundle(lens: Lens, poses: Sequence[Pose], views: Sequence[BoardView]) -> Bundle | None:
    """With its residuals; None where the lens cannot see a corner."""
    pairs = zip(poses, views, strict=True)
    residuals = tuple(pose_residuals(lens, pose, view.points, view.pixels)[0] for pose, view in pairs)
    if not all(np.isfinite(r).all() for r in residuals):
        return None
    return Bundle(lens=lens, poses=tuple(poses), residuals=residuals)


def _minimise(bundle: Bundle, views: Sequence[BoardView], free: NDArray[np.bool_]) -> Bundle:
    """Poses are eliminated view by view, the lens is solved for, then the poses; their weights have one scale."""
    sigma = bundle.sigma

    def cost(bundle: Bundle) -> float:
        return huber_cost(np.linalg.norm(np.concatenate(bundle.residuals), axis=-1) / sigma, HUBER)

    def steps_from(bundle: Bundle) -> Callable[[float], Bundle | None]:
        blocks = _blocks(bundle, views, free, sigma)

        def stepped(damping: float) -> Bundle | None:
            step, moves = arrow_step(blocks, damping)
            vector = lens_vector(bundle.lens)
            vector[free] += step
            fx, fy, cx, cy, *distortion = map(float, vector)
            poses = [pose.stepped(move) for pose, move in zip(bundle.poses, moves, strict=True)]
            try:
                lens = replace(bundle.lens, fx=fx, fy=fy, cx=cx, cy=cy, distortion=tuple(distortion))
            except OpticsError:  # a focal length below zero, say
                return None
            if fx < LEAST_FOCAL * lens.width:
                return None
            return _bundle(lens, poses, views)

        return stepped

    try:
        for better, _ in descent(bundle, cost, steps_from, rounds=STEPS, tolerance=1e-9):
            bundle = better
    except KeyboardInterrupt:
        return replace(bundle, interrupted=True)
    return bundle


def _blocks(bundle: Bundle, views: Sequence[BoardView], free: NDArray[np.bool_], sigma: float) -> list[Block]:
    """Weighted normal equations of each view, for the lens and the view's pose."""
    blocks = []
    for view, pose, residual in zip(views, bundle.poses, bundle.residuals, strict=True):
        points_c = pose.at(view.points)
        root = np.sqrt(huber_weight(np.linalg.norm(residual, axis=-1), HUBER * sigma))[:, None, None] / sigma
        A = (root * bundle.lens.parameter_jacobian(points_c)[..., free]).reshape(-1, int(free.sum()))
        B = (root * pose_jacobian(bundle.lens, pose, points_c)).reshape(-1, 6)
        blocks.append(block_of(A, B, (root[..., 0] * residual).ravel()))
    return blocks


def evidence(bundle: Bundle, views: Sequence[BoardView]) -> Evidence:
    """What each view says about the lens once its own pose is taken out, for intervals that treat a view as one."""
    names = lens_names(bundle.lens.model)
    return arrow_evidence(_blocks(bundle, views, np.ones(len(names), bool), bundle.sigma), names, "views")


@dataclass(frozen=True, kw_only=True)
class View:
    """One picture after the fit."""

    name: str
    pixels: Array
    """(n, 2)"""
    residuals: Array
    """Measured less predicted, (n, 2) [px]."""
    pose: Pose
    left_out: str = ""
    """Why it was not used; empty if it was."""

    @property
    def rms(self) -> float:
        """Root of the mean squared distance of its corners [px]."""
        return _rms(self.residuals)

    @property
    def tilt(self) -> float:
        """Angle between the board's normal and the optical axis [rad], 0 to pi/2."""
        return float(np.arccos(np.clip(abs(self.pose.R[2, 2]), 0.0, 1.0)))


@dataclass(frozen=True, kw_only=True)
class CameraFit:
    """A calibrated lens."""

    lens: Lens
    estimates: dict[str, Estimate]
    """fx, fy, cx, cy and the distortion, by name."""
    correlation: Correlation
    views: tuple[View, ...]
    """Every picture in which the board was seen, in the order given."""
    rms: float
    """Root of the mean squared distance of corners over the views used [px]."""
    held_out_rms: float
    """The same for views that the lens was not fitted to, only their pose; NaN if there are too few views [px]."""
    reach: LensReach
    """How well pixels are known over the picture."""
    findings: tuple[Finding, ...]
    settings: dict[str, Any] = field(default_factory=dict)
    interrupted: bool = False

    @property
    def used(self) -> tuple[View, ...]:
        """The views that the lens rests on."""
        return tuple(view for view in self.views if not view.left_out)


def calibrate_camera(
    views: Sequence[BoardView],
    *,
    model: str = "plumb_bob",
    seed: int = 0,
    progress: Callable[[float, str], None] | None = None,
) -> CameraFit:
    """Fit a lens to views of a board.

    Args:
        views: From `finssim.calibration.vision.boards.see_board`; all of one size.
        model: plumb_bob, rational or fisheye.
        seed: Of the split for the held-out error.
        progress: Told the part done, 0 to 1, and a few words.

    Returns:
        The fit. Ctrl-C ends it with the best until then, marked as interrupted.

    Raises:
        CalibrationError: Unknown model, fewer than four views, or pictures of several sizes, which are named.
    """
    told = progress or (lambda part, words: None)
    _check(views, model)
    told(0.0, "focal length")
    bundle = adjust(views, start(views, model))
    _refuse_nonsense(bundle, views)
    told(0.4, "outliers")
    used, bundle = _without_outliers(views, bundle)
    some = [view for view, keep in zip(views, used, strict=True) if keep]
    told(0.6, "held-out views")
    held_out = math.nan if bundle.interrupted else _held_out(some, bundle, seed)
    told(0.95, "intervals")
    covariance = trial_covariance(evidence(bundle, some))
    every = _views(views, used, bundle)
    reach = lens_reach(bundle.lens, np.concatenate([view.pixels for view in some]), covariance)
    half = intervals(np.zeros(len(covariance.names)), covariance)[:, 1]
    estimates = _estimates(bundle.lens, half)
    return CameraFit(
        lens=bundle.lens,
        estimates=estimates,
        correlation=correlation(covariance.names, covariance.local),
        views=every,
        rms=_rms(np.concatenate(bundle.residuals)),
        held_out_rms=held_out,
        reach=reach,
        findings=camera_findings(bundle.lens, [v for v in every if not v.left_out], estimates, reach),
        settings={"model": model, "seed": seed},
        interrupted=bundle.interrupted,
    )


def _check(views: Sequence[BoardView], model: str) -> None:
    if model not in MODELS:
        raise CalibrationError(f"unknown lens model '{model}'; available: {', '.join(MODELS)}")
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


def _refuse_nonsense(bundle: Bundle, views: Sequence[BoardView]) -> None:
    usual, limit = float(np.median(bundle.rms)), max(1.0, NONSENSE * views[0].width)
    if usual > limit and not bundle.interrupted:
        raise CalibrationError(
            f"corners miss their places by {usual:.1f} px in the usual picture, expected below {limit:.1f} px: no lens "
            "explains them: count the board's corners again, and see that it is flat and that the model suits the lens"
        )


def _outliers(rms: Array) -> NDArray[np.bool_]:
    log = np.log(np.maximum(rms, 1e-12))
    middle = np.median(log)
    spread = max(1.4826 * float(np.median(np.abs(log - middle))), 0.1)
    return np.asarray((log > middle + SPREAD * spread) & (log > middle + math.log(OUTLIER)))


def _without_outliers(views: Sequence[BoardView], bundle: Bundle) -> tuple[list[bool], Bundle]:
    """Leave out the worst view as long as it is far from the others, and fit again; which are used, and their fit."""
    used = [True] * len(views)
    most = min(int(MOST_LEFT_OUT * len(views)), len(views) - FEWEST_VIEWS)
    for _ in range(most):
        if bundle.interrupted or not _outliers(bundle.rms).any():
            break
        worst = int(np.argmax(bundle.rms))
        used[np.flatnonzero(used)[worst]] = False
        poses = [pose for i, pose in enumerate(bundle.poses) if i != worst]
        bundle = adjust([v for v, keep in zip(views, used, strict=True) if keep], bundle.lens, poses)
    return used, bundle


def _held_out(views: Sequence[BoardView], bundle: Bundle, seed: int) -> float:
    """Residual of views that the lens has not seen: each fold left out in turn, only the poses of its views fitted."""
    folds = min(FOLDS, len(views))
    if len(views) - math.ceil(len(views) / folds) < FEWEST_VIEWS - 1:
        return math.nan
    fold = np.random.default_rng(seed).permutation(len(views)) % folds
    residuals = []
    for k in range(folds):
        rest = np.flatnonzero(fold != k).tolist()
        lens = adjust([views[i] for i in rest], bundle.lens, [bundle.poses[i] for i in rest]).lens
        for i in np.flatnonzero(fold == k).tolist():
            pose = board_pose(lens, views[i].points, views[i].pixels, bundle.poses[i])
            if pose is not None:
                residuals.append(pose_residuals(lens, pose, views[i].points, views[i].pixels)[0])
    return _rms(np.concatenate(residuals)) if residuals else math.nan


def _views(views: Sequence[BoardView], used: Sequence[bool], bundle: Bundle) -> tuple[View, ...]:
    poses, median, every = iter(bundle.poses), float(np.median(bundle.rms)), []
    for view, keep in zip(views, used, strict=True):
        pose = next(poses) if keep else board_pose(bundle.lens, view.points, view.pixels)
        if pose is None:
            continue
        residual, _ = pose_residuals(bundle.lens, pose, view.points, view.pixels)
        reason = f"its corners miss by {_rms(residual):.2f} px, those of the others by {median:.2f} px"
        left_out = "" if keep else reason
        every.append(
            View(name=view.name, pixels=view.pixels, residuals=residual, pose=pose, left_out=left_out)
        )
    return tuple(every)


def _estimates(lens: Lens, half: Array) -> dict[str, Estimate]:
    """By name, from half widths of the 95 % intervals in the order of `lens_names`."""
    estimates = {}
    for name, value, width in zip(lens_names(lens.model), lens_vector(lens), half, strict=True):
        unit, limit, note = "-", math.inf, "not told"
        if name.startswith("f"):
            unit, limit, note = "px", UNSURE_FOCAL * value, "not told apart from the distance of the board"
        elif name.startswith("c"):
            unit, limit, note = "px", UNSURE_CENTRE * lens.width, "not told apart from a turn of the board"
        estimate = Estimate.within(name, value, width, unit, width < limit, note)
        if unit == "-" and abs(value) < width < limit:
            estimate = replace(estimate, note="not told apart from 0")
        estimates[name] = estimate
    return estimates


# How well a calibrated lens is known over the picture, and where the pictures taken say nothing about it.


@dataclass(frozen=True, kw_only=True)
class LensReach:
    """Over a grid of cells of the picture."""

    counts: NDArray[np.int64]
    """Corners in each cell, (rows, columns)."""
    error95: Array
    """Radius of the 95 % circle of a pixel whose direction is known, at the cell's centre [px], (rows, columns); a turn
    of the whole camera, which any pose takes up, is not in it. NaN where the lens cannot see."""
    edges: dict[str, float]
    """Empty border of the picture at left, right, top, bottom, as a share of its width or height."""

    @property
    def inside(self) -> float:
        """Largest error in cells with corners [px]."""
        return float(np.nanmax(np.where(self.counts > 0, self.error95, np.nan)))

    @property
    def anywhere(self) -> float:
        """Largest error over the picture [px]."""
        return float(np.nanmax(self.error95))


def lens_reach(lens: Lens, pixels: Array, covariance: Covariance) -> LensReach:
    """Count corners over the picture and carry the covariance of the lens to pixels.

    Args:
        lens: The lens.
        pixels: All corners used, (n, 2).
        covariance: Of the lens's numbers, in the order of `Lens.parameter_jacobian`.
    """
    u_edges = np.linspace(-0.5, lens.width - 0.5, COLUMNS + 1)
    v_edges = np.linspace(-0.5, lens.height - 0.5, ROWS + 1)
    counts = np.histogram2d(pixels[:, 1], pixels[:, 0], (v_edges, u_edges))[0].astype(np.int64)
    u, v = np.meshgrid(0.5 * (u_edges[1:] + u_edges[:-1]), 0.5 * (v_edges[1:] + v_edges[:-1]))
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    return LensReach(
        counts=counts,
        error95=_error95(lens, np.stack([u, v], axis=-1), counts > 0, covariance),
        edges={
            "left": float((low[0] + 0.5) / lens.width),
            "right": float((lens.width - 0.5 - high[0]) / lens.width),
            "top": float((low[1] + 0.5) / lens.height),
            "bottom": float((lens.height - 0.5 - high[1]) / lens.height),
        },
    )


def _error95(lens: Lens, pixels: Array, covered: NDArray[np.bool_], covariance: Covariance) -> Array:
    """d pixel = A d lens + B turn, with the turn that takes most of it away over the covered cells, (rows, columns)."""
    rays, ok = lens.rays(pixels)
    safe = np.where(ok[..., None], rays, np.array([0.0, 0.0, 1.0]))
    A = lens.parameter_jacobian(safe)
    B = -lens.project_jacobian(safe) @ skew(safe)
    fitted = covered & ok
    turn = -np.linalg.pinv(B[fitted].reshape(-1, 3)) @ A[fitted].reshape(-1, A.shape[-1])
    J = A + B @ turn
    if not np.isfinite(covariance.local).all():
        return np.full(pixels.shape[:-1], np.nan)
    # The information gives the shape, the disagreement of the views the size: alone, theirs would lack directions.
    ratio = covariance.std**2 / np.maximum(np.diagonal(covariance.local), 1e-300)
    S = max(float(np.mean(ratio)), 1.0) * J @ covariance.local @ np.swapaxes(J, -1, -2)
    radius = np.sqrt(TWO_SIGMA_PLANE * np.maximum(np.linalg.eigvalsh(S)[..., -1], 0.0))
    return np.asarray(np.where(ok, radius, np.nan))


def camera_findings(
    lens: Lens, views: Sequence[View], estimates: Mapping[str, Estimate], reach: LensReach
) -> tuple[Finding, ...]:
    """Coverage, tilt and what cannot be told, and what to photograph; none if nothing is to say."""
    tilts, findings = np.array([view.tilt for view in views]), []
    tilted = int(np.sum(tilts > TILTED))
    if tilts.max() < FLAT:
        findings.append(finding("views_flat", tilt=math.degrees(tilts.max())))
    elif tilted < 3:
        findings.append(finding("few_tilted", views=tilted))
    empty = {side: share for side, share in reach.edges.items() if share > BORDER}
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
    if np.isfinite(reach.anywhere) and reach.anywhere >= LARGE_ERROR:
        findings.append(finding("pixels_uncertain", inside=reach.inside, anywhere=reach.anywhere))
    return tuple(findings)
