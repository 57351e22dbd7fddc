"""Camera pose and water plane from surveyed points seen through the plane."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.fit import Correlation, Estimate
from finssim.calibration.vision.pool.observations import Observations
from finssim.calibration.vision.pool.pool_advice import advice
from finssim.calibration.vision.pool.pool_estimates import correlation, estimates
from finssim.calibration.vision.pool.pool_held_out import HeldOut, error_vectors, held_out, rms
from finssim.calibration.vision.pool.pool_model import NAMES, PoolModel, extended_lens
from finssim.calibration.vision.pool.pool_noise import Noise, Whitener
from finssim.calibration.vision.pool.pool_refine import Refined, refine, touched, touching_advice
from finssim.calibration.vision.pool.pool_search import UP, Found, prior_of, search, shifted_settings
from finssim.calibration.vision.pool.pool_settings import Settings, active_names, lens_std
from finssim.calibration.vision.pool.pool_solver import Prior, residuals, solve
from finssim.geometry.optics import Lens

__all__ = ["PoolFit", "calibrate_pool"]

Array = NDArray[np.float64]

DOUBT = 20.0
"""Fall of chi² above which a prior counts as contradicted: by chance once in 20000 surveys, more in very poor ones."""

LEVEL = np.radians(3.0)
"""A plane of any direction that is found this near to level is a water surface [rad]."""

MOST_LEAN = np.radians(5.0)
"""A surface tilted further from the survey's z than this is none [rad]."""

LENS_STEPS = ((), ("focal", "center"), ("focal", "center", "distortion"))
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
    notes: tuple[str, ...]
    advice: tuple[str, ...]
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

    @property
    def normal(self) -> Array:
        """Of the planes on which errors in the water are told, (3,)."""
        return UP if self.surface else self.model.interface.normal

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
    notes = list(seen.notes)
    fit = _best_lens(here, found, told, notes)
    if not found.surface and settings.interface == "auto" and settings.plane is None and _level(fit):
        found, notes = replace(found, surface=True), list(seen.notes)
        fit = _best_lens(here, found, told, notes)
    fit = _released(here, told, fit, notes)
    if found.surface and fit.model.interface.normal[2] < 0.0:
        notes.append(
            "the camera is on the -z side: the survey's z points down (or a flat survey is left-handed, which its "
            "points cannot tell); heights and --z of other commands are meant in that frame"
        )
    pinhole = _pinhole(here, found, told, fit)
    normal = UP if found.surface else fit.model.interface.normal
    parts = [held_out(f, here, settings.folds, settings.seed, normal) for f in (fit, pinhole)]
    table = estimates(fit, found.surface, told, centre)
    touching = touched(fit, here)
    return PoolFit(
        model=fit.model.shifted(centre),
        surface=found.surface,
        settings=settings,
        estimates=table,
        correlation=correlation(fit),
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
        notes=tuple(notes),
        advice=(
            *touching_advice(touching),
            *_contradicted(here, told, fit),
            *advice(fit, here, found.surface, told, table, found.minima),
        ),
        minima=found.minima,
        touching=touching,
    )


def _first_noise(settings: Settings) -> Noise:
    return Noise(
        pixel=settings.pixel_sigma or 0.4,
        survey=max(settings.survey_sigma, 1e-7),
        survey_yaw=settings.survey_yaw_sigma,
    )


def _refined(
    here: Observations, model: PoolModel, found: Found, told: Settings, active: NDArray[np.bool_]
) -> Refined:
    start = replace(found.model, interface=replace(found.model.interface, index_far=told.index))
    prior = prior_of(model, start, told, found.surface, lens_std(told, model.camera.lens.width))
    return refine(model, here, active, prior, _first_noise(told), pixel_known=told.pixel_sigma is not None)


