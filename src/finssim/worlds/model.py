"""Copies of one world side by side, as Newton's ray caster takes them, with what light and sound find on each shape."""
# mypy: ignore-errors

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from finssim.geometry.rotations import quat_from_yaw, quat_inverse_rotate, quat_multiply, quat_rotate
from finssim.worlds.description import Finish, Look, Object, World, load_world

TEXTURES = {None: 0, "checker": 1, "stripes": 2, "tiles": 3, "mottled": 4}
WALL = 0.1
"""Thickness of a basin's walls and floor [m]."""


@wp.struct
class Surface:
    """What light and sound find on a shape."""

    colour: wp.vec3  # diffuse reflectance
    second: wp.vec3  # of every other square or band, and of joints
    texture: int  # a value of TEXTURES
    size: float  # of the pattern [m]
    contrast: float
    backscatter: float  # Lambert's parameter mu
    glow: wp.vec3  # radiance of its own
    inverse: wp.transform  # from world axes to the shape's


@wp.struct
class Optics:
    """Water and daylight, by world where they differ."""

    attenuation: wp.array(dtype=wp.vec3)  # c [1/m]
    daylight_attenuation: wp.array(dtype=wp.vec3)  # K_d [1/m]
    veil: wp.array(dtype=wp.vec3)  # B just below the surface
    daylight: wp.vec3  # irradiance there
    sun: wp.vec3  # unit vector towards it
    diffuse: float  # share of the irradiance from everywhere above
    sky: wp.vec3  # radiance through the surface


