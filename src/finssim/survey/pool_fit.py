"""`finssim calibrate pool`: camera pose and water plane from surveyed points seen through the plane."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.stats import chi2
from scipy.stats import t as student

from finssim.core.least_squares import huber_weight, rms
from finssim.core.optics import Camera, Interface, Lens, back_project
from finssim.core.provenance import provenance
from finssim.core.rotations import matrix_to_quat, quat_from_rotvec, quat_to_euler, quat_to_matrix
from finssim.identification.fit import Correlation, Estimate
from finssim.identification.report import (
    AS_STATED,
    HEADS,
    Report,
    command_line,
    draw_arrows,
    draw_correlation,
    new_figure,
    picture_axes,
    png,
    publish,
    refuse_places,
)
from finssim.identification.uncertainty import correlation
from finssim.localization.camera_file import CameraFile, load_camera
from finssim.localization.overhead_camera import Pool, write_pool
from finssim.survey.points import Observations
from finssim.survey.pool_model import (
    LENS_NAMES,
    NAMES,
    PoolFitSettings,
    PoolModel,
    PoolSolution,
    Prior,
    active_names,
    clearances,
    extended_lens,
    lens_std,
    normal_equations,
    residuals,
    solve,
)
from finssim.survey.survey_file import load_survey_file
from finssim.trials.findings import CalibrationError, Finding, finding, plain

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["CAMERA", "PoolFit", "calibrate_pool", "doubted", "pool_record", "run"]


Array = NDArray[np.float64]

UP = np.array([0.0, 0.0, 1.0])
SURFACE_TILT, PLANE_TILT = np.radians(0.2), np.radians(0.5)

DRAWS, DRAWN = 60, 6
"""Samples of that many points, of which those that suit most of the others are kept."""

FLAT, SOLID = 0.02, 0.2
"""Thickness of the points, over their lesser width, from which they count as solid, and no longer as flat."""

STARTS = 12
"""Straight-line poses that are refined."""

SHARES = (0.1, 0.3, 0.55, 0.8, 1.0, 1.2)
"""Depth of the water as a part of the straight-line distance between camera and points: the camera is on the surface
at 1.33."""

REACHED = (1.0, 0.75)
"""Parts of the points that the plane begins before: all, or not the highest, which may be wrong or above the water."""

ENOUGH = 500
"""Rows from which the search begins; the fit takes all."""

ANYWHERE = 0.5
"""Prior of the water's depth over the camera's distance where it was not measured, and its standard deviation: so weak
that it matters only where the pixels contain no information."""

MIRRORED = 0.6
"""Residual of the mirror image over that of the best model, below which the survey's frame is left-handed."""


class RobustPixels:
    """Whitening of rows one by one with Huber's weights, from residuals at one model."""

    def __init__(self, model: PoolModel, observed: Observations, least: float = 0.3) -> None:
        size = _sizes(model, observed)
        self.scale = max(least, 1.2 * float(np.median(size)) / 1.1774)
        self._root = np.sqrt(huber_weight(size, 2.0 * self.scale)) / self.scale

    def __call__(self, values: Array) -> Array:
        scaled = values * self._root.reshape(-1, *([1] * (values.ndim - 1)))
        return np.asarray(scaled.reshape(-1, *values.shape[2:]))


def pinhole_poses(observed: Observations, lens: Lens, seed: int = 0) -> list[PoolSolution]:
    """Poses of a camera that saw the points in straight lines, the best first; costs are comparable.

    Water between changes such a pose much, but not where the search from it ends.

    Raises:
        CalibrationError: Fewer than four points, all on one line, or no pixel within the lens's reach.
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
    # Most starts have met by now, and what has met ends at one pose.
    poses = _distinct([_straightened(s.model, observed, 30) for s in _distinct(near)])
    poses = [s for s in poses if np.median(_sizes(s.model, observed)) <= 0.2 * lens.width]
    if not poses:
        raise CalibrationError(
            "no pose of the camera explains the pixels: check ids, units and the camera file"
        )
    return poses


def _candidates(X: Array, xy: Array, rng: np.random.Generator) -> list[tuple[Array, Array]]:
    """R_cp and C_p from points and their directions x / z, y / z: of all, of small samples, and of all that agree.

    Of flat points each pose has a reflection about the line of sight, which the water may turn into the better one.
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
            except cv2.error:  # a sample on one line, say
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
    """The straight-line pose nearby that suits the pixels better, judged by a scale common to all."""
    active = np.array([name in NAMES[:6] for name in NAMES])
    whiten, prior = RobustPixels(model, observed), Prior(start=model)
    model = solve(model, observed, whiten, active, prior, iterations=iterations, tolerance=1e-6).model
    return PoolSolution(model, _score(model, observed))


def _sizes(model: PoolModel, observed: Observations) -> Array:
    """Lengths of the residuals (N,) [px]."""
    return np.asarray(np.linalg.norm(residuals(model, observed)[0], axis=1))


def _score(model: PoolModel, observed: Observations) -> float:
    """Mean length of the residuals [px], long ones counted as three medians."""
    size = _sizes(model, observed)
    return float(np.minimum(size, 3.0 * np.median(size)).mean())


def _distinct(solutions: list[PoolSolution]) -> list[PoolSolution]:
    """The best first, without those that are another's pose to a degree and a hundredth of the distance."""
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
    """The straight-line pose with a plane put before the points and the camera moved back to match.

    Points d under the surface look as if d / n under it, so a camera found at H stands at H + d (1 - 1 / n).

    Args:
        pinhole: Straight-line pose.
        normals: Unit directions to try, each turned to the camera's side.
        plane: Holds indices and window.
        observed: Of which the points under water count.
        depth: Distance of the plane from the reference point where it is known [m], or NaN.
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


@dataclass(frozen=True)
class BestStart:
    """End of the search."""

    model: PoolModel
    pinhole: PoolModel


def search(observed: Observations, lens: Lens, settings: PoolFitSettings) -> BestStart:
    """The best of many starts, with robust weights.

    Raises:
        CalibrationError: No pose explains the pixels, the survey is left-handed, or contradicts what was measured.
    """
    if len(observed) > ENOUGH:
        sample = np.random.default_rng(settings.seed).choice(len(observed), ENOUGH, replace=False)
        observed = observed.subset(np.sort(sample))
    poses = pinhole_poses(observed, lens, settings.seed)
    near = [p.model for p in poses[:3] if p.cost < 3.0 * poses[0].cost + 0.5]
    runs = _descents(near, _normals(near[0], observed, settings), observed, settings)
    # Bent rays come first: straight ones may fit the mirror image of a good survey better than the survey.
    _refuse_mirrored(observed, lens, min([_score(near[0], observed), *(run[0] for run in runs)]))
    if not runs:
        raise CalibrationError(
            "no place of the plane between camera and points explains the pixels: check the water height, its sign and "
            "the interface"
        )
    return BestStart(runs[0][1], near[0])


def prior_of(model: PoolModel, start: PoolModel, settings: PoolFitSettings, stds: tuple[float, ...]) -> Prior:
    """Return the prior of plane, index and lens.

    Args:
        model: Model whose camera gives the side of the points.
        start: Model with the index and the lens as given.
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


def stated_plane(model: PoolModel, settings: PoolFitSettings) -> tuple[Array | None, float]:
    """Return the normal towards the camera, pool frame (3,), and the distance of the plane from the reference point
    [m]; None and NaN where unknown."""
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
    """Return the ends of the search from all starts: residual [px] and model, the best first."""
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
    """Fit the pose alone, then pose and plane; return None where the search is lost."""
    start = model
    for count, names in zip(counts, (NAMES[:6], NAMES[:9]), strict=True):
        prior = prior_of(model, start, settings, (np.inf,) * 8)
        active = np.array([name in names for name in NAMES])
        whiten = RobustPixels(model, observed)
        model, cost = solve(model, observed, whiten, active, prior, iterations=count, tolerance=1e-7)
        if not np.isfinite(cost):
            return None
    return model


