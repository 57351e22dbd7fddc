"""What was estimated, with intervals and whether the pictures tell it, and what to measure so that they do."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2
from scipy.stats import t as student

from finssim.calibration.degeneracy import correlation
from finssim.calibration.findings import Finding, finding
from finssim.calibration.fit import Correlation, Estimate
from finssim.calibration.vision.pool_model import LENS_NAMES, NAMES, PoolModel, Settings
from finssim.calibration.vision.pool_refine import Refined, surprise
from finssim.calibration.vision.report import AS_GIVEN
from finssim.calibration.vision.survey import Observations
from finssim.geometry.rotations import quat_to_euler

__all__ = ["advice", "estimates"]

Array = NDArray[np.float64]

TOLD = 0.7
"""A standard error above this part of what was known before means that the pictures tell next to nothing."""

FAR = 0.05
"""Standard error of a distance, over the whole distance, above which it counts as not determined."""

AT_BOUND = 0.01
"""Distance from the plane, over the whole distance, below which camera or points lie on it."""

STEPS = np.array([1e-5] * 3 + [1e-6] * 5 + [1e-5, 1e-5, 1e-6, 1e-3, 1e-3, 1e-6, 1e-6] + [1e-7] * 3)
"""Of the derivatives by the parameters."""


def estimates(
    fit: Refined, surface: bool, settings: Settings, centre: Array
) -> tuple[dict[str, Estimate], Correlation]:
    """Table of estimates, and the correlation of their errors, without what was not fitted.

    Args:
        fit: In the frame of the middle of the points.
        surface: The plane is a water surface.
        settings: Options, in the same frame.
        centre: The middle of the points in the survey's frame [m].
    """
    table, quantile = _quantities(fit.model, surface, centre), float(student.ppf(0.975, fit.dof))
    G = np.zeros((len(table), len(NAMES)))
    for k in np.flatnonzero(fit.active):
        step = STEPS[k] * np.eye(len(NAMES))[k]
        ends = (_quantities(fit.model.moved(s), surface, centre).values() for s in (step, -step))
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


def _quantities(model: PoolModel, surface: bool, centre: Array) -> dict[str, tuple[str, float]]:
    """Name -> unit and value of everything that is told."""
    camera, lens, n = model.camera, model.camera.lens, model.interface.normal
    rows = dict(
        zip(("camera_x", "camera_y", "camera_z"), (("m", x) for x in camera.position + centre), strict=True)
    )
    angles = np.degrees(quat_to_euler(np.asarray(camera.orientation)))
    rows |= dict(
        zip(("camera_roll", "camera_pitch", "camera_yaw"), (("deg", x) for x in angles), strict=True)
    )
    if surface:
        rows["camera_height"] = ("m", model.clearance)
        rows["water_height"] = ("m", float(model.interface.height(0.0, 0.0) + centre[2]))
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

SAME_PLACE = 0.005
"""Two places of the plane nearer than this are one [m]."""

CERTAIN = 0.999
"""Share of the marks above the water that are taken for such."""

WHOLE_LENS = "--fit pose,height,tilt,index,focal,center,distortion"


def advice(
    fit: Refined,
    seen: Observations,
    surface: bool,
    settings: Settings,
    table: Mapping[str, Estimate],
    minima: Sequence[tuple[float, float]],
    touching: Sequence[str],
    contradicted: Sequence[Finding],
) -> Iterator[Finding]:
    """Findings for the user, the gravest first.

    Args:
        fit: In the frame of `seen`.
        seen: All rows.
        surface: The plane is a water surface.
        settings: Options, in the same frame.
        table: Estimates.
        minima: Other places where the search came to rest.
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
    place = table["camera_height" if surface else "camera_distance"]
    close = [at for ratio, at in minima if ratio < 1.1 and abs(at - place.estimate) > SAME_PLACE]
    if close and not place.identifiable:
        yield finding("other_place", other=close[0], chosen=place.estimate)


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
