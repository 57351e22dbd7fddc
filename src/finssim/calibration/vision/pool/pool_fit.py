"""Camera pose and water plane from surveyed points seen through the plane."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from finssim.calibration.errors import CalibrationError
from finssim.calibration.fit import Correlation, Estimate
from finssim.calibration.vision.pool.observations import Observations
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

# What a survey cannot tell, and what to measure so that the next one can.

NARROW = np.radians(20.0)
"""Angle of incidence below which refraction looks like a nearer floor."""

ONE_DEPTH = 0.02
"""Spread of depths, over the distance to the camera, below which they count as one."""

SAME_PLACE = 0.005
"""Two places of the plane nearer than this are one [m]."""

CERTAIN = 0.999
"""Share of the marks above the water that are taken for such."""

MOST_NAMES = 12
"""Rows that a sentence names."""

WHOLE_LENS = "--fit pose,height,tilt,index,focal,center,distortion"


def advice(
    fit: Refined,
    seen: Observations,
    surface: bool,
    settings: Settings,
    table: Mapping[str, Estimate],
    minima: Sequence[tuple[float, float]],
) -> list[str]:
    """Sentences for the user, the gravest first.

    Args:
        fit: In the frame of `seen`.
        seen: All rows.
        surface: The plane is a water surface.
        settings: Options, in the same frame.
        table: Estimates.
        minima: Other places where the search came to rest.
    """
    found = [*_place(fit, seen, surface, settings, table), *_conflicts(fit, surface, settings)]
    found += [*_numbers(fit, seen), *_left_out(fit, seen, surface)]
    place = table["camera_height" if surface else "camera_distance"]
    close = [
        clearance
        for ratio, clearance in minima
        if ratio < 1.1 and abs(clearance - place.estimate) > SAME_PLACE
    ]
    if close and not place.identifiable:
        found.append(
            f"another place of the plane fits about as well (camera {close[0]:.2f} m from it instead of "
            f"{place.estimate:.2f} m): measure it with a tape"
        )
    return found


def _place(
    fit: Refined, seen: Observations, surface: bool, settings: Settings, table: Mapping[str, Estimate]
) -> list[str]:
    """On camera height, water height and index, which few points cannot separate."""
    model, wet = fit.model, seen.subset(fit.used & ~seen.dry)
    height = table["camera_height" if surface else "camera_distance"]
    half = 0.5 * (height.ci95[1] - height.ci95[0])
    n = model.interface.normal
    across = (wet.points - model.camera.position) - ((wet.points - model.camera.position) @ n)[:, None] * n
    radius = float(np.linalg.norm(across, axis=1).max())
    whole = model.clearance + model.depth
    steepest = float(np.arctan2(radius, whole))
    levels = float(np.ptp(wet.points @ n))
    told = settings.known_depth
    what = "camera height, water height" if surface else "distances of camera and points from the wall"
    tape = (
        "measure the water's height with a tape and give --water-height"
        if surface
        else "measure where the wall is and give --plane"
    )
    found = []
    if steepest < NARROW:
        found.append(
            f"all points lie within {100 * radius:.0f} cm of the axis through the camera ({np.degrees(steepest):.0f} "
            f"degrees off it): {what} and index are not separable"
            + ("" if told else f": {tape}")
            + ", or add points further out"
        )
    if levels < ONE_DEPTH * whole and half > 0.01 * whole:
        found.append(
            f"all points are at one depth (within {100 * levels:.0f} cm): {what} are told only by how refraction bends "
            f"rays far out, here to ±{1000 * half:.0f} mm"
            + ("" if told else f": {tape}")
            + ", or survey some points at another depth"
        )
    if not height.identifiable:
        found.append(
            f"{height.name} is not determined ({height.estimate:.3f} m, 95 % from {height.ci95[0]:.3f} to "
            f"{height.ci95[1]:.3f}): positions at the depths surveyed are right all the same, at other depths they are "
            "not to be trusted"
        )
    focal = table["focal"]
    loose = focal.ci95[1] - focal.ci95[0] > 0.02 * focal.estimate
    if fit.active[NAMES.index("focal")] and loose and levels < 0.05 * whole:
        found.append(
            "the focal length was fitted to points of one depth: it and the camera's height stand for each other; "
            "calibrate the camera by itself (finssim calibrate camera)"
        )
    return found


def _conflicts(fit: Refined, surface: bool, settings: Settings) -> list[str]:
    """Where the pixels pull an estimate far from what was known."""
    found, prior, model = [], fit.prior, fit.model
    focal = NAMES.index("focal")
    place = "water's height" if surface else "plane's place"
    lens = "" if fit.active[focal] else f"; or let the lens be fitted ({WHOLE_LENS})"
    if np.isfinite(prior.index_std):
        pull = (model.interface.index_far - settings.index) / prior.index_std
        if abs(pull) > 3.0:
            found.append(
                f"the pixels want an index of {model.interface.index_far:.4f} in place of {settings.index:g}, "
                f"{abs(pull):.1f} times the error given: check the window, the {place} and the camera file{lens}"
            )
    pull = np.log(model.camera.lens.fx / prior.start.camera.lens.fx) / prior.lens_std[0]
    if fit.active[focal] and abs(pull) > 2.0:
        found.append(
            f"the focal length came out {100.0 * (np.exp(pull * prior.lens_std[0]) - 1.0):+.0f} % from the camera "
            f"file's, further than was expected ({100.0 * prior.lens_std[0]:.1f} %): give --focal-sigma 0.3 if "
            "the file is a guess"
        )
    if np.isfinite(prior.tilt_std) and prior.normal is not None:
        lean = float(np.arccos(np.clip(model.interface.normal @ prior.normal, -1.0, 1.0)))
        if lean > 3.0 * prior.tilt_std:
            found.append(
                f"the pixels want the plane {np.degrees(lean):.2f} degrees tilted: the survey's axis may not be "
                f"plumb; raise --tilt-sigma or level the survey{lens}"
            )
    return found


def _numbers(fit: Refined, seen: Observations) -> list[str]:
    found = []
    locations = len(np.unique(seen.location[fit.used]))
    if locations < 12:
        found.append(f"{locations} surveyed places: intervals from so few are rough; survey 20 or more")
    if fit.noise.pixel > 1.5:
        found.append(
            f"residuals of {fit.noise.pixel:.1f} px are larger than corners are usually found (0.1 to 0.5 px): check "
            f"the camera file, or let the lens be fitted ({WHOLE_LENS})"
        )
    if fit.noise.scale > 2.0:
        found.append(
            f"the survey seems {fit.noise.scale:.1f} times less exact than said "
            f"({1000 * fit.noise.survey * fit.noise.scale:.1f} mm): measure again, or give --survey-sigma"
        )
    return found


def _left_out(fit: Refined, seen: Observations, surface: bool) -> list[str]:
    """Rows that were left out: marks above the water that nobody called dry, and others."""
    above = _above(fit, seen)
    wrong = int((~fit.used & ~above).sum())
    found = []
    if above.any():
        names = [seen.names[i] for i in np.flatnonzero(above)]
        where = "above the water found" if surface else "on the camera's side of the plane found"
        one = len(names) == 1
        found.append(
            f"{', '.join(names[:MOST_NAMES])}{', ...' if len(names) > MOST_NAMES else ''} "
            f"{'lies' if one else 'lie'} {where}, and straight lines meet {'it' if one else 'them'}: mark "
            f"{'it' if one else 'them'} dry (a column dry with yes), which makes the camera's place surer"
        )
    if wrong:
        found.append(
            f"{wrong} {'more ' if above.any() else ''}row{'s were' if wrong > 1 else ' was'} left out as wrong: check "
            "ids and coordinates"
        )
    return found


def _above(fit: Refined, seen: Observations) -> NDArray[np.bool_]:
    """Rows left out that lie on the camera's side of the plane and are met by straight lines, as far as the pose is
    told, (N,)."""
    model, noise = fit.model, fit.noise
    side = seen.points @ model.interface.normal + model.interface.offset > 0.0
    rows = np.flatnonzero(~fit.used & ~seen.dry & side)
    found = np.zeros(len(seen), bool)
    if not len(rows):
        return found
    points, dry = seen.points[rows], np.ones(len(rows), bool)
    r = seen.pixels[rows] - model.predict(points, dry)
    J, J_point = model.jacobians(points, dry)
    sigma = noise.scale * np.where(np.isfinite(seen.sigma[rows]), seen.sigma[rows], noise.survey)
    V = J @ fit.covariance @ J.transpose(0, 2, 1) + noise.pixel**2 * np.eye(2)
    V = V + J_point @ J_point.transpose(0, 2, 1) * sigma[:, None, None] ** 2
    ok = np.isfinite(r).all(axis=1) & np.isfinite(V).all(axis=(1, 2))
    d2 = np.einsum("ni,nij,nj->n", r[ok], np.linalg.inv(V[ok]), r[ok])
    found[rows[ok]] = d2 < float(chi2.ppf(CERTAIN, 2))
    return found if 2 * found.sum() > len(rows) else np.zeros(len(seen), bool)  # some are met by chance


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
