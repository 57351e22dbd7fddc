"""Ray sensors of many vehicles: cameras, imaging sonars, altimeters and the beams of a DVL.

Each takes the poses of N vehicles, and leaves arrays on the device:

    batch = WorldBatch("dock", worlds=256)
    camera = CameraBatch(batch, load_device("low_light_camera"), width=64)
    picture = camera.update(poses, seed=step)      # uint8 (256, 48, 64, 3)

Newton's ray caster gives depth, shape and normal of every ray; what light and sound make of them is here. All sensors
ask it for the same three outputs, so that its kernel is compiled once.
"""
# mypy: ignore-errors

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from scipy.special import ndtri

from finssim.extensions.perception.description import WorldError
from finssim.extensions.perception.model import Optics, RayScene, WorldBatch
from finssim.extensions.perception.rays import WATER_INDEX, camera_rays, cones, fan, ray_elevations
from finssim.physics.types import angular, linear, vec6
from finssim.sim.overhead_camera.photometry import fresnel, noise_key, refracted, through_water
from finssim.sim.sensors.dvl import sensed_velocity
from finssim.vehicles import Vehicle
from finssim.vehicles.device_files import CameraDevice, DeviceMount, RangeDevice, SonarDevice, device_of

wp.set_module_options({"enable_backward": False})

MISS = wp.constant(wp.uint32(0xFFFFFFFF))
SKIPPED = wp.constant(-101)
"""World of a view whose outputs Newton leaves unchanged (`WorldRenderFlag.DISABLE_PRESERVE`)."""
LEVELS = 4096
"""Levels of the converter behind a camera's pixels (12 bits), before the numbers are encoded to 8."""
LAMP_STEPS = wp.constant(8)
SNOW_STEPS = wp.constant(40)
SNOW_SHARE = wp.constant(0.7)
"""Share of the cells of marine snow's lattice that hold a particle; a ray is followed through twenty cells."""
BLUR = 5
"""Moments of an exposure that a blurred picture is the mean of."""
AUTO_MEAN = 0.42
"""Mean of a picture that automatic exposure aims at, as a share of the full scale after gamma."""


@wp.struct
class Traced:
    """A bundle of rays of many views, and what each of them met."""

    rays: wp.array4d(dtype=wp.vec3)  # (rows, columns, 2): origin [m] and unit direction, sensor axes
    views: wp.array(dtype=wp.transform)  # sensor to world [m, quaternion]
    worlds: wp.array(dtype=int)  # or SKIPPED
    dimming: wp.array(dtype=wp.vec3)  # daylight at the view's depth as a share of that at the surface [-]
    depth: wp.array3d(dtype=float)  # along the ray [m]
    shape_index: wp.array3d(dtype=wp.uint32)  # or MISS
    normal: wp.array3d(dtype=wp.vec3)  # world axes, unit


@wp.kernel(enable_backward=False)
def _place_views(
    poses: wp.array(dtype=wp.transform),
    mount: wp.transform,
    world_of_view: wp.array(dtype=int),
    mask: wp.array(dtype=int),
    optics: Optics,
    traced: Traced,
):
    """Place views: sensor poses, their worlds or SKIPPED, and daylight at their depths."""
    v = wp.tid()
    traced.worlds[v] = SKIPPED
    if mask.shape[0] > 0:
        if mask[v] == 0:
            return
    traced.worlds[v] = world_of_view[v]
    traced.views[v] = wp.transform_multiply(poses[v], mount)
    depth = wp.max(-wp.transform_get_translation(traced.views[v])[2], 0.0)
    K = optics.daylight_attenuation[world_of_view[v]]
    traced.dimming[v] = wp.vec3(wp.exp(-K[0] * depth), wp.exp(-K[1] * depth), wp.exp(-K[2] * depth))


@wp.kernel(enable_backward=False)
def _join_poses(
    position: wp.array2d(dtype=wp.vec3), quaternion: wp.array2d(dtype=wp.quat), poses: wp.array(dtype=wp.transform)
):  # fmt: skip
    w, v = wp.tid()
    poses[w * position.shape[1] + v] = wp.transform(position[w, v], quaternion[w, v])


def poses_of(state: Any, poses: wp.array | None = None) -> wp.array:
    """Poses of all vehicles of a simulator, as sensors take them.

    Args:
        state: Its `state`: `position` and `quaternion` by (world, vehicle).
        poses: Array for the poses [m, quaternion], filled where given.

    Returns:
        Body to world of each vehicle [m, quaternion], in order of world; transform (worlds · vehicles,).
    """
    if poses is None:
        poses = wp.zeros(state.position.size, dtype=wp.transform, device=state.position.device)
    inputs = [state.position, state.quaternion, poses]
    wp.launch(_join_poses, state.position.shape, inputs, device=poses.device)
    return poses


