"""Calibration of a pool: camera pose and water plane from surveyed points seen through the plane."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from finssim.core.least_squares import rms
from finssim.core.optics import Lens
from finssim.core.rotations import quat_to_euler
from finssim.identification.fit import Correlation, Estimate
from finssim.identification.report import AS_STATED
from finssim.identification.uncertainty import correlation
from finssim.survey.points import Observations
from finssim.survey.pool_findings import conflicts, excluded_rows, numbers, plane_contacts, separability
from finssim.survey.pool_model import (
    LENS_NAMES,
    NAMES,
    UP,
    PoolFitSettings,
    PoolModel,
    Prior,
    active_names,
    extended_lens,
    lens_std,
    mask_of,
    prior_of,
    residuals,
    solve,
    stated_plane,
)
from finssim.survey.pool_refine import (
    HeldOut,
    Refined,
    StandardErrors,
    Whitener,
    error_vectors,
    held_out,
    refine,
)
from finssim.survey.pool_search import search
from finssim.trials.findings import CalibrationError, Finding, finding

__all__ = ["PoolFit", "calibrate_pool", "with_critical_findings"]

Array = NDArray[np.float64]

IDENTIFIED = 0.7
"""Ratio of a standard error to its prior above which the pictures contain almost no information on a parameter."""

FAR = 0.05
"""Standard error of a distance, relative to the total distance, above which it is not determined [-]."""

AT_BOUND = 0.01
"""Distance from the plane, relative to the total distance, below which camera or points are at the bound [-]."""

STEPS = np.array([1e-5] * 3 + [1e-6] * 5 + [1e-5, 1e-5, 1e-6, 1e-3, 1e-3, 1e-6, 1e-6] + [1e-7] * 3)
"""Steps of the numerical derivatives by the parameters, in their units."""


def estimates(fit: Refined, settings: PoolFitSettings) -> tuple[dict[str, Estimate], Correlation]:
    """Return the table of estimates, and the correlation of the errors of the fitted ones.

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
        note = _uncertainty_note(name, std, fit, settings) if moves else AS_STATED
        rows[name] = Estimate.within(name, value, quantile * std, unit, not note, note)
    names = [name for name, moves in zip(table, moved, strict=True) if moves]
    return rows, correlation(names, V[np.ix_(moved, moved)])


def _quantities(model: PoolModel, surface: bool) -> dict[str, tuple[str, float]]:
    """Return all quantities of the table: name -> unit and value."""
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


def _uncertainty_note(name: str, std: float, fit: Refined, settings: PoolFitSettings) -> str:
    """Return the source of a number that the pictures do not determine; empty if they do."""
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


DOUBT = 20.0
"""Decrease of chi² without a prior above which the prior is contradicted: by chance once in 20000 surveys,
more often in very poor ones."""

MAX_LEAN = np.radians(5.0)
"""Largest angle between a water surface's normal and the survey's z axis [rad]."""

LENS_STEPS = (("focal", "center"), ("focal", "center", "distortion"))
"""Groups of lens parameters that are fitted if they decrease the error at held-out points."""

BETTER = 0.9
"""Factor on the held-out error below which a further group of parameters is fitted."""


