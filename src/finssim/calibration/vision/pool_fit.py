"""Camera pose and water plane from surveyed points seen through the plane."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.findings import Finding, finding
from finssim.calibration.fit import Correlation, Estimate
from finssim.calibration.vision.pool_advice import advice, estimates
from finssim.calibration.vision.pool_model import (
    NAMES,
    PoolModel,
    Prior,
    Settings,
    active_names,
    clearances,
    extended_lens,
    lens_std,
    residuals,
    shifted_settings,
    solve,
)
from finssim.calibration.vision.pool_refine import (
    HeldOut,
    Noise,
    Refined,
    Whitener,
    error_vectors,
    held_out,
    refine,
    rms,
    touched,
)
from finssim.calibration.vision.pool_search import UP, Found, prior_of, search
from finssim.calibration.vision.survey import Observations
from finssim.geometry.optics import Lens

__all__ = ["PoolFit", "calibrate_pool", "doubted"]

Array = NDArray[np.float64]

DOUBT = 20.0
"""Fall of chi² above which a prior counts as contradicted: by chance once in 20000 surveys, more in very poor ones."""

LEVEL = np.radians(3.0)
"""A plane of any direction that is found this near to level is a water surface [rad]."""

MOST_LEAN = np.radians(5.0)
"""A surface tilted further from the survey's z than this is none [rad]."""

LENS_STEPS = (("focal", "center"), ("focal", "center", "distortion"))
"""What the lens gives up where held-out points get better by it."""

BETTER = 0.9
"""Factor on the held-out error that makes another group of parameters worth it."""


@dataclass(frozen=True, kw_only=True)
class PoolFit:
    """The result, in the survey's frame."""

    model: PoolModel
    surface: bool
    """The plane was taken for a water surface, its normal along the survey's z."""
    settings: Settings
    estimates: dict[str, Estimate]
    correlation: Correlation
    seen: Observations
    used: NDArray[np.bool_]
    """Rows that are not outliers, (N,)."""
    noise: Noise
    residual: Array
    """Measured minus predicted [px], (N, 2)."""
    error: Array
    """Back-projected minus surveyed, in the plane of each point [m], (N, 3)."""
    held_out: HeldOut | None
    pinhole: Refined
    pinhole_residual: Array
    pinhole_held_out: HeldOut | None
    lens_fitted: tuple[str, ...]
    """Groups of `FITTED` that the lens gave up."""
    findings: tuple[Finding, ...]
    """The gravest first, then what is merely worth knowing."""
    minima: tuple[tuple[float, float], ...]
    """Other places where the search came to rest: residual over that of the best, clearance of the camera [m]."""
    touching: tuple[str, ...]
    """Places of the survey, or the camera, that the plane came to rest against: it can pass neither."""

    @property
    def outliers(self) -> list[str]:
        """Names of the rows left out, the worst first."""
        size = np.linalg.norm(self.residual, axis=1)
        rows = np.flatnonzero(~self.used)
        return [self.seen.names[i] for i in rows[np.argsort(-size[rows])]]

    def residual_json(self) -> dict[str, float | int]:
        """Figures of the rows used."""
        error = self.error[self.used]
        error = error[np.isfinite(error).all(axis=1)]
        return {
            "points": int(self.used.sum()),
            "locations": len(np.unique(self.seen.location[self.used])),
            "rms_px": rms(self.residual[self.used]),
            "rms_mm": 1000.0 * rms(error),
            "pixel_sigma": self.noise.pixel,
            "survey_sigma_mm": 1000.0 * self.noise.survey * self.noise.scale,
            "outliers": int((~self.used).sum()),
        }