class WorldBatch:
    """N copies of a world, apart from each other, for ray sensors.

        batch = WorldBatch("dock", worlds=256)
        batch.draw(seed=1)

    Args:
        world: A site of the catalogue, a path, or a world.
        worlds: How many copies.
        device: Where to compute: cpu or cuda.
    """

    def __init__(self, world: World | str, worlds: int = 1, device: str = "cpu") -> None:
        import newton
        from newton.sensors import SensorCamera

        self.world = world if isinstance(world, World) else load_world(world)
        self.worlds, self.device = worlds, wp.get_device(device)
        self._finishes: list[Finish] = []
        self._shapes: list[str] = []
        """Object of each shape, or `basin` or `seabed`."""
        self._anchors: list[int] = []
        """Which of the objects that draws move each shape moves with; -1: none."""
        self._rests: list[np.ndarray] = []
        """Pose of each shape, in the axes of that object or of the world, (7,) each."""
        self._varied: list[tuple[Object, int, np.ndarray]] = []
        """Each object that draws move, the one before it that it moves with, and its pose in the axes of that."""
        self._objects = self._placed()
        single = newton.ModelBuilder()
        self._config = newton.ModelBuilder.ShapeConfig(
            density=0.0, has_shape_collision=False, has_particle_collision=False
        )
        self._add_fixed(single)
        for name, item in self.world.objects.items():
            if item.shape != "group":
                self._add_object(single, name, item)
        builder = newton.ModelBuilder()
        builder.replicate(single, worlds)
        with wp.ScopedDevice(self.device), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of collisions between seabeds, which are not asked for
            self.model = builder.finalize(device=self.device)
            self.state = self.model.state()
        self.caster = SensorCamera(
            self.model,
            load_textures=False,
            default_render_config=SensorCamera.RenderConfig(
                enable_global_world=False,
                enable_particles=False,
                enable_ambient_lighting=False,
                enable_backface_culling=False,
                enable_fast_math=False,
                render_order=SensorCamera.RenderOrder.VIEW_PRIORITY,
            ),
        )
        self._anchor, self._rest = np.array(self._anchors), np.array(self._rests)
        self._pose = self.model.shape_transform.numpy().reshape(worlds, -1, 7).astype(float)
        self.optics = self._optics()
        self.grain = wp.array(_grain(), dtype=float, device=self.device)
        self._owners = sorted(set(self._shapes), key=self._shapes.index)
        self._drawn = np.zeros((worlds, 1 + 4 * len(self._varied) + len(self._owners)))
        self._look = np.zeros(worlds, int)
        self._tables = np.stack([self._surfaces(look) for look in self.looks])
        self._table = np.tile(self._tables[0], (worlds, 1))
        self._place(np.arange(worlds))

    def draw(self, seed: ArrayLike, mask: ArrayLike | None = None, held_out: bool = False) -> None:
        """Draw poses of objects, water, look and colours of worlds anew; world w depends on its seed and w alone.

        Args:
            seed: Of the draw, one for all worlds or one for each.
            mask: Which worlds; all if None. (worlds,)
            held_out: From the looks that the file holds out of training, in place of the others; the file's own look
                where it holds out none.
        """
        rows = np.arange(self.worlds) if mask is None else np.flatnonzero(np.asarray(mask))
        if not len(rows):
            return
        seeds = np.broadcast_to(np.asarray(seed), self.worlds)[rows]
        numbers = _uniform(seeds, rows, self._drawn.shape[1] + 1)
        self._drawn[rows] = 2.0 * numbers[:, :-1] - 1.0
        looks = np.flatnonzero([look is not None and look.held_out == held_out for look in self.looks])
        choice = looks if held_out else np.concatenate([[0], looks])
        choice = choice if len(choice) else np.zeros(1, int)
        self._look[rows] = choice[(numbers[:, -1] * len(choice)).astype(int)]
        self._place(rows)

    @property
    def drawn(self) -> np.ndarray:
        """What the worlds are made of, to be assigned to another batch of the same world, (worlds, numbers)."""
        return np.column_stack([self._drawn, self._look])

    @drawn.setter
    def drawn(self, values: np.ndarray) -> None:
        self._drawn[:], self._look[:] = values[:, :-1], values[:, -1].astype(int)
        self._place(np.arange(self.worlds))

    def _place(self, rows: np.ndarray) -> None:
        """Set water, surfaces and poses of some worlds, (k,), from what is drawn of them.

        Drawn are numbers in [-1, 1]: of the water, four of each varied object, and of each object's colour.
        """
        drawn, look, n = self._drawn[rows], self._look[rows], len(rows)
        waters = [self.world.water if one is None or one.water is None else one.water for one in self.looks]
        factor = np.exp(drawn[:, :1] * np.log([[water.vary] for water in waters])[look])
        for array, name, scale in (
            (self.optics.attenuation, "attenuation", factor),
            (self.optics.daylight_attenuation, "daylight_attenuation", factor),
            (self.optics.veil, "veil", 1.0),
        ):
            values = array.numpy().copy()
            values[rows] = scale * np.array([getattr(water, name) for water in waters])[look]
            array.assign(values)
        frames = np.zeros((len(self._varied) + 1, n, 7))
        frames[:, :, 6] = 1.0  # the last is the world's
        for i, (item, anchor, rest) in enumerate(self._varied):
            own = drawn[:, 1 + 4 * i : 5 + 4 * i]
            shift = np.concatenate(
                [own[:, :3] * item.vary.position, quat_from_yaw(own[:, 3] * item.vary.yaw)], 1
            )
            frames[i] = _compose(_compose(frames[anchor], rest), shift)
        self._frames[:, rows] = frames
        self._pose[rows] = _compose(frames[self._anchor], self._rest[:, None]).swapaxes(0, 1)
        self.model.shape_transform.assign(self._pose.reshape(-1, 7))
        self.model.bvh_refit_shapes(self.state)
        table = self._tables[look]
        level = np.exp(drawn[:, 1 + 4 * len(self._varied) :] * np.log(self.world.colour_vary))
        level = level[:, [self._owners.index(owner) for owner in self._shapes], None]
        for name in ("colour", "second", "glow"):
            table[name] *= level
        back = self._pose[rows] * [1, 1, 1, -1, -1, -1, 1]
        back[..., :3] = -quat_rotate(back[..., 3:], back[..., :3])
        table["inverse"] = back
        self._table[rows] = table
        self.surfaces = wp.array(self._table.reshape(-1), dtype=Surface, device=self.device)

    def poses(self, name: str) -> np.ndarray:
        """Position [m] and attitude xyzw of an object, of a row its first shape, world frame, (worlds, 7)."""
        anchor, rest = self._objects[name]
        return _compose(self._frames[anchor], rest)

    # ---- set-up

    def _placed(self) -> dict[str, tuple[int, np.ndarray]]:
        """Objects by name: which varied one each moves with, and its pose in the axes of that, undrawn."""
        objects: dict[str | None, tuple[int, np.ndarray]] = {None: (-1, _pose([0, 0, 0]))}
        for name, item in self.world.objects.items():
            anchor, frame = objects[item.frame]
            base = _compose(frame, _pose(item.position))
            if item.vary is not None:
                self._varied.append((item, anchor, base))
                anchor, base = len(self._varied) - 1, _pose([0, 0, 0])
            objects[name] = anchor, _compose(base, _pose([0, 0, 0], item.quaternion))
        del objects[None]
        self._frames = np.zeros((len(self._varied) + 1, self.worlds, 7))
        return objects  # type: ignore[return-value]

    def _add_shape(self, owner: str, finish: Finish, anchor: int, rest: np.ndarray) -> None:
        """Note the shape that was added last."""
        self._finishes.append(finish)
        self._shapes.append(owner)
        self._anchors.append(anchor)
        self._rests.append(rest)

    def _add_fixed(self, builder: Any) -> None:
        """Basin and seabed, which no draw moves."""
        import newton

        basin, bed = self.world.basin, self.world.seabed
        if basin is not None:
            (length, width, depth), t = basin.size, WALL
            height = depth + basin.freeboard
            middle = 0.5 * (basin.freeboard - depth)
            slabs = [((length + 2 * t, width + 2 * t, t), (0.0, 0.0, -depth - 0.5 * t))]
            for side in (-1.0, 1.0):
                slabs.append(((t, width + 2 * t, height), (side * 0.5 * (length + t), 0.0, middle)))
                slabs.append(((length, t, height), (0.0, side * 0.5 * (width + t), middle)))
            for size, position in slabs:
                hx, hy, hz = (0.5 * s for s in size)
                builder.add_shape_box(
                    -1,
                    xform=wp.transform(position, wp.quat_identity()),
                    hx=hx,
                    hy=hy,
                    hz=hz,
                    cfg=self._config,
                )
                self._add_shape("basin", basin, -1, _pose(position))
        if bed is not None:
            heights, rest = self.world.seabed_heights(), _pose([0, 0, 0])
            if heights is None:
                normal = np.array([-bed.slope[0], -bed.slope[1], 1.0])
                item = Object(shape="plane", position=np.array([0.0, 0.0, -bed.depth]), axis=normal)
                rest = _pose(item.position, item.quaternion)
                builder.add_shape_plane(
                    None,
                    xform=_transform(item.position, item.quaternion),
                    width=0.0,
                    length=0.0,
                    cfg=self._config,
                )
            else:
                field = newton.Heightfield(
                    heights, *heights.shape, hx=0.5 * bed.size[0], hy=0.5 * bed.size[1]
                )
                builder.add_shape_heightfield(heightfield=field, cfg=self._config)
            self._add_shape("seabed", bed, -1, rest)

    def _add_object(self, builder: Any, name: str, item: Object) -> None:
        import newton

        half = 0.5 * (item.length or 0.0)
        mesh = None
        if item.shape == "mesh":
            vertices, faces = self.world.mesh(name)
            mesh = newton.Mesh(np.float32(vertices), np.int32(faces).ravel(), compute_inertia=False)
        for position in item.positions:
            xform, options = _transform(position, item.quaternion), {"cfg": self._config}
            if item.shape == "box":
                hx, hy, hz = (0.5 * float(s) for s in item.size)
                builder.add_shape_box(-1, xform=xform, hx=hx, hy=hy, hz=hz, **options)
            elif item.shape == "sphere":
                builder.add_shape_sphere(-1, xform=xform, radius=item.radius, **options)
            elif item.shape == "capsule":
                builder.add_shape_capsule(-1, xform=xform, radius=item.radius, half_height=half, **options)
            elif item.shape == "cylinder":
                builder.add_shape_cylinder(-1, xform=xform, radius=item.radius, half_height=half, **options)
            elif item.shape == "plane":
                builder.add_shape_plane(None, xform=xform, width=0.0, length=0.0, **options)
            else:
                builder.add_shape_mesh(-1, xform=xform, mesh=mesh, **options)
            anchor, rest = self._objects[name]
            turned = np.concatenate(
                [quat_inverse_rotate(item.quaternion, position - item.position), [0, 0, 0, 1]]
            )
            self._add_shape(name, item, anchor, _compose(rest, turned))

    def _optics(self) -> Optics:
        water, light, optics = self.world.water, self.world.light, Optics()
        optics.attenuation = wp.full(self.worlds, wp.vec3(*water.attenuation), wp.vec3, self.device)
        optics.daylight_attenuation = wp.full(
            self.worlds, wp.vec3(*water.daylight_attenuation), wp.vec3, self.device
        )
        optics.veil = wp.full(self.worlds, wp.vec3(*water.veil), wp.vec3, self.device)
        optics.daylight = wp.vec3(*light.daylight)
        optics.sun = wp.normalize(wp.vec3(*light.sun))
        optics.diffuse, optics.sky = light.diffuse, wp.vec3(*light.sky)
        return optics

    @property
    def looks(self) -> list[Look | None]:
        """Those that a world may have; None is the file's own."""
        return [None, *self.world.looks.values()]

    def _surfaces(self, look: Look | None) -> np.ndarray:
        """The surfaces of one world's shapes in a look, poses left out."""
        table = np.zeros(len(self._finishes), Surface.numpy_dtype())
        for row, owner, finish in zip(table, self._shapes, self._finishes, strict=True):
            other = look.surfaces.get(owner) if look is not None else None
            finish = finish if other is None else other
            row["colour"] = row["second"] = finish.colour
            row["glow"] = finish.glow
            row["backscatter"] = 10.0 ** (0.1 * finish.backscatter_strength_db)
            if (texture := finish.texture) is not None:
                row["texture"], row["size"] = TEXTURES[texture.kind], texture.size
                row["contrast"], row["second"] = texture.contrast, texture.colour
        return table


