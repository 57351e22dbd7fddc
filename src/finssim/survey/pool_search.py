"""Initial values of a pool calibration: camera and plane from surveyed points and pixels, without an initial guess."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from finssim.core.least_squares import huber_weight
from finssim.core.optics import Camera, Interface, Lens
from finssim.core.rotations import matrix_to_quat, quat_from_rotvec, quat_to_matrix
from finssim.survey.points import Observations
from finssim.survey.pool_model import (
    NAMES,
    UP,
    PoolFitSettings,
    PoolModel,
    PoolSolution,
    Prior,
    mask_of,
    prior_of,
    residuals,
    solve,
    stated_plane,
)
from finssim.trials.findings import CalibrationError

Array = NDArray[np.float64]

DRAWS, DRAWN = 60, 6
"""Number of random samples and points per sample; samples that agree with most other points are kept."""

FLAT, SOLID = 0.02, 0.2
"""Thickness of the point set, relative to its lesser width: up to the first it is flat, from the second on solid."""

STARTS = 12
"""Greatest number of straight-line poses that are refined."""

SHARES = (0.1, 0.3, 0.55, 0.8, 1.0, 1.2)
"""Depths of the water relative to the straight-line distance between camera and points; at 1.33 the camera is
on the surface."""

REACHED = (1.0, 0.75)
"""Quantiles of the points' heights above which the plane may start: all points, or not the highest, which may
be wrong or above the water."""

ENOUGH = 500
"""Greatest number of rows used in the search; the fit uses all."""

MIRRORED = 0.6
"""Ratio of the mirror image's residual to that of the best model, below which the survey's frame is left-handed."""


class RobustPixels:
    """Whitening of single rows with Huber weights, from residuals of one model."""

    def __init__(self, model: PoolModel, observed: Observations, least: float = 0.3) -> None:
        size = _sizes(model, observed)
        self.scale = max(least, 1.2 * float(np.median(size)) / 1.1774)
        self._root = np.sqrt(huber_weight(size, 2.0 * self.scale)) / self.scale

    def __call__(self, values: Array) -> Array:
        scaled = values * self._root.reshape(-1, *([1] * (values.ndim - 1)))
        return np.asarray(scaled.reshape(-1, *values.shape[2:]))


def pinhole_poses(observed: Observations, lens: Lens, seed: int = 0) -> list[PoolSolution]:
    """Return camera poses from straight lines to the points, the best first; costs are comparable.

    Refraction changes such a pose considerably, but the search from it still converges.

    Raises:
        CalibrationError: There are fewer than four points, all points are on one line, or no pixel is within
            the lens's range.
    """
    rays, ok = lens.rays(observed.pixels)
    front = ok & (rays[:, 2] > 0.05)
    X, rays = observed.points[front], rays[front]
    count = len(np.unique(X.round(6), axis=0))
    values = np.linalg.svd(X - X.mean(axis=0), compute_uv=False) if count >= 3 else np.zeros(3)
    if count < 4 or values[1] < 1e-3 * values[0]:
        raise CalibrationError(
            f"{count} usable points{' on one line' if len(X) >= 4 else ''}: expected at least 4 that do not lie on one "
            "line; whether the camera file belongs to these pixels decides which are usable"
        )
    plane, reference = Interface(UP, 0.0), observed.points[~observed.dry].mean(axis=0)
    near = []
    for R_cp, C in _candidates(X, rays[:, :2] / rays[:, 2:], np.random.default_rng(seed)):
        camera = Camera(lens, C, matrix_to_quat(R_cp.T))
        near.append(_straightened(PoolModel(camera, plane, reference, refractive=False), observed, 10))
    # Many starts have converged to the same pose: continue only with distinct ones.
    poses = _distinct([_straightened(s.model, observed, 30) for s in _distinct(near)])
    poses = [s for s in poses if np.median(_sizes(s.model, observed)) <= 0.2 * lens.width]
    if not poses:
        raise CalibrationError(
            "no pose of the camera explains the pixels: check ids, units and the camera file"
        )
    return poses


def _candidates(X: Array, xy: Array, rng: np.random.Generator) -> list[tuple[Array, Array]]:
    """Return R_cp and C_p from points and their directions x / z, y / z: from all points, small samples, and
    consistent subsets.

    For flat points each pose has a mirror image about the line of sight, which may be the better one with
    refraction.
    """
    import cv2

    middle = X.mean(axis=0)
    X = X - middle
    _, values, axes = np.linalg.svd(X)
    flat, flatness = X - np.outer(X @ axes[2], axes[2]), values[2] / values[1]

    def poses(rows: NDArray[np.intp]) -> Iterator[tuple[Array, Array, Array]]:
        solvers = [(cv2.SOLVEPNP_IPPE, flat)] if flatness < SOLID else []
        solvers += [(cv2.SOLVEPNP_SQPNP, X)] if flatness > FLAT else []
        for solver, points in solvers:
            try:
                _, turns, shifts, _ = cv2.solvePnPGeneric(
                    points[rows], xy[rows], np.eye(3), None, flags=solver
                )
            except cv2.error:  # such as a sample on one line
                continue
            for turn, shift in zip(turns, shifts, strict=True):
                R = quat_to_matrix(quat_from_rotvec(turn.ravel()))
                at = X @ R.T + shift.ravel()
                off = np.linalg.norm(at[:, :2] / np.maximum(at[:, 2:], 1e-9) - xy, axis=1)
                if np.isfinite(off).all() and np.median(at[:, 2]) > 0.0:
                    yield off, R, middle - R.T @ shift.ravel()

    every = np.arange(len(X))
    samples = [every]
    if len(X) > DRAWN:
        samples += [rng.choice(len(X), DRAWN, replace=False) for _ in range(DRAWS)]
    runs = sorted((run for rows in samples for run in poses(rows)), key=lambda run: np.median(run[0]))
    for _ in range(3 if runs else 0):
        agreeing = np.flatnonzero(runs[0][0] < max(4.0 * np.median(runs[0][0]), 1e-4))
        if len(agreeing) >= 4:
            runs = [*poses(agreeing), *runs]
    return [(R, C) for _, R, C in runs[:STARTS]]


def _straightened(model: PoolModel, observed: Observations, iterations: int) -> PoolSolution:
    """Return the straight-line pose that fits the pixels better, from a nearby model, with a score comparable
    between poses."""
    whiten, prior, pose = RobustPixels(model, observed), Prior(start=model), mask_of(NAMES[:6])
    model = solve(model, observed, whiten, pose, prior, iterations=iterations, tolerance=1e-6).model
    return PoolSolution(model, _score(model, observed))


def _sizes(model: PoolModel, observed: Observations) -> Array:
    """Return the lengths of the residuals (N,) [px]."""
    return np.asarray(np.linalg.norm(residuals(model, observed)[0], axis=1))


def _score(model: PoolModel, observed: Observations) -> float:
    """Return the mean length of the residuals [px], each limited to three medians."""
    size = _sizes(model, observed)
    return float(np.minimum(size, 3.0 * np.median(size)).mean())


def _distinct(solutions: list[PoolSolution]) -> list[PoolSolution]:
    """Return distinct solutions, the best first; poses within a degree and a hundredth of the distance count
    as equal."""
    selected: list[PoolSolution] = []
    for s in sorted(solutions, key=lambda s: s.cost):
        here, reach = s.model.camera, 0.01 * np.linalg.norm(s.model.camera.position - s.model.reference)
        others = (k.model.camera for k in selected)
        if all(
            np.trace(here.R_pc.T @ other.R_pc) < 3.0 - 3e-4
            or np.linalg.norm(here.position - other.position) > reach
            for other in others
        ):
            selected.append(s)
    return selected


def plane_starts(
    pinhole: PoolModel, normals: Sequence[Array], plane: Interface, observed: Observations, depth: float
) -> Iterator[PoolModel]:
    """Yield the straight-line pose with a plane inserted above the points and the camera moved accordingly.

    Points at depth d appear at depth d / n, so a camera estimated at height H is at H + d (1 - 1 / n).

    Args:
        pinhole: Straight-line pose.
        normals: Unit directions to try, each turned to the camera's side.
        plane: Interface with the indices and the window.
        observed: Observations; only points under water are used.
        depth: Distance of the plane from the reference point if known [m], or NaN.
    """
    camera, reference = pinhole.camera, pinhole.reference
    wet = observed.points[~observed.dry]
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


def search(observed: Observations, lens: Lens, settings: PoolFitSettings) -> tuple[PoolModel, PoolModel]:
    """Return the best model from many starts, with robust weights, and the best straight-line pose.

    Raises:
        CalibrationError: No pose explains the pixels, the survey is left-handed, or contradicts what was measured.
    """
    if len(observed) > ENOUGH:
        sample = np.random.default_rng(settings.seed).choice(len(observed), ENOUGH, replace=False)
        observed = observed.subset(np.sort(sample))
    poses = pinhole_poses(observed, lens, settings.seed)
    near = [p.model for p in poses[:3] if p.cost < 3.0 * poses[0].cost + 0.5]
    runs = _descents(near, _normals(near[0], observed, settings), observed, settings)
    # Refractive models come first: straight lines may fit the mirror image of a good survey better than the survey.
    _refuse_mirrored(observed, lens, min([_score(near[0], observed), *(run[0] for run in runs)]))
    if not runs:
        raise CalibrationError(
            "no place of the plane between camera and points explains the pixels: check the water height, its sign and "
            "the interface"
        )
    return runs[0][1], near[0]


def _normals(pinhole: PoolModel, observed: Observations, settings: PoolFitSettings) -> list[Array]:
    """Return the normals to try, pool frame, each (3,): z for a surface, the measured one or several for a window."""
    if settings.surface:
        return [UP]
    if settings.plane is not None:
        return [settings.unit_plane[0]]
    towards = pinhole.camera.position - pinhole.reference
    towards = towards / np.linalg.norm(towards)
    axes = np.linalg.svd(observed.points - observed.points.mean(axis=0), full_matrices=True)[2]
    facing: list[Array] = []
    for n in (towards, -np.asarray(pinhole.camera.R_pc)[:, 2], *np.eye(3), *axes):
        n = n if n @ towards > 0.0 else -n
        if n @ towards > 0.35 and all(n @ other < 0.995 for other in facing):
            facing.append(n)
    return facing


def _descents(
    poses: Sequence[PoolModel], normals: Sequence[Array], observed: Observations, settings: PoolFitSettings
) -> list[tuple[float, PoolModel]]:
    """Return the results of the search from all starts: residual [px] and model, the best first."""
    plane = Interface(UP, 0.0, settings.index_near, settings.index, settings.layers)
    starts: list[PoolModel] = []
    for pinhole in poses:
        _refuse_wrong_side(pinhole, settings)
        _, depth = stated_plane(pinhole, settings)
        starts += plane_starts(pinhole, normals, plane, observed, depth)
    ends: list[tuple[float, PoolModel]] = []
    for counts, count in (((6, 4), len(starts)), ((30, 40), 4)):
        models = [_descend(model, observed, settings, counts) for model in starts[:count]]
        ends = [(_score(model, observed), model) for model in models if model is not None]
        ends.sort(key=lambda pair: pair[0])
        starts = [model for _, model in ends]
    return ends


def _descend(
    model: PoolModel, observed: Observations, settings: PoolFitSettings, counts: tuple[int, int]
) -> PoolModel | None:
    """Fit only the pose, then pose and plane; return None if the search diverges."""
    start = model
    for count, names in zip(counts, (NAMES[:6], NAMES[:9]), strict=True):
        prior, whiten = prior_of(model, start, settings, (np.inf,) * 8), RobustPixels(model, observed)
        model, cost = solve(model, observed, whiten, mask_of(names), prior, iterations=count, tolerance=1e-7)
        if not np.isfinite(cost):
            return None
    return model


def _refuse_mirrored(observed: Observations, lens: Lens, best: float) -> None:
    """Refuse a survey whose mirror image, with straight lines, fits clearly better than its best model.

    Points on a plane are not checked, since they can always be mirrored.
    """
    values = np.linalg.svd(observed.points - observed.points.mean(axis=0), compute_uv=False)
    if values[2] < 0.02 * values[1]:
        return
    mirrored = replace(observed, points=observed.points * np.array([1.0, 1.0, -1.0]))
    if _score(pinhole_poses(mirrored, lens)[0].model, mirrored) < MIRRORED * best:
        raise CalibrationError(
            "the survey's frame is left-handed: its mirror image fits clearly better; negate one axis (usually y or z) "
            "in the survey and in everything that uses its frame (or the pixels are mirrored: u and v exchanged, v "
            "counted upwards)"
        )


def _refuse_wrong_side(pinhole: PoolModel, settings: PoolFitSettings) -> None:
    """Refuse a plane on the opposite side of the points from the camera."""
    _, depth = stated_plane(pinhole, settings)
    if np.isfinite(depth) and depth <= 0.0:
        sense = "below" if pinhole.camera.position[2] < pinhole.reference[2] else "above"
        plane_name = "the window's plane" if settings.window else "the surface's height or depth"
        raise CalibrationError(
            f"the pixels put the camera at z {sense} the points, and {plane_name} is {-depth:.3g} m on the other side "
            f"of them: the survey's z points {'down' if sense == 'below' else 'up'}, or its x and y make it "
            "left-handed (seen from the camera, y must lie to the left of x where z is up); give the surface's height "
            "with the other sign, or negate y in the survey"
        )
