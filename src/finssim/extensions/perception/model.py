"""Copies of one world side by side for Newton's ray caster, with the optical and acoustic properties of each shape."""
# mypy: ignore-errors

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from finssim.core.budget import decoded_picture, read_bytes
from finssim.core.rotations import quat_rotate
from finssim.extensions.perception.description import Light, Look, Texture, World, WorldError
from finssim.extensions.perception.layout import WorldLayout

if TYPE_CHECKING:
    from finssim.extensions.perception.onboard import OnboardSensors
    from finssim.vehicles import Vehicle

# Pictures and printed tags on shapes, as reflectances.


SIDE = 256
"""Pixels along each side of every stored picture, whatever its aspect ratio."""
PAPER, INK = 0.85, 0.04
"""Reflectances of a tag's white and black."""


def picture_of(world: World, texture: Texture) -> tuple[np.ndarray, float, float]:
    """Return a texture's picture.

    Args:
        world: World whose file lies in the same folder as the picture.
        texture: Texture of kind picture or tag.

    Returns:
        Reflectance of red, green, blue, row 0 at the top, (SIDE, SIDE, 3); width [m]; height over width [-].

    Raises:
        WorldError: OpenCV is missing, or there is no such picture or tag.
    """
    try:
        import cv2
    except ImportError:
        raise WorldError("pictures and tags on shapes need OpenCV: pip install 'finssim[vision]'") from None
    if texture.kind == "tag":
        bits = _tag(cv2, world, texture)
        paper = np.kron(np.pad(bits, 1, constant_values=True), np.ones((32, 32)))
        gray = cv2.resize(paper.astype(np.float32), (SIDE, SIDE), interpolation=cv2.INTER_AREA)
        colour = np.repeat((INK + (PAPER - INK) * gray)[..., None], 3, axis=2)
        return colour, texture.size * (len(bits) + 2.0) / len(bits), 1.0
    path = world.beside(texture.file, "texture: file")
    label = f"{world.path}: texture: {texture.file}"
    data = (
        decoded_picture(read_bytes(path, WorldError, label), cv2.IMREAD_COLOR)
        if path.is_file()
        else "is not there"
    )
    if isinstance(data, str):
        raise WorldError(f"{label} {data}: give a PNG or JPEG beside the world file")
    small = cv2.resize(data, (SIDE, SIDE), interpolation=cv2.INTER_AREA)[..., ::-1]
    return (small / 255.0) ** 2.2, texture.size, data.shape[0] / data.shape[1]


def _tag(cv2, world: World, texture: Texture) -> np.ndarray:
    """Return the cells of a tag including its black border, True for white, row 0 at the top, (n, n)."""
    code = getattr(cv2.aruco, f"DICT_{texture.family.upper()}".replace("APRILTAG_36H", "APRILTAG_36h"), None)
    dictionary = cv2.aruco.getPredefinedDictionary(code) if code is not None else None
    if dictionary is None or texture.tag >= len(dictionary.bytesList):
        lack = "no such family" if dictionary is None else f"it has {len(dictionary.bytesList)} tags"
        raise WorldError(f"{world.path}: texture: tag {texture.tag} of {texture.family}: {lack}")
    n = dictionary.markerSize + 2
    return cv2.aruco.generateImageMarker(dictionary, texture.tag, n) > 127


TEXTURES = {None: 0, "checker": 1, "stripes": 2, "tiles": 3, "mottled": 4, "picture": 5, "tag": 5}


@wp.struct
class Surface:
    """Optical and acoustic properties of a shape."""

    colour: wp.vec3  # diffuse reflectance
    second: wp.vec3  # reflectance of every other square or band, and of joints
    texture: int  # a value of TEXTURES
    size: float  # size of the pattern [m]
    contrast: float  # contrast of the pattern; of a picture, its height over its width
    picture: int  # index of the picture
    backscatter: float  # Lambert's parameter mu [-]
    glow: wp.vec3  # emitted radiance [-]
    inverse: wp.transform  # from world axes to the shape's [m, quaternion]


@wp.struct
class Optics:
    """Water and daylight, per world where they differ."""

    attenuation: wp.array(dtype=wp.vec3)  # c [1/m]
    daylight_attenuation: wp.array(dtype=wp.vec3)  # K_d [1/m]
    veil: wp.array(dtype=wp.vec3)  # B just below the surface [-]
    daylight: wp.array(dtype=wp.vec3)  # irradiance just below the surface [-]
    sun: wp.array(dtype=wp.vec3)  # unit vector towards the sun
    diffuse: float  # diffuse fraction of the irradiance
    sky: wp.array(dtype=wp.vec3)  # radiance through the surface [-]
    snow: float  # particles per volume [1/m³]
    snow_size: float  # their diameter [m]