def calibrate_pool(seen: Observations, lens: Lens, settings: Settings | None = None) -> PoolFit:
    """Find the camera and the plane from no guess of either.

    Args:
        seen: Pixels and surveyed points.
        lens: Of the camera.
        settings: Options; those of `Settings` if None.

    Raises:
        CalibrationError: The points cannot tell a pose, or contradict each other or what is given; says which.
    """
    settings = settings or Settings()
    if seen.dry.all():
        raise CalibrationError("every point is marked dry: at least 4 must be under water")
    centre = seen.points[~seen.dry].mean(axis=0)
    here, told = seen.shifted(-centre), shifted_settings(settings, -centre)
    found = search(here, extended_lens(lens), told)
    notes = list(seen.findings)
    fit = _best_lens(here, found, told, notes)
    level = abs(float(fit.model.interface.normal[2])) > np.cos(LEVEL)
    if level and not found.surface and settings.interface == "auto" and settings.plane is None:
        found, notes = replace(found, surface=True), list(seen.findings)
        fit = _best_lens(here, found, told, notes)
    fit = _released(here, told, fit, notes)
    if found.surface and fit.model.interface.normal[2] < 0.0:
        notes.append(finding("camera_below"))
    pinhole = _pinhole(here, found, told, fit)
    normal = UP if found.surface else fit.model.interface.normal
    parts = [held_out(f, here, settings.folds, settings.seed, normal) for f in (fit, pinhole)]
    table, errors = estimates(fit, found.surface, told, centre)
    touching = touched(fit, here)
    contradicted = _contradicted(here, told, fit)
    return PoolFit(
        model=fit.model.shifted(centre),
        surface=found.surface,
        settings=settings,
        estimates=table,
        correlation=errors,
        seen=seen,
        used=fit.used,
        noise=fit.noise,
        residual=residuals(fit.model, here)[0],
        error=error_vectors(fit.model, here, normal),
        held_out=parts[0],
        pinhole=pinhole,
        pinhole_residual=residuals(pinhole.model, here)[0],
        pinhole_held_out=parts[1],
        lens_fitted=_lens_groups(fit.active),
        findings=(
            *advice(fit, here, found.surface, told, table, found.minima, touching, contradicted),
            *notes,
        ),
        minima=found.minima,
        touching=touching,
    )


def _refined(
    here: Observations, model: PoolModel, told: Settings, active: NDArray[np.bool_], prior: Prior
) -> Refined:
    pixel, survey = told.pixel_sigma or 0.4, max(told.survey_sigma, 1e-7)
    noise = Noise(pixel=pixel, survey=survey, survey_yaw=told.survey_yaw_sigma)
    return refine(model, here, active, prior, noise, pixel_known=told.pixel_sigma is not None)


def _best_lens(here: Observations, found: Found, told: Settings, notes: list[Finding]) -> Refined:
    """The fit as asked; where nobody asked, the lens is fitted as far as held-out points get better by it."""
    start = replace(found.model, interface=replace(found.model.interface, index_far=told.index))

    def fitted(model: PoolModel, active: NDArray[np.bool_]) -> Refined:
        stds = lens_std(told, model.camera.lens.width)
        return _refined(here, model, told, active, prior_of(model, start, told, found.surface, stds))

    best = fitted(found.model, active_names(told))
    if told.fit is not None:
        return best
    normal = UP if found.surface else best.model.interface.normal
    error = _generalisation(best, here, told, normal)
    for extra in LENS_STEPS:
        active = active_names(told, extra)
        if 2 * len(here) < 3 * active.sum() or not np.isfinite(error):
            break
        try:
            other = fitted(best.model, active)
        except (CalibrationError, np.linalg.LinAlgError):
            continue
        further = _generalisation(other, here, told, normal)
        if further < BETTER * error:
            best, error = other, further
    if groups := _lens_groups(best.active & ~active_names(told)):
        notes.append(finding("lens_refitted", groups=groups))
    return best


def _generalisation(fit: Refined, here: Observations, told: Settings, normal: Array) -> float:
    """Held-out error in the picture [px], rows that the fit left out counted as far as they lie."""
    out = held_out(fit, here, told.folds, told.seed, normal)
    if out is None:
        return float("nan")
    left = residuals(fit.model, here.subset(~fit.used))[0]
    return rms(np.concatenate([out.pixels, np.clip(left, -20.0, 20.0)]))


def _lens_groups(active: NDArray[np.bool_]) -> tuple[str, ...]:
    named = {"focal": "focal", "center": "center_x", "distortion": "distortion_1"}
    return tuple(group for group, name in named.items() if active[NAMES.index(name)])


def _released(here: Observations, told: Settings, fit: Refined, notes: list[Finding]) -> Refined:
    """Let the surface tilt freely where the pixels contradict a level one and nobody set how level it is."""
    if not np.isfinite(fit.prior.tilt_std) or told.tilt_sigma is not None or not fit.active[6]:
        return fit
    free = _without(here, told, fit, replace(fit.prior, tilt_std=np.inf))
    assert fit.prior.normal is not None
    if free is None or not _leans(free, fit.prior.normal):
        return fit
    lean = float(np.degrees(np.arccos(np.clip(free.model.interface.normal @ fit.prior.normal, -1.0, 1.0))))
    notes.append(finding("plane_tilted", lean=lean))
    return free


