"""Cameras of many vehicles: rendering of daylight, lamps, marine snow and the surface from below to noisy
8-bit pictures."""
# mypy: ignore-errors

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import warp as wp
from scipy.special import ndtri

from finssim.extensions.perception.model import Optics, RayScene, WorldBatch
from finssim.extensions.perception.ray_batch import MISS, SKIPPED, RayBatch, Traced
from finssim.extensions.perception.rays import WATER_INDEX, camera_rays
from finssim.physics.types import angular, linear, vec6
from finssim.sim.overhead_camera.photometry import fresnel, noise_key, refracted, through_water
from finssim.vehicles.device_files import CameraDevice

wp.set_module_options({"enable_backward": False})

LEVELS = 4096
"""Levels of the analog-to-digital converter (12 bits), before gamma encoding to 8 bits."""
LAMP_STEPS = wp.constant(8)
SNOW_STEPS = wp.constant(40)
SNOW_SHARE = wp.constant(0.7)
"""Fraction of the cells of the marine-snow lattice that contain a particle [-]; a ray is followed through
twenty cells."""
BLUR = 5
"""Number of instants of an exposure that are averaged for motion blur."""
AUTO_MEAN = 0.42
"""Target mean of automatic exposure, as a fraction of the full scale after gamma [-]."""


@wp.struct
class Lamp:
    """Light on a vehicle: a point source with a round beam whose edge is smooth."""

    position: wp.vec3  # body axes [m]
    axis: wp.vec3  # of its beam, body axes, unit
    intensity: (
        wp.vec3
    )  # irradiance [-] at 1 m on its axis, without water, relative to daylight at the surface
    cosine: float  # cosine of the beam's half angle


@wp.struct
class Film:
    """Sensor of a camera (everything behind the lens), for all views."""

    lamps: wp.array(dtype=Lamp)  # lamps on each vehicle
    pixel: float  # angle between neighbouring pixels [rad]
    full_well: float  # [electrons]
    read_noise: float  # [electrons]
    gain: wp.array(dtype=wp.vec3)  # by view: fraction of the full scale at radiance 1
    code: wp.array(dtype=wp.uint8)  # 8-bit values by converter level
    quantiles: wp.array(dtype=float)  # of the normal distribution [-]
    radiance: wp.array3d(dtype=wp.vec3)  # [-], or empty
    picture: wp.array4d(dtype=wp.uint8)


@wp.struct
class WaterRay:
    """A ray in the water, up to a surface or the end of the water."""

    origin: wp.vec3  # point where it enters the water, world frame [m]
    direction: wp.vec3  # unit, world frame
    length: float  # [m]


@dataclass(frozen=True, kw_only=True)
class Headlight:
    """Light on the vehicle."""

    position: tuple[float, float, float]
    """Position, body axes [m]."""
    axis: tuple[float, float, float] = (1.0, 0.0, 0.0)
    """Axis of the beam, body axes, unit length."""
    intensity: float = 0.5
    """Irradiance at 1 m on the axis, without water, relative to daylight just below the surface [-]."""
    half_angle: float = 1.0
    """Angle from the axis at which the intensity is half of that on the axis [rad]."""


@wp.func
def mottled(local: wp.vec3, grain: wp.array2d(dtype=float)) -> float:
    """Return a random relative brightness at a point, about 0 [-].

    Args:
        local: Point in shape axes, in units of the pattern size [-].
        grain: Periodic field [-], sixteen patches along each side.
    """
    # Skewed along z, so that upright faces have a pattern too.
    u = (local[0] + 0.37 * local[2]) / 16.0
    v = (local[1] + 0.61 * local[2]) / 16.0
    n = grain.shape[0]
    x = float(n) * (u - wp.floor(u))
    y = float(n) * (v - wp.floor(v))
    a = wp.clamp(int(x), 0, n - 1)  # also valid for a point that is NaN
    b = wp.clamp(int(y), 0, n - 1)
    c = wp.where(a + 1 == n, 0, a + 1)
    d = wp.where(b + 1 == n, 0, b + 1)
    fy = y - float(b)
    lower = grain[a, b] + fy * (grain[a, d] - grain[a, b])
    right = grain[c, b] + fy * (grain[c, d] - grain[c, b])
    return lower + (x - float(a)) * (right - lower)


