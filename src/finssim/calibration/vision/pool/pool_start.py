"""Poses to begin from, with no guess: straight-line poses of planar and solid sets of points, then planes before."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.vision.pool.observations import Observations
from finssim.calibration.vision.pool.pool_model import NAMES, PoolModel
from finssim.calibration.vision.pool.pool_solver import Prior, Solution, residuals, solve
from finssim.geometry.optics import Camera, Interface, Lens
from finssim.geometry.rotations import matrix_to_quat

__all__ = ["RobustPixels", "pinhole_poses", "plane_starts"]

Array = NDArray[np.float64]

DRAWS = 60
"""Samples of few points, of which the one that suits most of the others is kept."""

SHARES = (0.1, 0.3, 0.55, 0.8, 1.0, 1.2)
"""Depth of the water as a part of the straight-line distance between camera and points: the camera is on the surface
at 1.33."""

REACHED = (1.0, 0.75)
"""Parts of the points that the plane begins before: all, or not the highest, which may be wrong or above the water."""


class RobustPixels:
    """Whitening of rows one by one with Huber's weights, from residuals at one model."""

    def __init__(self, model: PoolModel, seen: Observations, least: float = 0.3) -> None:
        size = np.linalg.norm(residuals(model, seen)[0], axis=1)
        self.scale = max(least, 1.2 * float(np.median(size)) / 1.1774)
        weight = np.minimum(1.0, 2.0 * self.scale / np.maximum(size, 1e-12))
        self._root = np.sqrt(weight) / self.scale

    def __call__(self, values: Array) -> Array:
        scaled = values * self._root.reshape(-1, *([1] * (values.ndim - 1)))
        return np.asarray(scaled.reshape(-1, *values.shape[2:]))


def pinhole_poses(seen: Observations, lens: Lens, seed: int = 0) -> list[Solution]:
    """Poses of a camera that saw the points in straight lines, the best first; costs are comparable.

    Water between changes such a pose much, but not where the search from it ends.

    Raises:
        CalibrationError: Fewer than four points, all on one line, or no pixel within the lens's reach.
    """
    rays, ok = lens.rays(seen.pixels)
    front = ok & (rays[:, 2] > 0.05)
    X, rays = seen.points[front], rays[front]
    centre = X.mean(axis=0) if len(X) else np.zeros(3)
    values = np.linalg.svd(X - centre, compute_uv=False) if len(X) >= 3 else np.zeros(3)
    if len(np.unique(X.round(6), axis=0)) < 4 or values[1] < 1e-3 * values[0]:
        raise CalibrationError(
            f"{len(np.unique(X.round(6), axis=0))} usable points"
            + (" on one line" if len(X) >= 4 else "")
            + ": expected at least 4 that do not lie on one line; whether the camera file belongs to these "
            "pixels decides which are usable"
        )
    near = [_straight(R, C, seen, lens) for R, C in _candidates(X, rays, values, seed)]
    # Most starts have met by now, and what has met ends at one pose.
    near = _distinct([_refined(model, seen, 10) for model in near])
    found = _distinct([_refined(s.model, seen, 30) for s in near])
    found = [s for s in found if np.median(_sizes(s.model, seen)) <= 0.2 * lens.width]
    if not found:
        raise CalibrationError(
            "no pose of the camera explains the pixels: check ids, units and the camera file"
        )
    return found


def _candidates(X: Array, rays: Array, values: Array, seed: int) -> Iterator[tuple[Array, Array]]:
    """(R_pc, C_p) from homographies of the best plane, from the direct linear transform, and from turned cubes."""
    rng = np.random.default_rng(seed)
    flatness = values[2] / values[1]
    if flatness < 0.2:
        yield from _plane_poses(X, rays, rng)
    if flatness > 0.02 and len(X) >= 6:
        yield from _solid_poses(X, rays, rng)
    if len(X) < 12 or flatness > 0.02:
        for R in _cube():
            C = _position(R, X, rays)
            if C is not None:
                yield R, C


