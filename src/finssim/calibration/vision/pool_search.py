"""From no guess to the neighbourhood of the answer: straight-line poses, planes before them, the best few refined."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.vision.pool_model import (
    NAMES,
    PoolModel,
    Prior,
    Settings,
    Solution,
    residuals,
    solve,
)
from finssim.calibration.vision.survey import Observations
from finssim.geometry.optics import Camera, Interface, Lens
from finssim.geometry.rotations import matrix_to_quat

__all__ = ["Found", "RobustPixels", "UP", "prior_of", "search", "shifted_settings"]

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


UP = np.array([0.0, 0.0, 1.0])
SURFACE_TILT, PLANE_TILT = np.radians(0.2), np.radians(0.5)
ENOUGH = 500
"""Rows from which the search begins; the fit takes all."""

ANYWHERE = 0.5
"""Depth of the water over the distance of the camera, where nobody measured it, and the standard deviation of that: so
weak that it only decides where the pixels say nothing."""

MIRRORED = 0.6
"""Residual of the mirror image over that of the best model, below which the survey's frame is left-handed."""

SAME = 1.15
"""A surface that fits within this factor of a wall is taken for a surface."""


@dataclass(frozen=True)
class Found:
    """Where the search ended."""

    model: PoolModel
    pinhole: PoolModel
    surface: bool
    """The plane's normal is along the survey's z."""
    minima: tuple[tuple[float, float], ...]
    """Other places where the search came to rest: (residual over the best one's, clearance of the camera [m])."""


def search(seen: Observations, lens: Lens, settings: Settings) -> Found:
    """The best of many starts, with robust weights.

    Raises:
        CalibrationError: No pose explains the pixels, the survey is left-handed, or contradicts what was measured.
    """
    if len(seen) > ENOUGH:
        kept = np.random.default_rng(settings.seed).choice(len(seen), ENOUGH, replace=False)
        seen = seen.subset(np.sort(kept))
    poses = pinhole_poses(seen, lens, settings.seed)
    near = [p.model for p in poses[:3] if p.cost < 3.0 * poses[0].cost + 0.5]
    runs: list[tuple[float, PoolModel, bool]] = []
    for surface, normals in _families(near[0], seen, settings):
        best = _family(near, normals, seen, settings, surface)
        runs += [(value, model, surface) for value, model in best]
    # Bent rays come first: straight ones may fit the mirror image of a good survey better than the survey.
    _refuse_left_handed(seen, lens, min([_score(near[0], seen), *(run[0] for run in runs)]))
    if not runs:
        raise CalibrationError(
            "no place of the plane between camera and points explains the pixels: check the water height, its sign and "
            "the interface"
        )
    chosen = _choose(runs, len(seen))
    minima = tuple(
        (value / max(chosen[0], 1e-9), model.clearance)
        for value, model, surface in sorted(runs, key=lambda run: run[0])
        if surface == chosen[2]
        and abs(model.clearance - chosen[1].clearance) > 0.02 * abs(chosen[1].clearance)
    )
    return Found(chosen[1], near[0], chosen[2], minima)


def prior_of(
    model: PoolModel, start: PoolModel, settings: Settings, surface: bool, stds: tuple[float, ...]
) -> Prior:
    """What is known of the plane before the pictures, as the fit wants it.

    Args:
        model: On whose side of the points the camera is.
        start: Holds the index and the lens as given.
        settings: Options.
        surface: The normal is along the survey's z.
        stds: Of the lens's parameters.
    """
    normal, depth = known_plane(model, settings, surface)
    tilt = settings.tilt_sigma
    if tilt is None:
        tilt = float(PLANE_TILT if settings.plane is not None else SURFACE_TILT if surface else np.inf)
    depth_std = max(settings.water_height_sigma, 1e-6)
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


def known_plane(model: PoolModel, settings: Settings, surface: bool) -> tuple[Array | None, float]:
    """Normal towards the camera, and distance of the plane from the reference point; None and NaN where unknown."""
    towards = model.camera.position - model.reference
    if settings.plane is not None:
        normal = np.array(settings.plane[:3]) / np.linalg.norm(settings.plane[:3])
        depth = -(normal @ model.reference + settings.plane[3] / np.linalg.norm(settings.plane[:3]))
        sign = 1.0 if normal @ towards > 0.0 else -1.0
        return sign * normal, float(sign * depth)
    if not surface:
        return None, np.nan if settings.water_depth is None else settings.water_depth
    normal = UP if towards[2] > 0.0 else -UP
    if settings.water_height is not None:
        return normal, float(normal[2] * (settings.water_height - model.reference[2]))
    return normal, np.nan if settings.water_depth is None else settings.water_depth


def _score(model: PoolModel, seen: Observations) -> float:
    """Mean length of the residuals [px], long ones counted as three medians."""
    size = np.linalg.norm(residuals(model, seen)[0], axis=1)
    return float(np.minimum(size, 3.0 * np.median(size)).mean())