def _refuse_mirrored(observed: Observations, lens: Lens, best: float) -> None:
    """Refuse a survey whose mirror image, in straight lines, fits clearly better than the best model of it.

    A plane of points can always be mirrored, and says nothing.
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
    """Refuse a plane on the other side of the points than the camera."""
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


# The fit proper: full weights, the size of the errors, wrong rows left out, errors at points not seen.

LEAST_PIXEL = 0.02
"""Smallest standard error of a pixel that an estimate can take [px]: no corner is found better."""

NOISE_ROWS = 2000
"""Rows from which the size of the errors is estimated."""

STATED_SURVEY = 0.35
"""Standard deviation of the logarithm of the survey's error: the stated error is right within about a third."""

STATED_PIXEL, USUAL_PIXEL = 1.2, 0.4
"""Standard deviation of the logarithm of a pixel's error, and its usual size [px]."""


@dataclass(frozen=True, kw_only=True)
class StandardErrors:
    """Standard errors."""

    pixel: float
    """Standard error of each image coordinate [px]."""
    survey: float = 0.002
    """Standard error of each coordinate of a location, where the survey does not give its own [m]."""
    survey_yaw: float = 0.0087
    """Standard error of a tag's direction [rad]."""
    scale: float = 1.0
    """Factor on all survey errors, estimated from the residuals [-]."""

    def survey_modes(self, J_point: Array, observed: Observations) -> Array:
        """Return the change of pixels by one standard error of a place's x, y, z and of a tag's turn [px], (N, 2, 4).

        Args:
            J_point: Derivative of the pixel by the point, (N, 2, 3).
            observed: The rows.
        """
        sigma = np.where(np.isfinite(observed.sigma), observed.sigma, self.survey)[:, None, None]
        turn = self.survey_yaw * np.einsum("nij,nj->ni", J_point, observed.arm)[..., None]
        return np.asarray(self.scale * np.concatenate([J_point * sigma, turn], axis=-1))


class Whitener:
    """Makes residuals independent and of unit variance; rows of one location belong together.

    V_l = sigma² 1 + J_l B_l S B_lᵀ J_lᵀ: a location is displaced as a whole, and a tag turned, by the survey's error.
    """

    def __init__(self, J_point: Array, observed: Observations, noise: StandardErrors) -> None:
        """
        Args:
            J_point: Derivative of the pixel by the point, (N, 2, 3).
            observed: The rows.
            noise: Standard errors.
        """
        modes = noise.survey_modes(J_point, observed)
        self.logdet = 0.0
        self._groups: list[tuple[NDArray[np.intp], Array]] = []
        order = np.argsort(observed.location, kind="stable")
        _, starts, counts = np.unique(observed.location[order], return_index=True, return_counts=True)
        for count in np.unique(counts):
            rows = np.stack([order[s : s + count] for s in starts[counts == count]])
            B = modes[rows].reshape(len(rows), 2 * count, 4)
            V = B @ B.transpose(0, 2, 1)
            index = np.arange(2 * count)
            V[:, index, index] += noise.pixel**2
            L = np.linalg.cholesky(V)
            self.logdet += 2.0 * float(np.log(L[:, index, index]).sum())
            self._groups.append((rows, np.linalg.inv(L)))

    def __call__(self, values: Array) -> Array:
        """Whitened rows of values (N, 2) or (N, 2, P), as (2N,) or (2N, P); locations one after another."""
        tail = values.shape[2:]
        parts = []
        for rows, L_inverse in self._groups:
            block = values[rows].reshape(len(rows), L_inverse.shape[-1], -1)
            parts.append((L_inverse @ block).reshape(-1, *tail))
        return np.concatenate(parts)


def estimate_noise(
    residual: Array,
    J: Array,
    J_point: Array,
    observed: Observations,
    noise: StandardErrors,
    prior: Array,
    *,
    fixed_pixel: bool,
) -> StandardErrors:
    """Most likely standard errors of pixels and survey (restricted likelihood: what the fit swallowed is given back).

    Args:
        residual: Measured minus predicted [px], (N, 2).
        J: Derivative of the prediction in pixels by the fitted parameters, per unit of these, (N, 2, P).
        J_point: The same by the point [px/m], (N, 2, 3).
        observed: The rows.
        noise: What is believed before.
        prior: Information of the priors on the parameters, per unit of these squared, (P, P).
        fixed_pixel: The pixel's error is given and stays.
    """
    if len(observed) > NOISE_ROWS:  # enough for two numbers; complete locations, evenly
        every = int(np.ceil(len(observed) / NOISE_ROWS))
        rows = np.flatnonzero(observed.location % every == 0)
        if len(rows) > NOISE_ROWS // 4:
            residual, J, J_point, observed = residual[rows], J[rows], J_point[rows], observed.subset(rows)

    def at(x: Array) -> StandardErrors:
        pixel = noise.pixel if fixed_pixel else max(LEAST_PIXEL, math.exp(x[1]))
        return replace(noise, pixel=pixel, scale=math.exp(x[0]))

    def cost(x: Array) -> float:
        if np.abs(x).max() > 12.0:
            return 1e12
        whiten = Whitener(J_point, observed, at(x))
        r, A = whiten(residual), whiten(J)
        N = A.T @ A + prior
        scale = np.sqrt(np.maximum(np.diagonal(N), 1e-300))
        logdet = float(np.linalg.slogdet(N / np.outer(scale, scale))[1]) + 2.0 * float(np.log(scale).sum())
        g = A.T @ r
        chi2 = float(r @ r) - float(g @ np.linalg.lstsq(N, g, rcond=None)[0])
        usual = (x[0] / STATED_SURVEY) ** 2
        if not fixed_pixel:
            usual += ((x[1] - math.log(USUAL_PIXEL)) / STATED_PIXEL) ** 2
        return chi2 + whiten.logdet + logdet + usual

    start = [0.0, math.log(max(noise.pixel, LEAST_PIXEL))][: 1 if fixed_pixel else 2]
    solution = minimize(
        cost, np.array(start), method="Nelder-Mead", options={"xatol": 0.01, "fatol": 0.01, "maxiter": 120}
    )
    return at(solution.x)


CHANCE = 0.02
"""Chance that a right row is taken for a wrong one anywhere in a survey."""

MAX_WRONG = 0.4
"""Share of wrong rows beyond which nothing is believed."""

ROUNDS = 6

TOUCHING = 0.0001
"""Distance of the plane from a point or the camera, below which the one keeps the other from moving on [m]."""

PRESSED = 9.0
"""Fall of chi² that a plane held by a point or the camera would gain beyond it, from which that is no chance."""

CAMERA = "the camera"


@dataclass(frozen=True)
class Refined:
    """A fit and what it rests on."""

    model: PoolModel
    noise: StandardErrors
    used: NDArray[np.bool_]
    """Rows that are not outliers, (N,)."""
    whiten: Whitener
    """Whitening of the rows used."""
    active: NDArray[np.bool_]
    """Parameters fitted, (18,)."""
    prior: Prior
    covariance: Array
    """Covariance of all parameters in their units, zero where held, (18, 18)."""
    cost: float
    """Half the sum of squares that was minimised [-]."""
    dof: float
    """Number of rows of residuals less that of parameters."""


