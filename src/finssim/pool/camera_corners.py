"""Tag corners as a detector reports them, computed from the optics without drawing a picture."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from finssim.geometry.rotations import quat_to_matrix
from finssim.localization.pool import Pool
from finssim.pool.fitted_corners import CornerFit
from finssim.pool.rippled_view import RippledView
from finssim.robot.messages import Picture, TagCorners
from finssim.sensors.overhead_camera import Ripples
from finssim.vehicles.equipment import Tags

__all__ = ["CornerCamera"]

Array = npt.NDArray[np.float64]

LEAST_EDGE = 12.0
"""A tag with a shorter edge is not found [px]."""
RIM = 0.15
"""White around the tag that must be in the picture too, part of its edge."""
NARROWEST = 0.25
"""A tag whose image covers less of the square over its longest side is not found: it is seen from 75° off its normal,
or from behind."""
OPPOSITE = [2, 3, 0, 1]
MOST_BENT = 0.031
"""A tag that ripples bend further from a plane one is not found, rms in edges of the tag: half of those that are bent
so are found in rendered pictures."""
UNEXPLAINED = 0.33
"""Error of a corner, part of the bend [px]: the fit gives less weight to the cells that are bent most."""


class CornerCamera:
    """Looks at the tags of a vehicle."""

    def __init__(
        self, tags: Tags, site: Pool, ripples: Ripples | None, *, pixel_noise: float, seed: int
    ) -> None:
        """
        Args:
            tags: Where they truly sit.
            site: Camera and water as they are.
            ripples: Of the water; None for flat.
            pixel_noise: Standard deviation of a corner, per axis [px].
            seed: Of the noise.
        """
        self._noise, self._seed = pixel_noise, seed
        self._inside = site.camera.lens.inside
        self._view = RippledView(site.camera, site.interface, ripples)
        self._ids = list(tags.mounts)
        self._fit = CornerFit(tags.family, self._ids, tags.edge)
        self._nodes_b = np.concatenate(
            [
                np.asarray(m.position) + self._fit.nodes @ quat_to_matrix(m.orientation).T
                for m in tags.mounts.values()
            ]
        )

    def picture(
        self, start: tuple[Array, Array], end: tuple[Array, Array], middle: float, sequence: int
    ) -> Picture:
        """Corners at the middle of an exposure.

        Args:
            start: Position [m] and orientation (xyzw) of the body when it began, pool frame.
            end: The same when it ended.
            middle: [s]
            sequence: Of the picture.
        """
        q = start[1] + math.copysign(1.0, float(start[1] @ end[1])) * end[1]
        position, R = 0.5 * (start[0] + end[0]), quat_to_matrix(q / np.linalg.norm(q))
        pixels, seen = self._view.pixels(position + self._nodes_b @ R.T, middle)
        shape = len(self._ids), -1
        seen = seen.reshape(shape).all(axis=1)
        corners, bend = self._fit.corners(pixels.reshape(*shape, 2))
        rim = self._inside(corners + RIM * (corners - corners[:, OPPOSITE])).all(axis=1)
        noise = np.random.default_rng([self._seed, sequence]).standard_normal(corners.shape)
        found = [
            TagCorners(tag, reported)
            for tag, there, c, b, e in zip(self._ids, seen & rim, corners, bend.tolist(), noise, strict=True)
            if there and (reported := _reported(c, b, self._noise, e)) is not None
        ]
        return Picture(middle, sequence, tags=tuple(found))


def _reported(corners: Array, bend: float, pixel_noise: float, noise: Array) -> Array | None:
    """Corners of one tag in the picture, None where a detector would not find it."""
    (ax, ay), (bx, by), (cx, cy), (dx, dy) = corners.tolist()
    sides = math.hypot(bx - ax, by - ay), math.hypot(cx - bx, cy - by), math.hypot(dx - cx, dy - cy)
    area = 0.5 * ((cx - ax) * (dy - by) - (cy - ay) * (dx - bx))
    if bend > MOST_BENT or min(sides) < LEAST_EDGE or area < NARROWEST * max(sides) ** 2:
        return None
    error = math.hypot(pixel_noise, UNEXPLAINED * bend * math.sqrt(area))
    return np.asarray(corners + error * noise)