def _leans(free: Refined, normal: Array) -> bool:
    """Whether the tilt is small enough to be one, and told by the pixels rather than free to go anywhere."""
    lean = float(np.arccos(np.clip(free.model.interface.normal @ normal, -1.0, 1.0)))
    error = float(np.sqrt(max(free.covariance[k, k] for k in (6, 7))))
    return lean < MOST_LEAN and error < lean / 3.0


def _contradicted(here: Observations, told: Settings, fit: Refined) -> list[Finding]:
    """A finding where the pixels by themselves put the plane elsewhere than it was measured."""
    if not told.known_depth or not fit.active[NAMES.index("depth")]:
        return []
    free = _without(here, told, fit, replace(fit.prior, depth_std=np.inf))
    if free is None:
        return []
    by = 1000.0 * (free.model.depth - fit.prior.depth)
    sense = "nearer to" if by > 0.0 else "further from"
    return [finding("plane_contradicted", distance=abs(by), sense=sense)]


def _without(here: Observations, told: Settings, fit: Refined, loose: Prior) -> Refined | None:
    """The fit with a prior loosened, where the pixels contradict that prior; else None."""
    try:
        free = _refined(here, fit.model, told, fit.active, loose)
    except (CalibrationError, np.linalg.LinAlgError):
        return None
    held = solve(free.model, here.subset(free.used), free.whiten, fit.active, fit.prior)
    return free if 2.0 * (held.cost - free.cost) > DOUBT else None


def _pinhole(here: Observations, found: Found, told: Settings, fit: Refined) -> Refined:
    """Straight lines fitted to the same rows, as plain calibrations do."""
    model = replace(found.pinhole, camera=replace(found.pinhole.camera, lens=fit.model.camera.lens))
    active = fit.active & np.array([name in NAMES[:6] or name in NAMES[10:] for name in NAMES])
    prior = replace(fit.prior, normal=None, depth=np.nan, depth_std=np.inf, index_std=np.inf)
    part = here.subset(fit.used)
    alike = Noise(pixel=1.0, survey=1e-7, survey_yaw=1e-7)
    end = solve(model, part, Whitener(np.zeros((len(part), 2, 3)), part, alike), active, prior).model
    alike = replace(alike, pixel=max(0.05, rms(residuals(end, part)[0]) / np.sqrt(2.0)))
    whiten = Whitener(end.jacobians(part.points, part.dry)[1], part, alike)
    model, cost = solve(end, part, whiten, active, prior)
    nothing = np.zeros((len(NAMES), len(NAMES)))
    return Refined(model, alike, fit.used, whiten, active, prior, nothing, cost, fit.dof)


# What a finished calibration of a pool says against itself: no water, a wrong unit, a frame that cannot be told.

STRAIGHTER = 0.7
"""Held-out error of straight lines over that of refraction below which refraction is not believed."""

ENOUGH = 8
"""Held-out rows from which the two are compared."""

TOUCHING = 0.01
"""Distance of the camera from the plane, over that of the points from the camera, below which it lies on it."""

ODD, ABSURD = 3.0, 10.0
"""Residuals of a camera on the plane [px] above which it is doubted, and refused."""

TOO_DEEP = 1.5
"""Depth of the points below the plane as it was told, over the deepest that a camera above it could see so large."""

FLAT = 0.02
"""Thickness of the points, over their lesser width, below which their mirror image cannot be told from them."""

AGAINST = 0.002
"""Clearance of a point from the plane below which the plane ends against it [m]."""

MOST_ABOVE = 0.4
"""Share of the points that may be marks above the water."""

MET = 4.0, 3.0
"""Residual of straight lines that meets a mark: so many residuals of the rest, and so many pixels more."""


def doubted(fit: PoolFit, lens: Lens, *, lens_told: bool = True) -> PoolFit:
    """The calibration with what speaks against it put first.

    Args:
        fit: The calibration.
        lens: That it began with.
        lens_told: Somebody said how sure the lens is.

    Raises:
        CalibrationError: It cannot be a camera before water; says which number to check.
    """
    _refuse_depth(fit)
    found = [*_touching(fit), *_unmarked(fit, lens), *_handed(fit)]
    exact = [] if lens_told or "focal" in fit.lens_fitted else [finding("lens_exact")]
    return replace(fit, findings=(*_straight(fit), *found, *fit.findings, *exact))


def _refuse_depth(fit: PoolFit) -> None:
    """Refuse a plane told so far from the points that the camera, seen through it, would be between."""
    told, option = _told_depth(fit)
    camera = fit.pinhole.model
    apparent = abs(float(fit.model.interface.normal @ (camera.camera.position - camera.reference)))
    if told > TOO_DEEP * fit.model.interface.index_far * apparent:
        raise CalibrationError(
            f"{option} puts the plane {told:.3g} m from the points, but by the pixels the camera is only about "
            f"{apparent:.3g} m from them: check its unit (metres) and the survey's; nothing is written"
        )


