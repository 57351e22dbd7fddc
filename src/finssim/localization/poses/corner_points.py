"""Where on its known height each corner lies that a picture shows: eq. 12 of the paper, in the medium it is in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from finssim.geometry.optics import Status, back_project
from finssim.localization.pool import Pool

__all__ = ["CornerPoints", "corner_points"]

Array = npt.NDArray[np.float64]

_STEP = 0.1
"""Step of the derivative with respect to the pixel [px]: optics change over hundreds of pixels: its error is 1e-4."""
_STEPS = np.array([[[0.0, 0.0]], [[_STEP, 0.0]], [[0.0, _STEP]]])
_GRAZING = 1e-3
"""A ray that makes less than this angle with the plane of heights [rad] does not tell where the corner is."""


@dataclass(frozen=True, eq=False)
class CornerPoints:
    """Corners on their heights, in a frame g whose z axis points up."""

    Q: Array
    """Horizontal coordinates [m], (n, 2); NaN where the status is not OK."""
    per_pixel: Array
    """dQ/d(u, v) [m/px], (n, 2, 2)."""
    per_height: Array
    """dQ/dz [-], (n, 2)."""
    status: npt.NDArray[np.int8]
    """(n,)"""
    in_air: npt.NDArray[np.bool_]
    """Whether the corner is on the camera's side of the water, (n,)."""


def corner_points(pool: Pool, R_pg: Array, pixels: Array, heights: Array, *, straight: bool) -> CornerPoints:
    """Meet each pixel's ray with the plane on which its corner is.

    Q = S + (z - e3 . S) / (e3 . r) r                                                       (paper, eq. 12)

    The ray is bent at the interface unless it meets the plane before it: then the corner is in the air, and the ray
    straight.

    Args:
        pool: Camera and interface.
        R_pg: Frame g, whose z axis points up, to the pool frame, (3, 3).
        pixels: (n, 2).
        heights: Along the z axis of g, from the pool's origin [m], (n,).
        straight: Leave the water out.
    """
    beside = pixels + _STEPS
    with np.errstate(all="ignore"):
        if straight:
            found = _points(*_air(pool, R_pg, beside), heights)
            return _corner_points(*found, np.ones(len(pixels), bool))
        rays = back_project(pool.camera, pool.interface, beside)
        origin, direction = rays.origin @ R_pg, rays.direction @ R_pg
        centre = float(pool.camera.position @ R_pg[:, 2])
        # Part of the way from the camera to the water at which the height is reached.
        part = (heights - centre) / (origin[0, :, 2] - centre)
        in_air = (part > 0.0) & (part < 1.0)
        points, slope, status = _points(origin, direction, rays.status, heights)
        if in_air.any():
            above = _points(*_air(pool, R_pg, beside[:, in_air]), heights[in_air])
            points[:, in_air], slope[in_air], status[in_air] = above
        return _corner_points(points, slope, status, in_air)


def _air(pool: Pool, R_pg: Array, pixels: Array) -> tuple[Array, Array, npt.NDArray[np.int8]]:
    """Straight rays: origin, direction in g, status."""
    rays, seen = pool.camera.lens.rays(pixels)
    status = np.where(seen, np.int8(Status.OK), np.int8(Status.NO_RAY)).astype(np.int8)
    return pool.camera.position @ R_pg, rays @ (pool.camera.R_pc.T @ R_pg), status


def _points(
    origin: Array, direction: Array, status: npt.NDArray[np.int8], heights: Array
) -> tuple[Array, Array, npt.NDArray[np.int8]]:
    """Horizontal coordinates (3, n, 2), their change with height (n, 2) and status (n,)."""
    steep = direction[..., 2]
    length = (heights - origin[..., 2]) / steep
    points = origin[..., :2] + length[..., None] * direction[..., :2]
    slope = direction[0, :, :2] / steep[0, :, None]
    met = (length > -1e-9).all(axis=0) & (np.abs(steep[0]) > _GRAZING)
    worst = status.max(axis=0)
    if met.all() and not worst.any():
        return points, slope, worst
    why = np.where(np.abs(steep[0]) > _GRAZING, np.int8(Status.AWAY), np.int8(Status.PARALLEL))
    return points, slope, np.where((worst == 0) & ~met, why, worst).astype(np.int8)


def _corner_points(
    points: Array, slope: Array, status: npt.NDArray[np.int8], in_air: npt.NDArray[np.bool_]
) -> CornerPoints:
    per_pixel = np.empty((points.shape[1], 2, 2))
    per_pixel[..., 0] = (points[1] - points[0]) / _STEP
    per_pixel[..., 1] = (points[2] - points[0]) / _STEP
    return CornerPoints(points[0], per_pixel, slope, status, in_air)
