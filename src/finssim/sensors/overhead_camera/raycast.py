"""The ray caster: each thread follows the rays of four pixels from the camera through the surface to what they meet.

Everything is in the surface frame, in single precision: with the camera's foot as origin, coordinates of a few metres
keep 0.001 px.
"""
# mypy: ignore-errors

import warp as wp

from finssim.sensors.overhead_camera.materials import (
    NOTHING,
    Surfel,
    meet_basin,
    meet_body,
    meet_tag,
    on_deck,
)
from finssim.sensors.overhead_camera.photometry import fresnel, refracted, through_water
from finssim.sensors.overhead_camera.scene_data import SceneData
from finssim.sensors.overhead_camera.surface import (
    Patch,
    distance_to,
    normal_of,
    surface_at,
    surface_hit,
)

ON_TOP = wp.constant(1.0e-3)
"""A tag this little behind a wall or a body's face lies on it: stuck-on tags are given the same height [m]."""

HORIZON = wp.constant(-1.0e-3)
"""Rays that go down no steeper than this are left dark, as is what the lens does not see (zero)."""


@wp.struct
class Refraction:
    """A ray after the surface."""

    origin: wp.vec3  # [m]
    ray: wp.vec3  # unit direction; zero after total reflection
    transmitted: float  # share of the light


@wp.func
def meet_things(
    scene: SceneData, origin: wp.vec3, ray: wp.vec3, t: float, angle: float, travelled: float
) -> Surfel:
    """The first tag or body on a ray.

    Args:
        scene: Holds tags and bodies.
        origin: Of the ray, surface frame [m].
        ray: Its unit direction.
        t: Time as a fraction of the exposure, 0 to 1.
        angle: Width of the ray's share of the pixel per distance travelled [rad].
        travelled: Distance before the origin that counts for that width [m].
    """
    first = Surfel()
    first.distance = NOTHING
    for i in range(scene.tags.shape[0]):
        hit = meet_tag(scene.cells, scene.tags[i], origin, ray, t, angle, travelled)
        if hit.distance < first.distance:
            first = hit
    for i in range(scene.bodies.shape[0]):
        hit = meet_body(scene.bodies[i], origin, ray, t)
        if hit.distance + ON_TOP < first.distance:
            first = hit
    return first


@wp.func
def enter_water(scene: SceneData, origin: wp.vec3, ray: wp.vec3, normal: wp.vec3) -> Refraction:
    """A ray through the surface, or through the layers of a window, by Snell's and Fresnel's laws.

    Args:
        scene: Holds indices and layers.
        origin: On the near face, surface frame [m].
        ray: Unit direction in air.
        normal: Unit normal of the face towards the camera, surface frame [-].
    """
    out = Refraction()
    out.origin = origin
    out.ray = ray
    out.transmitted = 1.0
    index = scene.index_near
    for i in range(scene.layer_index.shape[0] + 1):
        if i > 0:
            thickness = scene.layer_thickness[i - 1]
            out.origin += (-thickness / wp.dot(out.ray, normal)) * out.ray
        following = scene.index_far
        if i < scene.layer_index.shape[0]:
            following = scene.layer_index[i]
        bent = refracted(out.ray, normal, index / following)
        if wp.dot(bent, bent) == 0.0:
            out.ray = bent
            out.transmitted = 0.0
            return out
        cos_in = -wp.dot(out.ray, normal)
        out.transmitted *= 1.0 - fresnel(cos_in, -wp.dot(bent, normal), index, following)
        out.ray = bent
        index = following
    return out


@wp.func
def mirrored(scene: SceneData, origin: wp.vec3, ray: wp.vec3, normal: wp.vec3) -> float:
    """Radiance of sky or lamp in the direction in which the surface reflects a ray.

    Args:
        scene: Holds sky and lamps.
        origin: Where the ray meets the surface, surface frame [m].
        ray: Its unit direction.
        normal: Unit normal towards the camera, surface frame [-].
    """
    up = ray - 2.0 * wp.dot(ray, normal) * normal
    for i in range(scene.lamps.shape[0]):
        lamp = scene.lamps[i]
        s = (lamp.centre[2] - origin[2]) / wp.max(up[2], 1.0e-6)
        x = origin[0] + s * up[0] - lamp.centre[0]
        y = origin[1] + s * up[1] - lamp.centre[1]
        if s > 0.0 and wp.abs(x) < lamp.half[0] and wp.abs(y) < lamp.half[1]:
            return lamp.radiance
    return scene.sky


@wp.func
def focused(scene: SceneData, at: wp.vec3) -> float:
    """Light that ripples gather on a point in the water, relative to a flat surface.

    To first order in the slope, light from straight above falls with 1 - (1 - n1/n2) depth ∇²h; its mean is 1.
    """
    above = surface_at(scene.waves, at[0], at[1])
    bend = 1.0 - scene.index_near / scene.index_far
    return wp.max(1.0 + scene.caustics * bend * at[2] * (above.hxx + above.hyy), 0.0)


@wp.func
def under_water(
    scene: SceneData, origin: wp.vec3, ray: wp.vec3, t: float, angle: float, travelled: float, things: bool
) -> wp.vec3:
    """Radiance that reaches the surface from below.

    Args:
        scene: What is there.
        origin: Where the ray starts [m].
        ray: Its unit direction.
        t: Time as a fraction of the exposure.
        angle: Width of the ray's share of the pixel per distance, in the water [rad].
        travelled: Distance before that counts for that width [m].
        things: Whether tags and bodies may be near.
    """
    p = scene.basin.R_bs * (origin - scene.basin.origin)
    hit = meet_basin(scene.basin, p, scene.basin.R_bs * ray, angle, travelled)
    if things:
        thing = meet_things(scene, origin, ray, t, angle, travelled)
        if thing.distance < hit.distance + ON_TOP:
            hit = thing
    radiance = hit.radiance
    if scene.caustics > 0.0:
        radiance *= focused(scene, origin + hit.distance * ray)
    return through_water(radiance, scene.attenuation, scene.veil, hit.distance)