@dataclass(frozen=True, kw_only=True)
class PoolFit(Refined):
    """Result of a pool calibration, in the survey's frame."""

    settings: PoolFitSettings
    estimates: dict[str, Estimate]
    correlation: Correlation
    observed: Observations
    residual: Array
    """Measured minus predicted pixels [px], (N, 2)."""
    error: Array
    """Back-projected minus surveyed points, in the plane of each point [m], (N, 3)."""
    held_out: HeldOut | None
    pinhole: Refined
    pinhole_residual: Array
    """Residuals of the straight-line fit, (N, 2), in pixels."""
    pinhole_held_out: HeldOut | None
    lens_fitted: tuple[str, ...]
    """Groups in `FITTED` of lens parameters that were fitted."""
    findings: tuple[Finding, ...]
    """Findings, the most severe first, notes last."""

    @property
    def outliers(self) -> list[str]:
        """Names of the excluded rows, the worst first."""
        size = np.linalg.norm(self.residual, axis=1)
        rows = np.flatnonzero(~self.used)
        return [self.observed.names[i] for i in rows[np.argsort(-size[rows])]]

    def residual_json(self) -> dict[str, float | int]:
        """Return the residual figures of the rows used. Units are in the names."""
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
    """Estimate the camera and the plane without an initial guess.

    Args:
        observed: Pixels and surveyed points.
        lens: Lens of the camera.
        settings: Options; None: those of `PoolFitSettings()`.

    Raises:
        CalibrationError: The points do not determine a pose, or contradict each other or the priors.
    """
    settings = settings or PoolFitSettings()
    if observed.dry.all():
        raise CalibrationError("every point is marked dry: at least 4 must be under water")
    refractive, straight = search(observed, extended_lens(lens), settings)
    steps, notes = _Steps(observed, settings), list(observed.findings)
    fit = steps.released(steps.best_lens(refractive, notes), notes)
    if settings.surface and fit.model.interface.normal[2] < 0.0:
        notes.append(finding("camera_below"))
    pinhole = steps.pinhole(straight, fit)
    table, errors = estimates(fit, settings)
    places = plane_contacts(fit, observed)
    return PoolFit(
        **vars(fit),
        settings=settings,
        estimates=table,
        correlation=errors,
        observed=observed,
        residual=residuals(fit.model, observed)[0],
        error=error_vectors(fit.model, observed, steps.normal(fit)),
        held_out=steps.held_out(fit, fit),
        pinhole=pinhole,
        pinhole_residual=residuals(pinhole.model, observed)[0],
        pinhole_held_out=steps.held_out(pinhole, fit),
        lens_fitted=_lens_groups(fit.active),
        findings=(
            *([finding("plane_touches", places=places)] if places else []),
            *steps.contradicted(fit),
            *separability(fit, observed, settings, table),
            *conflicts(fit, settings),
            *numbers(fit, observed),
            *excluded_rows(fit, observed, settings.surface),
            *notes,
        ),
    )