def refine(
    model: PoolModel,
    observed: Observations,
    active: NDArray[np.bool_],
    prior: Prior,
    noise: StandardErrors,
    *,
    fixed_pixel: bool = False,
) -> Refined:
    """Fit with the errors of pixels and survey estimated on the way, and wrong rows named.

    Args:
        model: From the search.
        observed: All rows.
        active: Parameters to fit, (18,).
        prior: What is known beforehand.
        noise: What is believed of the errors.
        fixed_pixel: The pixel's error is given.

    Raises:
        CalibrationError: Too many rows do not fit.
    """
    robust = RobustPixels(model, observed)
    model = solve(model, observed, robust, active, prior, iterations=40).model
    robust = RobustPixels(model, observed, least=0.05)
    model = solve(model, observed, robust, active, prior, iterations=40).model
    if not fixed_pixel:
        size = np.linalg.norm(residuals(model, observed)[0], axis=1)
        noise = replace(noise, pixel=max(0.05, float(np.median(size)) / 1.1774))
    used = _plausible(model, observed, noise)
    free = np.flatnonzero(active)
    for _ in range(ROUNDS):
        _refuse_few(used, observed, int(active.sum()))
        rows = observed.subset(used)
        J, J_point = model.jacobians(rows.points, rows.dry)
        J_prior = prior.rows(model)[1][:, free]
        off, information = residuals(model, rows)[0], J_prior.T @ J_prior
        noise = estimate_noise(off, J[..., free], J_point, rows, noise, information, fixed_pixel=fixed_pixel)
        whiten = Whitener(J_point, rows, noise)
        (model, cost), before = solve(model, rows, whiten, active, prior), used
        used = _plausible(model, observed, noise)
        if np.array_equal(used, before):
            break
    covariance = _covariance(model, rows, whiten, free, prior)
    dof = max(3.0, 2.0 * len(rows) - len(free))
    return Refined(model, noise, before, whiten, active, prior, covariance, cost, dof)


def touched(fit: Refined, observed: Observations) -> tuple[str, ...]:
    """Points used, and the camera, that the plane and its window have come to rest against although the pixels want it
    further on; the nearest first.

    Args:
        fit: Of these rows.
        observed: All rows.
    """
    wet = fit.used & ~observed.dry
    distance = np.where(wet, clearances(fit.model, observed.points), np.inf)
    near = [i for i in np.argsort(distance) if distance[i] < TOUCHING]
    if not near and fit.model.clearance >= TOUCHING:
        return ()
    N, g = normal_equations(
        fit.model, observed.subset(fit.used), fit.whiten, np.flatnonzero(fit.active), fit.prior
    )
    scale = np.sqrt(np.maximum(np.diagonal(N), 1e-300))
    if float((g / scale) @ np.linalg.lstsq(N / np.outer(scale, scale), g / scale, rcond=1e-9)[0]) < PRESSED:
        return ()
    names = dict.fromkeys(observed.locations[observed.location[i]] for i in near)
    return (*((CAMERA,) if fit.model.clearance < TOUCHING else ()), *names)


def _plausible(model: PoolModel, observed: Observations, noise: StandardErrors) -> NDArray[np.bool_]:
    """Rows whose residual is of the size that the errors of pixel and survey make, whatever it shares with others."""
    d2 = surprise(model, observed, noise)
    inner = max(1.0, float(np.median(d2)) / float(chi2.ppf(0.5, 2)))
    return np.asarray(d2 < inner * chi2.ppf(1.0 - CHANCE / len(observed), 2))


def surprise(
    model: PoolModel, observed: Observations, noise: StandardErrors, covariance: Array | None = None
) -> Array:
    """Squared residuals over what the errors of pixel and survey make of them, (N,); infinite where there is none.

    Args:
        model: Predicts.
        observed: The rows.
        noise: Standard errors.
        covariance: Of the model's parameters, if their errors count too, (18, 18).
    """
    r, ok = residuals(model, observed)
    J, J_point = (
        np.where(ok[:, None, None], part, 0.0) for part in model.jacobians(observed.points, observed.dry)
    )
    modes = noise.survey_modes(J_point, observed)
    V = modes @ modes.transpose(0, 2, 1) + noise.pixel**2 * np.eye(2)
    if covariance is not None:
        V = V + J @ covariance @ J.transpose(0, 2, 1)
    return np.where(ok, np.einsum("ni,nij,nj->n", r, np.linalg.inv(V), r), np.inf)


def _refuse_few(used: NDArray[np.bool_], observed: Observations, parameters: int) -> None:
    wrong = len(observed) - int(used.sum())
    if wrong > MAX_WRONG * len(observed):
        raise CalibrationError(
            f"{wrong} of {len(observed)} points do not fit any one camera and plane: check that ids, units and the "
            "camera file belong together, and that the camera did not move"
        )
    if 2 * int(used.sum()) < 6:
        raise CalibrationError(
            f"{int(used.sum())} usable points for {parameters} parameters: survey at least 4, better 20"
        )


def _covariance(
    model: PoolModel, rows: Observations, whiten: Whitener, free: NDArray[np.intp], prior: Prior
) -> Array:
    """Return the inverse information, in the order of `NAMES`; a very large variance where there is none."""
    N, _ = normal_equations(model, rows, whiten, free, prior)
    scale = np.sqrt(np.maximum(np.diagonal(N), 1e-300))
    values, vectors = np.linalg.eigh(N / np.outer(scale, scale))
    half = vectors / np.sqrt(np.maximum(values, 1e-14)) / scale[:, None]
    covariance = np.zeros((len(NAMES), len(NAMES)))
    covariance[np.ix_(free, free)] = half @ half.T
    return covariance


FEW = 4
"""Locations below which single rows are held out instead: a target or two have no parts to leave out."""


@dataclass(frozen=True)
class HeldOut:
    """Errors of K rows, each from a fit without its location."""

    pixels: Array
    """Measured minus predicted [px], (K, 2)."""
    points: Array
    """Back-projected minus surveyed, in the plane of the point [m], (K, 3)."""
    rows: NDArray[np.intp]
    """Indices of the observations, (K,)."""
    folds: int

    def as_json(self) -> dict[str, float | int | None]:
        """Root mean squares and 95th percentiles; the error of the survey is in them. Units are in the names."""
        size = np.linalg.norm(self.points, axis=1)
        size = size[np.isfinite(size)]
        return {
            "folds": self.folds,
            "points": len(self.rows),
            "rms_px": rms(self.pixels),
            "rms_cm": 100.0 * rms(size[:, None]) if len(size) else None,
            "p95_cm": 100.0 * float(np.percentile(size, 95)) if len(size) else None,
        }


def held_out(fit: Refined, observed: Observations, folds: int, seed: int, normal: Array) -> HeldOut | None:
    """Refit without each part of the locations in turn; None where too few would be left.

    Args:
        fit: To all rows; its outliers stay out.
        observed: All rows.
        folds: Parts, at most one for each location.
        seed: Of the parts.
        normal: Of the planes, one through each point, on which pixels are back-projected: unit, pool frame [-], (3,).
    """
    used = np.flatnonzero(fit.used)
    group = observed.location if len(np.unique(observed.location[used])) >= FEW else np.arange(len(observed))
    names = np.unique(group[used])
    folds = min(folds, len(names))
    if folds < 2:
        return None
    fold = np.empty(int(group.max()) + 1, int)
    fold[np.random.default_rng(seed).permutation(names)] = np.arange(len(names)) % folds
    pixels, points, rows = [], [], []
    for k in range(folds):
        inside = np.zeros(len(observed), bool)
        inside[used] = fold[group[used]] != k
        outside = used[fold[group[used]] == k]
        if 2 * inside.sum() < 8 or len(np.unique(observed.points[inside].round(6), axis=0)) < 4:
            return None
        part = observed.subset(inside)  # the errors stay as they were
        whiten = Whitener(fit.model.jacobians(part.points, part.dry)[1], part, fit.noise)
        model = solve(fit.model, part, whiten, fit.active, fit.prior).model
        here = observed.subset(outside)
        r, ok = residuals(model, here)
        rows.append(outside[ok])
        pixels.append(r[ok])
        points.append(error_vectors(model, here, normal)[ok])
    return HeldOut(np.concatenate(pixels), np.concatenate(points), np.concatenate(rows), folds)