@wp.struct
class RayScene:
    """Optical and acoustic scene of all worlds, for ray kernels."""

    optics: Optics
    surfaces: wp.array(dtype=Surface)  # by shape
    grain: wp.array2d(dtype=float)  # periodic random field of mottled surfaces [-]
    pictures: wp.array3d(dtype=wp.vec3)  # reflectances, row 0 at the top


class WorldBatch(WorldLayout):
    """N separate copies of a world for ray sensors.

        batch = WorldBatch("dock", worlds=256)
        batch.draw(seed=1)

    Args:
        world: Name of a site in the catalogue, a path, or a world.
        worlds: Number of copies.
        device: Compute device: cpu or cuda.
    """

    def __init__(self, world: World | str, worlds: int = 1, device: str = "cpu") -> None:
        import newton
        from newton.sensors import SensorCamera

        super().__init__(world, worlds, device)
        single, builder = newton.ModelBuilder(), newton.ModelBuilder()
        self._add_shapes(single)
        builder.replicate(single, worlds)
        with wp.ScopedDevice(self.device), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about collisions between seabeds, which are not used
            self.model = builder.finalize(device=self.device)
            self.state = self.model.state()
        self._sizes = self.model.shape_scale.numpy().copy()
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
        self.scene = RayScene()
        self.scene.optics = self.optics = self._optics()
        self.scene.grain = wp.array(_grain(), dtype=float, device=self.device)
        self._pictures: list[np.ndarray] = []
        self._tables = np.stack([self._surfaces(look) for look in self.looks])
        pictures = np.float32(self._pictures or np.zeros((1, 1, 1, 3)))
        self.scene.pictures = wp.array(pictures, dtype=wp.vec3, device=self.device)
        self._table = np.tile(self._tables[0], (worlds, 1))
        self._place(np.arange(worlds))

    def _place(self, rows: np.ndarray) -> None:
        """Set water, surfaces and poses of some worlds, (k,), from their drawn numbers; see `WorldLayout`."""
        super()._place(rows)
        drawn, look = self._drawn[rows], self._look[rows]
        waters = [
            self.world.water if look_or_none is None or look_or_none.water is None else look_or_none.water
            for look_or_none in self.looks
        ]
        factor = np.exp(drawn[:, :1] * np.log([[water.vary] for water in waters])[look])
        light, own = self.world.light, drawn[:, self._first[3] :]
        bright = light.vary.brightness ** own[:, :1]
        c, K, veil = (
            np.array([getattr(water, name) for water in waters])[look]
            for name in ("attenuation", "daylight_attenuation", "veil")
        )
        for name, value in (
            ("attenuation", factor * c),
            ("daylight_attenuation", factor * K),
            ("veil", bright * veil),
            ("daylight", bright * light.daylight),
            ("sky", bright * light.sky),
            ("sun", _suns(light, own[:, 1:])),
        ):
            array = getattr(self.optics, name)
            values = array.numpy().copy()
            values[rows] = value
            array.assign(values)
        self.model.shape_transform.assign(self.transforms.flatten())
        if self._first[3] > self._first[2]:
            self.model.shape_scale.assign(self._sizes * self.scales.numpy().reshape(-1, 1))
        self.model.bvh_refit_shapes(self.state)
        table = self._tables[look]
        level = np.exp(drawn[:, self._first[1] : self._first[2]] * np.log(self.world.colour_vary))
        level = level[:, [self._owners.index(shape.owner) for shape in self.shapes], None]
        for name in ("colour", "second", "glow"):
            table[name] *= level
        back = self._pose[rows] * [1, 1, 1, -1, -1, -1, 1]
        back[..., :3] = -quat_rotate(back[..., 3:], back[..., :3])
        table["inverse"] = back
        self._table[rows] = table
        self.scene.surfaces = wp.array(self._table.reshape(-1), dtype=Surface, device=self.device)

    # ---- set-up

    def _add_shapes(self, builder: Any) -> None:
        import newton

        config = newton.ModelBuilder.ShapeConfig(
            density=0.0, has_shape_collision=False, has_particle_collision=False
        )
        meshes: dict[int, Any] = {}
        for shape, pose in zip(self.shapes, self._pose[0], strict=True):
            options = {"xform": wp.transform(*map(float, pose)), "cfg": config}
            a, b, c = shape.size
            if shape.kind == "box":
                builder.add_shape_box(-1, hx=a, hy=b, hz=c, **options)
            elif shape.kind == "sphere":
                builder.add_shape_sphere(-1, radius=a, **options)
            elif shape.kind == "capsule":
                builder.add_shape_capsule(-1, radius=a, half_height=b, **options)
            elif shape.kind == "cylinder":
                builder.add_shape_cylinder(-1, radius=a, half_height=b, **options)
            elif shape.kind == "plane":
                builder.add_shape_plane(None, width=0.0, length=0.0, **options)
            elif shape.kind == "heightfield":
                field = newton.Heightfield(shape.heights, *shape.heights.shape, hx=a, hy=b)
                builder.add_shape_heightfield(heightfield=field, cfg=config)
            else:
                if id(shape.vertices) not in meshes:
                    meshes[id(shape.vertices)] = newton.Mesh(
                        np.float32(shape.vertices), np.int32(shape.faces).ravel(), compute_inertia=False
                    )
                builder.add_shape_mesh(-1, mesh=meshes[id(shape.vertices)], **options)

    def _optics(self) -> Optics:
        water, optics = self.world.water, Optics()
        for name in ("attenuation", "daylight_attenuation", "veil", "daylight", "sun", "sky"):
            setattr(
                optics, name, wp.zeros(self.worlds, dtype=wp.vec3, device=self.device)
            )  # `_place` fills them
        optics.diffuse = self.world.light.diffuse
        if water.snow is not None:
            optics.snow, optics.snow_size = water.snow.density, water.snow.size
        return optics

    def _surfaces(self, look: Look | None) -> np.ndarray:
        """Return the surfaces of one world's shapes in a look, without poses."""
        table = np.zeros(len(self.shapes), Surface.numpy_dtype())
        for row, shape in zip(table, self.shapes, strict=True):
            other = look.surfaces.get(shape.owner) if look is not None else None
            finish = shape.finish if other is None else other
            row["colour"] = row["second"] = finish.colour
            row["glow"] = finish.glow
            row["backscatter"] = 10.0 ** (0.1 * finish.backscatter_strength_db)
            if (texture := finish.texture) is not None:
                row["texture"], row["size"] = TEXTURES[texture.kind], texture.size
                row["contrast"], row["second"] = texture.contrast, texture.colour
                if texture.kind in ("picture", "tag"):
                    row["picture"] = len(self._pictures)
                    picture, row["size"], row["contrast"] = picture_of(self.world, texture)
                    self._pictures.append(picture)
        return table

    def sensors(self, vehicle: Vehicle, names: Sequence[str], seed: int) -> OnboardSensors:
        """Return some of a vehicle's cameras and sonars in this batch, which must contain one world; see
        `OnboardSensors`."""
        from finssim.extensions.perception.onboard import OnboardSensors

        return OnboardSensors(vehicle, self, names=names, seed=seed)