def _families(pinhole: PoolModel, seen: Observations, settings: Settings) -> list[tuple[bool, list[Array]]]:
    """(surface?, normals to try)."""
    if settings.plane is not None:
        normal = np.array(settings.plane[:3]) / np.linalg.norm(settings.plane[:3])
        return [(bool(abs(normal[2]) > 0.9), [normal])]
    towards = pinhole.camera.position - pinhole.reference
    towards = towards / np.linalg.norm(towards)
    axes = np.linalg.svd(seen.points - seen.points.mean(axis=0), full_matrices=True)[2]
    walls = [towards, -np.asarray(pinhole.camera.R_pc)[:, 2], *np.eye(3), *axes]
    facing: list[Array] = []
    for n in walls:
        n = n if n @ towards > 0.0 else -n
        if n @ towards > 0.35 and all(n @ other < 0.995 for other in facing):
            facing.append(n)
    families = {"surface": [(True, [UP])], "wall": [(False, facing)]}
    both = families["surface"] + (families["wall"] if settings.water_height is None else [])
    return {**families, "auto": both}[settings.interface]


def _family(
    poses: Sequence[PoolModel],
    normals: Sequence[Array],
    seen: Observations,
    settings: Settings,
    surface: bool,
) -> list[tuple[float, PoolModel]]:
    """Ends of the search from all starts of one family, the best first."""
    plane = Interface(UP, 0.0, settings.index_near, settings.index, settings.window)
    rough: list[tuple[float, PoolModel]] = []
    for pinhole in poses:
        _refuse_wrong_side(pinhole, settings, surface)
        _, depth = known_plane(pinhole, settings, surface)
        for start in plane_starts(pinhole, normals, plane, seen, depth):
            model = _descend(start, seen, settings, surface, (6, 4))
            if model is not None:
                rough.append((_score(model, seen), model))
    rough.sort(key=lambda pair: pair[0])
    fine = []
    for _, model in rough[:4]:
        end = _descend(model, seen, settings, surface, (30, 40))
        if end is not None:
            fine.append((_score(end, seen), end))
    return sorted(fine, key=lambda pair: pair[0])


def _descend(
    model: PoolModel, seen: Observations, settings: Settings, surface: bool, counts: tuple[int, int]
) -> PoolModel | None:
    """Pose alone, then pose and plane."""
    start = model
    for count, names in zip(counts, (NAMES[:6], NAMES[:9]), strict=True):
        whiten = RobustPixels(model, seen)
        prior = prior_of(model, start, settings, surface, (np.inf,) * 8)
        active = np.array([name in names for name in NAMES])
        end = solve(model, seen, whiten, active, prior, iterations=count, tolerance=1e-7)
        if not np.isfinite(end.cost):
            return None
        model = end.model
    return model


def _refuse_left_handed(seen: Observations, lens: Lens, best: float) -> None:
    """Refuse a survey whose mirror image, in straight lines, fits clearly better than the best model of it.

    A plane of points can always be mirrored, and says nothing.
    """
    values = np.linalg.svd(seen.points - seen.points.mean(axis=0), compute_uv=False)
    if values[2] < 0.02 * values[1]:
        return
    mirrored = replace(seen, points=seen.points * np.array([1.0, 1.0, -1.0]))
    if _score(pinhole_poses(mirrored, lens)[0].model, mirrored) < MIRRORED * best:
        raise CalibrationError(
            "the survey's frame is left-handed: its mirror image fits clearly better; negate one axis (usually y or z) "
            "in the survey and in everything that uses its frame (or the pixels are mirrored: u and v exchanged, v "
            "counted upwards)"
        )


def _refuse_wrong_side(pinhole: PoolModel, settings: Settings, surface: bool) -> None:
    _, depth = known_plane(pinhole, settings, surface)
    if np.isfinite(depth) and depth <= 0.0:
        sense = "below" if pinhole.camera.position[2] < pinhole.reference[2] else "above"
        where = "the plane given" if settings.water_height is None else "the water's height given"
        raise CalibrationError(
            f"the pixels put the camera at z {sense} the points, and {where} is {-depth:.3g} m on the other side of "
            f"them: the survey's z points {'down' if sense == 'below' else 'up'}, or its x and y make it left-handed "
            "(seen from the camera, y must lie to the left of x where z is up); give the water's height with the other "
            "sign, or negate y in the survey"
        )


def _choose(runs: list[tuple[float, PoolModel, bool]], count: int) -> tuple[float, PoolModel, bool]:
    """The best run; a level surface wherever it does as well as a wall, or the points are too few to tell."""
    best = min(runs, key=lambda run: run[0])
    surfaces = [run for run in runs if run[2]]
    if surfaces and not best[2]:
        level = min(surfaces, key=lambda run: run[0])
        upright = abs(float(best[1].interface.normal[2])) > np.cos(np.radians(5.0))
        spare = 2.0 * count - 9.0  # a wall's parameters are nine, two more than a surface's
        freedom = np.sqrt((spare + 2.0) / spare) if spare > 0.0 else 1.0
        if spare <= 0.0 or level[0] <= SAME * freedom * best[0] + 0.02 or upright:
            return level
    return best


def shifted_settings(settings: Settings, vector: Array) -> Settings:
    """The same in a frame in which every point lies `vector` further [m]."""
    changed = settings
    if settings.water_height is not None:
        changed = replace(changed, water_height=settings.water_height + float(vector[2]))
    if settings.plane is not None:
        n, b = np.array(settings.plane[:3]), settings.plane[3]
        changed = replace(changed, plane=(*map(float, n), float(b - n @ vector)))
    return changed