def error_vectors(model: PoolModel, observed: Observations, normal: Array) -> Array:
    """Return where each pixel's ray meets the plane through its point, minus the point [m], (N, 3); NaN without one.

    Args:
        model: Camera and water.
        observed: Pixels and points.
        normal: Unit normal of the planes, pool frame [-], (3,).
    """
    rays, ok = model.camera.lens.rays(observed.pixels)
    origin = np.broadcast_to(np.asarray(model.camera.position), observed.points.shape).copy()
    direction = np.where(ok[:, None], rays, np.nan) @ np.asarray(model.camera.R_pc).T
    if model.refractive and not observed.dry.all():  # what is dry is seen straight from the camera
        water = back_project(model.camera, model.interface, observed.pixels[~observed.dry])
        origin[~observed.dry], direction[~observed.dry] = water.origin, water.direction
    with np.errstate(all="ignore"):
        length = ((observed.points - origin) @ normal) / (direction @ normal)
    return np.asarray(origin + length[:, None] * direction - observed.points)


# Estimates with intervals, and findings on what the pictures do not determine.

IDENTIFIED = 0.7
"""Ratio of a standard error to its prior above which the pictures contain almost no information."""

FAR = 0.05
"""Standard error of a distance, over the total distance, above which it counts as not determined."""

AT_BOUND = 0.01
"""Distance from the plane, over the total distance, below which camera or points lie on it."""

STEPS = np.array([1e-5] * 3 + [1e-6] * 5 + [1e-5, 1e-5, 1e-6, 1e-3, 1e-3, 1e-6, 1e-6] + [1e-7] * 3)
"""Steps of the derivatives by the parameters."""


def estimates(fit: Refined, settings: PoolFitSettings) -> tuple[dict[str, Estimate], Correlation]:
    """Return the table of estimates and the correlation of their errors; the latter without what was not fitted.

    Args:
        fit: The fit.
        settings: Options.
    """
    surface = settings.surface
    table, quantile = _quantities(fit.model, surface), float(student.ppf(0.975, fit.dof))
    G = np.zeros((len(table), len(NAMES)))
    for k in np.flatnonzero(fit.active):
        step = STEPS[k] * np.eye(len(NAMES))[k]
        ends = (_quantities(fit.model.moved(s), surface).values() for s in (step, -step))
        after, before = (np.array([value for _, value in end]) for end in ends)
        G[:, k] = (after - before) / (2.0 * STEPS[k])
    V = G @ fit.covariance @ G.T
    rows, moved = {}, (np.abs(G) > 1e-12).any(axis=1)
    for (name, (unit, value)), variance, moves in zip(table.items(), np.diagonal(V), moved, strict=True):
        std = float(np.sqrt(max(0.0, variance)))
        note = _doubt(name, std, fit, settings) if moves else AS_STATED
        rows[name] = Estimate.within(name, value, quantile * std, unit, not note, note)
    names = [name for name, moves in zip(table, moved, strict=True) if moves]
    return rows, correlation(names, V[np.ix_(moved, moved)])


def _quantities(model: PoolModel, surface: bool) -> dict[str, tuple[str, float]]:
    """Return name -> unit and value of all quantities in the table."""
    camera, lens, n = model.camera, model.camera.lens, model.interface.normal
    rows = dict(zip(("camera_x", "camera_y", "camera_z"), (("m", x) for x in camera.position), strict=True))
    angles = np.degrees(quat_to_euler(np.asarray(camera.orientation)))
    rows |= dict(
        zip(("camera_roll", "camera_pitch", "camera_yaw"), (("deg", x) for x in angles), strict=True)
    )
    if surface:
        rows["camera_height"] = ("m", model.clearance)
        rows["water_height"] = ("m", float(model.interface.height(*model.reference[:2])))
        rows["tilt_x"], rows["tilt_y"] = (("deg", np.degrees(np.arctan2(x, abs(n[2])))) for x in n[:2])
    else:
        rows["camera_distance"], rows["point_distance"] = ("m", model.clearance), ("m", model.depth)
        rows |= {f"normal_{axis}": ("1", x) for axis, x in zip("xyz", n, strict=True)}
    rows["index"], rows["focal"] = ("1", model.interface.index_far), ("px", lens.fx)
    rows["center_x"], rows["center_y"] = ("px", lens.cx), ("px", lens.cy)
    return rows | {name: ("1", x) for name, x in zip(LENS_NAMES[3:], lens.distortion, strict=False)}


def _doubt(name: str, std: float, fit: Refined, settings: PoolFitSettings) -> str:
    """Return the basis of a number that the pictures do not determine; empty where they do."""
    model, prior = fit.model, fit.prior
    reach = model.clearance + max(model.depth, 0.0)
    before, sentence = np.inf, ""
    if name == "index":
        before, sentence = prior.index_std, f"not determined by the pixels: fixed at {settings.index:g}"
    elif name in ("tilt_x", "tilt_y"):
        before, sentence = np.degrees(prior.tilt_std), "not determined by the pixels: assumed level"
    elif name in LENS_NAMES:
        before = prior.lens_std[LENS_NAMES.index(name)] * (model.camera.lens.fx if name == "focal" else 1.0)
        sentence = "not determined by the pixels: fixed at the camera file's"
    elif name in ("water_height", "point_distance") and settings.stated_depth:
        before, sentence = prior.depth_std, "rests on the measured height"
    elif name in ("camera_height", "camera_distance", "water_height", "point_distance"):
        if min(model.clearance, model.depth - model.interface.thickness) < AT_BOUND * reach:
            return "at its bound: the plane touches the camera or a point"
        before, sentence = FAR * reach / IDENTIFIED, "not determined by the pixels"
    return sentence if np.isfinite(before) and std > IDENTIFIED * before else ""


# Findings on what a survey does not determine, with the measurements that would.

NARROW = np.radians(20.0)
"""Angle of incidence below which refraction looks like a nearer floor."""

COMMON_DEPTH = 0.02
"""Spread of depths, over the distance to the camera, below which they count as one."""

CERTAIN = 0.999
"""Share of the marks above the water that are taken for such."""

FULL_LENS = "fit: [pose, height, tilt, index, focal, center, distortion]"


def advice(
    fit: Refined,
    observed: Observations,
    settings: PoolFitSettings,
    table: Mapping[str, Estimate],
    touching: Sequence[str],
    contradicted: Sequence[Finding],
) -> Iterator[Finding]:
    """Findings for the user, the gravest first.

    Args:
        fit: The fit.
        observed: All rows.
        settings: Options.
        table: Estimates.
        touching: What the plane came to rest against.
        contradicted: On measurements that the pixels contradict.
    """
    if touching:
        yield finding("plane_touches", places=tuple(touching))
    yield from contradicted
    yield from _separability(fit, observed, settings, table)
    yield from _conflicts(fit, settings)
    yield from _numbers(fit, observed)
    yield from _excluded_rows(fit, observed, settings.surface)


