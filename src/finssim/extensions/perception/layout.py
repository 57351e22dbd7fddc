"""Shapes of a world and their poses in each of its copies. Newton is not needed, so that collisions work
without it."""
# mypy: ignore-errors

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from finssim.core.rotations import quat_from_yaw, quat_inverse_rotate, quat_multiply, quat_rotate
from finssim.extensions.perception.description import Finish, Look, Object, World, load_world

WALL = 0.1
"""Thickness of a basin's walls and floor [m]."""


@dataclass(frozen=True, kw_only=True)
class Shape:
    """One shape of a world."""

    kind: str
    """A key of `SIZES` but group, or heightfield."""
    owner: str
    """Name of its object; `basin` or `seabed` for the shapes that no draw moves."""
    finish: Finish
    rest: np.ndarray
    """Pose [m, quaternion] in the axes of `anchor` or of the world, (7,)."""
    anchor: int = -1
    """Index of the varied object with which the shape moves; -1: none."""
    size: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Half extents of a box or a heightfield; radius and half length of spheres, capsules and cylinders [m]."""
    vertices: np.ndarray | None = None
    """Vertices of a mesh, shape axes [m], (n, 3)."""
    faces: np.ndarray | None = None
    """Vertex indices of each face, (m, 3)."""
    heights: np.ndarray | None = None
    """Heights z of a heightfield [m], (ny, nx), row 0 at the least y."""


class WorldLayout:
    """Poses and looks of all shapes in N separate copies of a world.

    Args:
        world: Name of a site in the catalogue, a path, or a world.
        worlds: Number of copies.
        device: Device of their arrays: cpu or cuda.
    """

    transforms: wp.array
    """Shape to world of every shape [m, quaternion]; transform (worlds, shapes)."""
    scales: wp.array
    """Scale factor of every shape [-]; float (worlds, shapes)."""
    draws: wp.array
    """Number of draws of each world; int (worlds,)."""

    def __init__(self, world: World | str, worlds: int = 1, device: str = "cpu") -> None:
        self.world = world if isinstance(world, World) else load_world(world)
        self.worlds, self.device = worlds, wp.get_device(device)
        self._varied: list[tuple[Object, int, np.ndarray]] = []
        """Each object that draws move, the index of the varied object with which it moves, and its pose in
        the axes of that."""
        self._moved: dict[int, np.ndarray] = {}
        """Poses of varied objects that were moved explicitly, (worlds, 7)."""
        self._objects = self._placed()
        self.shapes = [*self._fixed_shapes(), *self._object_shapes()]
        self._anchor = np.array([shape.anchor for shape in self.shapes], int)
        self._rest = np.array([shape.rest for shape in self.shapes]).reshape(-1, 7)
        self._owners = list(dict.fromkeys(shape.owner for shape in self.shapes))
        self._frames = np.zeros((len(self._varied) + 1, worlds, 7))
        self._pose = np.zeros((worlds, len(self.shapes), 7))
        self._scale = np.ones((len(self._varied) + 1, worlds))
        sizes = sum(item.vary.size > 1.0 for item, _, _ in self._varied)
        self._first = np.cumsum([1, 4 * len(self._varied), len(self._owners), sizes, 3])
        """First column of the drawn poses, colours, sizes and light (the water is column 0), and the number
        of columns."""
        self._drawn = np.zeros((worlds, self._first[-1]))
        self._look = np.zeros(worlds, int)
        self.transforms = wp.zeros((worlds, len(self.shapes)), dtype=wp.transform, device=self.device)
        self.scales = wp.ones((worlds, len(self.shapes)), dtype=float, device=self.device)
        self.draws = wp.zeros(worlds, dtype=int, device=self.device)
        WorldLayout._place(self, np.arange(worlds))

    def layout(self, worlds: int, device: str) -> WorldLayout:
        """Return this layout, so that existing copies can be passed instead of a world."""
        return self

    def draw(self, seed: ArrayLike, mask: ArrayLike | None = None, held_out: bool = False) -> None:
        """Draw poses of objects, water, look and colours of worlds; world w depends only on its seed and w.

        Args:
            seed: Seed of the draw, one for all worlds or one for each.
            mask: Worlds to draw; all if None. (worlds,)
            held_out: Draw from the looks that the file holds out of training instead of the others; without any,
                the file's own look.
        """
        rows = np.arange(self.worlds) if mask is None else np.flatnonzero(np.asarray(mask))
        if not len(rows):
            return
        seeds = np.broadcast_to(np.asarray(seed), self.worlds)[rows]
        numbers = _uniform(seeds, rows, self._drawn.shape[1] + 1)
        look = self._first[2]
        self._drawn[rows] = 2.0 * np.delete(numbers, look, axis=1) - 1.0
        candidates = np.flatnonzero([look is not None and look.held_out == held_out for look in self.looks])
        choice = candidates if held_out else np.concatenate([[0], candidates])
        choice = choice if len(choice) else np.zeros(1, int)
        self._look[rows] = choice[(numbers[:, look] * len(choice)).astype(int)]
        self._place(rows)

    @property
    def looks(self) -> list[Look | None]:
        """Return the looks that a world may have; None is the file's own."""
        return [None, *self.world.looks.values()]

    @property
    def drawn(self) -> np.ndarray:
        """Return the drawn numbers of the worlds, with which another batch of the same world can be set,
        (worlds, numbers)."""
        return np.column_stack([self._drawn, self._look])

    @drawn.setter
    def drawn(self, values: np.ndarray) -> None:
        self._drawn[:], self._look[:] = values[:, :-1], values[:, -1].astype(int)
        self._place(np.arange(self.worlds))

    def copy_draw(self, other: WorldLayout, world: int) -> None:
        """Set all worlds to the draw of one world of another layout, whose objects are the first of this one's."""
        self._drawn[:], self._look[:] = 0.0, other._look[world]
        own, theirs = (np.concatenate([[0], layout._first]) for layout in (self, other))
        for here, there, count in zip(own, theirs, np.diff(theirs), strict=False):
            self._drawn[:, here : here + count] = other._drawn[world, there : there + count]
        self._place(np.arange(self.worlds))

    def move(self, name: str, poses: ArrayLike) -> None:
        """Move a varied object, with everything in its frame, to given poses.

        Args:
            name: Name of the object.
            poses: Position [m] and attitude xyzw, world frame, (7,) or (worlds, 7).
        """
        self._moved[self._objects[name][0]] = np.broadcast_to(np.asarray(poses, float), (self.worlds, 7))
        self._place(np.arange(self.worlds))

    def _place(self, rows: np.ndarray) -> None:
        """Set the poses of some worlds, (k,), from their drawn numbers.

        The numbers are in [-1, 1]: one for the water, four for each varied object, one for each object's
        colour and each size that varies, and three for the light.
        """
        drawn, n = self._drawn[rows], len(rows)
        frames = np.zeros((len(self._varied) + 1, n, 7))
        frames[:, :, 6] = 1.0  # the last one is the world frame
        scale, size = np.ones((len(self._varied) + 1, n)), self._first[2]
        for i, (item, anchor, rest) in enumerate(self._varied):
            drawn_pose = drawn[:, 1 + 4 * i : 5 + 4 * i]
            shift = np.concatenate(
                [drawn_pose[:, :3] * item.vary.position, quat_from_yaw(drawn_pose[:, 3] * item.vary.yaw)], 1
            )
            frames[i] = _compose(_compose(frames[anchor], rest, scale[anchor]), shift)
            scale[i] = scale[anchor]
            if item.vary.size > 1.0:
                scale[i] *= item.vary.size ** drawn[:, size]
                size += 1
            if i in self._moved:
                frames[i] = self._moved[i][rows]
        self._frames[:, rows], self._scale[:, rows] = frames, scale
        scale = scale[self._anchor]
        self._pose[rows] = _compose(frames[self._anchor], self._rest[:, None], scale).swapaxes(0, 1)
        self.transforms.assign(np.float32(self._pose))
        self.scales.assign(np.float32(self._scale[self._anchor].T))
        draws = self.draws.numpy().copy()
        draws[rows] += 1
        self.draws.assign(draws)

    def poses(self, name: str) -> np.ndarray:
        """Return position [m] and attitude xyzw of an object, or of the first shape of a row, world frame,
        (worlds, 7)."""
        anchor, rest = self._objects[name]
        return _compose(self._frames[anchor], rest, self._scale[anchor])

    # ---- set-up

    def _placed(self) -> dict[str, tuple[int, np.ndarray]]:
        """Return the objects by name: index of the varied object with which each moves, and its pose in the
        axes of that."""
        objects: dict[str | None, tuple[int, np.ndarray]] = {None: (-1, _pose([0, 0, 0]))}
        for name, item in self.world.objects.items():
            anchor, frame = objects[item.frame]
            base = _compose(frame, _pose(item.position))
            if item.vary is not None:
                self._varied.append((item, anchor, base))
                anchor, base = len(self._varied) - 1, _pose([0, 0, 0])
            objects[name] = anchor, _compose(base, _pose([0, 0, 0], item.quaternion))
        del objects[None]
        return objects

    def _fixed_shapes(self) -> Iterator[Shape]:
        """Yield the shapes of basin and seabed, which no draw moves."""
        basin, bed = self.world.basin, self.world.seabed
        if basin is not None:
            (length, width, depth), t = basin.size, WALL
            height, middle = depth + basin.freeboard, 0.5 * (basin.freeboard - depth)
            slabs = [((length + 2 * t, width + 2 * t, t), (0.0, 0.0, -depth - 0.5 * t))]
            for side in (-1.0, 1.0):
                slabs.append(((t, width + 2 * t, height), (side * 0.5 * (length + t), 0.0, middle)))
                slabs.append(((length, t, height), (0.0, side * 0.5 * (width + t), middle)))
            for extent, position in slabs:
                size = tuple(0.5 * float(s) for s in extent)
                yield Shape(kind="box", owner="basin", finish=basin, rest=_pose(position), size=size)
        if bed is None:
            return
        heights = self.world.seabed_heights()
        if heights is None:
            normal = np.array([-bed.slope[0], -bed.slope[1], 1.0])
            item = Object(shape="plane", position=np.array([0.0, 0.0, -bed.depth]), axis=normal)
            rest = _pose(item.position, item.quaternion)
            yield Shape(kind="plane", owner="seabed", finish=bed, rest=rest)
        else:
            size = (0.5 * bed.size[0], 0.5 * bed.size[1], 0.0)
            rest = _pose([0, 0, 0])
            yield Shape(kind="heightfield", owner="seabed", finish=bed, rest=rest, size=size, heights=heights)

    def _object_shapes(self) -> Iterator[Shape]:
        """Yield the shapes of the objects, in their order."""
        for name, item in self.world.objects.items():
            if item.shape == "group":
                continue
            parts = self._parts(name, item)
            anchor, rest = self._objects[name]
            for position in item.positions:
                turned = _pose(quat_inverse_rotate(item.quaternion, position - item.position))
                for part in parts:
                    yield replace(part, rest=_compose(_compose(rest, turned), part.rest), anchor=anchor)

    def _parts(self, name: str, item: Object) -> list[Shape]:
        """Return the shapes of one object, in its axes."""
        if item.shape == "model":
            factor, shapes = item.scale or 1.0, []
            for part in self.world.model(name):
                given = "colour" in item.model_fields_set or part.colour is None
                finish = item if given else item.model_copy(update={"colour": part.colour})
                vertices = None if part.vertices is None else factor * part.vertices
                shapes.append(Shape(
                    kind=part.kind, owner=name, finish=finish, rest=_pose(factor * part.position, part.quaternion),
                    size=tuple(factor * s for s in part.size), vertices=vertices, faces=part.faces,
                ))  # fmt: skip
            return shapes
        vertices, faces = self.world.mesh(name) if item.shape == "mesh" else (None, None)
        size = (item.radius or 0.0, 0.5 * (item.length or 0.0), 0.0)
        if item.size is not None:
            size = tuple(0.5 * float(s) for s in item.size)
        rest = _pose([0, 0, 0])
        return [
            Shape(
                kind=item.shape, owner=name, finish=item, rest=rest, size=size, vertices=vertices, faces=faces
            )
        ]


