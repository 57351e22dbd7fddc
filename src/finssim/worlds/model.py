"""Copies of one world side by side, as Newton's ray caster takes them, with what light and sound find on each shape."""
# mypy: ignore-errors

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from finssim.geometry.rotations import quat_from_yaw, quat_multiply, quat_rotate
from finssim.worlds.description import Finish, Object, World, load_world

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
    veil: wp.vec3  # B just below the surface
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
        self._shapes: list[tuple[str, np.ndarray]] = []
        """Object of each shape after the fixed ones, and how far it stands from the first of its row [m]."""
        self._varied = [name for name, item in self.world.objects.items() if item.vary is not None]
        single = newton.ModelBuilder()
        self._config = newton.ModelBuilder.ShapeConfig(
            density=0.0, has_shape_collision=False, has_particle_collision=False
        )
        self._add_fixed(single)
        self._fixed = len(self._finishes)
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
        self._pose = self.model.shape_transform.numpy().reshape(worlds, -1, 7)
        self.optics = self._optics()
        self.grain = wp.array(_grain(), dtype=float, device=self.device)
        self._drawn = np.zeros((worlds, 1 + 4 * len(self._varied)))
        self._place()

    def draw(self, seed: int, mask: ArrayLike | None = None) -> None:
        """Draw poses of objects, and the water, of worlds anew; world w depends on `seed` and w alone.

        Args:
            seed: Of the draw.
            mask: Which worlds; all if None. (worlds,)
        """
        for world in range(self.worlds) if mask is None else np.flatnonzero(np.asarray(mask)):
            random = np.random.default_rng([seed, int(world)])
            self._drawn[world] = random.uniform(-1.0, 1.0, self._drawn.shape[1])
        self._place()

    def _place(self) -> None:
        """Set water and poses from what is drawn: a number in [-1, 1] of the water, four of each varied object."""
        water, n, drawn = self.world.water, self.worlds, self._drawn
        factor = np.exp(drawn[:, :1] * math.log(water.vary))
        self.optics.attenuation.assign(np.float32(factor * water.attenuation))
        self.optics.daylight_attenuation.assign(np.float32(factor * water.daylight_attenuation))
        frames = {None: (np.zeros((n, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (n, 1)))}
        rows = {}
        for name, item in self.world.objects.items():
            shift, turn = np.zeros((n, 3)), quat_from_yaw(np.zeros(n))
            if item.vary is not None:
                own = drawn[:, 1 + 4 * self._varied.index(name) :]
                shift, turn = own[:, :3] * item.vary.position, quat_from_yaw(own[:, 3] * item.vary.yaw)
            outer, attitude = frames[item.frame]
            rows[name] = quat_multiply(attitude, turn)
            frames[name] = (
                outer + quat_rotate(attitude, item.position + shift),
                quat_multiply(rows[name], np.tile(item.quaternion, (n, 1))),
            )
        for k, (name, offset) in enumerate(self._shapes, start=self._fixed):
            self._pose[:, k, :3] = frames[name][0] + quat_rotate(rows[name], np.tile(offset, (n, 1)))
            self._pose[:, k, 3:] = frames[name][1]
        self.model.shape_transform.assign(self._pose.reshape(-1, 7))
        self.model.bvh_refit_shapes(self.state)
        self._set_surfaces()

    def poses(self, name: str) -> np.ndarray:
        """Position [m] and attitude xyzw of an object's first shape, world frame, (worlds, 7)."""
        k = next(k for k, (owner, _) in enumerate(self._shapes) if owner == name)
        return self._pose[:, self._fixed + k].copy()

    # ---- set-up

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
                self._finishes.append(basin)
        if bed is not None:
            heights = self.world.seabed_heights()
            if heights is None:
                normal = np.array([-bed.slope[0], -bed.slope[1], 1.0])
                item = Object(shape="plane", position=np.array([0.0, 0.0, -bed.depth]), axis=normal)
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
            self._finishes.append(bed)

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
            self._finishes.append(item)
            self._shapes.append((name, position - item.position))

    def _optics(self) -> Optics:
        water, light, optics = self.world.water, self.world.light, Optics()
        optics.attenuation = wp.full(self.worlds, wp.vec3(*water.attenuation), wp.vec3, self.device)
        optics.daylight_attenuation = wp.full(
            self.worlds, wp.vec3(*water.daylight_attenuation), wp.vec3, self.device
        )
        optics.veil, optics.daylight = wp.vec3(*water.veil), wp.vec3(*light.daylight)
        optics.sun = wp.normalize(wp.vec3(*light.sun))
        optics.diffuse, optics.sky = light.diffuse, wp.vec3(*light.sky)
        return optics

    def _set_surfaces(self) -> None:
        """The table of surfaces by shape, over all worlds."""
        one = np.zeros(len(self._finishes), Surface.numpy_dtype())
        for row, finish in zip(one, self._finishes, strict=True):
            row["colour"] = row["second"] = finish.colour
            row["glow"] = finish.glow
            row["backscatter"] = 10.0 ** (0.1 * finish.backscatter_strength_db)
            if (texture := finish.texture) is not None:
                row["texture"], row["size"] = TEXTURES[texture.kind], texture.size
                row["contrast"], row["second"] = texture.contrast, texture.colour
        table = np.tile(one, self.worlds)
        back = self._pose.reshape(-1, 7) * [1, 1, 1, -1, -1, -1, 1]
        back[:, :3] = -quat_rotate(back[:, 3:], back[:, :3])
        table["inverse"] = back
        self.surfaces = wp.array(table, dtype=Surface, device=self.device)


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