def _separability(
    fit: Refined, observed: Observations, settings: PoolFitSettings, table: Mapping[str, Estimate]
) -> Iterator[Finding]:
    """Yield findings on camera height, water height and index, which few points cannot separate."""
    model, wet = fit.model, observed.subset(fit.used & ~observed.dry)
    surface = settings.surface
    height = table["camera_height" if surface else "camera_distance"]
    half = 0.5 * (height.ci95[1] - height.ci95[0])
    n = model.interface.normal
    across = (wet.points - model.camera.position) - ((wet.points - model.camera.position) @ n)[:, None] * n
    radius = float(np.linalg.norm(across, axis=1).max())
    distance = model.clearance + model.depth
    steepest = float(np.arctan2(radius, distance))
    levels = float(np.ptp(wet.points @ n))
    quantities = (
        "camera height, water height" if surface else "distances of camera and points from the window"
    )
    tape = "measure the water's height with a tape and give surface: height"
    tape = (
        ""
        if settings.stated_depth
        else f": {tape if surface else 'measure where the window is and give window: plane'}"
    )
    if steepest < NARROW:
        angle = float(np.degrees(steepest))
        yield finding("points_narrow", radius=radius, angle=angle, quantities=quantities, remedy=tape)
    if levels < COMMON_DEPTH * distance and half > 0.01 * distance:
        yield finding("one_depth", spread=levels, quantities=quantities, half=1000.0 * half, remedy=tape)
    if not height.identifiable:
        low, high = height.ci95
        yield finding("height_unknown", height.name, estimate=height.estimate, low=low, high=high)
    focal = table["focal"]
    loose = focal.ci95[1] - focal.ci95[0] > 0.02 * focal.estimate
    if fit.active[NAMES.index("focal")] and loose and levels < 0.05 * distance:
        yield finding("focal_of_one_depth")


def _conflicts(fit: Refined, settings: PoolFitSettings) -> Iterator[Finding]:
    """Yield findings where the pixels pull an estimate far from its prior."""
    prior, model = fit.prior, fit.model
    focal = NAMES.index("focal")
    plane_name = "water's height" if settings.surface else "window's place"
    lens = "" if fit.active[focal] else f"; or let the lens be fitted ({FULL_LENS})"
    if np.isfinite(prior.index_std):
        pull = (model.interface.index_far - settings.index) / prior.index_std
        if abs(pull) > 3.0:
            yield finding(
                "index_pulled",
                index=model.interface.index_far,
                given=settings.index,
                times=abs(pull),
                place=plane_name,
                remedy=lens,
            )
    pull = np.log(model.camera.lens.fx / prior.start.camera.lens.fx) / prior.lens_std[0]
    if fit.active[focal] and abs(pull) > 2.0:
        change = float(np.exp(pull * prior.lens_std[0]) - 1.0)
        yield finding("focal_pulled", change=change, expected=prior.lens_std[0])
    if np.isfinite(prior.tilt_std) and prior.normal is not None:
        lean = _lean(model, prior.normal)
        if lean > 3.0 * prior.tilt_std:
            yield finding("tilt_pulled", lean=float(np.degrees(lean)), remedy=lens)


def _numbers(fit: Refined, observed: Observations) -> Iterator[Finding]:
    locations = len(np.unique(observed.location[fit.used]))
    if locations < 12:
        yield finding("few_places", places=locations)
    if fit.noise.pixel > 1.5:
        yield finding("residuals_large", residual=fit.noise.pixel, options=FULL_LENS)
    if fit.noise.scale > 2.0:
        error = 1000.0 * fit.noise.survey * fit.noise.scale
        yield finding("survey_rough", times=fit.noise.scale, error=error)


def _excluded_rows(fit: Refined, observed: Observations, surface: bool) -> Iterator[Finding]:
    """Yield findings on rows that were left out: marks above the water that are not flagged as dry, and others."""
    above = _above(fit, observed)
    wrong = int((~fit.used & ~above).sum())
    if above.any():
        names = tuple(observed.names[i] for i in np.flatnonzero(above))
        side_name = "above the water found" if surface else "on the camera's side of the plane found"
        yield finding("marks_dry", marks=names, place=side_name)
    if wrong:
        yield finding("rows_wrong", rows=wrong)


def _above(fit: Refined, observed: Observations) -> NDArray[np.bool_]:
    """Rows left out that lie on the camera's side of the plane and are met by straight lines, as far as the pose is
    told, (N,)."""
    side = observed.points @ fit.model.interface.normal + fit.model.interface.offset > 0.0
    side &= ~fit.used & ~observed.dry
    straight = surprise(
        fit.model, replace(observed, dry=np.ones(len(observed), bool)), fit.noise, fit.covariance
    )
    met = side & (straight < float(chi2.ppf(CERTAIN, 2)))
    return met & (2 * met.sum() > side.sum())  # some are met by chance


DOUBT = 20.0
"""Fall of chi² above which a prior counts as contradicted: by chance once in 20000 surveys, more in very poor ones."""

MAX_LEAN = np.radians(5.0)
"""A surface tilted further from the survey's z than this is none [rad]."""

LENS_STEPS = (("focal", "center"), ("focal", "center", "distortion"))
"""Groups of lens parameters that are fitted where the error at held-out points decreases."""

BETTER = 0.9
"""Factor on the held-out error below which another group of parameters is fitted."""


@dataclass(frozen=True, kw_only=True)
class PoolFit(Refined):
    """The result, in the survey's frame."""

    settings: PoolFitSettings
    estimates: dict[str, Estimate]
    correlation: Correlation
    observed: Observations
    residual: Array
    """Measured minus predicted [px], (N, 2)."""
    error: Array
    """Back-projected minus surveyed, in the plane of each point [m], (N, 3)."""
    held_out: HeldOut | None
    pinhole: Refined
    pinhole_residual: Array
    """Residuals of the straight-line fit, (N, 2), in pixels."""
    pinhole_held_out: HeldOut | None
    lens_fitted: tuple[str, ...]
    """Groups of `FITTED` that the lens gave up."""
    findings: tuple[Finding, ...]
    """Findings, the gravest first, notes last."""
    touching: tuple[str, ...]
    """Places of the survey, or the camera, that the plane came to rest against: it can pass neither."""

    @property
    def outliers(self) -> list[str]:
        """Names of the rows left out, the worst first."""
        size = np.linalg.norm(self.residual, axis=1)
        rows = np.flatnonzero(~self.used)
        return [self.observed.names[i] for i in rows[np.argsort(-size[rows])]]

    def residual_json(self) -> dict[str, float | int]:
        """Figures of the rows used. Units are in the names."""
        error = self.error[self.used]
        error = error[np.isfinite(error).all(axis=1)]
        return {
            "points": int(self.used.sum()),
            "locations": len(np.unique(self.observed.location[self.used])),
            "rms_px": rms(self.residual[self.used]),
            "rms_mm": 1000.0 * rms(error),
            "pixel_sigma": self.noise.pixel,
            "survey_sigma_mm": 1000.0 * self.noise.survey * self.noise.scale,
            "outliers": int((~self.used).sum()),
        }


