"""Camera pose and water plane from surveyed points seen through the plane."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2
from scipy.stats import t as student

from finssim.calibration.degeneracy import correlation
from finssim.calibration.errors import CalibrationError
from finssim.calibration.findings import Finding, finding
from finssim.calibration.fit import Correlation, Estimate
from finssim.calibration.vision.pool_model import (
    LENS_NAMES,
    NAMES,
    PoolModel,
    Prior,
    Settings,
    active_names,
    clearances,
    extended_lens,
    lens_std,
    residuals,
    solve,
)
from finssim.calibration.vision.pool_search import (
    UP,
    Found,
    HeldOut,
    Noise,
    Refined,
    Whitener,
    error_vectors,
    held_out,
    prior_of,
    refine,
    rms,
    search,
    surprise,
    touched,
)
from finssim.calibration.vision.report import AS_GIVEN
from finssim.calibration.vision.survey import Observations
from finssim.geometry.optics import Lens
from finssim.geometry.rotations import quat_to_euler

__all__ = ["PoolFit", "calibrate_pool", "doubted"]

Array = NDArray[np.float64]

# What was estimated, with intervals and whether the pictures tell it, and what to measure so that they do.

TOLD = 0.7
"""A standard error above this part of what was known before means that the pictures tell next to nothing."""

FAR = 0.05
"""Standard error of a distance, over the whole distance, above which it counts as not determined."""

AT_BOUND = 0.01
"""Distance from the plane, over the whole distance, below which camera or points lie on it."""

STEPS = np.array([1e-5] * 3 + [1e-6] * 5 + [1e-5, 1e-5, 1e-6, 1e-3, 1e-3, 1e-6, 1e-6] + [1e-7] * 3)
"""Of the derivatives by the parameters."""


def estimates(fit: Refined, surface: bool, settings: Settings) -> tuple[dict[str, Estimate], Correlation]:
    """Table of estimates, and the correlation of their errors, without what was not fitted.

    Args:
        fit: The fit.
        surface: The plane is a water surface.
        settings: Options.
    """
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
        note = _doubt(name, std, fit, settings) if moves else AS_GIVEN
        rows[name] = Estimate.within(name, value, quantile * std, unit, not note, note)
    names = [name for name, moves in zip(table, moved, strict=True) if moves]
    return rows, correlation(names, V[np.ix_(moved, moved)])


def _quantities(model: PoolModel, surface: bool) -> dict[str, tuple[str, float]]:
    """Name -> unit and value of everything that is told."""
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


def _doubt(name: str, std: float, fit: Refined, settings: Settings) -> str:
    """What a number rests on where the pictures do not tell it; empty where they do."""
    model, prior = fit.model, fit.prior
    reach = model.clearance + max(model.depth, 0.0)
    before, sentence = np.inf, ""
    if name == "index":
        before, sentence = prior.index_std, f"the pixels do not tell it: held at {settings.index:g}"
    elif name in ("tilt_x", "tilt_y"):
        before, sentence = np.degrees(prior.tilt_std), "the pixels do not tell it: held level"
    elif name in LENS_NAMES:
        before = prior.lens_std[LENS_NAMES.index(name)] * (model.camera.lens.fx if name == "focal" else 1.0)
        sentence = "the pixels do not tell it: held at the camera file's"
    elif name in ("water_height", "point_distance") and settings.known_depth:
        before, sentence = prior.depth_std, "rests on the measured height"
    elif name in ("camera_height", "camera_distance", "water_height", "point_distance"):
        if min(model.clearance, model.depth - model.interface.thickness) < AT_BOUND * reach:
            return "at its bound: the plane touches the camera or a point"
        before, sentence = FAR * reach / TOLD, "the pixels do not tell it"
    return sentence if np.isfinite(before) and std > TOLD * before else ""


# What a survey cannot tell, and what to measure so that the next one can.

NARROW = np.radians(20.0)
"""Angle of incidence below which refraction looks like a nearer floor."""

ONE_DEPTH = 0.02
"""Spread of depths, over the distance to the camera, below which they count as one."""

CERTAIN = 0.999
"""Share of the marks above the water that are taken for such."""

WHOLE_LENS = "--fit pose,height,tilt,index,focal,center,distortion"


def advice(
    fit: Refined,
    seen: Observations,
    surface: bool,
    settings: Settings,
    table: Mapping[str, Estimate],
    touching: Sequence[str],
    contradicted: Sequence[Finding],
) -> Iterator[Finding]:
    """Findings for the user, the gravest first.

    Args:
        fit: The fit.
        seen: All rows.
        surface: The plane is a water surface.
        settings: Options.
        table: Estimates.
        touching: What the plane came to rest against.
        contradicted: On measurements that the pixels contradict.
    """
    if touching:
        yield finding("plane_touches", places=tuple(touching))
    yield from contradicted
    yield from _place(fit, seen, surface, settings, table)
    yield from _conflicts(fit, surface, settings)
    yield from _numbers(fit, seen)
    yield from _left_out(fit, seen, surface)


def _place(
    fit: Refined, seen: Observations, surface: bool, settings: Settings, table: Mapping[str, Estimate]
) -> Iterator[Finding]:
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
    what = "camera height, water height" if surface else "distances of camera and points from the wall"
    tape = "measure the water's height with a tape and give --water-height"
    tape = (
        ""
        if settings.known_depth
        else f": {tape if surface else 'measure where the wall is and give --plane'}"
    )
    if steepest < NARROW:
        angle = float(np.degrees(steepest))
        yield finding("points_narrow", radius=radius, angle=angle, quantities=what, remedy=tape)
    if levels < ONE_DEPTH * whole and half > 0.01 * whole:
        yield finding("one_depth", spread=levels, quantities=what, half=1000.0 * half, remedy=tape)
    if not height.identifiable:
        low, high = height.ci95
        yield finding("height_unknown", height.name, estimate=height.estimate, low=low, high=high)
    focal = table["focal"]
    loose = focal.ci95[1] - focal.ci95[0] > 0.02 * focal.estimate
    if fit.active[NAMES.index("focal")] and loose and levels < 0.05 * whole:
        yield finding("focal_of_one_depth")


def _conflicts(fit: Refined, surface: bool, settings: Settings) -> Iterator[Finding]:
    """Where the pixels pull an estimate far from what was known."""
    prior, model = fit.prior, fit.model
    focal = NAMES.index("focal")
    place = "water's height" if surface else "plane's place"
    lens = "" if fit.active[focal] else f"; or let the lens be fitted ({WHOLE_LENS})"
    if np.isfinite(prior.index_std):
        pull = (model.interface.index_far - settings.index) / prior.index_std
        if abs(pull) > 3.0:
            yield finding(
                "index_pulled",
                index=model.interface.index_far,
                given=settings.index,
                times=abs(pull),
                place=place,
                remedy=lens,
            )
    pull = np.log(model.camera.lens.fx / prior.start.camera.lens.fx) / prior.lens_std[0]
    if fit.active[focal] and abs(pull) > 2.0:
        change = float(np.exp(pull * prior.lens_std[0]) - 1.0)
        yield finding("focal_pulled", change=change, expected=prior.lens_std[0])
    if np.isfinite(prior.tilt_std) and prior.normal is not None:
        lean = float(np.arccos(np.clip(model.interface.normal @ prior.normal, -1.0, 1.0)))
        if lean > 3.0 * prior.tilt_std:
            yield finding("tilt_pulled", lean=float(np.degrees(lean)), remedy=lens)


def _numbers(fit: Refined, seen: Observations) -> Iterator[Finding]:
    locations = len(np.unique(seen.location[fit.used]))
    if locations < 12:
        yield finding("few_places", places=locations)
    if fit.noise.pixel > 1.5:
        yield finding("residuals_large", residual=fit.noise.pixel, options=WHOLE_LENS)
    if fit.noise.scale > 2.0:
        error = 1000.0 * fit.noise.survey * fit.noise.scale
        yield finding("survey_rough", times=fit.noise.scale, error=error)


def _left_out(fit: Refined, seen: Observations, surface: bool) -> Iterator[Finding]:
    """Rows that were left out: marks above the water that nobody called dry, and others."""
    above = _above(fit, seen)
    wrong = int((~fit.used & ~above).sum())
    if above.any():
        names = tuple(seen.names[i] for i in np.flatnonzero(above))
        place = "above the water found" if surface else "on the camera's side of the plane found"
        yield finding("marks_dry", marks=names, place=place)
    if wrong:
        yield finding("rows_wrong", rows=wrong)


def _above(fit: Refined, seen: Observations) -> NDArray[np.bool_]:
    """Rows left out that lie on the camera's side of the plane and are met by straight lines, as far as the pose is
    told, (N,)."""
    side = seen.points @ fit.model.interface.normal + fit.model.interface.offset > 0.0
    side &= ~fit.used & ~seen.dry
    straight = surprise(fit.model, replace(seen, dry=np.ones(len(seen), bool)), fit.noise, fit.covariance)
    met = side & (straight < float(chi2.ppf(CERTAIN, 2)))
    return met & (2 * met.sum() > side.sum())  # some are met by chance


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
    found = search(seen, extended_lens(lens), settings)
    notes = list(seen.findings)
    fit = _best_lens(seen, found, settings, notes)
    level = abs(float(fit.model.interface.normal[2])) > np.cos(LEVEL)
    if level and not found.surface and settings.interface == "auto" and settings.plane is None:
        found, notes = replace(found, surface=True), list(seen.findings)
        fit = _best_lens(seen, found, settings, notes)
    fit = _released(seen, settings, fit, notes)
    if found.surface and fit.model.interface.normal[2] < 0.0:
        notes.append(finding("camera_below"))
    pinhole = _pinhole(seen, found, settings, fit)
    normal = UP if found.surface else fit.model.interface.normal
    parts = [held_out(f, seen, settings.folds, settings.seed, normal) for f in (fit, pinhole)]
    table, errors = estimates(fit, found.surface, settings)
    touching = touched(fit, seen)
    contradicted = _contradicted(seen, settings, fit)
    return PoolFit(
        model=fit.model,
        surface=found.surface,
        settings=settings,
        estimates=table,
        correlation=errors,
        seen=seen,
        used=fit.used,
        noise=fit.noise,
        residual=residuals(fit.model, seen)[0],
        error=error_vectors(fit.model, seen, normal),
        held_out=parts[0],
        pinhole=pinhole,
        pinhole_residual=residuals(pinhole.model, seen)[0],
        pinhole_held_out=parts[1],
        lens_fitted=_lens_groups(fit.active),
        findings=(
            *advice(fit, seen, found.surface, settings, table, touching, contradicted),
            *notes,
        ),
        touching=touching,
    )


def _refined(
    seen: Observations, model: PoolModel, settings: Settings, active: NDArray[np.bool_], prior: Prior
) -> Refined:
    pixel, survey = settings.pixel_sigma or 0.4, max(settings.survey_sigma, 1e-7)
    noise = Noise(pixel=pixel, survey=survey, survey_yaw=settings.survey_yaw_sigma)
    return refine(model, seen, active, prior, noise, pixel_known=settings.pixel_sigma is not None)


def _best_lens(seen: Observations, found: Found, settings: Settings, notes: list[Finding]) -> Refined:
    """The fit as asked; where nobody asked, the lens is fitted as far as held-out points get better by it."""
    start = replace(found.model, interface=replace(found.model.interface, index_far=settings.index))

    def fitted(model: PoolModel, active: NDArray[np.bool_]) -> Refined:
        stds = lens_std(settings, model.camera.lens.width)
        return _refined(seen, model, settings, active, prior_of(model, start, settings, found.surface, stds))

    best = fitted(found.model, active_names(settings))
    if settings.fit is not None:
        return best
    normal = UP if found.surface else best.model.interface.normal
    error = _generalisation(best, seen, settings, normal)
    for extra in LENS_STEPS:
        active = active_names(settings, extra)
        if 2 * len(seen) < 3 * active.sum() or not np.isfinite(error):
            break
        try:
            other = fitted(best.model, active)
        except (CalibrationError, np.linalg.LinAlgError):
            continue
        further = _generalisation(other, seen, settings, normal)
        if further < BETTER * error:
            best, error = other, further
    if groups := _lens_groups(best.active & ~active_names(settings)):
        notes.append(finding("lens_refitted", groups=groups))
    return best


def _generalisation(fit: Refined, seen: Observations, settings: Settings, normal: Array) -> float:
    """Held-out error in the picture [px], rows that the fit left out counted as far as they lie."""
    out = held_out(fit, seen, settings.folds, settings.seed, normal)
    if out is None:
        return float("nan")
    left = residuals(fit.model, seen.subset(~fit.used))[0]
    return rms(np.concatenate([out.pixels, np.clip(left, -20.0, 20.0)]))


def _lens_groups(active: NDArray[np.bool_]) -> tuple[str, ...]:
    named = {"focal": "focal", "center": "center_x", "distortion": "distortion_1"}
    return tuple(group for group, name in named.items() if active[NAMES.index(name)])


def _released(seen: Observations, settings: Settings, fit: Refined, notes: list[Finding]) -> Refined:
    """Let the surface tilt freely where the pixels contradict a level one and nobody set how level it is."""
    if not np.isfinite(fit.prior.tilt_std) or settings.tilt_sigma is not None or not fit.active[6]:
        return fit
    free = _without(seen, settings, fit, replace(fit.prior, tilt_std=np.inf))
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


def _contradicted(seen: Observations, settings: Settings, fit: Refined) -> list[Finding]:
    """A finding where the pixels by themselves put the plane elsewhere than it was measured."""
    if not settings.known_depth or not fit.active[NAMES.index("depth")]:
        return []
    free = _without(seen, settings, fit, replace(fit.prior, depth_std=np.inf))
    if free is None:
        return []
    by = 1000.0 * (free.model.depth - fit.prior.depth)
    sense = "nearer to" if by > 0.0 else "further from"
    return [finding("plane_contradicted", distance=abs(by), sense=sense)]


def _without(seen: Observations, settings: Settings, fit: Refined, loose: Prior) -> Refined | None:
    """The fit with a prior loosened, where the pixels contradict that prior; else None."""
    try:
        free = _refined(seen, fit.model, settings, fit.active, loose)
    except (CalibrationError, np.linalg.LinAlgError):
        return None
    held = solve(free.model, seen.subset(free.used), free.whiten, fit.active, fit.prior)
    return free if 2.0 * (held.cost - free.cost) > DOUBT else None


def _pinhole(seen: Observations, found: Found, settings: Settings, fit: Refined) -> Refined:
    """Straight lines fitted to the same rows, as plain calibrations do."""
    model = replace(found.pinhole, camera=replace(found.pinhole.camera, lens=fit.model.camera.lens))
    active = fit.active & np.array([name in NAMES[:6] or name in NAMES[10:] for name in NAMES])
    prior = replace(fit.prior, normal=None, depth=np.nan, depth_std=np.inf, index_std=np.inf)
    part = seen.subset(fit.used)
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
    depth, option = _measured_depth(fit)
    camera = fit.pinhole.model
    apparent = abs(float(fit.model.interface.normal @ (camera.camera.position - camera.reference)))
    if depth > TOO_DEEP * fit.model.interface.index_far * apparent:
        raise CalibrationError(
            f"{option} puts the plane {depth:.3g} m from the points, but by the pixels the camera is only about "
            f"{apparent:.3g} m from them: check its unit (metres) and the survey's; nothing is written"
        )


def _measured_depth(fit: PoolFit) -> tuple[float, str]:
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
