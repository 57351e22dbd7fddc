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
GRAZING = math.cos(math.radians(75.0))
"""A tag is not found if the ray to the camera leans further from its normal than 75°."""
MOST_BENT = 0.031
"""A tag that ripples bend further from a plane one is not found, rms in edges of the tag: half of those that are bent
so are found in rendered pictures."""
UNEXPLAINED = 0.33
"""Error of a corner, part of the bend [px]: the fit gives less weight to cells that are bent most, which is not linear."""


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
        self._site, self._noise, self._seed = site, pixel_noise, seed
        self._view = RippledView(site.camera, site.interface, ripples)
        self._fits = {tag: CornerFit(tags.family, tag, tags.edge) for tag in tags.mounts}
        mounted = [
            (np.asarray(m.position), quat_to_matrix(m.orientation), self._fits[t].nodes)
            for t, m in tags.mounts.items()
        ]
        self._nodes_b = np.concatenate([p + nodes @ R.T for p, R, nodes in mounted])
        self._middles_b = np.array([p for p, _, _ in mounted])
        self._normals_b = np.array([R[:, 2] for _, R, _ in mounted])

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
        facing = self._facing(position, R)
        noise = np.random.default_rng([self._seed, sequence]).standard_normal((len(self._fits), 4, 2))
        found = []
        per_tag = len(pixels) // len(self._fits)
        for i, (tag, fit) in enumerate(self._fits.items()):
            part = slice(i * per_tag, (i + 1) * per_tag)
            if facing[i] and seen[part].all():
                corners = self._reported(fit, pixels[part], noise[i])
                if corners is not None:
                    found.append(TagCorners(tag, corners))
        return Picture(middle, sequence, tags=tuple(found))

    def _reported(self, fit: CornerFit, pixels: Array, noise: Array) -> Array | None:
        """Corners of one tag, None where a detector would not find it."""
        corners, bend = fit.corners(pixels)
        sides = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
        middle = corners.mean(axis=0)
        rim = middle + (1.0 + 2.0 * RIM) * (corners - middle)
        if sides.min() < LEAST_EDGE or bend > MOST_BENT or not self._site.camera.lens.inside(rim).all():
            return None
        error = math.hypot(self._noise, UNEXPLAINED * bend * float(sides.mean()))
        return corners + error * noise

    def _facing(self, position: Array, R: Array) -> npt.NDArray[np.bool_]:
        """Whether each tag shows its face to the camera, under water along the bent ray, (T,)."""
        towards = self._site.camera.position - (position + self._middles_b @ R.T)
        n = self._site.interface.normal
        up = towards @ n
        across = (towards - up[:, None] * n) * (
            self._site.interface.index_near / self._site.interface.index_far
        )
        bent = across + up[:, None] * n
        normals = self._normals_b @ R.T
        cosine = np.einsum("ij,ij->i", normals, bent) / np.linalg.norm(bent, axis=1)
        return np.asarray(cosine > GRAZING)