def _best_lens(here: Observations, found: Found, told: Settings, notes: list[str]) -> Refined:
    """The fit as asked; where nobody asked, the lens is fitted as far as held-out points get better by it."""
    best = _refined(here, found.model, found, told, active_names(told))
    if told.fit is not None:
        return best
    normal = UP if found.surface else best.model.interface.normal
    error = _generalisation(best, here, told, normal)
    for extra in LENS_STEPS[1:]:
        active = active_names(told, extra)
        if 2 * len(here) < 3 * active.sum() or not np.isfinite(error):
            break
        try:
            other = _refined(here, best.model, found, told, active)
        except (CalibrationError, np.linalg.LinAlgError):
            continue
        further = _generalisation(other, here, told, normal)
        if further < BETTER * error:
            best, error = other, further
    if groups := _lens_groups(best.active & ~active_names(told)):
        notes.append(
            f"the camera file does not fit these pixels: {', '.join(groups)} of the lens fitted here as well, because "
            "points held out are met better so; a calibration of the camera by itself is worth more"
        )
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


def _released(here: Observations, told: Settings, fit: Refined, notes: list[str]) -> Refined:
    """Let the surface tilt freely where the pixels contradict a level one and nobody set how level it is."""
    if not np.isfinite(fit.prior.tilt_std) or told.tilt_sigma is not None or not fit.active[6]:
        return fit
    free = _without(here, told, fit, replace(fit.prior, tilt_std=np.inf))
    assert fit.prior.normal is not None
    if free is None or not _leans(free, fit.prior.normal):
        return fit
    lean = float(np.degrees(np.arccos(np.clip(free.model.interface.normal @ fit.prior.normal, -1.0, 1.0))))
    notes.append(
        f"the pixels contradict a plane along the survey's axis and want it {lean:.2f} degrees tilted: its "
        "direction was fitted freely; the survey's z may not be plumb (a sloping floor taken for level), or the camera "
        "file is off"
    )
    return free


def _level(fit: Refined) -> bool:
    """Whether a plane of free direction came out as level as a water surface is."""
    return bool(abs(float(fit.model.interface.normal[2])) > np.cos(LEVEL))


def _leans(free: Refined, normal: Array) -> bool:
    """Whether the tilt is small enough to be one, and told by the pixels rather than free to go anywhere."""
    lean = float(np.arccos(np.clip(free.model.interface.normal @ normal, -1.0, 1.0)))
    error = float(np.sqrt(max(free.covariance[k, k] for k in (6, 7))))
    return lean < MOST_LEAN and error < lean / 3.0


def _contradicted(here: Observations, told: Settings, fit: Refined) -> list[str]:
    """A sentence where the pixels by themselves put the plane elsewhere than it was measured."""
    if not told.known_depth or not fit.active[NAMES.index("depth")]:
        return []
    free = _without(here, told, fit, replace(fit.prior, depth_std=np.inf))
    if free is None:
        return []
    by = 1000.0 * (free.model.depth - fit.prior.depth)
    where = "nearer to" if by > 0.0 else "further from"
    return [
        f"the pixels by themselves put the plane {abs(by):.0f} mm {where} the camera than it was measured, "
        "which its error does not explain: check the tape, the survey's zero, the window and the camera file"
    ]


def _without(here: Observations, told: Settings, fit: Refined, loose: Prior) -> Refined | None:
    """The fit with a prior loosened, where the pixels contradict that prior; else None."""
    try:
        known = told.pixel_sigma is not None
        free = refine(fit.model, here, fit.active, loose, _first_noise(told), pixel_known=known)
    except (CalibrationError, np.linalg.LinAlgError):
        return None
    held = solve(free.model, here.subset(free.used), free.whiten, fit.active, fit.prior)
    return free if 2.0 * (held.cost - free.solution.cost) > DOUBT else None


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
    solution = solve(end, part, whiten, active, prior)
    return Refined(
        solution.model,
        alike,
        fit.used,
        whiten,
        active,
        prior,
        np.zeros((len(NAMES), len(NAMES))),
        solution,
        fit.dof,
    )