def calibrate_pool(observed: Observations, lens: Lens, settings: PoolFitSettings | None = None) -> PoolFit:
    """Find the camera and the plane from no guess of either.

    Args:
        observed: Pixels and surveyed points.
        lens: Of the camera.
        settings: Options; those of `PoolFitSettings` if None.

    Raises:
        CalibrationError: The points cannot tell a pose, or contradict each other or what is given; says which.
    """
    settings = settings or PoolFitSettings()
    if observed.dry.all():
        raise CalibrationError("every point is marked dry: at least 4 must be under water")
    best_start = search(observed, extended_lens(lens), settings)
    notes = list(observed.findings)
    fit = _best_lens(observed, best_start, settings, notes)
    fit = _released(observed, settings, fit, notes)
    if settings.surface and fit.model.interface.normal[2] < 0.0:
        notes.append(finding("camera_below"))
    pinhole = _pinhole(observed, best_start, settings, fit)
    normal = UP if settings.surface else fit.model.interface.normal
    parts = [held_out(f, observed, settings.folds, settings.seed, normal) for f in (fit, pinhole)]
    table, errors = estimates(fit, settings)
    touching = touched(fit, observed)
    contradicted = _contradicted(observed, settings, fit)
    return PoolFit(
        **vars(fit),
        settings=settings,
        estimates=table,
        correlation=errors,
        observed=observed,
        residual=residuals(fit.model, observed)[0],
        error=error_vectors(fit.model, observed, normal),
        held_out=parts[0],
        pinhole=pinhole,
        pinhole_residual=residuals(pinhole.model, observed)[0],
        pinhole_held_out=parts[1],
        lens_fitted=_lens_groups(fit.active),
        findings=(
            *advice(fit, observed, settings, table, touching, contradicted),
            *notes,
        ),
        touching=touching,
    )


def _refined(
    observed: Observations,
    model: PoolModel,
    settings: PoolFitSettings,
    active: NDArray[np.bool_],
    prior: Prior,
) -> Refined:
    pixel, survey = settings.pixel_sigma or 0.4, max(settings.survey_sigma, 1e-7)
    noise = StandardErrors(pixel=pixel, survey=survey, survey_yaw=settings.survey_yaw_sigma)
    return refine(model, observed, active, prior, noise, fixed_pixel=settings.pixel_sigma is not None)


def _best_lens(
    observed: Observations, best_start: BestStart, settings: PoolFitSettings, notes: list[Finding]
) -> Refined:
    """Return the fit as set; unless set, lens parameters are fitted if the error at held-out points decreases."""
    start = replace(best_start.model, interface=replace(best_start.model.interface, index_far=settings.index))

    def fitted(model: PoolModel, active: NDArray[np.bool_]) -> Refined:
        stds = lens_std(settings, model.camera.lens.width)
        return _refined(observed, model, settings, active, prior_of(model, start, settings, stds))

    best = fitted(best_start.model, active_names(settings))
    if settings.fit is not None:
        return best
    normal = UP if settings.surface else best.model.interface.normal
    error = _generalisation(best, observed, settings, normal)
    for extra in LENS_STEPS:
        active = active_names(settings, extra)
        if 2 * len(observed) < 3 * active.sum() or not np.isfinite(error):
            break
        try:
            other = fitted(best.model, active)
        except (CalibrationError, np.linalg.LinAlgError):
            continue
        further = _generalisation(other, observed, settings, normal)
        if further < BETTER * error:
            best, error = other, further
    if groups := _lens_groups(best.active & ~active_names(settings)):
        notes.append(finding("lens_refitted", groups=groups))
    return best


def _generalisation(fit: Refined, observed: Observations, settings: PoolFitSettings, normal: Array) -> float:
    """Held-out error in the picture [px], rows that the fit left out counted as far as they lie."""
    out = held_out(fit, observed, settings.folds, settings.seed, normal)
    if out is None:
        return float("nan")
    excluded = residuals(fit.model, observed.subset(~fit.used))[0]
    return rms(np.concatenate([out.pixels, np.clip(excluded, -20.0, 20.0)]))


def _lens_groups(active: NDArray[np.bool_]) -> tuple[str, ...]:
    named = {"focal": "focal", "center": "center_x", "distortion": "distortion_1"}
    return tuple(group for group, name in named.items() if active[NAMES.index(name)])


def _released(
    observed: Observations, settings: PoolFitSettings, fit: Refined, notes: list[Finding]
) -> Refined:
    """Let the plane tilt freely where the pixels contradict its prior direction and no tilt sigma is set."""
    if not np.isfinite(fit.prior.tilt_std) or settings.tilt_sigma is not None or not fit.active[6]:
        return fit
    free = _without(observed, settings, fit, replace(fit.prior, tilt_std=np.inf))
    assert fit.prior.normal is not None
    if free is None:
        return fit
    # Small enough to be a tilt, and determined by the pixels.
    lean = _lean(free.model, fit.prior.normal)
    error = float(np.sqrt(max(free.covariance[k, k] for k in (6, 7))))
    if not (lean < MAX_LEAN and error < lean / 3.0):
        return fit
    notes.append(finding("plane_tilted", lean=float(np.degrees(lean))))
    return free


def _lean(model: PoolModel, normal: Array) -> float:
    """Angle between the plane's normal and another [rad]."""
    return float(np.arccos(np.clip(model.interface.normal @ normal, -1.0, 1.0)))


def _contradicted(observed: Observations, settings: PoolFitSettings, fit: Refined) -> list[Finding]:
    """A finding where the pixels by themselves put the plane elsewhere than it was measured."""
    if not settings.stated_depth or not fit.active[NAMES.index("depth")]:
        return []
    free = _without(observed, settings, fit, replace(fit.prior, depth_std=np.inf))
    if free is None:
        return []
    by = 1000.0 * (free.model.depth - fit.prior.depth)
    sense = "nearer to" if by > 0.0 else "further from"
    return [finding("plane_contradicted", distance=abs(by), sense=sense)]


def _without(observed: Observations, settings: PoolFitSettings, fit: Refined, loose: Prior) -> Refined | None:
    """The fit with a prior loosened, where the pixels contradict that prior; else None."""
    try:
        free = _refined(observed, fit.model, settings, fit.active, loose)
    except (CalibrationError, np.linalg.LinAlgError):
        return None
    held = solve(free.model, observed.subset(free.used), free.whiten, fit.active, fit.prior)
    return free if 2.0 * (held.cost - free.cost) > DOUBT else None


def _pinhole(
    observed: Observations, best_start: BestStart, settings: PoolFitSettings, fit: Refined
) -> Refined:
    """Straight lines fitted to the same rows, as plain calibrations do."""
    model = replace(best_start.pinhole, camera=replace(best_start.pinhole.camera, lens=fit.model.camera.lens))
    active = fit.active & np.array([name in NAMES[:6] or name in NAMES[10:] for name in NAMES])
    prior = replace(fit.prior, normal=None, depth=np.nan, depth_std=np.inf, index_std=np.inf)
    part = observed.subset(fit.used)
    alike = StandardErrors(pixel=1.0, survey=1e-7, survey_yaw=1e-7)
    end = solve(model, part, Whitener(np.zeros((len(part), 2, 3)), part, alike), active, prior).model
    alike = replace(alike, pixel=max(0.05, rms(residuals(end, part)[0]) / np.sqrt(2.0)))
    whiten = Whitener(end.jacobians(part.points, part.dry)[1], part, alike)
    model, cost = solve(end, part, whiten, active, prior)
    nothing = np.zeros((len(NAMES), len(NAMES)))
    return Refined(model, alike, fit.used, whiten, active, prior, nothing, cost, fit.dof)


# Findings against a finished calibration: no water, a wrong unit, an ambiguous frame.

STRAIGHTER = 0.7
"""Held-out error of straight lines over that of refraction below which refraction is not believed."""

FEWEST_COMPARED = 8
"""Held-out rows from which the two are compared."""

ON_PLANE = 0.01
"""Distance of the camera from the plane, over that of the points from the camera, below which it lies on it."""

ODD, ABSURD = 3.0, 10.0
"""Residuals of a camera on the plane [px] above which it is doubted, and refused."""