@dataclass(frozen=True)
class _Steps:
    """Stages of a calibration after the search, for the same rows and options."""

    observed: Observations
    settings: PoolFitSettings

    def refined(self, model: PoolModel, active: NDArray[np.bool_], prior: Prior) -> Refined:
        settings = self.settings
        pixel, survey = settings.pixel_sigma or 0.4, max(settings.survey_sigma, 1e-7)
        noise = StandardErrors(pixel=pixel, survey=survey, survey_yaw=settings.survey_yaw_sigma)
        fixed = settings.pixel_sigma is not None
        return refine(model, self.observed, active, prior, noise, fixed_pixel=fixed)

    def normal(self, fit: Refined) -> Array:
        """Return the normal of the planes in which errors in the water are measured, pool frame, (3,)."""
        return UP if self.settings.surface else fit.model.interface.normal

    def held_out(self, fit: Refined, refractive: Refined) -> HeldOut | None:
        """Return the errors of a fit at points held out, on planes parallel to those of the refractive fit."""
        settings = self.settings
        return held_out(fit, self.observed, settings.folds, settings.seed, self.normal(refractive))

    def best_lens(self, model: PoolModel, notes: list[Finding]) -> Refined:
        """Return the fit; unless its parameters are set, lens parameters are fitted if they decrease the
        held-out error."""
        settings = self.settings
        start = replace(model, interface=replace(model.interface, index_far=settings.index))

        def fitted(model: PoolModel, active: NDArray[np.bool_]) -> Refined:
            stds = lens_std(settings, model.camera.lens.width)
            return self.refined(model, active, prior_of(model, start, settings, stds))

        first = best = fitted(model, active_names(settings))
        if settings.fit is not None:
            return best
        error = self.generalisation(best, first)
        for extra in LENS_STEPS:
            active = active_names(settings, extra)
            if 2 * len(self.observed) < 3 * active.sum() or not np.isfinite(error):
                break
            try:
                other = fitted(best.model, active)
            except (CalibrationError, np.linalg.LinAlgError):
                continue
            further = self.generalisation(other, first)
            if further < BETTER * error:
                best, error = other, further
        if groups := _lens_groups(best.active & ~active_names(settings)):
            notes.append(finding("lens_refitted", groups=groups))
        return best

    def generalisation(self, fit: Refined, first: Refined) -> float:
        """Return the held-out error in the picture [px], including the bounded residuals of rows that the fit
        excluded."""
        out = self.held_out(fit, first)
        if out is None:
            return float("nan")
        excluded = residuals(fit.model, self.observed.subset(~fit.used))[0]
        return rms(np.concatenate([out.pixels, np.clip(excluded, -20.0, 20.0)]))

    def released(self, fit: Refined, notes: list[Finding]) -> Refined:
        """Return the fit with a free tilt if the pixels contradict the prior direction of the plane and no
        tilt sigma is set."""
        normal = fit.prior.normal
        if normal is None or not np.isfinite(fit.prior.tilt_std):
            return fit
        if self.settings.tilt_sigma is not None or not fit.active[6]:
            return fit
        free = self.without(fit, replace(fit.prior, tilt_std=np.inf))
        if free is None:
            return fit
        # Accept it if it is small enough for a tilt, and determined by the pixels.
        lean = free.model.lean(normal)
        error = float(np.sqrt(max(free.covariance[k, k] for k in (6, 7))))
        if not (lean < MAX_LEAN and error < lean / 3.0):
            return fit
        notes.append(finding("plane_tilted", lean=float(np.degrees(lean))))
        return free

    def contradicted(self, fit: Refined) -> list[Finding]:
        """Return a finding if the pixels alone place the plane at a distance that contradicts its measurement."""
        if not self.settings.stated_depth or not fit.active[NAMES.index("depth")]:
            return []
        free = self.without(fit, replace(fit.prior, depth_std=np.inf))
        if free is None:
            return []
        by = 1000.0 * (free.model.depth - fit.prior.depth)
        sense = "nearer to" if by > 0.0 else "further from"
        return [finding("plane_contradicted", distance=abs(by), sense=sense)]

    def without(self, fit: Refined, loose: Prior) -> Refined | None:
        """Return the fit with a loosened prior if the pixels contradict the original prior; else None."""
        try:
            free = self.refined(fit.model, fit.active, loose)
        except (CalibrationError, np.linalg.LinAlgError):
            return None
        held = solve(free.model, self.observed.subset(free.used), free.whiten, fit.active, fit.prior)
        return free if 2.0 * (held.cost - free.cost) > DOUBT else None

    def pinhole(self, model: PoolModel, fit: Refined) -> Refined:
        """Return a straight-line fit to the same rows, as in an ordinary calibration."""
        model = replace(model, camera=replace(model.camera, lens=fit.model.camera.lens))
        active = fit.active & mask_of((*NAMES[:6], *NAMES[10:]))
        prior = replace(fit.prior, normal=None, depth=np.nan, depth_std=np.inf, index_std=np.inf)
        part = self.observed.subset(fit.used)
        alike = StandardErrors(pixel=1.0, survey=1e-7, survey_yaw=1e-7)
        end = solve(model, part, Whitener(np.zeros((len(part), 2, 3)), part, alike), active, prior).model
        alike = replace(alike, pixel=max(0.05, rms(residuals(end, part)[0]) / np.sqrt(2.0)))
        whiten = Whitener(end.jacobians(part.points, part.dry)[1], part, alike)
        model, cost = solve(end, part, whiten, active, prior)
        nothing = np.zeros((len(NAMES), len(NAMES)))
        return Refined(model, alike, fit.used, whiten, active, prior, nothing, cost, fit.dof)


def _lens_groups(active: NDArray[np.bool_]) -> tuple[str, ...]:
    named = {"focal": "focal", "center": "center_x", "distortion": "distortion_1"}
    return tuple(group for group, name in named.items() if active[NAMES.index(name)])


# Critical findings about a finished calibration: no water, a wrong unit, an ambiguous frame.