@wp.func
def patterned(kind: int, local: wp.vec3, colour: wp.vec3, second: wp.vec3, contrast: float) -> wp.vec3:
    """Return the reflectance at a point of squares, bands or tiles [-].

    Args:
        kind: A value of `TEXTURES`.
        local: Point in shape axes, in units of the pattern size [-].
        colour: Reflectance of the first colour.
        second: Reflectance of the second colour, or of joints.
        contrast: Contrast between tiles.
    """
    # Shifted slightly inside the face, so that points on it fall on one side of the pattern.
    cx = int(wp.floor(local[0] + 1.0e-3))
    cy = int(wp.floor(local[1] + 1.0e-3))
    cz = int(wp.floor(local[2] + 1.0e-3))
    if kind == 1:
        return wp.where((cx + cy + cz) & 1 == 1, second, colour)
    if kind == 2:
        return wp.where(local[2] - float(cz) > 0.5, second, colour)
    # On a face of an axis-aligned slab one coordinate is constant, possibly at a joint: it is ignored.
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
    """Return the reflectance at a point of a face with a picture in its middle [-].

    Args:
        pictures: All pictures, row 0 at the top.
        index: Index of the picture.
        local: Point in shape axes, in units of the picture width [-].
        normal: Unit normal of the face, shape axes [-].
        aspect: Height of the picture divided by its width [-].
        base: Reflectance outside the picture.
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
    """Return the radiance transmitted and reflected by the still water surface, seen from below (Fresnel,
    Snell's window).

    Radiances are relative to that of white paper [-].

    Args:
        ray: Unit direction from the camera upwards, world frame [-].
        veil: Radiance of the water itself [-].
        sky: Radiance above the surface [-].
    """
    out = refracted(ray, wp.vec3(0.0, 0.0, -1.0), WATER_INDEX)
    if out[2] <= 0.0:
        return veil
    share = fresnel(ray[2], out[2], WATER_INDEX, 1.0)
    return share * veil + (1.0 - share) * sky


@wp.func
def lamp_light(point: wp.vec3, lamp: Lamp, position: wp.vec3, axis: wp.vec3, attenuation: wp.vec3) -> wp.vec4:
    """Return the irradiance of a lamp at a point, and its distance as fourth component.

    E = I f(angle) exp(-c r)/r², with f = 1/(1 + ((1 - cos angle)/(1 - cos half))²)

    Irradiance is relative to daylight [-], the distance in [m].

    Args:
        point: Point, world frame [m].
        lamp: Lamp with its beam and intensity.
        position: Position of the lamp, world frame [m].
        axis: Unit axis of its beam, world frame [-].
        attenuation: Beam attenuation c [1/m].
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
    """Return the first three components of a light, in its unit."""
    return wp.vec3(light[0], light[1], light[2])


@wp.func
def lamps_seen(
    ray: WaterRay, normal: wp.vec3, reflectance: wp.vec3, c: wp.vec3, veil: wp.vec3, lamps: wp.array(dtype=Lamp),
    pose: wp.transform,
) -> wp.vec3:  # fmt: skip
    """Return the light that the vehicle's lamps add to a ray: rho E e^(-c s) from the surface, and
    backscatter on the path.

    The backscatter is the integral of c B E e^(-c s) along the ray, by the midpoint rule over steps of equal
    length ratio: the water scatters lamplight back as it does daylight.

    Args:
        ray: The ray, of length s [m].
        normal: Unit normal of the surface, world frame [-].
        reflectance: Reflectance rho; 0 without a surface.
        c: Beam attenuation [1/m].
        veil: Radiance B [-].
        lamps: Lamps on the vehicle.
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
    """Return the light that particles in the water add to a ray, and the fraction that they cover as fourth
    component.

    A hash of each lattice cell decides whether it contains a particle, which covers a²/s² e^(-(x/s)²) of a
    pixel whose ray passes it at distance x, with its radius a and s² = a² + w², w the pixel's half width
    there. Snow reflects 0.4 of its light.

    Args:
        sight: The ray.
        c: Beam attenuation [1/m].
        daylight: Irradiance at the camera's depth [-].
        optics: Water with the snow's density [1/m³] and size [m].
        film: Sensor with the lamps and the angle between neighbouring pixels [rad].
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
            # Steps of half a cell visit most cells twice: only the step nearest to the particle counts.
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
    """Return the reflectance of a surface, with its texture, at a world position [m]."""
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
    """Compute the radiance of every pixel, and its 8-bit values.

    With the camera at depth h and the ray rising by u per metre, daylight at path s is D e^(K u s), D = e^(-K
    h). The surface's radiance rho E and the veil accumulated on the path (the integral of c B D e^(K u s)
    e^(-c s)) are together

        L = D [ rho E e^(-(c - K u) s) + B c/(c - K u) (1 - e^(-(c - K u) s)) ]

    which is `through_water` with c - K u in place of c. Daylight on a surface, relative to that on a
    horizontal one, comes
    from the sun, from above, and from the water below (d is the diffuse fraction, s the sun's direction):

        E = (1 - d) max(n . s, 0)/s_z + d (1 + n_z)/2 + B (1 - n_z)/2

    Then follow charge with shot and read noise, 12-bit conversion and 8-bit encoding. A thread processes
    `span` pixels of a row. `radiance` may be empty. A negative key means no noise: a value is then that of
    the mean charge.
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
        # Light that decreases with depth subtracts K u from the exponent; a beacon's own light does not.
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
            colour = wp.vec3(0.0)  # the lens has no ray for this pixel
        if keep:
            if share < 1.0:
                colour = film.radiance[v, i, j] + share * colour
            film.radiance[v, i, j] = colour
        if last == 0:
            continue
        bits = wp.uint32(0)
        if key >= 0:
            # Normally distributed numbers by their quantiles, 10 bits each, from one hash of the pixel.
            bits = wp.rand_init(key, (v * traced.depth.shape[1] + i) * traced.depth.shape[2] + j)
        for k in range(3):
            charge = wp.max(gains[k] * colour[k], 0.0)
            if key >= 0:
                # Shot noise, of variance `charge`, is normal instead of Poisson; above 20 electrons the two
                # hardly differ.
                drawn = film.quantiles[int(bits & wp.uint32(1023))]
                bits = bits >> wp.uint32(11)
                charge += drawn * wp.sqrt(charge + noise_floor)
            last_digit = film.code.shape[0] - 1
            digit = int(wp.clamp(charge * digits, 0.0, float(last_digit)) + 0.5)
            film.picture[v, i, j, k] = film.code[
                wp.clamp(digit, 0, last_digit)
            ]  # also for a charge that is NaN


@wp.kernel(enable_backward=False)
def _meter(
    worlds: wp.array(dtype=int),
    picture: wp.array4d(dtype=wp.uint8),
    target: float,
    gamma: float,
    balance: float,
    gain: wp.array(dtype=wp.vec3),
):
    """Automatic exposure and white balance: move the gains towards those that give the last picture the
    target mean.

    The fraction `balance` of the differences between the channel means is removed (gray world).
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
    # A channel's gain relative to the mean gain moves a third of the way to its target, within a factor of 4.
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
    """Compute the poses after a time [s] at the vehicles' present twists."""
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
    """Clear the accumulated radiance at the start of an exposure."""
    v, i, j = wp.tid()
    if worlds[v] != SKIPPED:
        linear[v, i, j] = wp.vec3(0.0)


class CameraBatch(RayBatch):
    """Camera on each of N vehicles.

    Args:
        batch: The worlds.
        camera: Lens, port, exposure, mount.
        width: Width of the pictures instead of the camera's own [px]; the height follows.
        vehicles: Number of vehicles in each world.
        lamps: Lights on each vehicle.
        linear: True to store the radiance too.
        twists: nu of the vehicles, body frame [m/s, rad/s], read in each update, such as a simulator's
            `state.velocity`; needed for motion blur by the camera's exposure time; vec6 (worlds, vehicles).
    """

    picture: wp.array
    """Picture: red, green, blue, row 0 at the top; uint8 (N, height, width, 3)."""
    radiance: wp.array
    """Radiance before noise and gain [-], relative to white paper just below the surface; vec3 (N, height, width), or
    empty."""
    gain: wp.array
    """Fraction of the full scale at radiance 1 in red, green, blue; vec3 (N,)."""

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
        """Render a picture for each vehicle.

        Args:
            poses: Body to world of each vehicle, xyzw; transform (N,) on the batch's device [m].
            seed: Seed of the noise; None for no noise.
            time: Time of the pictures [s]; it changes the noise.
            mask: Vehicles that measure; the others keep their last picture. int (N,); all if None.

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
        """Add instant k of an exposure; after the last one, encode the picture."""
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