@wp.func
def radiance_along(
    scene: SceneData, patch: Patch, ray: wp.vec3, t: float, angle: float, things: bool
) -> wp.vec3:
    """Radiance that the camera receives from one direction at one moment.

    Args:
        scene: What is there.
        patch: The surface around the pixel.
        ray: Unit direction from the camera.
        t: Time as a fraction of the exposure.
        angle: Width of the ray's share of the pixel [rad].
        things: Whether tags and bodies may be near.
    """
    eye = wp.vec3(0.0, 0.0, scene.camera_height)
    after = (t - 0.5) * scene.shutter
    reach = distance_to(patch, scene.camera_height, ray, after)
    surface = eye + reach * ray
    basin_point = scene.basin.R_bs * (surface - scene.basin.origin)
    in_air = Surfel()
    in_air.distance = NOTHING
    if things:
        in_air = meet_things(scene, eye, ray, t, angle, 0.0)
    if in_air.distance < reach:
        return in_air.radiance
    if on_deck(scene.basin, basin_point):
        return scene.basin.deck_colour
    normal = normal_of(patch, surface[0], surface[1], after)
    bent = enter_water(scene, surface, ray, normal)
    glare = (1.0 - bent.transmitted) * mirrored(scene, surface, ray, normal)
    below = wp.vec3(0.0)
    if bent.transmitted > 0.0:
        ratio = scene.index_near / scene.index_far
        below = under_water(scene, bent.origin, bent.ray, t, ratio * angle, reach / ratio, things)
    return bent.transmitted * below + wp.vec3(glare, glare, glare)


@wp.func
def moment(i: int, j: int, n: int, start: float) -> float:
    """When a ray of a pixel is sent, as a fraction of the exposure.

    Each of n² equal parts of the exposure gets one ray; the rays of a row, and of a column, are spread over all of it.

    Args:
        i: Column of the ray in its pixel.
        j: Row of the ray.
        n: Rays per row and column.
        start: The pixel's own number in [0, 1): what the pattern gets wrong must not be the same along an edge.
    """
    part = n * ((i + j) % n) + (i * (n // 3) + j * (n // 3 + 1)) % n
    t = (float(part) + 0.5) / float(n * n) + start
    return t - wp.floor(t)


@wp.func
def pixel(
    scene: SceneData,
    patch: Patch,
    corner_rays: wp.array2d(dtype=wp.vec3),
    samples: wp.array2d(dtype=wp.uint8),
    row: int,
    column: int,
) -> wp.vec3:
    """Mean radiance of a pixel. Arguments as of `cast`, with the surface around it."""
    a = corner_rays[row, column]
    b = corner_rays[row, column + 1]
    c = corner_rays[row + 1, column]
    d = corner_rays[row + 1, column + 1]
    total = wp.vec3(0.0)
    if wp.max(wp.max(a[2], b[2]), wp.max(c[2], d[2])) > HORIZON:
        return total
    n = wp.max(int(samples[row, column]), 1)
    angle = wp.sqrt(wp.length(wp.cross(b - a, c - a))) * scene.spot / float(n)
    start = wp.randf(wp.rand_init(row, column))
    for k in range(n * n):
        u = 0.5 + ((float(k % n) + 0.5) / float(n) - 0.5) * scene.spot
        v = 0.5 + ((float(k // n) + 0.5) / float(n) - 0.5) * scene.spot
        ray = wp.normalize((1.0 - v) * ((1.0 - u) * a + u * b) + v * ((1.0 - u) * c + u * d))
        t = moment(k % n, k // n, n, start)
        total += radiance_along(scene, patch, ray, t, angle, samples[row, column] > wp.uint8(0))
    return total / float(n * n)


@wp.kernel(enable_backward=False)
def cast(
    scene: SceneData,
    corner_rays: wp.array2d(dtype=wp.vec3),
    samples: wp.array2d(dtype=wp.uint8),
    first_row: int,
    first_column: int,
    radiance: wp.array2d(dtype=wp.vec3),
):
    """Mean radiance of the pixels of a rectangle; a thread takes a block of 2 x 2, whose rays share the surface's
    Taylor series. Blocks start at even rows and columns, whatever the rectangle.

    Args:
        scene: What is there.
        corner_rays: Directions through the pixels' corners, zero where the lens sees nothing.
        samples: Rays along each axis of each pixel; 0 for one ray that passes by all tags and bodies.
        first_row: Of the rectangle.
        first_column: Of the rectangle.
        radiance: Result over the rectangle.
    """
    i, j = wp.tid()
    row = 2 * (first_row // 2 + i)
    column = 2 * (first_column // 2 + j)
    middle = corner_rays[row + 1, column + 1]
    patch = Patch()
    if middle[2] < HORIZON:
        patch = surface_hit(scene.waves, scene.camera_height, middle)
    for k in range(4):
        y = row + k // 2 - first_row
        x = column + k % 2 - first_column
        if y >= 0 and y < radiance.shape[0] and x >= 0 and x < radiance.shape[1]:
            colour = wp.vec3(0.0)
            if middle[2] < HORIZON:
                colour = pixel(scene, patch, corner_rays, samples, first_row + y, first_column + x)
            radiance[y, x] = colour