def _plane_poses(X: Array, rays: Array, rng: np.random.Generator) -> Iterator[tuple[Array, Array]]:
    """Pose from the homography of a plane, and its reflection about the line of sight."""
    centre = X.mean(axis=0)
    axes = np.linalg.svd(X - centre)[2]
    axes[2] = np.cross(axes[0], axes[1])
    flat = (X - centre) @ axes.T
    size = float(np.abs(flat[:, :2]).max())
    plane = np.column_stack([flat[:, :2] / size, np.ones(len(X))])
    H = _consensus(plane, rays, 4, rng)
    if H is None:
        return
    H = H @ np.diag([1.0 / size, 1.0 / size, 1.0])
    H = H / (0.5 * (np.linalg.norm(H[:, 0]) + np.linalg.norm(H[:, 1])))
    if H[2, 2] < 0.0:
        H = -H
    U, _, Vt = np.linalg.svd(np.column_stack([H[:, 0], H[:, 1], np.cross(H[:, 0], H[:, 1])]))
    R_cl, t = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt, H[:, 2]
    sight = t / np.linalg.norm(t)
    for R in (R_cl, (2.0 * np.outer(sight, sight) - np.eye(3)) @ R_cl @ np.diag([-1.0, -1.0, 1.0])):
        R_pc = axes.T @ R.T
        yield R_pc, centre - R_pc @ t


def _solid_poses(X: Array, rays: Array, rng: np.random.Generator) -> Iterator[tuple[Array, Array]]:
    centre = X.mean(axis=0)
    size = float(np.abs(X - centre).max())
    P = _consensus(np.column_stack([(X - centre) / size, np.ones(len(X))]), rays, 6, rng)
    if P is None:
        return
    for sign in (1.0, -1.0):
        U, s, Vt = np.linalg.svd(sign * P[:, :3])
        if np.linalg.det(U @ Vt) > 0.0:
            R_cp = U @ Vt
            yield R_cp.T, centre - size * R_cp.T @ (sign * P[:, 3] / s.mean())


def _consensus(points: Array, rays: Array, least: int, rng: np.random.Generator) -> Array | None:
    """Linear map of homogeneous points (N, k) to rays: the best of many small samples, then of all that agree."""
    best, threshold = None, np.inf
    samples = [np.arange(len(points))]
    if len(points) > least:
        samples += [rng.choice(len(points), least, replace=False) for _ in range(DRAWS)]
    for sample in samples:
        M = _linear(points[sample], rays[sample])
        error = float(np.median(_angle(M, points, rays)))
        if error < threshold:
            best, threshold = M, error
    if best is None:
        return None
    for _ in range(3):
        near = _angle(best, points, rays) < max(4.0 * threshold, 1e-4)
        if near.sum() >= least:
            best = _linear(points[near], rays[near])
    return best


def _linear(points: Array, rays: Array) -> Array:
    """Least-squares M (3, k) of ray x M point = 0."""
    x, y = (rays[:, :2] / rays[:, 2:]).T
    zero = np.zeros_like(points)
    rows = np.concatenate(
        [
            np.concatenate([points, zero, -x[:, None] * points], axis=1),
            np.concatenate([zero, points, -y[:, None] * points], axis=1),
        ]
    )
    M = np.linalg.svd(rows, full_matrices=len(rows) < rows.shape[1])[2][-1].reshape(3, -1)
    return np.asarray(M if np.median((M @ points.T)[2]) >= 0.0 else -M)


def _angle(M: Array, points: Array, rays: Array) -> Array:
    towards = points @ M.T
    length = np.linalg.norm(towards, axis=1)
    return np.arccos(np.clip(np.sum(towards * rays, axis=1) / np.maximum(length, 1e-300), -1.0, 1.0))


def _cube() -> Iterator[Array]:
    """The 24 turns of a cube."""
    for i, j in ((i, j) for i in range(3) for j in range(3) if i != j):
        for a in (1.0, -1.0):
            for b in (1.0, -1.0):
                R = np.zeros((3, 3))
                R[i, 0], R[j, 1] = a, b
                R[:, 2] = np.cross(R[:, 0], R[:, 1])
                yield R


