"""A lens and the poses of all boards at once, from the pixels of their corners."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.uncertainty import Evidence
from finssim.calibration.vision.camera.board_pose import (
    BoardPose,
    board_pose,
    pose_from_rays,
    pose_jacobian,
    pose_residuals,
    turned,
)
from finssim.calibration.vision.camera.boards import BoardView
from finssim.calibration.vision.mounts.arrow import Block, arrow_evidence, arrow_step, block_of
from finssim.geometry.optics import Lens, OpticsError

__all__ = ["DISTORTION_NAMES", "Bundle", "adjust", "evidence", "lens_names", "lens_vector", "start"]

Array = NDArray[np.float64]

DISTORTION_NAMES = {
    "plumb_bob": ("k1", "k2", "p1", "p2", "k3"),
    "rational": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "fisheye": ("k1", "k2", "k3", "k4"),
}

FOCAL_SHARES = np.geomspace(0.2, 4.0, 25)
"""Focal lengths that are tried at the start, in widths of the image."""

HUBER = 2.0
"""Residuals beyond this many standard deviations count linearly."""

STEPS = 100


@dataclass(frozen=True, kw_only=True)
class Bundle:
    """A lens and one pose per view."""

    lens: Lens
    poses: tuple[BoardPose, ...]
    residuals: tuple[Array, ...]
    """Measured less predicted, per view (n, 2) [px]."""
    sigma: float
    """Robust standard deviation of one coordinate of a corner [px]."""
    interrupted: bool = False

    @property
    def rms(self) -> Array:
        """Root of the mean squared distance of corners, per view [px]."""
        return np.array([np.sqrt(np.mean(np.sum(r**2, axis=-1))) for r in self.residuals])


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
    first = views[0]
    some = views[:: max(1, len(views) // 8)]
    best, lowest = None, np.inf
    for share in FOCAL_SHARES:
        f = float(share) * first.width
        lens = Lens(
            width=first.width,
            height=first.height,
            fx=f,
            fy=f,
            cx=0.5 * (first.width - 1),
            cy=0.5 * (first.height - 1),
            model=model,
            distortion=(0.0,) * len(DISTORTION_NAMES[model]),
        )
        rms = np.median([_misfit(lens, view) for view in some])
        if rms < lowest:
            best, lowest = lens, float(rms)
    if best is None:
        raise CalibrationError("no focal length explains the pictures: is the board as stated, and flat?")
    return best


def _misfit(lens: Lens, view: BoardView) -> float:
    rays, ok = lens.rays(view.pixels)
    pose = pose_from_rays(rays[ok], view.points[ok]) if ok.all() else None
    if pose is None:
        return np.inf
    residual, _ = pose_residuals(lens, pose, view.points, view.pixels)
    return float(np.sqrt(np.mean(residual**2))) if np.isfinite(residual).all() else np.inf


def adjust(views: Sequence[BoardView], lens: Lens, poses: Sequence[BoardPose] | None = None) -> Bundle:
    """Least squares over lens and poses, corners far from the others weighing less (Huber).

    Without poses it begins from the lens's focal length alone, and frees the centre and the distortion one after the
    other. Ctrl-C ends it with the best until then.

    Raises:
        CalibrationError: A view has no pose before the camera, which is named.
    """
    names = lens_names(lens.model)
    stages = [("fx", "fy"), ("fx", "fy", "cx", "cy", "k1"), names] if poses is None else [names]
    found = list(poses) if poses is not None else [_pose(lens, view) for view in views]
    bundle = _bundle(lens, found, views)
    assert bundle is not None
    for stage in stages:
        free = np.array([name in stage for name in names])
        bundle = _minimise(bundle, views, free)
        if bundle.interrupted:
            break
    return bundle


def _pose(lens: Lens, view: BoardView) -> BoardPose:
    pose = board_pose(lens, view.points, view.pixels)
    if pose is None:
        raise CalibrationError(
            f"{view.name}: no pose of the board explains its corners: leave the picture out"
        )
    return pose


def _bundle(lens: Lens, poses: Sequence[BoardPose], views: Sequence[BoardView]) -> Bundle | None:
    """With its residuals; None where the lens cannot see a corner."""
    residuals = tuple(
        pose_residuals(lens, pose, view.points, view.pixels)[0]
        for pose, view in zip(poses, views, strict=True)
    )
    every = np.concatenate(residuals)
    if not np.isfinite(every).all():
        return None
    sigma = max(1.4826 * float(np.median(np.abs(every))), 1e-9)
    return Bundle(lens=lens, poses=tuple(poses), residuals=residuals, sigma=sigma)


def _weights(residual: Array, sigma: float) -> Array:
    """Huber's, per corner, (n,)."""
    return np.minimum(1.0, HUBER * sigma / np.maximum(np.linalg.norm(residual, axis=-1), 1e-300))