STRAIGHTER = 0.7
"""Ratio of the held-out error of straight lines to that of refraction below which refraction is doubted."""

FEWEST_COMPARED = 8
"""Least number of held-out rows for this comparison."""

ON_PLANE = 0.01
"""Distance of the camera from the plane, relative to that of the points from the camera, below which it lies
on it [-]."""

ODD, ABSURD = 3.0, 10.0
"""Residuals of a camera on the plane above which it is reported, and refused [px]."""

TOO_DEEP = 1.5
"""Ratio of the stated depth of the points to the greatest depth consistent with their apparent size, above which it
is refused."""

LEAST_THICKNESS = 0.02
"""Thickness of the point set, relative to its lesser width, below which it cannot be distinguished from its
mirror image."""


def with_critical_findings(fit: PoolFit, *, lens_stated: bool = True) -> PoolFit:
    """Return the calibration with critical findings put first.

    Args:
        fit: The calibration.
        lens_stated: True if the uncertainty of the lens is stated.

    Raises:
        CalibrationError: The result is impossible for a camera in front of water; the message names the
            number to check.
    """
    _refuse_depth(fit)
    findings = [*_touching(fit), *_handed(fit)]
    exact = [] if lens_stated or "focal" in fit.lens_fitted else [finding("lens_exact")]
    return replace(fit, findings=(*_straight(fit), *findings, *fit.findings, *exact))


def _refuse_depth(fit: PoolFit) -> None:
    """Refuse a stated plane that is so far from the points that the camera would be between them."""
    settings, model = fit.settings, fit.pinhole.model
    depth = abs(stated_plane(model, settings)[1])
    apparent = abs(float(fit.model.interface.normal @ (model.camera.position - model.reference)))
    if depth > TOO_DEEP * fit.model.interface.index_far * apparent:
        option = "window: plane"
        if settings.water_height is not None:
            option = f"surface: height {settings.water_height:g}"
        elif settings.water_depth is not None:
            option = f"surface: depth {settings.water_depth:g}"
        raise CalibrationError(
            f"{option} puts the plane {depth:.3g} m from the points, but by the pixels the camera is only about "
            f"{apparent:.3g} m from them: check its unit (metres) and the survey's; nothing is written"
        )


def _touching(fit: PoolFit) -> list[Finding]:
    """Return findings if the fitted camera lies on the plane, which it cannot cross; refuse large residuals there."""
    model, error = fit.model, rms(fit.residual[fit.used])
    if model.clearance >= ON_PLANE * (model.clearance + max(model.depth, 0.0)) or error <= ODD:
        return []
    if error > ABSURD:
        raise CalibrationError(
            f"the fitted camera is on the plane itself, with residuals of {error:.0f} px: no camera "
            "in front of this plane fits the points; check the unit and sign of the water's height, the "
            "window's thickness [m], the index, and whether there is water between at all; nothing is written"
        )
    return [finding("camera_on_plane", residual=error)]


def _straight(fit: PoolFit) -> list[Finding]:
    """Return findings if straight lines predict points better than refraction."""
    bent, straight = fit.held_out, fit.pinhole_held_out
    if bent is None or straight is None or len(bent.rows) < FEWEST_COMPARED:
        return []
    errors = rms(bent.pixels), rms(straight.pixels)
    if not errors[1] < STRAIGHTER * errors[0]:
        return []
    return [finding("straight_better", straight=errors[1], refraction=errors[0])]


def _handed(fit: PoolFit) -> list[Finding]:
    """Return findings on a flat survey with z down or left-handed axes, which pixels do not distinguish."""
    settings = fit.settings
    if not settings.surface or fit.model.interface.normal[2] > 0.0 or settings.water_height is not None:
        return []
    values = np.linalg.svd(fit.observed.points - fit.observed.points.mean(axis=0), compute_uv=False)
    if values[2] >= LEAST_THICKNESS * values[1]:
        return []
    return [finding("handedness_open")]


# Steps of `finssim calibrate pool`: read, match, fit, write the pool file, report.