def _position(R_pc: Array, X: Array, rays: Array) -> Array | None:
    """Camera centre nearest to all rays' lines through their points; None where the points would lie behind it."""
    r = rays @ R_pc.T
    across = np.eye(3) - r[:, :, None] * r[:, None, :]
    M = across.sum(axis=0)
    if np.linalg.cond(M) > 1e8:
        return None
    C = np.linalg.solve(M, (across @ X[:, :, None]).sum(axis=0)[:, 0])
    return np.asarray(C) if np.median(np.sum((X - C) * r, axis=1)) > 0.0 else None


def _straight(R_pc: Array, C: Array, seen: Observations, lens: Lens) -> PoolModel:
    """A camera without water before it."""
    camera = Camera(lens, C, matrix_to_quat(R_pc))
    plane = Interface(np.array([0.0, 0.0, 1.0]), 0.0)
    return PoolModel(camera, plane, seen.points[~seen.dry].mean(axis=0), refractive=False)


def _refined(model: PoolModel, seen: Observations, iterations: int) -> Solution:
    """The straight-line pose nearby that suits the pixels better, judged by a scale common to all."""
    active = np.array([name in NAMES[:6] for name in NAMES])
    whiten, prior = RobustPixels(model, seen), Prior(start=model)
    model = solve(model, seen, whiten, active, prior, iterations=iterations, tolerance=1e-6).model
    size = _sizes(model, seen)
    return Solution(model, float(np.minimum(size, 3.0 * np.median(size)).mean()), 0, True)


def _sizes(model: PoolModel, seen: Observations) -> Array:
    """Lengths of the residuals (N,) [px]."""
    return np.asarray(np.linalg.norm(residuals(model, seen)[0], axis=1))


def _distinct(solutions: list[Solution]) -> list[Solution]:
    """The best first, without those that are another's pose."""
    kept: list[Solution] = []
    for s in sorted(solutions, key=lambda s: s.cost):
        if all(_apart(s.model, k.model) for k in kept):
            kept.append(s)
    return kept


def _apart(a: PoolModel, b: PoolModel) -> bool:
    """Whether two poses differ by more than a degree or a hundredth of the distance."""
    turn = np.trace(a.camera.R_pc.T @ b.camera.R_pc)
    far = np.linalg.norm(a.camera.position - a.reference)
    return bool(turn < 3.0 - 3e-4 or np.linalg.norm(a.camera.position - b.camera.position) > 0.01 * far)


def plane_starts(
    pinhole: PoolModel, normals: Sequence[Array], plane: Interface, seen: Observations, depth: float
) -> Iterator[PoolModel]:
    """The straight-line pose with a plane put before the points and the camera moved back to match.

    Points d under the surface look as if d / n under it, so a camera found at H stands at H + d (1 - 1 / n).

    Args:
        pinhole: Straight-line pose.
        normals: Directions to try, each turned to the camera's side.
        plane: Holds indices and window.
        seen: Of which the points under water count.
        depth: Distance of the plane from the reference point where it is known [m], or NaN.
    """
    camera, reference = pinhole.camera, pinhole.reference
    wet = seen.points[~seen.dry]
    for direction in normals:
        apparent = float(direction @ (camera.position - reference))
        normal, apparent = (direction, apparent) if apparent > 0.0 else (-direction, -apparent)
        heights = (wet - reference) @ normal
        leasts = [float(np.quantile(heights, share)) + plane.thickness for share in REACHED]
        depths = (
            [depth]
            if np.isfinite(depth)
            else sorted({max(s * apparent, 1.02 * least + 1e-4) for s in SHARES for least in leasts})
        )
        for d in depths:
            ratio = plane.index_near / plane.index_far
            position = camera.position + normal * d * (1.0 - ratio)
            if float(normal @ (position - reference)) - d < 0.01 * apparent:
                position = position + normal * (d + 0.05 * apparent - float(normal @ (position - reference)))
            here = replace(plane, normal=normal, offset=-float(normal @ reference) - d)
            yield replace(pinhole, camera=replace(camera, position=position), interface=here, refractive=True)