TOO_DEEP = 1.5
"""Ratio of the stated depth of the points to the greatest at which the camera could see them so large, above which it
is refused."""

LEAST_THICKNESS = 0.02
"""Thickness of the points, over their lesser width, below which they equal their mirror image."""


def doubted(fit: PoolFit, *, lens_stated: bool = True) -> PoolFit:
    """Return the calibration with the findings against it put first.

    Args:
        fit: The calibration.
        lens_stated: Somebody said how sure the lens is.

    Raises:
        CalibrationError: It cannot be a camera before water; says which number to check.
    """
    _refuse_depth(fit)
    findings = [*_touching(fit), *_handed(fit)]
    exact = [] if lens_stated or "focal" in fit.lens_fitted else [finding("lens_exact")]
    return replace(fit, findings=(*_straight(fit), *findings, *fit.findings, *exact))


def _refuse_depth(fit: PoolFit) -> None:
    """Refuse a stated plane so far from the points that the camera would be between them."""
    depth, option = _measured_depth(fit)
    camera = fit.pinhole.model
    apparent = abs(float(fit.model.interface.normal @ (camera.camera.position - camera.reference)))
    if depth > TOO_DEEP * fit.model.interface.index_far * apparent:
        raise CalibrationError(
            f"{option} puts the plane {depth:.3g} m from the points, but by the pixels the camera is only about "
            f"{apparent:.3g} m from them: check its unit (metres) and the survey's; nothing is written"
        )


def _measured_depth(fit: PoolFit) -> tuple[float, str]:
    """Return the measured distance of the plane from the middle of the points under water [m], and the key that gave
    it."""
    settings, middle = fit.settings, fit.observed.points[~fit.observed.dry].mean(axis=0)
    if settings.water_height is not None:
        return abs(settings.water_height - float(middle[2])), f"surface: height {settings.water_height:g}"
    if settings.water_depth is not None:
        return abs(settings.water_depth), f"surface: depth {settings.water_depth:g}"
    if settings.plane is not None:
        normal, offset = settings.unit_plane
        return abs(float(normal @ middle) + offset), "window: plane"
    return 0.0, ""


def _touching(fit: PoolFit) -> list[Finding]:
    """Return findings where the camera ends on the plane, which it cannot pass; refuse large residuals there."""
    model, error = fit.model, rms(fit.residual[fit.used])
    if model.clearance >= ON_PLANE * (model.clearance + max(model.depth, 0.0)) or error <= ODD:
        return []
    if error > ABSURD:
        raise CalibrationError(
            f"the fitted camera is on the plane itself, with residuals of {error:.0f} px: no camera "
            "in front of this plane fits the points; check the unit and sign of the water's height, the "
            "window's thickness [m], the index, and "
            "whether there is water between at all; nothing is written"
        )
    return [finding("camera_on_plane", residual=error)]


def _straight(fit: PoolFit) -> list[Finding]:
    """Return findings where straight lines predict points better than refraction."""
    bent, straight = fit.held_out, fit.pinhole_held_out
    if bent is None or straight is None or len(bent.rows) < FEWEST_COMPARED:
        return []
    errors = rms(bent.pixels), rms(straight.pixels)
    if not errors[1] < STRAIGHTER * errors[0]:
        return []
    return [finding("straight_better", straight=errors[1], refraction=errors[0])]


def _handed(fit: PoolFit) -> list[Finding]:
    """Return findings on a flat survey with z down or left-handed, which pixels do not distinguish."""
    settings = fit.settings
    if not settings.surface or fit.model.interface.normal[2] > 0.0 or settings.water_height is not None:
        return []
    values = np.linalg.svd(fit.observed.points - fit.observed.points.mean(axis=0), compute_uv=False)
    if values[2] >= LEAST_THICKNESS * values[1]:
        return []
    return [finding("handedness_open")]


# What `finssim calibrate pool` runs: read, match, fit, write the pool file, report.


DIGITS = {"m": 4, "deg": 3, "px": 2}
"""Digits after the point: tenths of a millimetre, thousandths of a degree, hundredths of a pixel; five without unit."""

MAX_NAMES = 12
"""Outliers that a sentence names."""

LEAST_SPREAD = 5.0
"""Largest width of all pixels that are refused: numbers from 0 to 1 are no pixels [px]."""

READING = (
    "The interval holds the true value in 19 of 20 such calibrations, if the priors (index, tape, "
    "level, camera file) are as accurate as stated. A note marks a number that the pixels do not "
    "determine, and names its prior. Judge the result by the error at points held out, in the depth "
    "where it will be used. "
    "Arrows that swirl or grow outwards indicate a wrong lens, window or water height; others are noise."
)


def pool_json(
    fit: PoolFit, *, out: Path | None = None, inputs: Mapping[str, str] | None = None
) -> dict[str, Any]:
    """Return the content of `--json` and of the report's `fit.json`.

    Args:
        fit: The calibration.
        out: Pool file that was written.
        inputs: File -> SHA-256 of what the fit was made from.
    """
    held_out, pinhole = (None if h is None else h.as_json() for h in (fit.held_out, fit.pinhole_held_out))
    figures = {
        "residual": fit.residual_json(),
        "held_out": held_out and {**held_out, "survey_cm": _survey_share(fit)},
        "pinhole": {"rms_px": rms(fit.pinhole_residual[fit.used]), "held_out": pinhole},
    }
    return {
        "kind": "pool",
        "interface": "surface" if fit.settings.surface else "window",
        "parameters": {name: estimate.as_json() for name, estimate in fit.estimates.items()},
        **plain(figures),
        "lens_fitted": list(fit.lens_fitted),
        "outliers": fit.outliers,
        "correlation": plain(fit.correlation.as_json(), 4),
        "findings": [item.as_json() for item in fit.findings],
        "settings": plain(asdict(fit.settings)),
        "inputs": dict(inputs or {}),
        "out": None if out is None else str(out),
        "provenance": provenance(),
    }


def pool_record(fit: PoolFit, inputs: Mapping[str, str]) -> dict[str, Any]:
    """Return the record in the pool file: the same without its long parts."""
    record = pool_json(fit, inputs=inputs)
    return {key: value for key, value in record.items() if key not in ("kind", "correlation", "out")}


def pool_report(fit: PoolFit) -> Report:
    """The calibration in words."""
    figures, held_out = (
        fit.residual_json(),
        "too few points to hold any out: the error at other points is not known",
    )
    summary = [
        f"residual {figures['rms_px']:.2f} px, {figures['rms_mm']:.1f} mm at the points; of it a pixel is worth "
        f"{figures['pixel_sigma']:.2f} px, the survey {figures['survey_sigma_mm']:.1f} mm"
    ]
    if fit.held_out is not None:
        share = _survey_share(fit)
        of_it = f"; of it the survey's own error {share:.2f} cm" if math.isfinite(share) else ""
        held_out = f"held out ({fit.held_out.folds} parts): {_figures(fit.held_out)}{of_it}"
    summary.append(held_out)
    if fit.pinhole_held_out is not None:
        summary.append(f"straight lines, held out: {_figures(fit.pinhole_held_out)}")
    if fit.outliers:
        more = ", ..." if len(fit.outliers) > MAX_NAMES else ""
        summary.append(f"left out as wrong: {', '.join(fit.outliers[:MAX_NAMES])}{more}")
    kind = "water surface" if fit.settings.surface else "window"
    return Report(
        title=f"Camera and {kind} from {figures['locations']} surveyed places",
        heads=(*HEADS, "note"),
        headline=f"camera before a {kind}, from {figures['locations']} surveyed places",
        estimates=list(fit.estimates.values()),
        cells=_cells,
        summary=summary,
        findings=fit.findings,
        reading=READING,
    )


