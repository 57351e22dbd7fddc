"""What was estimated, with intervals and whether the pictures tell it, and what to measure so that they do."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2
from scipy.stats import t as student

from finssim.calibration.fit import Correlation, Estimate
from finssim.calibration.vision.pool_model import (
    LENS_NAMES,
    NAMES,
    PoolModel,
    Settings,
)
from finssim.calibration.vision.pool_refine import (
    Refined,
)
from finssim.calibration.vision.survey import Observations
from finssim.geometry.rotations import quat_to_euler

__all__ = ["advice", "correlation", "estimates"]

Array = NDArray[np.float64]

TOLD = 0.7
"""A standard error above this part of what was known before means that the pictures tell next to nothing."""

FAR = 0.05
"""Standard error of a distance, over the whole distance, above which it counts as not determined."""

AT_BOUND = 0.01
"""Distance from the plane, over the whole distance, below which camera or points lie on it."""

_STEPS = np.array(
    [1e-5] * 3
    + [1e-6] * 2
    + [1e-6]
    + [1e-6] * 2
    + [1e-5, 1e-5, 1e-6, 1e-3, 1e-3, 1e-6, 1e-6, 1e-7, 1e-7, 1e-7]
)


def estimates(fit: Refined, surface: bool, settings: Settings, centre: Array) -> dict[str, Estimate]:
    """Table of estimates.

    Args:
        fit: In the frame of the middle of the points.
        surface: The plane is a water surface.
        settings: Options, in the same frame.
        centre: The middle of the points in the survey's frame [m].
    """
    columns = _columns(surface, centre, len(fit.model.camera.lens.distortion))
    width = float(student.ppf(0.975, fit.dof))
    table: dict[str, Estimate] = {}
    for name, (unit, tell) in columns.items():
        gradient = _gradient(fit.model, tell, fit.active)
        std = float(np.sqrt(max(0.0, gradient @ fit.covariance @ gradient)))
        value = tell(fit.model)
        known, note = _judged(name, std, gradient, fit, settings)
        table[name] = Estimate(
            name=name,
            estimate=value,
            ci95=(value - width * std, value + width * std),
            unit=unit,
            identifiable=known,
            note=note,
        )
    return table


def correlation(fit: Refined) -> Correlation:
    """Of the errors of what the table of estimates holds, under its names; what was not fitted is left out."""
    columns = _columns(_is_surface(fit), np.zeros(3), len(fit.model.camera.lens.distortion))
    gradients = {name: _gradient(fit.model, tell, fit.active) for name, (_, tell) in columns.items()}
    G = np.stack([g for g in gradients.values() if _moves(g)])
    names = tuple(name for name, g in gradients.items() if _moves(g))
    V = G @ fit.covariance @ G.T
    std = np.sqrt(np.maximum(np.diagonal(V), 1e-300))
    return Correlation(names=names, matrix=np.clip(V / np.outer(std, std), -1.0, 1.0))


def _is_surface(fit: Refined) -> bool:
    """Whether the plane was searched for along the survey's z; a wall has a normal of its own, or none beforehand."""
    normal = fit.prior.normal
    return normal is not None and bool(abs(normal[2]) > 0.9)


def _moves(gradient: Array) -> bool:
    return bool((np.abs(gradient) > 1e-12).any())


def _columns(surface: bool, centre: Array, terms: int) -> dict[str, tuple[str, Callable[[PoolModel], float]]]:
    def euler(model: PoolModel, axis: int) -> float:
        return float(np.degrees(quat_to_euler(np.asarray(model.camera.orientation))[axis]))

    def tilt(model: PoolModel, axis: int) -> float:
        n = model.interface.normal
        return float(np.degrees(np.arctan2(n[axis], abs(n[2]))))

    columns: dict[str, tuple[str, Callable[[PoolModel], float]]] = {}
    for k, axis in enumerate("xyz"):
        columns[f"camera_{axis}"] = ("m", lambda m, k=k: float(m.camera.position[k] + centre[k]))
    for k, axis in enumerate(("roll", "pitch", "yaw")):
        columns[f"camera_{axis}"] = ("deg", lambda m, k=k: euler(m, k))
    if surface:
        columns["camera_height"] = ("m", lambda m: m.clearance)
        columns["water_height"] = ("m", lambda m: float(m.interface.height(0.0, 0.0) + centre[2]))
        columns["tilt_x"] = ("deg", lambda m: tilt(m, 0))
        columns["tilt_y"] = ("deg", lambda m: tilt(m, 1))
    else:
        columns["camera_distance"] = ("m", lambda m: m.clearance)
        columns["point_distance"] = ("m", lambda m: m.depth)
        for k, axis in enumerate("xyz"):
            columns[f"normal_{axis}"] = ("1", lambda m, k=k: float(m.interface.normal[k]))
    columns["index"] = ("1", lambda m: float(m.interface.index_far))
    columns["focal"] = ("px", lambda m: float(m.camera.lens.fx))
    columns["center_x"] = ("px", lambda m: float(m.camera.lens.cx))
    columns["center_y"] = ("px", lambda m: float(m.camera.lens.cy))
    for k, name in enumerate(LENS_NAMES[3 : 3 + terms]):
        columns[name] = ("1", lambda m, k=k: float(m.camera.lens.distortion[k]))
    return columns


def _gradient(model: PoolModel, tell: Callable[[PoolModel], float], active: NDArray[np.bool_]) -> Array:
    g = np.zeros(len(NAMES))
    for k in np.flatnonzero(active):
        step = np.zeros(len(NAMES))
        step[k] = _STEPS[k]
        g[k] = (tell(model.moved(step)) - tell(model.moved(-step))) / (2.0 * _STEPS[k])
    return g


def _judged(name: str, std: float, gradient: Array, fit: Refined, settings: Settings) -> tuple[bool, str]:
    """Whether the pictures tell it, and a word on what it rests on."""
    if not _moves(gradient):
        return False, "as given"
    model, prior = fit.model, fit.prior
    whole = model.clearance + max(model.depth, 0.0)
    if name == "index":
        return _against(std, prior.index_std, f"the pixels do not tell it: held at {settings.index:g}")
    if name in ("tilt_x", "tilt_y"):
        return _against(std, np.degrees(prior.tilt_std), "the pixels do not tell it: held level")
    if name in LENS_NAMES:
        width = prior.lens_std[LENS_NAMES.index(name)] * (model.camera.lens.fx if name == "focal" else 1.0)
        return _against(std, width, "the pixels do not tell it: held at the camera file's")
    if name in ("water_height", "point_distance"):
        if settings.known_depth:
            return _against(std, prior.depth_std, "rests on the measured height")
    if name in ("camera_height", "camera_distance", "water_height", "point_distance"):
        if min(model.clearance, _shallowest(fit)) < AT_BOUND * whole:
            return False, "at its bound: the plane touches the camera or a point"
        if std > FAR * whole:
            return False, "the pixels do not tell it"
    return True, ""


def _against(std: float, before: float, sentence: str) -> tuple[bool, str]:
    return (False, sentence) if np.isfinite(before) and std > TOLD * before else (True, "")


def _shallowest(fit: Refined) -> float:
    """Distance of the nearest point from the plane, as far as the reference point tells [m]."""
    return fit.model.depth - fit.model.interface.thickness


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