def _pose(position: ArrayLike, quaternion: ArrayLike = (0.0, 0.0, 0.0, 1.0)) -> np.ndarray:
    """Position and attitude xyzw in one row, (7,)."""
    return np.concatenate([np.asarray(position, float), np.asarray(quaternion, float)])


def _compose(outer: np.ndarray, inner: np.ndarray) -> np.ndarray:
    """Pose of `inner`, which is given in the axes of `outer`, in the axes that `outer` is given in, (..., 7)."""
    q = outer[..., 3:]
    moved, turned = outer[..., :3] + quat_rotate(q, inner[..., :3]), quat_multiply(q, inner[..., 3:])
    return np.concatenate([moved, turned], -1)


def _uniform(seeds: np.ndarray, worlds: np.ndarray, count: int) -> np.ndarray:
    """Numbers in [0, 1) by seed and world, (k, count): the counter-based generator SplitMix64 (Steele et al. 2014)."""

    def mixed(x: np.ndarray) -> np.ndarray:
        x = x + np.uint64(0x9E3779B97F4A7C15)
        x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        return x ^ (x >> np.uint64(31))

    key = mixed(mixed(seeds.astype(np.uint64)) ^ worlds.astype(np.uint64))
    return (mixed(key[:, None] + np.arange(count, dtype=np.uint64)) >> np.uint64(11)) * 2.0**-53


def _transform(position: np.ndarray, quaternion: np.ndarray) -> wp.transform:
    return wp.transform(wp.vec3(*map(float, position)), wp.quat(*map(float, quaternion)))


def _grain(side: int = 256, patches: int = 16) -> np.ndarray:
    """A periodic random field of mean 0 and standard deviation 0.5 whose power falls with frequency, (side, side)."""
    random = np.random.default_rng(0)
    frequency = np.fft.fftfreq(side, 1.0 / side)
    cycles = np.hypot(frequency[:, None], frequency)
    amplitude = np.where(cycles > 0.0, (1.0 + (cycles / (0.6 * patches)) ** 2) ** -0.75, 0.0)
    field = np.fft.ifft2(amplitude * np.fft.fft2(random.standard_normal((side, side)))).real
    return np.float32(np.clip(0.5 * field / field.std(), -1.0, 1.0))
