"""From no guess to the neighbourhood of the answer: straight-line poses, planes before them, the best few refined."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.vision.pool.observations import Observations
from finssim.calibration.vision.pool.pool_model import NAMES, PoolModel
from finssim.calibration.vision.pool.pool_settings import Settings
from finssim.calibration.vision.pool.pool_solver import Prior, residuals, solve
from finssim.calibration.vision.pool.pool_start import RobustPixels, pinhole_poses, plane_starts
from finssim.geometry.optics import Interface, Lens

__all__ = ["UP", "Found", "prior_of", "search", "shifted_settings"]

Array = NDArray[np.float64]

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