def _told_depth(fit: PoolFit) -> tuple[float, str]:
    """Distance of the plane from the middle of the points under water as it was measured [m], and by which option."""
    settings, middle = fit.settings, fit.seen.points[~fit.seen.dry].mean(axis=0)
    if settings.water_height is not None:
        return abs(settings.water_height - float(middle[2])), f"--water-height {settings.water_height:g}"
    if settings.water_depth is not None:
        return abs(settings.water_depth), f"--water-depth {settings.water_depth:g}"
    if settings.plane is not None:
        normal, offset = settings.unit_plane
        return abs(float(normal @ middle) + offset), "--plane"
    return 0.0, ""


def _touching(fit: PoolFit) -> list[Finding]:
    """Where the camera comes to rest on the plane, which it cannot pass; refused where that is absurd."""
    model, error = fit.model, rms(fit.residual[fit.used])
    if model.clearance >= TOUCHING * (model.clearance + max(model.depth, 0.0)) or error <= ODD:
        return []
    if error > ABSURD:
        raise CalibrationError(
            f"the camera ends on the plane itself, with residuals of {error:.0f} px: no camera before this plane sees "
            "the points so; check the unit and sign of the water's height, the window's thickness [m], the index, and "
            "whether there is water between at all; nothing is written"
        )
    return [finding("camera_on_plane", residual=error)]


def _straight(fit: PoolFit) -> list[Finding]:
    """Where straight lines foretell points better than refraction."""
    bent, straight = fit.held_out, fit.pinhole_held_out
    if bent is None or straight is None or len(bent.rows) < ENOUGH:
        return []
    errors = rms(bent.pixels), rms(straight.pixels)
    if not errors[1] < STRAIGHTER * errors[0]:
        return []
    return [finding("straight_better", straight=errors[1], refraction=errors[0])]


def _unmarked(fit: PoolFit, lens: Lens) -> list[Finding]:
    """Marks above the water that nobody called dry, for which the plane was put over them, or the lens bent."""
    seen, rows = fit.seen, _highest(fit)
    if not rows.any():
        return []
    try:
        other = calibrate_pool(seen.subset(~rows), lens, fit.settings)
    except (CalibrationError, np.linalg.LinAlgError):
        return []
    marks = seen.subset(rows)
    above = clearances(other.model, marks.points) + other.model.interface.thickness < 0.0
    if not (above & _met(other, marks)).all():
        return []
    return [
        finding(
            "marks_unmarked",
            marks=marks.names,
            clearance=other.model.clearance,
            instead=fit.model.clearance,
        )
    ]


def _highest(fit: PoolFit) -> NDArray[np.bool_]:
    """Points nearest to the plane, down to the widest gap between heights, (N,).

    None of them where nothing is odd: the plane ends against no point, and the lens gave up nothing.
    """
    seen, model = fit.seen, fit.model
    distance = np.where(seen.dry, np.inf, clearances(model, seen.points))
    bent = fit.settings.fit is None and bool(fit.lens_fitted)
    order = np.sort(distance[~seen.dry])
    most = int(MOST_ABOVE * len(order))
    if most < 1 or not (bent or float(distance[fit.used].min()) < AGAINST):
        return np.zeros(len(seen), bool)
    gap = int(np.argmax(np.diff(order[: most + 1])))
    return np.asarray(distance <= order[gap])


def _met(fit: PoolFit, marks: Observations) -> NDArray[np.bool_]:
    """Which marks the camera sees where straight lines say, (K,)."""
    off = marks.pixels - fit.model.predict(marks.points, np.ones(len(marks), bool))
    times, more = MET
    return np.asarray(np.linalg.norm(off, axis=1) < times * rms(fit.residual[fit.used]) + more)


def _handed(fit: PoolFit) -> list[Finding]:
    """A flat survey whose z points down, or is left-handed: the same pixels, unless the water's height is told."""
    settings = fit.settings
    if not fit.surface or fit.model.interface.normal[2] > 0.0:
        return []
    if settings.water_height is not None or settings.plane is not None:
        return []
    values = np.linalg.svd(fit.seen.points - fit.seen.points.mean(axis=0), compute_uv=False)
    if values[2] >= FLAT * values[1]:
        return []
    return [finding("handedness_open")]