class RayBatch:
    """A bundle of rays for each of N vehicles: what all these sensors share.

    Args:
        batch: The worlds. Vehicles are in order of world, as many in each.
        rays: The bundle of unit vectors, sensor axes, (rows, columns, 2, 3).
        mount: Where the sensor sits on its vehicle.
        vehicles: In each world.
    """

    reading: wp.array
    """Result of `update` in the unit of the sensor; one row for each vehicle."""

    def __init__(self, batch: WorldBatch, rays: np.ndarray, mount: DeviceMount, vehicles: int = 1) -> None:
        self.batch, self.device, self.count = batch, batch.device, batch.worlds * vehicles
        shape = (self.count, *rays.shape[:2])
        with wp.ScopedDevice(self.device):
            self.rays = wp.array(np.float32(rays[:, :, None]), dtype=wp.vec3)
            self.depth, self.normal = wp.zeros(shape, dtype=float), wp.zeros(shape, dtype=wp.vec3)
            self.shape_index = wp.zeros(shape, dtype=wp.uint32)
            self.world_of_view = wp.array(np.arange(self.count) // vehicles, dtype=int)
            self.views = wp.zeros(self.count, dtype=wp.transform)
            self.dimming = wp.zeros(self.count, dtype=wp.vec3)
            self.worlds = wp.zeros(self.count, dtype=int)
            self._all = wp.zeros(0, dtype=int)
        self.traced = Traced()
        for name in Traced.vars:
            setattr(self.traced, name, getattr(self, name))
        self._mount = wp.transform(wp.vec3(*mount.position), wp.quat(*map(float, mount.quaternion)))

    def _span(self, columns: int) -> int:
        """Elements of a row for a thread: neighbours are other threads on a GPU, and its own next on a processor."""
        return 1 if self.device.is_cuda else columns

    def _blocks(self, array: wp.array) -> tuple[int, int, int]:
        """Threads over an array of (views, rows, columns)."""
        views, rows, columns = array.shape[:3]
        return views, rows, columns // self._span(columns)

    def cast(self, poses: wp.array, mask: wp.array | None = None) -> None:
        """Trace the rays: depth from where each enters the water [m], index of the shape, normal.

        Args:
            poses: Body to world of each vehicle, xyzw; transform (N,) on the batch's device [m].
            mask: Which vehicles' sensors measure; the others' outputs stay. int (N,); all if None.

        Raises:
            WorldError: Another number of vehicles.
        """
        if len(poses) != self.count:
            raise WorldError(
                f"{len(poses)} poses for {self.count} vehicles: give one for each, in order of world"
            )
        inputs = [poses, self._mount, self.world_of_view, self._all if mask is None else mask]
        inputs += [self.batch.optics, self.traced]
        wp.launch(_place_views, self.count, inputs, device=self.device)
        self.batch.caster.update(
            self.batch.state,
            self.views,
            self.rays,
            depth_image=self.depth,
            normal_image=self.normal,
            shape_index_image=self.shape_index,
            world_indices=self.worlds,
            sync_deformables=False,
        )


# Cameras.


@wp.struct
class Lamp:
    """A vehicle's light: a point with a round, even beam that ends softly."""

    position: wp.vec3  # body axes [m]
    axis: wp.vec3  # of its beam, body axes, unit
    intensity: (
        wp.vec3
    )  # irradiance [-] at 1 m on its axis, without water, relative to daylight at the surface
    cosine: float  # cosine of the beam's half angle


@wp.struct
class Film:
    """Everything behind the lens of a camera, for all views."""

    lamps: wp.array(dtype=Lamp)  # of each vehicle
    pixel: float  # angle from pixel to pixel [rad]
    full_well: float  # [electrons]
    read_noise: float  # [electrons]
    gain: wp.array(dtype=wp.vec3)  # by view: share of the full scale of radiance 1
    code: wp.array(dtype=wp.uint8)  # numbers by level of the converter
    quantiles: wp.array(dtype=float)  # of the normal distribution [-]
    radiance: wp.array3d(dtype=wp.vec3)  # [-], or empty
    picture: wp.array4d(dtype=wp.uint8)


@wp.struct
class WaterRay:
    """A ray in the water, up to a surface or the end of the water."""

    origin: wp.vec3  # where it enters the water, world frame [m]
    direction: wp.vec3  # unit, world frame
    length: float  # [m]


@dataclass(frozen=True, kw_only=True)
class Headlight:
    """A light on the vehicle."""

    position: tuple[float, float, float]
    """Body axes [m]."""
    axis: tuple[float, float, float] = (1.0, 0.0, 0.0)
    """Axis of its beam, body axes, unit length."""
    intensity: float = 0.5
    """Irradiance at 1 m on its axis, without water, relative to daylight just below the surface [-]."""
    half_angle: float = 1.0
    """Angle at which it has half of its intensity on the axis [rad]."""


@wp.func
def mottled(local: wp.vec3, grain: wp.array2d(dtype=float)) -> float:
    """Random brightness at a point, about 0.

    Brightness has no unit [-].

    Args:
        local: Point in shape axes, in sizes of the pattern [-].
        grain: A periodic field [-], sixteen patches along each side.
    """
    # Skewed along z, so that upright faces have a pattern too.
    u = (local[0] + 0.37 * local[2]) / 16.0
    v = (local[1] + 0.61 * local[2]) / 16.0
    n = grain.shape[0]
    x = float(n) * (u - wp.floor(u))
    y = float(n) * (v - wp.floor(v))
    a = wp.clamp(int(x), 0, n - 1)  # of a point that is no number too
    b = wp.clamp(int(y), 0, n - 1)
    c = wp.where(a + 1 == n, 0, a + 1)
    d = wp.where(b + 1 == n, 0, b + 1)
    fy = y - float(b)
    lower = grain[a, b] + fy * (grain[a, d] - grain[a, b])
    right = grain[c, b] + fy * (grain[c, d] - grain[c, b])
    return lower + (x - float(a)) * (right - lower)


@wp.func
def patterned(kind: int, local: wp.vec3, colour: wp.vec3, second: wp.vec3, contrast: float) -> wp.vec3:
    """Reflectance at a point of squares, bands or tiles.

    Args:
        kind: A value of `TEXTURES`.
        local: The point, shape axes, in sizes of the pattern [-].
        colour: Reflectance of the one.
        second: Reflectance of the other, or of joints.
        contrast: Contrast from tile to tile.
    """
    # A hair inside the face, so that points on it fall on one side of the pattern.
    cx = int(wp.floor(local[0] + 1.0e-3))
    cy = int(wp.floor(local[1] + 1.0e-3))
    cz = int(wp.floor(local[2] + 1.0e-3))
    if kind == 1:
        return wp.where((cx + cy + cz) & 1 == 1, second, colour)
    if kind == 2:
        return wp.where(local[2] - float(cz) > 0.5, second, colour)
    # On a face of an axis-aligned slab one coordinate is constant, perhaps at a joint: that one does not count.
    dx = wp.abs(local[0] - float(cx) - 0.5)
    dy = wp.abs(local[1] - float(cy) - 0.5)
    dz = wp.abs(local[2] - float(cz) - 0.5)
    if (dx > 0.47 and dx < 0.4995) or (dy > 0.47 and dy < 0.4995) or (dz > 0.47 and dz < 0.4995):
        return second
    mixed = (cx * 73856093) ^ (cy * 19349663) ^ (cz * 83492791)
    mixed = (mixed ^ (mixed >> 13)) * 1274126177
    return (1.0 - contrast * float((mixed >> 16) & 255) / 255.0) * colour


@wp.func
def painted(
    pictures: wp.array3d(dtype=wp.vec3), index: int, local: wp.vec3, normal: wp.vec3, aspect: float, base: wp.vec3
) -> wp.vec3:  # fmt: skip
    """Reflectance at a point of a face with a picture in its middle.

    Args:
        pictures: All pictures, row 0 at the top.
        index: Which.
        local: The point, shape axes, in widths of the picture.
        normal: Of the face, shape axes, unit [-].
        aspect: Height of the picture over its width.
        base: Reflectance beside it.
    """
    n = wp.vec3(wp.abs(normal[0]), wp.abs(normal[1]), wp.abs(normal[2]))
    u = wp.sign(normal[2]) * local[0]
    v = local[1]
    if n[0] > n[1] and n[0] > n[2]:
        u = wp.sign(normal[0]) * local[1]
        v = local[2]
    elif n[1] > n[2]:
        u = -wp.sign(normal[1]) * local[0]
        v = local[2]
    x = u + 0.5
    y = 0.5 - v / aspect
    if not (x >= 0.0 and x <= 1.0 and y >= 0.0 and y <= 1.0):
        return base
    rows = pictures.shape[1]
    columns = pictures.shape[2]
    x = wp.clamp(x * float(columns) - 0.5, 0.0, float(columns - 1))
    y = wp.clamp(y * float(rows) - 0.5, 0.0, float(rows - 1))
    j = wp.min(int(x), wp.max(columns - 2, 0))
    i = wp.min(int(y), wp.max(rows - 2, 0))
    fx = x - float(j)
    fy = y - float(i)
    above = (1.0 - fx) * pictures[index, i, j] + fx * pictures[index, i, j + 1]
    below = (1.0 - fx) * pictures[index, i + 1, j] + fx * pictures[index, i + 1, j + 1]
    return (1.0 - fy) * above + fy * below


@wp.func
def below_surface(ray: wp.vec3, veil: wp.vec3, sky: wp.vec3) -> wp.vec3:
    """Radiance that comes down through the still water surface, or is thrown back by it (Fresnel, Snell's window).

    Radiances are relative to that of white paper [-].

    Args:
        ray: Unit direction from the eye upwards, world frame [-].
        veil: Radiance of the water itself [-].
        sky: Radiance of what lies above [-].
    """
    out = refracted(ray, wp.vec3(0.0, 0.0, -1.0), WATER_INDEX)
    if out[2] <= 0.0:
        return veil
    share = fresnel(ray[2], out[2], WATER_INDEX, 1.0)
    return share * veil + (1.0 - share) * sky


@wp.func
def lamp_light(point: wp.vec3, lamp: Lamp, position: wp.vec3, axis: wp.vec3, attenuation: wp.vec3) -> wp.vec4:
    """Irradiance of a lamp at a point, and in the fourth number the distance.

    E = I f(angle) exp(-c r)/r², with f = 1/(1 + ((1 - cos angle)/(1 - cos half))²)

    Irradiance is relative to daylight [-], the distance in [m].

    Args:
        point: World frame [m].
        lamp: Its beam and intensity.
        position: Of the lamp, world frame [m].
        axis: Of its beam, world frame, unit [-].
        attenuation: c [1/m].
    """
    way = point - position
    r = wp.max(wp.length(way), 0.05)
    off = (1.0 - wp.dot(way, axis) / r) / (1.0 - lamp.cosine)
    level = 1.0 / ((1.0 + off * off) * r * r)
    return wp.vec4(
        lamp.intensity[0] * level * wp.exp(-attenuation[0] * r),
        lamp.intensity[1] * level * wp.exp(-attenuation[1] * r),
        lamp.intensity[2] * level * wp.exp(-attenuation[2] * r),
        r,
    )


@wp.func
def rgb(light: wp.vec4) -> wp.vec3:
    """Return the first three numbers of a light, in its unit."""
    return wp.vec3(light[0], light[1], light[2])


@wp.func
def lamps_seen(
    ray: WaterRay, normal: wp.vec3, reflectance: wp.vec3, c: wp.vec3, veil: wp.vec3, lamps: wp.array(dtype=Lamp),
    pose: wp.transform,
) -> wp.vec3:  # fmt: skip
    """Return the light that the vehicle's lamps add to a ray: rho E e^(-c s) of the surface, and the veil between.

    The veil is the integral of c B E e^(-c s) along the ray, by the midpoint rule over equal shares of its logarithm:
    the water scatters lamplight back as it does daylight.

    Args:
        ray: The ray, of length s [m].
        normal: Of the surface, world frame, unit [-].
        reflectance: Reflectance rho; 0 where there is none.
        c: Beam attenuation [1/m].
        veil: Radiance B [-].
        lamps: On the vehicle.
        pose: Pose of the vehicle, body to world [m, quaternion].
    """
    radiance = wp.vec3(0.0)
    far = wp.min(ray.length, 8.0)
    near = wp.min(0.15, 0.5 * far)
    ratio = wp.pow(far / near, 1.0 / float(LAMP_STEPS))
    for k in range(lamps.shape[0]):
        lamp = lamps[k]
        position = wp.transform_point(pose, lamp.position)
        axis = wp.transform_vector(pose, lamp.axis)
        if ray.length < 1.0e6:
            point = ray.origin + ray.length * ray.direction
            light = lamp_light(point, lamp, position, axis, c)
            cosine = wp.max(wp.dot(normal, position - point) / light[3], 0.0)
            radiance += through_water(
                wp.cw_mul(reflectance, cosine * rgb(light)), c, wp.vec3(0.0), ray.length
            )
        here = near
        for _ in range(LAMP_STEPS):
            middle = here * wp.sqrt(ratio)
            light = lamp_light(ray.origin + middle * ray.direction, lamp, position, axis, c)
            glow = (here * (ratio - 1.0)) * wp.cw_mul(wp.cw_mul(c, veil), rgb(light))
            radiance += through_water(glow, c, wp.vec3(0.0), middle)
            here = here * ratio
    return radiance


@wp.func
def snow_seen(
    sight: WaterRay, c: wp.vec3, daylight: wp.vec3, optics: Optics, film: Film, pose: wp.transform
) -> wp.vec4:
    """Return the light that particles in the water add to a ray, and as fourth number the share that they cover.

    Each cell of a lattice holds a particle or none, by a hash of the cell; it covers a²/s² e^(-(x/s)²) of a pixel that
    it passes at x, a its radius and s² = a² + w² with the pixel's half width w there. Snow reflects 0.4 of its light.

    Args:
        sight: The ray.
        c: Beam attenuation [1/m].
        daylight: Irradiance at the eye's depth [-].
        optics: Has the snow's density [1/m³] and size [m].
        film: Has the lamps and the angle from pixel to pixel [rad].
        pose: Pose of the vehicle, body to world [m, quaternion].
    """
    ray = sight.direction
    cell = wp.pow(SNOW_SHARE / optics.snow, 1.0 / 3.0)
    light = wp.vec3(0.0)
    clear = float(1.0)
    t = float(0.05)
    for _ in range(SNOW_STEPS):
        t += 0.5 * cell
        if t > sight.length:
            break
        at = (sight.origin + t * ray) / cell
        corner = wp.vec3(wp.floor(at[0]), wp.floor(at[1]), wp.floor(at[2]))
        mixed = (int(corner[0]) * 73856093) ^ (int(corner[1]) * 19349663) ^ (int(corner[2]) * 83492791)
        state = wp.rand_init(17, mixed)
        if wp.randf(state) < SNOW_SHARE:
            inset = wp.vec3(wp.randf(state), wp.randf(state), wp.randf(state))
            particle = cell * (corner + wp.vec3(0.1) + 0.8 * inset)
            way = wp.dot(particle - sight.origin, ray)
            # Half a cell's steps meet most cells twice: the step nearest to the particle counts.
            if wp.abs(way - t) <= 0.25 * cell and way > 0.05:
                a = 0.5 * optics.snow_size
                w = 0.5 * film.pixel * way
                s = a * a + w * w
                off = wp.length_sq(particle - sight.origin - way * ray)
                cover = a * a / s * wp.exp(-off / s)
                if cover > 1.0e-4:
                    lit = daylight
                    for k in range(film.lamps.shape[0]):
                        lamp = film.lamps[k]
                        lamp_position = wp.transform_point(pose, lamp.position)
                        axis = wp.transform_vector(pose, lamp.axis)
                        lit += rgb(lamp_light(particle, lamp, lamp_position, axis, c))
                    light += (0.4 * clear * cover) * through_water(lit, c, wp.vec3(0.0), way)
                    clear = clear * (1.0 - cover)
    return wp.vec4(light[0], light[1], light[2], 1.0 - clear)


@wp.func
def reflectance_at(scene: RayScene, shape: int, position: wp.vec3, normal: wp.vec3):
    """Return the reflectance of a surface at a position of the world [m], with its texture."""
    reflectance = scene.surfaces[shape].colour
    kind = scene.surfaces[shape].texture
    if kind > 0:
        inverse = scene.surfaces[shape].inverse
        local = wp.transform_point(inverse, position) / scene.surfaces[shape].size
        contrast = scene.surfaces[shape].contrast
        if kind == 4:
            reflectance = (1.0 + contrast * mottled(local, scene.grain)) * reflectance
        elif kind == 5:
            face = wp.transform_vector(inverse, normal)
            which = scene.surfaces[shape].picture
            reflectance = painted(scene.pictures, which, local, face, contrast, reflectance)
        else:
            reflectance = patterned(kind, local, reflectance, scene.surfaces[shape].second, contrast)
    return reflectance


@wp.kernel(enable_backward=False)
def _take_picture(
    traced: Traced, poses: wp.array(dtype=wp.transform), scene: RayScene, film: Film, share: float, last: int, key: int,
    span: int,
):  # fmt: skip
    """Radiance of every pixel, and its 8-bit numbers.

    With the eye at depth h and the ray rising by u per metre, daylight at path s is D e^(K u s), D = e^(-K h). The
    surface's radiance rho E and the veil gathered on the way (the integral of c B D e^(K u s) e^(-c s)) are together

        L = D [ rho E e^(-(c - K u) s) + B c/(c - K u) (1 - e^(-(c - K u) s)) ]

    which is `through_water` with c - K u in place of c. Daylight on a surface, relative to that on a level one, is of
    the sun, of what lies above, and of the water below (d is the diffuse share, s the sun's direction):

        E = (1 - d) max(n . s, 0)/s_z + d (1 + n_z)/2 + B (1 - n_z)/2

    Then charge with shot and read noise, 12 bits, and the code's 8. A thread takes `span` pixels of a row.
    `radiance` may be empty; without noise, which a negative key means, a number is that of the mean charge.
    """
    v, i, block = wp.tid()
    w = traced.worlds[v]
    if w == SKIPPED:
        return
    view = traced.views[v]
    optics = scene.optics
    pose = poses[v]
    c = optics.attenuation[w]
    K = optics.daylight_attenuation[w]
    veil = optics.veil[w]
    daylight = optics.daylight[w]
    diffuse = optics.diffuse
    sun = (1.0 - diffuse) / optics.sun[w][2] * optics.sun[w]
    dim = traced.dimming[v]
    gains = film.full_well * film.gain[v]
    noise_floor = film.read_noise * film.read_noise
    digits = float(film.code.shape[0] - 1) / film.full_well
    lit = film.lamps.shape[0] > 0
    keep = film.radiance.shape[0] > 0
    for j in range(block * span, wp.min(block * span + span, traced.depth.shape[2])):
        ray = wp.transform_vector(view, traced.rays[i, j, 0, 1])
        origin = wp.transform_point(view, traced.rays[i, j, 0, 0])
        path = float(1.0e9)
        if ray[2] > 1.0e-6:
            path = wp.max(-origin[2], 0.0) / ray[2]
        index = traced.shape_index[v, i, j]
        n = traced.normal[v, i, j]
        reflectance = wp.vec3(0.0)
        start = wp.vec3(0.0)
        glow = wp.vec3(0.0)
        if index != MISS and traced.depth[v, i, j] < path:
            path = traced.depth[v, i, j]
            shape = int(index)
            reflectance = reflectance_at(scene, shape, origin + path * ray, n)
            above = 0.5 * (1.0 + n[2])
            level = wp.max(wp.dot(n, sun), 0.0) + diffuse * above
            start = wp.cw_mul(reflectance, level * daylight + (1.0 - above) * veil)
            glow = scene.surfaces[shape].glow
        elif ray[2] > 1.0e-6:
            start = below_surface(ray, veil, optics.sky[w])
        # Light that falls off with depth takes K u from the exponent; a beacon's own light does not.
        net = c - ray[2] * K
        net = wp.vec3(wp.max(net[0], 1.0e-6), wp.max(net[1], 1.0e-6), wp.max(net[2], 1.0e-6))
        colour = wp.cw_mul(dim, through_water(start, net, wp.cw_mul(veil, wp.cw_div(c, net)), path))
        if glow[0] + glow[1] + glow[2] > 0.0:
            colour += through_water(glow, c, wp.vec3(0.0), path)
        sight = WaterRay()
        sight.origin = origin
        sight.direction = ray
        sight.length = path
        if lit:
            colour += lamps_seen(sight, n, reflectance, c, veil, film.lamps, pose)
        if optics.snow > 0.0:
            flakes = snow_seen(sight, c, wp.cw_mul(dim, daylight), optics, film, pose)
            colour = (1.0 - flakes[3]) * colour + rgb(flakes)
        if wp.length_sq(ray) < 0.5:
            colour = wp.vec3(0.0)  # the lens has no ray here
        if keep:
            if share < 1.0:
                colour = film.radiance[v, i, j] + share * colour
            film.radiance[v, i, j] = colour
        if last == 0:
            continue
        bits = wp.uint32(0)
        if key >= 0:
            # Numbers of the normal distribution by their quantiles, 10 bits each, from one hash of the pixel.
            bits = wp.rand_init(key, (v * traced.depth.shape[1] + i) * traced.depth.shape[2] + j)
        for k in range(3):
            charge = wp.max(gains[k] * colour[k], 0.0)
            if key >= 0:
                # Shot noise, of variance `charge`, is normal instead of Poisson; above 20 electrons they hardly differ.
                drawn = film.quantiles[int(bits & wp.uint32(1023))]
                bits = bits >> wp.uint32(11)
                charge += drawn * wp.sqrt(charge + noise_floor)
            last_digit = film.code.shape[0] - 1
            digit = int(wp.clamp(charge * digits, 0.0, float(last_digit)) + 0.5)
            film.picture[v, i, j, k] = film.code[
                wp.clamp(digit, 0, last_digit)
            ]  # of a charge that is no number too


@wp.kernel(enable_backward=False)
def _meter(
    worlds: wp.array(dtype=int),
    picture: wp.array4d(dtype=wp.uint8),
    target: float,
    gamma: float,
    balance: float,
    gain: wp.array(dtype=wp.vec3),
):
    """Automatic exposure and white balance: move gains towards what would have given the last picture the target mean.

    Of the differences between the channels' means, the share `balance` is taken out (gray world).
    """
    v = wp.tid()
    if worlds[v] == SKIPPED:
        return
    total = wp.vec3(0.0)
    rows = wp.min(picture.shape[1], 16)
    columns = wp.min(picture.shape[2], 16)
    for i in range(rows):
        for j in range(columns):
            y = (2 * i + 1) * picture.shape[1] / (2 * rows)
            x = (2 * j + 1) * picture.shape[2] / (2 * columns)
            for k in range(3):
                total[k] = total[k] + float(picture[v, y, x, k])
    mean = total / (255.0 * float(rows * columns))
    common = wp.max((mean[0] + mean[1] + mean[2]) / 3.0, 0.01)
    change = wp.clamp(wp.pow(target / common, gamma), 0.25, 4.0)
    old = gain[v]
    # A channel's gain over their mean goes a third of the way to what the share asks for, within a factor of 4.
    level = (old[0] + old[1] + old[2]) / 3.0
    new = wp.vec3(0.0)
    for k in range(3):
        linear = wp.pow(wp.max(mean[k], 0.01) / common, gamma)
        unbalanced = linear * level / old[k]
        aim = wp.pow(wp.max(unbalanced, 1.0e-3), -balance)
        relative = old[k] / level * wp.pow(aim * level / old[k], 0.34)
        new[k] = wp.clamp(level * change * wp.clamp(relative, 0.25, 4.0), 0.02, 200.0)
    gain[v] = new


@wp.kernel(enable_backward=False)
def _move(
    poses: wp.array(dtype=wp.transform),
    twists: wp.array2d(dtype=vec6),
    time: float,
    moved: wp.array(dtype=wp.transform),
):
    """Poses a time [s] on, at the twists that the vehicles have."""
    i = wp.tid()
    nu = twists[i // twists.shape[1], i % twists.shape[1]]
    q = wp.transform_get_rotation(poses[i])
    angle = time * wp.length(angular(nu))
    turned = q
    if wp.abs(angle) > 1.0e-9:
        turned = q * wp.quat_from_axis_angle(wp.normalize(angular(nu)), angle)
    moved[i] = wp.transform(
        wp.transform_get_translation(poses[i]) + time * wp.quat_rotate(q, linear(nu)), turned
    )


@wp.kernel(enable_backward=False)
def _clear(worlds: wp.array(dtype=int), linear: wp.array3d(dtype=wp.vec3)):
    """Begin an exposure."""
    v, i, j = wp.tid()
    if worlds[v] != SKIPPED:
        linear[v, i, j] = wp.vec3(0.0)


class CameraBatch(RayBatch):
    """A camera on each of N vehicles.

    Args:
        batch: The worlds.
        camera: Lens, port, exposure, mount.
        width: Of the pictures, in place of the camera's own [px]; their height follows.
        vehicles: In each world.
        lamps: Lights on each vehicle.
        linear: Keep the radiance too.
        twists: nu of the vehicles, body frame [m/s, rad/s], read in each update, as a simulator's `state.velocity`:
            with the camera's exposure time, pictures blur; vec6 (worlds, vehicles).
    """

    picture: wp.array
    """Picture: red, green, blue, row 0 at the top; uint8 (N, height, width, 3)."""
    radiance: wp.array
    """Radiance before noise and gain [-], relative to white paper just below the surface; vec3 (N, height, width), or
    empty."""
    gain: wp.array
    """Share of the full scale that radiance 1 reaches in red, green, blue; vec3 (N,)."""

    def __init__(
        self,
        batch: WorldBatch,
        camera: CameraDevice,
        *,
        width: int | None = None,
        vehicles: int = 1,
        lamps: tuple[Headlight, ...] = (),
        linear: bool = False,
        twists: wp.array | None = None,
    ) -> None:
        self.camera, self.lens = camera, camera.lens(width)
        super().__init__(batch, camera_rays(self.lens, camera.port), camera.mount, vehicles)
        shape = self.depth.shape
        self.twists = twists if camera.exposure_time > 0.0 else None
        keep = linear or self.twists is not None
        code = 255.0 * np.linspace(0.0, 1.0, LEVELS) ** (1.0 / camera.gamma) + 0.5
        with wp.ScopedDevice(self.device):
            self.reading = self.picture = wp.zeros((*shape, 3), dtype=wp.uint8)
            self.radiance = wp.zeros(shape if keep else (0, 0, 0), dtype=wp.vec3)
            self._moved = wp.zeros(self.count, dtype=wp.transform)
            self.gain = wp.full(self.count, wp.vec3(camera.gain), dtype=wp.vec3)
            film = self._film = Film()
            film.lamps = wp.array([_lamp(lamp) for lamp in lamps], dtype=Lamp)
            film.quantiles = wp.array(np.float32(ndtri((np.arange(1024) + 0.5) / 1024)), dtype=float)
            film.code = wp.array(np.uint8(code), dtype=wp.uint8)
        film.pixel, film.full_well, film.read_noise = 1.0 / self.lens.fx, camera.full_well, camera.read_noise
        film.gain, film.radiance, film.picture = self.gain, self.radiance, self.picture

    def update(
        self, poses: wp.array, *, seed: int | None = None, time: float = 0.0, mask: wp.array | None = None
    ) -> wp.array:
        """Take a picture of each world.

        Args:
            poses: Body to world of each vehicle, xyzw; transform (N,) on the batch's device [m].
            seed: Of the noise; None for none.
            time: Of the pictures [s]: pictures of other times have other noise.
            mask: Which vehicles measure; the others keep their last. int (N,); all if None.

        Returns:
            `picture`, which the next update overwrites.
        """
        moments = 1 if self.twists is None else BLUR
        for k in range(moments):
            if moments > 1:
                before = self.camera.exposure_time * ((k + 0.5) / moments - 1.0)
                inputs = [poses, self.twists, before, self._moved]
                wp.launch(_move, self.count, inputs, device=self.device)
            self._expose(self._moved if moments > 1 else poses, seed, time, mask, k, moments)
        if self.camera.exposure == "auto":
            inputs = [
                self.worlds,
                self.picture,
                AUTO_MEAN,
                self.camera.gamma,
                self.camera.white_balance,
                self.gain,
            ]
            wp.launch(_meter, self.count, inputs, device=self.device)
        return self.picture

    def _expose(
        self, poses: wp.array, seed: int | None, time: float, mask: wp.array | None, k: int, moments: int
    ) -> None:
        """Add moment k of an exposure; after the last, encode it."""
        self.cast(poses, mask)
        if moments > 1 and k == 0:
            wp.launch(_clear, self.radiance.shape, [self.worlds, self.radiance], device=self.device)
        key = -1 if seed is None else noise_key(seed, time)
        inputs = [self.traced, poses, self.batch.scene, self._film, 1.0 / moments, int(k == moments - 1), key]
        inputs.append(self._span(self.depth.shape[2]))
        wp.launch(_take_picture, self._blocks(self.depth), inputs, device=self.device)


def _lamp(light: Headlight) -> Lamp:
    lamp = Lamp()
    lamp.position, lamp.axis = wp.vec3(*light.position), wp.vec3(*light.axis)
    lamp.intensity, lamp.cosine = wp.vec3(light.intensity), math.cos(light.half_angle)
    return lamp


# Imaging sonars.


@wp.struct
class Echoes:
    """Echoes of the rays of many sonars, and what their receivers make of them."""

    weight: wp.array(dtype=float)  # b² dW/pi, by elevation [-]
    absorption: float  # [dB/m]
    steps: wp.vec2  # between rays along elevation and azimuth [rad]
    bins_per_metre: float  # range cells [1/m]
    noise: float  # power in a range cell before gain [-]
    display: wp.vec2  # levels of 0 and 255 [dB]
    taps: wp.array(dtype=float)  # pattern of a receiving beam [-]
    gain: wp.array(dtype=float)  # by range cell [-]
    quantiles: wp.array(dtype=float)  # of the exponential distribution [-]
    energy: wp.array3d(dtype=float)  # in one range cell, by view, elevation and azimuth [-]
    spread: wp.array3d(dtype=wp.vec2)  # first and last range cell [-]
    intensity: wp.array3d(dtype=float)  # power, by view, beam and range cell [-]
    picture: wp.array3d(dtype=wp.uint8)


@wp.kernel(enable_backward=False)
def _echo_rays(traced: Traced, scene: RayScene, echoes: Echoes, span: int):
    """Echo of every ray and the ranges it comes from.

    A ray of solid angle dW that strikes a Lambertian surface of parameter mu at range r under cosine k returns

        e = b² dW mu k 10^(-2 alpha r/10)/r²,   from the sonar equation with A = dW r²/k and S_b = mu k²

    relative to the source's level at 1 m. (Lambert's law: 10 log mu + 10 log k²; b² dW is `weight`.) It comes from the
    ranges of its footprint: half-way to the rays above and below where they strike the same shape, else as far as the
    normal says; so that no gaps open between rays on a slanting floor. `energy` is that of one range cell. What stands
    above the water is not heard.
    """
    v, i, block = wp.tid()
    if traced.worlds[v] == SKIPPED:
        return
    view = traced.views[v]
    rotation = wp.transform_get_rotation(view)
    decay = 0.2 * wp.log(10.0) * echoes.absorption
    for j in range(block * span, wp.min(block * span + span, traced.depth.shape[2])):
        r = traced.depth[v, i, j]
        index = traced.shape_index[v, i, j]
        d = traced.rays[i, j, 0, 1]
        echoes.energy[v, i, j] = 0.0
        if index != MISS and r > 0.0 and wp.transform_point(view, r * d)[2] < 0.0:
            n = wp.quat_rotate_inv(rotation, traced.normal[v, i, j])
            k = wp.max(wp.abs(wp.dot(n, d)), 1.0e-3)
            flat = wp.max(d[0] * d[0] + d[1] * d[1], 1.0e-9)
            ahead = (n[0] * d[0] + n[1] * d[1]) / flat
            beside = (n[1] * d[0] - n[0] * d[1]) / k
            # Half the footprint along elevation and azimuth, by dr/dangle = r (n · e)/(n · d).
            flat = wp.sqrt(flat)
            half = 0.5 * r * echoes.steps[0] * wp.min(wp.abs(n[2] - d[2] * ahead) * flat / k, 20.0)
            across = 0.5 * r * echoes.steps[1] * wp.min(wp.abs(beside), 5.0)
            low = r
            high = r
            count = int(0)
            for side in range(2):
                other = i + 2 * side - 1
                if other >= 0 and other < traced.depth.shape[1]:
                    if traced.shape_index[v, other, j] == index:
                        way = wp.clamp(
                            0.5 * (traced.depth[v, other, j] - r), -2.0 * half - 1.0e-3, 2.0 * half + 1.0e-3
                        )
                        low = wp.min(low, r + way)
                        high = wp.max(high, r + way)
                        count += 1
            if count < 2:
                # At an edge: as far to the other side as the footprint lets it, but no farther than to this one.
                low = wp.min(low, r - wp.min(half, wp.where(count == 0, half, high - r)))
                high = wp.max(high, r + wp.min(half, wp.where(count == 0, half, r - low)))
            first = (low - across) * echoes.bins_per_metre
            last = wp.max((high + across) * echoes.bins_per_metre, first + 1.0e-3)
            echo = (
                echoes.weight[i] * scene.surfaces[int(index)].backscatter * k * wp.exp(-decay * r) / (r * r)
            )
            echoes.spread[v, i, j] = wp.vec2(first, last)
            echoes.energy[v, i, j] = echo / (last - first)


@wp.kernel(enable_backward=False)
def _gather_echoes(worlds: wp.array(dtype=int), echoes: Echoes):
    """Echo by beam and range cell: rays of the beam's own and the neighbouring directions, by its pattern."""
    v, b = wp.tid()
    if worlds[v] == SKIPPED:
        return
    bins = echoes.intensity.shape[2]
    reach = echoes.taps.shape[0] / 2
    for k in range(bins):
        echoes.intensity[v, b, k] = 0.0
    for j in range(wp.max(b - reach, 0), wp.min(b + reach + 1, echoes.energy.shape[2])):
        tap = echoes.taps[j - b + reach]
        for i in range(echoes.energy.shape[1]):
            e = echoes.energy[v, i, j]
            if e > 0.0:
                low = echoes.spread[v, i, j][0]
                high = echoes.spread[v, i, j][1]
                for k in range(wp.max(int(wp.floor(low)), 0), wp.min(int(wp.floor(high)) + 1, bins)):
                    overlap = wp.max(wp.min(high, float(k + 1)) - wp.max(low, float(k)), 0.0)
                    echoes.intensity[v, b, k] += tap * e * overlap


@wp.kernel(enable_backward=False)
def _receive(worlds: wp.array(dtype=int), echoes: Echoes, key: int, span: int):
    """Noise and speckle, gain, and 8 bits of the level; a thread takes `span` range cells of a beam.

    Echoes of many scatterers and noise add as complex normal numbers: power is (I + N) times a draw of the exponential
    distribution, amplitude Rayleigh. Without a seed (key < 0) it is I + N itself.
    """
    v, b, block = wp.tid()
    if worlds[v] == SKIPPED:
        return
    bins = echoes.intensity.shape[2]
    first = (v * echoes.intensity.shape[1] + b) * bins
    low = echoes.display[0]
    scale = 255.0 / (echoes.display[1] - low)
    for k in range(block * span, wp.min(block * span + span, bins)):
        power = (echoes.intensity[v, b, k] + echoes.noise) * echoes.gain[k]
        if key >= 0:
            power = power * echoes.quantiles[int(wp.rand_init(key, first + k) & wp.uint32(4095))]
        echoes.intensity[v, b, k] = power
        level = scale * (4.3429448 * wp.log(wp.max(power, 1.0e-30)) - low)
        echoes.picture[v, b, k] = wp.uint8(wp.clamp(level, 0.0, 255.0) + 0.5)


@wp.kernel(enable_backward=False)
def _detect(
    worlds: wp.array(dtype=int),
    intensity: wp.array3d(dtype=float),
    threshold: float,
    bin_length: float,
    ranges: wp.array2d(dtype=float),
):
    """Range of the first cell of each beam that is loud enough and within 6 dB of its loudest: the cell's middle."""
    v, b = wp.tid()
    if worlds[v] == SKIPPED:
        return
    ranges[v, b] = float(wp.inf)
    enough = float(threshold)
    for k in range(intensity.shape[2]):
        enough = wp.max(enough, 0.25 * intensity[v, b, k])
    for k in range(intensity.shape[2]):
        if intensity[v, b, k] >= enough:
            ranges[v, b] = (float(k) + 0.5) * bin_length
            return


class SonarBatch(RayBatch):
    """An imaging, profiling or side-scan sonar on each of N vehicles.

    Args:
        batch: The worlds; their water's temperature and salinity give the absorption of sound.
        sonar: The device.
        beams: In place of its own, over the same sector.
        bins: In place of its own, over the same range.
        vehicles: In each world.
    """

    intensity: wp.array
    """Power after gain [-], relative to the source's level at 1 m; float (N, beams, bins), beam 0 at the left."""
    picture: wp.array
    """Picture: its level between the device's `display` levels; uint8 (N, beams, bins)."""
    ranges: wp.array
    """Range of a profiling sonar: first range with a level of `detection_db` and within 6 dB of the beam's loudest [m],
    infinite if there is none; float (N, beams)."""

    def __init__(
        self,
        batch: WorldBatch,
        sonar: SonarDevice,
        *,
        beams: int | None = None,
        bins: int | None = None,
        vehicles: int = 1,
    ) -> None:
        rays = fan(sonar, beams)
        super().__init__(batch, rays, sonar.mount, vehicles)
        self.sonar, self.bins = sonar, bins or sonar.bins
        self.absorption = batch.world.water.sound_absorption(sonar.frequency)
        """[dB/m]"""
        count = rays.shape[1]
        elevation, spacing = ray_elevations(sonar), sonar.sector / count
        if sonar.mode == "side_scan":
            spacing = sonar.beam_width / 0.8859  # the integral of its pattern sinc²
        steps = wp.vec2(float(elevation[1] - elevation[0]) if len(elevation) > 1 else 0.0, spacing)
        two_way = np.exp(
            -8.0 * math.log(2.0) * ((elevation + sonar.depression) / sonar.vertical_beam_width) ** 2
        )
        solid = max(steps[0], 1e-6) * spacing * np.cos(elevation) / math.pi
        ranges = (np.arange(self.bins) + 0.5) * self.bin_length
        loss = sonar.gain_spreading * np.log10(ranges) + 2.0 * self.absorption * ranges
        gain = np.where(ranges >= sonar.minimum_range, 10.0 ** (0.1 * loss), 0.0)
        shape = (self.count, len(elevation), count)
        echoes = self._echoes = Echoes()
        echoes.absorption, echoes.steps, echoes.bins_per_metre = self.absorption, steps, 1.0 / self.bin_length
        echoes.noise, echoes.display = 10.0 ** (0.1 * sonar.noise_level_db), wp.vec2(*sonar.display)
        taps = np.ones(1) if sonar.mode == "side_scan" else beam_pattern(sonar.beam_width, spacing, count)
        with wp.ScopedDevice(self.device):
            echoes.weight = wp.array(np.float32(two_way * solid), dtype=float)
            echoes.taps, echoes.gain = (wp.array(np.float32(x), dtype=float) for x in (taps, gain))
            echoes.quantiles = wp.array(np.float32(-np.log1p(-(np.arange(4096) + 0.5) / 4096)), dtype=float)
            echoes.energy, echoes.spread = wp.zeros(shape, dtype=float), wp.zeros(shape, dtype=wp.vec2)
            self.intensity = wp.zeros((self.count, count, self.bins), dtype=float)
            self.reading = self.picture = wp.zeros(self.intensity.shape, dtype=wp.uint8)
            self.ranges = wp.zeros(self.intensity.shape[:2], dtype=float)
        echoes.intensity, echoes.picture = self.intensity, self.picture

    @property
    def bin_length(self) -> float:
        """Length of a range cell [m]."""
        return self.sonar.range / self.bins

    def update(
        self, poses: wp.array, *, seed: int | None = None, time: float = 0.0, mask: wp.array | None = None
    ) -> wp.array:
        """One ping of each vehicle.

        Args:
            poses: Body to world of each vehicle, xyzw; transform (N,) on the batch's device [m].
            seed: Of speckle and noise; None for the mean power.
            time: Of the ping [s]: pings of other times have other speckle.
            mask: Which vehicles measure; the others keep their last. int (N,); all if None.

        Returns:
            `picture`, which the next update overwrites.
        """
        self.cast(poses, mask)
        sonar, echoes, key = self.sonar, self._echoes, -1 if seed is None else noise_key(seed, time)
        inputs = [self.traced, self.batch.scene, echoes, self._span(self.depth.shape[2])]
        wp.launch(_echo_rays, self._blocks(self.depth), inputs, device=self.device)
        wp.launch(_gather_echoes, self.intensity.shape[:2], [self.worlds, echoes], device=self.device)
        inputs = [self.worlds, echoes, key, self._span(self.bins)]
        wp.launch(_receive, self._blocks(self.intensity), inputs, device=self.device)
        if sonar.mode == "profiling":
            threshold = 10.0 ** (0.1 * sonar.detection_db)
            inputs = [self.worlds, self.intensity, threshold, self.bin_length, self.ranges]
            wp.launch(_detect, self.ranges.shape, inputs, device=self.device)
        return self.picture


def beam_pattern(width: float, spacing: float, beams: int) -> np.ndarray:
    """Return the weights of a receiving beam in the directions of its neighbours: sinc² of an even line array, sum 1,
    (odd,).

    Args:
        width: Between half-power points [rad]: sinc²(0.443) = 1/2.
        spacing: Of the beams [rad].
        beams: How many; the pattern ends after its first side lobes, at 2.5 widths.
    """
    reach = min(int(2.5 * width / spacing), beams - 1)
    taps = np.sinc(0.8859 * np.arange(-reach, reach + 1) * spacing / width) ** 2
    return taps / taps.sum()


# Altimeters, rangefinders, the beams of a DVL.


@wp.kernel(enable_backward=False)
def _take_ranges(
    traced: Traced, scene: RayScene, weight: wp.array(dtype=float), quantile: float, reach: wp.vec2, noise: float,
    key: int, ranges: wp.array2d(dtype=float),
):  # fmt: skip
    """Range of each beam: where the given share of its echo has come; infinite beyond the device's reach."""
    v, b = wp.tid()
    if traced.worlds[v] == SKIPPED:
        return
    rotation = wp.transform_get_rotation(traced.views[v])
    total = float(0.0)
    for j in range(traced.depth.shape[2]):
        total += _ray_echo(traced, scene, rotation, weight, v, b, j)
    best = float(wp.inf)
    for j in range(traced.depth.shape[2]):
        r = traced.depth[v, b, j]
        if traced.shape_index[v, b, j] != MISS and r < best:
            nearer = float(0.0)
            for i in range(traced.depth.shape[2]):
                if traced.depth[v, b, i] <= r:
                    nearer += _ray_echo(traced, scene, rotation, weight, v, b, i)
            if nearer >= quantile * total:
                best = r
    if key >= 0:
        state = wp.rand_init(key, v * traced.depth.shape[1] + b)
        best = best * (1.0 + noise * wp.randn(state))
    if best < reach[0] or best > reach[1]:
        best = float(wp.inf)
    ranges[v, b] = best


@wp.func
def _ray_echo(
    traced: Traced, scene: RayScene, rotation: wp.quat, weight: wp.array(dtype=float), v: int, b: int, j: int
) -> float:
    """Echo of one ray as `_echo_rays` has it, without absorption; 0 for a miss."""
    index = traced.shape_index[v, b, j]
    r = traced.depth[v, b, j]
    if index == MISS or r <= 0.0:
        return 0.0
    ray = wp.quat_rotate(rotation, traced.rays[b, j, 0, 1])
    return (
        weight[j]
        * scene.surfaces[int(index)].backscatter
        * wp.abs(wp.dot(traced.normal[v, b, j], ray))
        / (r * r)
    )


class RangeBatch(RayBatch):
    """An altimeter, a rangefinder or a DVL's beams on each of N vehicles.

    Args:
        batch: The worlds.
        ranger: The device.
        vehicles: In each world.
    """

    ranges: wp.array
    """Along each beam [m], infinite where nothing is within reach; float (N, beams)."""

    def __init__(self, batch: WorldBatch, ranger: RangeDevice, *, vehicles: int = 1) -> None:
        rays, weight = cones(ranger)
        super().__init__(batch, rays, ranger.mount, vehicles)
        self.ranger = ranger
        self._weight = wp.array(np.float32(weight), dtype=float, device=self.device)
        self.reading = self.ranges = wp.zeros((self.count, ranger.beams), dtype=float, device=self.device)

    def update(
        self, poses: wp.array, *, seed: int | None = None, time: float = 0.0, mask: wp.array | None = None
    ) -> wp.array:
        """Measure.

        Args:
            poses: Body to world of each vehicle, xyzw; transform (N,) on the batch's device [m].
            seed: Of the noise; None for none.
            time: Of the measurement [s]: others have other noise.
            mask: Which vehicles measure; the others keep their last. int (N,); all if None.

        Returns:
            `ranges` [m], which the next update overwrites.
        """
        self.cast(poses, mask)
        ranger, key = self.ranger, -1 if seed is None else noise_key(seed, time)
        reach = wp.vec2(ranger.minimum_range, ranger.range)
        inputs = [self.traced, self.batch.scene, self._weight, ranger.quantile, reach, ranger.noise, key]
        wp.launch(_take_ranges, self.ranges.shape, [*inputs, self.ranges], device=self.device)
        return self.ranges


@wp.kernel(enable_backward=False)
def _take_velocities(
    traced: Traced, twists: wp.array2d(dtype=vec6), mount: wp.transform, noise: float, key: int,
    reading: wp.array2d(dtype=float), lock: wp.array2d(dtype=int),
):  # fmt: skip
    """Speed along each beam that finds the bottom, and the velocity that fits them best.

    s_b = d_b . v + noise;  v = (sum d d^T)^-1 sum d s  over the beams with an echo, of which there must be three

    Ranges are read from the last columns of `reading`: velocity, speeds, ranges.
    """
    i = wp.tid()
    if traced.worlds[i] == SKIPPED:
        return
    w = i // twists.shape[1]
    v = i % twists.shape[1]
    turn = wp.transform_get_rotation(mount)
    nu = twists[w, v]
    exact = sensed_velocity(nu, wp.quat_identity(), wp.vec3(0.0), wp.transform_get_translation(mount), turn)
    state = wp.rand_init(wp.max(key, 0), i)
    normal = wp.mat33(0.0)
    right = wp.vec3(0.0)
    count = int(0)
    beams = traced.depth.shape[1]
    for b in range(beams):
        d = traced.rays[b, 0, 0, 1]
        reading[i, 3 + b] = float(wp.nan)
        drawn = wp.randn(state)
        if wp.isfinite(reading[i, 3 + beams + b]):
            s = wp.dot(d, exact)
            if key >= 0:
                s += noise * drawn
            reading[i, 3 + b] = s
            normal += wp.outer(d, d)
            right += s * d
            count += 1
    lock[w, v] = wp.where(count >= 3, 1, 0)
    solution = wp.vec3(float(wp.nan))
    if count >= 3:
        solution = wp.inverse(normal) * right
    for k in range(3):
        reading[i, k] = solution[k]


class DopplerBatch(RangeBatch):
    """A DVL on each of N vehicles: bottom track by the ranges and speeds of its beams.

    Args:
        batch: The worlds.
        device: At least three beams; the speeds are those along the beams' middles.
        twists: nu of the vehicles, body frame [m/s, rad/s], read in each update, as a simulator's `state.velocity`;
            vec6 (worlds, vehicles).
        lock: Flags [0, 1] filled in place of its own; those of a `finssim.sim.sensors.DvlBatch` make that one lose the
            bottom too.

    Raises:
        WorldError: The device has fewer beams.
    """

    speeds: wp.array
    """Velocity of the sensor along each beam, positive away from it [m/s], NaN without an echo; float (N, beams)."""
    velocity: wp.array
    """Velocity of the sensor, in its own axes [m/s], NaN without lock; float (N, 3)."""
    lock: wp.array
    """Flag [-] of at least three beams finding the bottom; int (worlds, vehicles)."""

    def __init__(
        self, batch: WorldBatch, device: RangeDevice, twists: wp.array, *, lock: wp.array | None = None
    ) -> None:
        if device.beams < 3:
            raise WorldError(f"a DVL of {device.beams} beams: give at least 3 for a velocity")
        super().__init__(batch, device, vehicles=twists.shape[1])
        beams, self.twists = device.beams, twists
        # One row for each vehicle, so that all of it arrives together: velocity, speeds, ranges.
        self.reading = wp.zeros((self.count, 3 + 2 * beams), dtype=float, device=self.device)
        self.velocity, self.speeds = self.reading[:, :3], self.reading[:, 3 : 3 + beams]
        self.ranges = self.reading[:, 3 + beams :]
        self.lock = wp.zeros(twists.shape, dtype=int, device=self.device) if lock is None else lock

    def update(
        self, poses: wp.array, *, seed: int | None = None, time: float = 0.0, mask: wp.array | None = None
    ) -> wp.array:
        """Measure.

        Args:
            poses: Body to world of each vehicle, xyzw; transform (N,) on the batch's device [m].
            seed: Of the noise; None for none.
            time: Of the measurement [s]: others have other noise.
            mask: Which vehicles measure; the others keep their last. int (N,); all if None.

        Returns:
            `reading`: velocity [m/s], speeds [m/s] and ranges [m] in a row; float (N, 3 + 2 beams).
        """
        super().update(poses, seed=seed, time=time, mask=mask)
        key = -1 if seed is None else noise_key(seed + 1, time)
        inputs = [
            self.traced,
            self.twists,
            self._mount,
            self.ranger.velocity_noise,
            key,
            self.reading,
            self.lock,
        ]
        wp.launch(_take_velocities, self.count, inputs, device=self.device)
        return self.reading


def sensor_of(
    batch: WorldBatch, vehicle: Vehicle, name: str, *, vehicles: int = 1, lamps: tuple[Headlight, ...] = ()
) -> CameraBatch | SonarBatch | RangeBatch:
    """The sensor of an entry of a vehicle's `perception`, on every vehicle of a batch.

    Args:
        batch: The worlds.
        vehicle: Its file has mount, rate, width and range cells.
        name: Of the entry, such as `front_camera`.
        vehicles: In each world.
        lamps: Lights on each vehicle, for cameras.

    Raises:
        WorldError: The vehicle has no such entry, or its device is refused.
    """
    device = device_of(vehicle, name)
    if isinstance(device, CameraDevice):
        return CameraBatch(batch, device, vehicles=vehicles, lamps=lamps)
    if isinstance(device, SonarDevice):
        return SonarBatch(batch, device, vehicles=vehicles)
    return RangeBatch(batch, device, vehicles=vehicles)
