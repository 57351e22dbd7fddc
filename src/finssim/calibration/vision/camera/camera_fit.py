"""A camera's lens from pictures of a board: estimates, intervals, what the pictures do and do not cover."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.fit import Correlation, Estimate
from finssim.calibration.uncertainty import intervals, trial_covariance
from finssim.calibration.vision.camera.board_pose import BoardPose, board_pose, pose_residuals
from finssim.calibration.vision.camera.boards import BoardView
from finssim.calibration.vision.camera.camera_advice import camera_advice
from finssim.calibration.vision.camera.lens_bundle import (
    Bundle,
    adjust,
    evidence,
    lens_names,
    lens_vector,
    start,
)
from finssim.calibration.vision.camera.lens_reach import LensReach, lens_reach
from finssim.geometry.optics import Lens

__all__ = ["MODELS", "CameraFit", "View", "calibrate_camera"]

Array = NDArray[np.float64]

MODELS = ("plumb_bob", "rational", "fisheye")

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


@dataclass(frozen=True, kw_only=True)
class View:
    """One picture after the fit."""

    name: str
    pixels: Array
    """(n, 2)"""
    residuals: Array
    """Measured less predicted, (n, 2) [px]."""
    pose: BoardPose
    left_out: str = ""
    """Why it was not used; empty if it was."""

    @property
    def rms(self) -> float:
        """Root of the mean squared distance of its corners [px]."""
        return float(np.sqrt(np.mean(np.sum(self.residuals**2, axis=-1))))

    @property
    def tilt(self) -> float:
        """Angle between the board's normal and the optical axis [rad], 0 to pi/2."""
        return float(np.arccos(np.clip(abs(self.pose.R_cb[2, 2]), 0.0, 1.0)))


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
    sigma: float
    """Robust standard deviation of one coordinate of a corner [px]."""
    reach: LensReach
    """How well pixels are known over the picture."""
    advice: tuple[str, ...]
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
        views: From `finssim.calibration.vision.camera.boards.see_board`; all of one size.
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
    information = evidence(bundle, some)
    covariance = trial_covariance(information)
    vector = lens_vector(bundle.lens)
    ends = intervals(vector, covariance)
    seen = _views(views, used, bundle)
    reach = lens_reach(bundle.lens, np.concatenate([view.pixels for view in some]), covariance)
    estimates = _estimates(bundle.lens, ends)
    return CameraFit(
        lens=bundle.lens,
        estimates=estimates,
        correlation=Correlation(
            names=information.names,
            matrix=covariance.local / np.sqrt(np.outer(*[np.diagonal(covariance.local)] * 2)),
        ),
        views=seen,
        rms=float(np.sqrt(np.mean(np.concatenate([np.sum(r**2, axis=-1) for r in bundle.residuals])))),
        held_out_rms=held_out,
        sigma=bundle.sigma,
        reach=reach,
        advice=camera_advice(bundle.lens, [v for v in seen if not v.left_out], estimates, reach),
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
    squares = []
    for k in range(folds):
        rest = [i for i in range(len(views)) if fold[i] != k]
        lens = adjust([views[i] for i in rest], bundle.lens, [bundle.poses[i] for i in rest]).lens
        for i in np.flatnonzero(fold == k).tolist():
            pose = board_pose(lens, views[i].points, views[i].pixels, bundle.poses[i])
            if pose is not None:
                residual, _ = pose_residuals(lens, pose, views[i].points, views[i].pixels)
                squares.append(np.sum(residual**2, axis=-1))
    return float(np.sqrt(np.mean(np.concatenate(squares)))) if squares else math.nan


def _views(views: Sequence[BoardView], used: Sequence[bool], bundle: Bundle) -> tuple[View, ...]:
    poses, residuals = iter(bundle.poses), iter(bundle.residuals)
    median = float(np.median(bundle.rms))
    found = []
    for view, keep in zip(views, used, strict=True):
        if keep:
            found.append(
                View(name=view.name, pixels=view.pixels, residuals=next(residuals), pose=next(poses))
            )
            continue
        pose = board_pose(bundle.lens, view.points, view.pixels)
        if pose is None:
            continue
        residual, _ = pose_residuals(bundle.lens, pose, view.points, view.pixels)
        rms = float(np.sqrt(np.mean(np.sum(residual**2, axis=-1))))
        reason = f"its corners miss by {rms:.2f} px, those of the others by {median:.2f} px"
        found.append(View(name=view.name, pixels=view.pixels, residuals=residual, pose=pose, left_out=reason))
    return tuple(found)


def _estimates(lens: Lens, ends: Array) -> dict[str, Estimate]:
    estimates = {}
    for name, value, (low, high) in zip(lens_names(lens.model), lens_vector(lens), ends, strict=True):
        half = 0.5 * (high - low)
        if name.startswith("f"):
            sure, note = half < UNSURE_FOCAL * value, "not told apart from the distance of the board"
        elif name.startswith("c"):
            sure, note = half < UNSURE_CENTRE * lens.width, "not told apart from a turn of the board"
        else:
            sure, note = bool(np.isfinite(half)), "not told"
            if sure and low < 0.0 < high:
                note = "not told apart from 0"
                estimates[name] = _estimate(name, value, low, high, True, note)
                continue
        estimates[name] = _estimate(name, value, low, high, bool(sure), "" if sure else note)
    return estimates


def _estimate(name: str, value: float, low: float, high: float, sure: bool, note: str) -> Estimate:
    unit = "px" if name in ("fx", "fy", "cx", "cy") else "-"
    return Estimate(
        name=name,
        estimate=float(value),
        ci95=(float(low), float(high)),
        unit=unit,
        identifiable=sure,
        note=note,
    )
