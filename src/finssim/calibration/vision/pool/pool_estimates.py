"""What was estimated, in words and units of a pool, with 95 % intervals and whether the pictures tell it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from finssim.calibration.fit import Correlation, Estimate
from finssim.calibration.vision.pool.pool_model import LENS_NAMES, NAMES, PoolModel
from finssim.calibration.vision.pool.pool_refine import Refined
from finssim.calibration.vision.pool.pool_settings import Settings
from finssim.geometry.rotations import quat_to_euler

__all__ = ["correlation", "estimates"]

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
