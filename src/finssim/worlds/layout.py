"""The shapes of a world and where they stand in each of its copies. Needs no Newton: collisions read it alone."""
# mypy: ignore-errors

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from finssim.geometry.rotations import quat_from_yaw, quat_multiply, quat_rotate
from finssim.worlds.description import Finish, Object, World, load_world

WALL = 0.1
"""Thickness of a basin's walls and floor [m]."""
UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])


@dataclass(frozen=True, kw_only=True)
class Shape:
    """One shape of a world."""

    kind: str
    """A key of `SIZES` but group, or heightfield."""
    owner: str
    """Name of its object; `basin` or `seabed` for those, which no draw moves."""
    finish: Finish
    position: np.ndarray
    """From the first shape of its row, in the frame of its object; of basin and seabed in the world [m], (3,)."""
    quaternion: np.ndarray
    """To that frame, xyzw, (4,)."""
    size: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Half extents of a box or a heightfield; radius and half length of the round ones [m]."""
    vertices: np.ndarray | None = None
    """Of a mesh, shape axes [m], (n, 3)."""
    faces: np.ndarray | None = None
    """(m, 3)"""
    heights: np.ndarray | None = None
    """Of a heightfield: z [m], (ny, nx), row 0 at the least y."""


def shapes_of(world: World) -> list[Shape]:
    """All shapes of a world with their copies: basin, seabed, objects in their order."""
    shapes = []
    basin, bed = world.basin, world.seabed
    if basin is not None:
        (length, width, depth), t = basin.size, WALL
        height, middle = depth + basin.freeboard, 0.5 * (basin.freeboard - depth)
        slabs = [((length + 2 * t, width + 2 * t, t), (0.0, 0.0, -depth - 0.5 * t))]
        for side in (-1.0, 1.0):
            slabs.append(((t, width + 2 * t, height), (side * 0.5 * (length + t), 0.0, middle)))
            slabs.append(((length, t, height), (0.0, side * 0.5 * (width + t), middle)))
        for extent, position in slabs:
            size = tuple(0.5 * s for s in extent)
            shapes.append(
                Shape(
                    kind="box", owner="basin", finish=basin, position=np.array(position), quaternion=UPRIGHT,
                    size=size,
                )
            )  # fmt: skip
    if bed is not None:
        heights, position, q = world.seabed_heights(), np.zeros(3), UPRIGHT
        size = (0.0, 0.0, 0.0) if bed.size is None else (0.5 * bed.size[0], 0.5 * bed.size[1], 0.0)
        if heights is None:
            position = np.array([0.0, 0.0, -bed.depth])
            normal = np.array([-bed.slope[0], -bed.slope[1], 1.0])
            q = Object(shape="plane", position=position, axis=normal).quaternion
        shapes.append(
            Shape(
                kind="plane" if heights is None else "heightfield", owner="seabed", finish=bed, position=position,
                quaternion=q, size=size, heights=heights,
            )
        )  # fmt: skip
    for name, item in world.objects.items():
        if item.shape == "group":
            continue
        vertices, faces = world.mesh(name) if item.shape == "mesh" else (None, None)
        size = (item.radius or 0.0, 0.5 * (item.length or 0.0), 0.0)
        if item.size is not None:
            size = tuple(0.5 * float(s) for s in item.size)
        shapes += [
            Shape(
                kind=item.shape, owner=name, finish=item, position=position - item.position,
                quaternion=item.quaternion, size=size, vertices=vertices, faces=faces,
            )
            for position in item.positions
        ]  # fmt: skip
    return shapes


class WorldLayout:
    """N copies of a world, apart from each other: what stands where in each, and the water drawn for it.

    Args:
        world: A site of the catalogue, a path, or a world.
        worlds: How many copies.
        device: Where their arrays are: cpu or cuda.
    """

    transforms: wp.array
    """Shape to world of every shape; transform (worlds, shapes)."""
    draws: wp.array
    """How often each world was drawn; int (worlds,)."""

    def __init__(self, world: World | str, worlds: int = 1, device: str = "cpu") -> None:
        self.world = world if isinstance(world, World) else load_world(world)
        self.worlds, self.device = worlds, wp.get_device(device)
        self.shapes = shapes_of(self.world)
        self._varied = [name for name, item in self.world.objects.items() if item.vary is not None]
        self._pose = np.zeros((worlds, len(self.shapes), 7))
        self.transforms = wp.zeros((worlds, len(self.shapes)), dtype=wp.transform, device=self.device)
        self.draws = wp.zeros(worlds, dtype=int, device=self.device)
        self._drawn = np.zeros((worlds, 1 + 4 * len(self._varied)))
        """Numbers in [-1, 1]: one of the water, four of each varied object."""
        self._place(np.arange(worlds))

    def draw(self, seed: int, mask: ArrayLike | None = None) -> None:
        """Draw poses of objects, and the water, of worlds anew; world w depends on `seed` and w alone.

        Args:
            seed: Of the draw.
            mask: Which worlds; all if None. (worlds,)
        """
        chosen = np.arange(self.worlds) if mask is None else np.flatnonzero(np.asarray(mask))
        for world in chosen:
            random = np.random.default_rng([seed, int(world)])
            self._drawn[world] = random.uniform(-1.0, 1.0, self._drawn.shape[1])
        self._place(chosen)

    def _place(self, chosen: np.ndarray) -> None:
        """Set the poses of shapes in these worlds from what is drawn."""
        n, drawn = len(chosen), self._drawn[chosen]
        frames = {None: (np.zeros((n, 3)), np.tile(UPRIGHT, (n, 1)))}
        rows = dict.fromkeys(("basin", "seabed"), (*frames[None], frames[None][1]))
        for name, item in self.world.objects.items():
            shift, turn = np.zeros((n, 3)), quat_from_yaw(np.zeros(n))
            if item.vary is not None:
                own = drawn[:, 1 + 4 * self._varied.index(name) :]
                shift, turn = own[:, :3] * item.vary.position, quat_from_yaw(own[:, 3] * item.vary.yaw)
            outer, attitude = frames[item.frame]
            row = quat_multiply(attitude, turn)
            frames[name] = (
                outer + quat_rotate(attitude, item.position + shift),
                quat_multiply(row, np.tile(item.quaternion, (n, 1))),
            )
            rows[name] = (frames[name][0], row, frames[name][1])
        poses = np.zeros((n, len(self.shapes), 7))
        for k, shape in enumerate(self.shapes):
            origin, row, attitude = rows[shape.owner]
            poses[:, k, :3] = origin + quat_rotate(row, np.tile(shape.position, (n, 1)))
            poses[:, k, 3:] = shape.quaternion if shape.owner in ("basin", "seabed") else attitude
        self._pose[chosen] = poses
        self.transforms.assign(np.float32(self._pose))
        draws = self.draws.numpy()
        draws[chosen] += 1
        self.draws.assign(draws)

    @property
    def water_factor(self) -> np.ndarray:
        """By which attenuations of each world's water exceed those of the file [-], (worlds,)."""
        return np.exp(self._drawn[:, 0] * math.log(self.world.water.vary))

    def poses(self, name: str) -> np.ndarray:
        """Position [m] and attitude xyzw of an object's first shape, world frame, (worlds, 7)."""
        return self._pose[:, next(k for k, shape in enumerate(self.shapes) if shape.owner == name)].copy()