def _cost(bundle: Bundle, sigma: float) -> float:
    total = 0.0
    for residual in bundle.residuals:
        r = np.linalg.norm(residual, axis=-1) / sigma
        total += float(np.sum(np.where(r <= HUBER, r**2, HUBER * (2.0 * r - HUBER))))
    return total


def _minimise(bundle: Bundle, views: Sequence[BoardView], free: NDArray[np.bool_]) -> Bundle:
    damping, failures = 1e-3, 0
    try:
        for _ in range(STEPS):
            sigma = bundle.sigma
            candidate = _step(bundle, views, free, damping)
            before = _cost(bundle, sigma)
            after = np.inf if candidate is None else _cost(candidate, sigma)
            if candidate is not None and after < before:
                bundle, failures = candidate, 0
                damping = max(0.2 * damping, 1e-9)
                if before - after < 1e-9 * before:
                    break
            else:
                damping, failures = 10.0 * damping, failures + 1
                if failures > 12:
                    break
    except KeyboardInterrupt:
        return replace(bundle, interrupted=True)
    return bundle


def _step(
    bundle: Bundle, views: Sequence[BoardView], free: NDArray[np.bool_], damping: float
) -> Bundle | None:
    """One damped Gauss-Newton step: poses are eliminated view by view, the lens is solved for, then the poses."""
    blocks = [_block(bundle, view, i, free) for i, view in enumerate(views)]
    step, moves = arrow_step(blocks, damping)
    vector = lens_vector(bundle.lens)
    vector[free] += step
    poses = [turned(pose, move) for pose, move in zip(bundle.poses, moves, strict=True)]
    try:
        return _bundle(_with(bundle.lens, vector), poses, views)
    except OpticsError:  # a focal length below zero, say
        return None


def _with(lens: Lens, vector: Array) -> Lens:
    fx, fy, cx, cy, *distortion = map(float, vector)
    return replace(lens, fx=fx, fy=fy, cx=cx, cy=cy, distortion=tuple(distortion))


def _block(bundle: Bundle, view: BoardView, i: int, free: NDArray[np.bool_]) -> Block:
    """Weighted normal equations of one view, for the lens and the view's pose."""
    pose, residual = bundle.poses[i], bundle.residuals[i]
    points_c = pose.points_c(view.points)
    root = np.sqrt(_weights(residual, bundle.sigma))[:, None, None] / bundle.sigma
    A = (root * bundle.lens.parameter_jacobian(points_c)[..., free]).reshape(-1, int(free.sum()))
    B = (root * pose_jacobian(bundle.lens, pose, points_c)).reshape(-1, 6)
    return block_of(A, B, (root[..., 0] * residual).ravel())


def evidence(bundle: Bundle, views: Sequence[BoardView]) -> Evidence:
    """What each view says about the lens once its own pose is taken out, for intervals that treat a view as one."""
    names = lens_names(bundle.lens.model)
    free = np.ones(len(names), bool)
    return arrow_evidence([_block(bundle, view, i, free) for i, view in enumerate(views)], names, "views")