def _suns(light: Light, drawn: np.ndarray) -> np.ndarray:
    """Return unit vectors towards the sun, (k, 3), from numbers in [-1, 1] for azimuth and elevation, (k, 2)."""
    x, y, z = light.sun / np.linalg.norm(light.sun)
    turn = math.atan2(y, x) + light.vary.sun * drawn[:, 0]
    lowest = min(math.radians(5.0), math.asin(z))
    height = np.clip(math.asin(z) + light.vary.sun * drawn[:, 1], lowest, 0.5 * math.pi)
    return np.stack([np.cos(height) * np.cos(turn), np.cos(height) * np.sin(turn), np.sin(height)], axis=1)


def _grain(side: int = 256, patches: int = 16) -> np.ndarray:
    """Return a periodic random field of mean 0 and standard deviation 0.5 with falling power spectrum, (side,
    side)."""
    random = np.random.default_rng(0)
    frequency = np.fft.fftfreq(side, 1.0 / side)
    cycles = np.hypot(frequency[:, None], frequency)
    amplitude = np.where(cycles > 0.0, (1.0 + (cycles / (0.6 * patches)) ** 2) ** -0.75, 0.0)
    field = np.fft.ifft2(amplitude * np.fft.fft2(random.standard_normal((side, side)))).real
    return np.float32(np.clip(0.5 * field / field.std(), -1.0, 1.0))