def _cells(estimate: Estimate) -> tuple[str, ...]:
    value, low, high = (f"{x:.{DIGITS.get(estimate.unit, 5)}f}" for x in (estimate.estimate, *estimate.ci95))
    interval = "" if estimate.note == AS_STATED else f"{low} to {high}"
    return estimate.name, value, interval, estimate.unit, estimate.note


def _figures(held_out: HeldOut) -> str:
    figures = held_out.as_json()
    text = f"{figures['rms_px']:.2f} px"
    if figures["rms_cm"] is not None:
        text += f", in the water {figures['rms_cm']:.2f} cm rms, 95 % within {figures['p95_cm']:.2f} cm"
    return text


def _survey_share(fit: PoolFit) -> float:
    """Root mean square of the survey's own error across the planes of the points held out [cm].

    Two coordinates of each place, and the turn of tags; it is in the held-out error, and not one of the calibration.
    """
    if fit.held_out is None or not len(fit.held_out.rows):
        return math.nan
    held_out_rows, noise = fit.observed.subset(fit.held_out.rows), fit.noise
    sigma = np.where(np.isfinite(held_out_rows.sigma), held_out_rows.sigma, noise.survey)
    turn = noise.survey_yaw**2 * np.sum(held_out_rows.arm**2, axis=1)
    return 100.0 * noise.scale * float(np.sqrt(np.mean(2.0 * sigma**2 + turn)))


# Pictures of a calibrated pool: errors on the map and in the picture, and beside straight lines.


def pool_pictures(fit: PoolFit) -> dict[str, tuple[str, bytes]]:
    """File name -> what the picture shows, and the PNG; equal fits give equal pictures."""
    drawn = {
        "map.png": ("Where each pixel's ray meets the point's plane, less the surveyed point", _map(fit)),
        "picture.png": ("Measured less predicted pixels, enlarged", _picture(fit)),
    }
    if len(fit.correlation.names) > 1:
        drawn["correlation.png"] = ("Correlation of the errors", draw_correlation(fit.correlation))
    return {name: (text, png(figure)) for name, (text, figure) in drawn.items()}


def _map(fit: PoolFit) -> Figure:
    """Seen along the plane's normal."""
    figure = new_figure(7.4, 5.6)
    axes = figure.subplots()
    across, names = np.eye(3)[:2], ("x [m]", "y [m]")
    if not fit.settings.surface:
        across, names = fit.model.tangents, ("along the window [m]", "along the window, across [m]")
    axes.plot(*(across @ fit.model.camera.position), "^", color="black", markersize=8, label="camera")
    draw_arrows(axes, fit.observed.points @ across.T, 1000.0 * fit.error @ across.T, fit.used, "mm", 1000.0)
    axes.set(xlabel=names[0], ylabel=names[1], aspect="equal")
    return figure


def _picture(fit: PoolFit) -> Figure:
    lens = fit.model.camera.lens
    figure = new_figure(7.4, 7.4 * lens.height / lens.width + 0.6)
    axes = figure.subplots()
    draw_arrows(axes, fit.observed.pixels, fit.residual, fit.used, "px", 1.0)
    picture_axes(axes, lens)
    return figure


def run(
    inputs: Sequence[Path],
    *,
    survey: Path,
    camera: Path,
    out: Path,
    report: Path | None = None,
    seed: int = 1,
    as_json: bool = False,
) -> PoolFit:
    """Estimate camera pose [m, deg] and water plane (height [m], tilt [deg], index) from surveyed points in the
    water.

    Example: finssim calibrate pool pixels.csv --survey survey.yaml --camera camera.yaml --out pool.yaml

    Args:
        inputs (INPUT): Detections (.csv), pixels (id,u,v), pixels with points (u,v,x,y,z), or images of tags.
        survey (FILE): Survey file (.yaml): the points, what the camera looks through, and what is known of it.
        camera (FILE): Camera file: ours, or that of another program (see the page Bring what you have).
        out (FILE): Pool file to write (.yaml).
        report (DIR): Directory for the report and its figures.
        seed: Seed of every random number; equal seeds give equal results.
        as_json: Print one JSON object instead of tables.

    Returns:
        The calibration.

    Raises:
        CalibrationError, LocalizationError, OutputError: As they say; nothing is written then.
    """
    refuse_places(out, report, "pool")
    camera_file, survey_file = load_camera(camera), load_survey_file(survey)
    focal_sigma, center_sigma = _lens_sigma(camera_file)
    settings = survey_file.fit_settings(focal_sigma=focal_sigma, center_sigma=center_sigma, seed=seed)
    for path in inputs:
        if not Path(path).exists():
            raise CalibrationError(f"{path}: no such file")
    observed = survey_file.observe(list(map(Path, inputs)))
    _refuse_pixels(observed, camera_file)
    lens_stated = bool({"focal_sigma", "center_sigma"} & survey_file.settings.keys()) or any(
        (focal_sigma, center_sigma)
    )
    pool_fit = doubted(calibrate_pool(observed, camera_file.lens, settings), lens_stated=lens_stated)
    hashes = {
        str(path): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in map(Path, [*inputs, *survey_file.sources, camera])
        if path.is_file()
    }
    record = pool_record(pool_fit, hashes)
    pool = Pool(pool_fit.model.camera, pool_fit.model.interface, survey_file.latency, record=record)
    write_pool(pool, out)
    summary = pool_report(pool_fit)
    if report is not None:
        options = {"survey": survey, "camera": camera, "out": out, "seed": seed}
        repeat = [command_line("pool", inputs, options)]
        repeat += [f"{path}  sha256 {digest}" for path, digest in hashes.items()]
        summary.write(
            report, pool_json(pool_fit, out=Path(out), inputs=hashes), pool_pictures(pool_fit), repeat
        )
    as_object = pool_json(pool_fit, out=Path(out), inputs=hashes) if as_json else None
    publish(as_object, summary.show, (out, report))
    return pool_fit


def _refuse_pixels(observed: Observations, file: CameraFile) -> None:
    """Refuse pixels that another size of picture must have had, and what are none."""
    spread = float(np.ptp(observed.pixels, axis=0).max())
    if len(observed) > 1 and 0.0 < spread < LEAST_SPREAD:
        raise CalibrationError(
            f"the pixels spread over {spread:.3g} px in all: expected pixels, u from 0 to {file.lens.width - 1} and v "
            f"from 0 to {file.lens.height - 1}, not parts of the picture's size or coordinates on a plane before the "
            "lens: multiply them by the size"
        )
    outside = ~file.lens.inside(observed.pixels)
    if outside.mean() > 0.2:
        raise CalibrationError(
            f"{int(outside.sum())} of {len(observed)} pixels lie outside the camera file's picture of "
            f"{file.lens.width} x {file.lens.height}: the pixels come from another camera or another resolution"
        )


def _lens_sigma(file: CameraFile) -> tuple[float, float]:
    """Standard errors that the camera file remembers: of the focal length, relative, and of the centre [px]; or 0."""
    fx, cx, cy = (_remembered(file, name) for name in ("fx", "cx", "cy"))
    return fx / file.lens.fx, max(cx, cy)


def _remembered(file: CameraFile, name: str) -> float:
    estimates = file.record.get("estimates")
    entry = estimates.get(name) if isinstance(estimates, Mapping) else None
    try:
        low, high = (float(x) for x in entry["ci95"])  # type: ignore[index]
    except (KeyError, TypeError, ValueError):
        return 0.0
    return max(0.0, (high - low) / 3.92)