def _pose(position: ArrayLike, quaternion: ArrayLike = (0.0, 0.0, 0.0, 1.0)) -> np.ndarray:
    """Return position and attitude xyzw as one row, (7,)."""
    return np.concatenate([np.asarray(position, float), np.asarray(quaternion, float)])


def _compose(outer: np.ndarray, inner: np.ndarray, scale: ArrayLike = 1.0) -> np.ndarray:
    """Return the pose of `inner`, which is given in the axes of `outer`, in the reference axes of `outer`,
    (..., 7).

    Args:
        outer: Pose of the outer frame, (..., 7).
        inner: Pose in the outer frame; its position is multiplied by `scale`, (..., 7).
        scale: Factor [-], (...).
    """
    q, way = outer[..., 3:], np.asarray(scale)[..., None] * inner[..., :3]
    moved, turned = outer[..., :3] + quat_rotate(q, way), quat_multiply(q, inner[..., 3:])
    return np.concatenate([moved, turned], -1)


def _uniform(seeds: np.ndarray, worlds: np.ndarray, count: int) -> np.ndarray:
    """Return numbers in [0, 1) by seed and world, (k, count): counter-based generator SplitMix64 (Steele et
    al. 2014)."""

    def mixed(x: np.ndarray) -> np.ndarray:
        x = x + np.uint64(0x9E3779B97F4A7C15)
        x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        return x ^ (x >> np.uint64(31))

    key = mixed(mixed(seeds.astype(np.uint64)) ^ worlds.astype(np.uint64))
    return (mixed(key[:, None] + np.arange(count, dtype=np.uint64)) >> np.uint64(11)) * 2.0**-53
