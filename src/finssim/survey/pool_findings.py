"""Findings on parameters that a survey of a pool does not determine, with measurements that would help."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from finssim.core.least_squares import unit_diagonal
from finssim.identification.fit import Estimate
from finssim.survey.points import Observations
from finssim.survey.pool_model import NAMES, PoolFitSettings, clearances, normal_equations
from finssim.survey.pool_refine import Refined, squared_distance
from finssim.trials.findings import Finding, finding

NARROW = np.radians(20.0)
"""Angle of incidence below which refraction cannot be distinguished from a shallower floor [rad]."""

COMMON_DEPTH = 0.02
"""Spread of depths, relative to the distance to the camera, below which they count as equal [-]."""

TOUCHING = 0.0001
"""Distance of the plane from a point or the camera below which it counts as touching [m]."""

PRESSED = 9.0
"""Decrease of chi² possible beyond a touching point or camera, above which the contact is significant."""

CERTAIN = 0.999
"""Quantile of the residuals up to which excluded points above the plane are identified as dry [-]."""

CAMERA = "the camera"

FULL_LENS = "fit: [pose, height, tilt, index, focal, center, distortion]"


def plane_contacts(fit: Refined, observed: Observations) -> tuple[str, ...]:
    """Return the points in use, and the camera, that stop the plane or its window although the pixels favour
    a position beyond them; the nearest first.

    Args:
        fit: Fit of these rows.
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
    scaled, scale = unit_diagonal(N)
    if float((g / scale) @ np.linalg.lstsq(scaled, g / scale, rcond=1e-9)[0]) < PRESSED:
        return ()
    names = dict.fromkeys(observed.locations[observed.location[i]] for i in near)
    return (*((CAMERA,) if fit.model.clearance < TOUCHING else ()), *names)


def separability(
    fit: Refined, observed: Observations, settings: PoolFitSettings, table: Mapping[str, Estimate]
) -> Iterator[Finding]:
    """Yield findings on camera height, water height and index, which unsuitable points cannot separate.

    Args:
        fit: The fit.
        observed: All rows.
        settings: Options.
        table: Estimates.
    """
    model, n = fit.model, fit.model.interface.normal
    points = observed.points[fit.used & ~observed.dry]
    if settings.surface:
        height, quantities = table["camera_height"], "camera height, water height"
        remedy = ": measure the water's height with a tape and give surface: height"
    else:
        height, quantities = table["camera_distance"], "distances of camera and points from the window"
        remedy = ": measure where the window is and give window: plane"
    texts = {"quantities": quantities, "remedy": "" if settings.stated_depth else remedy}
    half = 0.5 * (height.ci95[1] - height.ci95[0])
    ways = points - model.camera.position
    radius = float(np.linalg.norm(ways - (ways @ n)[:, None] * n, axis=1).max())
    distance, levels = model.clearance + model.depth, float(np.ptp(points @ n))
    steepest = float(np.arctan2(radius, distance))
    if steepest < NARROW:
        yield finding("points_narrow", radius=radius, angle=float(np.degrees(steepest)), **texts)
    if levels < COMMON_DEPTH * distance and half > 0.01 * distance:
        yield finding("one_depth", spread=levels, half=1000.0 * half, **texts)
    if not height.identifiable:
        low, high = height.ci95
        yield finding("height_unknown", height.name, estimate=height.estimate, low=low, high=high)
    focal = table["focal"]
    loose = focal.ci95[1] - focal.ci95[0] > 0.02 * focal.estimate
    if fit.active[NAMES.index("focal")] and loose and levels < 0.05 * distance:
        yield finding("focal_of_one_depth")


def conflicts(fit: Refined, settings: PoolFitSettings) -> Iterator[Finding]:
    """Yield findings on estimates that the pixels pull far from their priors.

    Args:
        fit: The fit.
        settings: Options.
    """
    prior, model, focal = fit.prior, fit.model, NAMES.index("focal")
    plane_name = "water's height" if settings.surface else "window's place"
    lens = "" if fit.active[focal] else f"; or let the lens be fitted ({FULL_LENS})"
    index = model.interface.index_far
    times = abs(index - settings.index) / prior.index_std
    if times > 3.0:
        yield finding(
            "index_pulled", index=index, given=settings.index, times=times, place=plane_name, remedy=lens
        )
    pull = np.log(model.camera.lens.fx / prior.start.camera.lens.fx) / prior.lens_std[0]
    if fit.active[focal] and abs(pull) > 2.0:
        change = float(np.exp(pull * prior.lens_std[0]) - 1.0)
        yield finding("focal_pulled", change=change, expected=prior.lens_std[0])
    if prior.normal is not None and (lean := model.lean(prior.normal)) > 3.0 * prior.tilt_std:
        yield finding("tilt_pulled", lean=float(np.degrees(lean)), remedy=lens)


def numbers(fit: Refined, observed: Observations) -> Iterator[Finding]:
    """Yield findings on too few locations and large errors of pixels and survey.

    Args:
        fit: The fit.
        observed: All rows.
    """
    locations = len(np.unique(observed.location[fit.used]))
    if locations < 12:
        yield finding("few_places", places=locations)
    if fit.noise.pixel > 1.5:
        yield finding("residuals_large", residual=fit.noise.pixel, options=FULL_LENS)
    if fit.noise.scale > 2.0:
        error = 1000.0 * fit.noise.survey * fit.noise.scale
        yield finding("survey_rough", times=fit.noise.scale, error=error)


def excluded_rows(fit: Refined, observed: Observations, surface: bool) -> Iterator[Finding]:
    """Yield findings on excluded rows: marks above the water that are not flagged as dry, and others.

    Args:
        fit: The fit.
        observed: All rows.
        surface: True if the plane is the water's surface, False if a window.
    """
    above = _above(fit, observed)
    if above.any():
        place = "above the water found" if surface else "on the camera's side of the plane found"
        yield finding("marks_dry", marks=tuple(np.array(observed.names)[above].tolist()), place=place)
    if wrong := int((~fit.used & ~above).sum()):
        yield finding("rows_wrong", rows=wrong)


def _above(fit: Refined, observed: Observations) -> NDArray[np.bool_]:
    """Return a mask of excluded rows whose straight rays from the camera meet the points on its side of the
    plane, (N,)."""
    side = observed.points @ fit.model.interface.normal + fit.model.interface.offset > 0.0
    side &= ~fit.used & ~observed.dry
    dry = replace(observed, dry=np.ones(len(observed), bool))
    met = side & (squared_distance(fit.model, dry, fit.noise, fit.covariance) < float(chi2.ppf(CERTAIN, 2)))
    return met & (2 * met.sum() > side.sum())  # a few may agree by chance
