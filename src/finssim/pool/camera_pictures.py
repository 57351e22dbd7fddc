"""Pictures of a vehicle's tags under water, drawn by the overhead camera's renderer; its hull is left out."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from finssim.geometry.rotations import quat_multiply, quat_rotate
from finssim.localization.detection.families import bitmap, family_named
from finssim.localization.pool import Pool
from finssim.pool.plant_spec import Basin
from finssim.robot.messages import Picture
from finssim.sensors import overhead_camera as oc
from finssim.vehicles.equipment import Mount, Tags

__all__ = ["PictureCamera"]

Array = npt.NDArray[np.float64]

MARGIN = 0.15
"""White around a tag, part of its edge."""
STILL = 0.05
"""Motion during the exposure that is left out [px]."""
SLOW = 0.4
"""Motion up to which one ray a pixel will do, where corners are placed to 0.03 px; beyond it, two by two [px]."""
REACH = 0.2
"""Of a tag's corner from the body's origin, for the motion that a turn makes [m]."""
FREEBOARD = 0.1
"""Of the pool's edge above the water [m]."""


class PictureCamera:
    """Draws what moves anew in every picture, and the pool around it once."""

    def __init__(
        self,
        tags: Tags,
        site: Pool,
        ripples: oc.Ripples | None,
        *,
        basin: Basin,
        exposure: float,
        seed: int,
    ) -> None:
        """
        Args:
            tags: Where they truly sit.
            site: Camera and water as they are; the pool's floor is at z = 0 under its middle.
            ripples: Of the water; None for flat.
            basin: Of the pool.
            exposure: [s]
            seed: Of the noise.
        """
        self._tags, self._seed = tags, seed
        self._bitmaps = {tag: bitmap(tags.family, tag).astype(bool) for tag in tags.mounts}
        reach = (0.5 * basin.length, 0.5 * basin.width)
        surface = float(site.interface.height(0.0, 0.0))
        scene = oc.Scene(
            camera=site.camera,
            interface=site.interface,
            basin=oc.Basin(
                lower=(-reach[0], -reach[1], surface - basin.depth),
                upper=(reach[0], reach[1], surface + FREEBOARD),
            ),
            ripples=ripples,
            sensor=oc.Sensor(shutter=exposure),
            samples=1,
        )
        self._slow = oc.OverheadCamera(scene)
        self._fast = oc.OverheadCamera(replace(scene, samples=2))
        height = float(site.interface.distance(site.camera.position))
        self._per_metre = site.camera.lens.fx / (height + 0.25 * basin.depth)

    def picture(
        self, start: tuple[Array, Array], end: tuple[Array, Array], middle: float, sequence: int
    ) -> Picture:
        """Expose; arguments as of `CornerCamera.picture`."""
        motion = self._motion(start, end)
        moves = motion > STILL
        image = (self._slow if motion < SLOW else self._fast).render(
            tags=[self._tag(t, m, start, end if moves else None) for t, m in self._tags.mounts.items()],
            time=middle,
            seed=(self._seed * 1_000_003 + sequence) % 2**31,
            region="tags",
        )
        return Picture(middle, sequence, image=image)

    def _motion(self, start: tuple[Array, Array], end: tuple[Array, Array]) -> float:
        """About how far a tag moves in the picture [px]."""
        turn = 2.0 * math.sqrt(max(1.0 - float(start[1] @ end[1]) ** 2, 0.0))
        return self._per_metre * (float(np.linalg.norm(end[0] - start[0])) + REACH * turn)

    def _tag(
        self, tag: int, mount: Mount, start: tuple[Array, Array], end: tuple[Array, Array] | None
    ) -> oc.TagInScene:
        family = family_named(self._tags.family)
        return oc.TagInScene(
            bitmap=self._bitmaps[tag],
            edge=self._tags.edge,
            border_cells=family.border,
            margin=MARGIN * self._tags.edge,
            pose=_placed(start, mount.position, mount.orientation),
            end=None if end is None else _placed(end, mount.position, mount.orientation),
        )


def _placed(body: tuple[Array, Array], position: npt.ArrayLike, orientation: npt.ArrayLike) -> oc.Pose:
    """Pose of a thing fixed to the body, pool frame."""
    x, y, z = (body[0] + quat_rotate(body[1], np.asarray(position))).tolist()
    q = np.asarray(quat_multiply(body[1], orientation))
    a, b, c, d = (q / np.linalg.norm(q)).tolist()
    return oc.Pose(position=(x, y, z), orientation=(a, b, c, d))
