"""Errors at points that the fit has not seen: in the picture, and in the water at the points' own depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.vision.pool.observations import Observations
from finssim.calibration.vision.pool.pool_model import PoolModel
from finssim.calibration.vision.pool.pool_refine import Refined, refit
from finssim.calibration.vision.pool.pool_solver import residuals
from finssim.geometry.optics import back_project

__all__ = ["HeldOut", "error_vectors", "held_out", "rms"]

Array = NDArray[np.float64]


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
    """Of the observations, (K,)."""
    folds: int

    def as_json(self) -> dict[str, float | int | None]:
        """Root mean squares and 95th percentiles; the error of the survey is in them."""
        size = np.linalg.norm(self.points, axis=1)
        size = size[np.isfinite(size)]
        return {
            "folds": self.folds,
            "points": len(self.rows),
            "rms_px": rms(self.pixels),
            "rms_cm": 100.0 * rms(size[:, None]) if len(size) else None,
            "p95_cm": 100.0 * float(np.percentile(size, 95)) if len(size) else None,
        }


def rms(errors: Array) -> float:
    """Root mean square length of vectors (K, n)."""
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=-1)))) if len(errors) else float("nan")


def held_out(fit: Refined, seen: Observations, folds: int, seed: int, normal: Array) -> HeldOut | None:
    """Refit without each part of the locations in turn; None where too few would be left.

    Args:
        fit: To all rows; its outliers stay out.
        seen: All rows.
        folds: Parts, at most one for each location.
        seed: Of the parts.
        normal: Of the planes, one through each point, on which pixels are back-projected, (3,).
    """
    used = np.flatnonzero(fit.used)
    place = seen.location if len(np.unique(seen.location[used])) >= FEW else np.arange(len(seen))
    names = np.unique(place[used])
    folds = min(folds, len(names))
    if folds < 2:
        return None
    part = np.empty(int(place.max()) + 1, int)
    part[np.random.default_rng(seed).permutation(names)] = np.arange(len(names)) % folds
    pixels, points, rows = [], [], []
    for k in range(folds):
        inside = np.zeros(len(seen), bool)
        inside[used] = part[place[used]] != k
        outside = used[part[place[used]] == k]
        if 2 * inside.sum() < 8 or len(np.unique(seen.points[inside].round(6), axis=0)) < 4:
            return None
        model = refit(fit, seen, inside)
        here = seen.subset(outside)
        r, ok = residuals(model, here)
        rows.append(outside[ok])
        pixels.append(r[ok])
        points.append(error_vectors(model, here, normal)[ok])
    return HeldOut(np.concatenate(pixels), np.concatenate(points), np.concatenate(rows), folds)


def error_vectors(model: PoolModel, seen: Observations, normal: Array) -> Array:
    """Where each pixel's ray meets the plane through its point, minus the point [m], (N, 3); NaN where it does not."""
    origin, direction = _rays(model, seen)
    with np.errstate(all="ignore"):
        length = ((seen.points - origin) @ normal) / (direction @ normal)
    return np.asarray(origin + length[:, None] * direction - seen.points)


def _rays(model: PoolModel, seen: Observations) -> tuple[Array, Array]:
    """Origins and directions (N, 3), straight from the camera for what is dry."""
    rays, ok = model.camera.lens.rays(seen.pixels)
    origin = np.broadcast_to(np.asarray(model.camera.position), seen.points.shape).copy()
    direction = np.where(ok[:, None], rays, np.nan) @ np.asarray(model.camera.R_pc).T
    if model.refractive and not seen.dry.all():
        wet = ~seen.dry
        water = back_project(model.camera, model.interface, seen.pixels[wet])
        origin[wet], direction[wet] = water.origin, water.direction
    return origin, direction
