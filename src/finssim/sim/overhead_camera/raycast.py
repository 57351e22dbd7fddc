"""The ray caster: each thread traces the rays of four pixels from the camera through the surface to the first
object.

Everything is in the surface frame, in single precision: with the origin below the camera, coordinates of a
few metres resolve 0.001 px.
"""
# mypy: ignore-errors

import warp as wp

from finssim.sim.overhead_camera.photometry import fresnel, refracted, through_water
from finssim.sim.overhead_camera.surface import Patch, SurfaceWave, distance_to, normal_of, surface_hit

# Objects in and around the pool: printed tags and the tiled basin, each intersected with one ray.
#
# Texture is averaged over the ray's part of the pixel, a square of a given width, in closed form.


NOTHING = wp.constant(1.0e9)
"""Distance to an object that a ray misses [m]."""

BACK = wp.constant(0.45)
"""Reflectance of a tag's unprinted side."""


@wp.struct
class Surfel:
    """The first surface that a ray hits."""

    distance: float  # [m], NOTHING if there is none
    radiance: wp.vec3  # reflected radiance [-]


@wp.struct
class TagData:
    """A tag, surface frame, at the start and the end of the exposure."""

    start: wp.vec3  # middle [m]
    end: wp.vec3  # middle at the end of the exposure [m]
    q_start: wp.quat  # tag to surface frame, xyzw
    q_end: wp.quat
    moving: int
    cell: float  # [m]
    half: float  # from the middle to the rim's edge [m]
    cells: int  # along one side of the bitmap
    offset: int  # of its bitmap in the array of all cells
    white: float  # reflectance of white cells
    black: float  # reflectance of black cells


@wp.struct
class BasinData:
    """The tiled box. Basin axes are the pool's, its origin the lower corner."""

    R_bs: wp.mat33  # rotation matrix from surface frame to basin axes
    origin: wp.vec3  # surface frame [m]
    size: wp.vec3  # [m]
    up: int  # axis closest to the interface's normal
    tile: float  # [m], 0 for none
    joint: float  # [m]
    colour: wp.vec3  # reflectance of the tiles
    joint_colour: wp.vec3  # reflectance of the joints
    variation: float  # relative variation of the reflectance between tiles
    deck_colour: wp.vec3  # reflectance of the deck


@wp.func
def share(x: float, period: float, width: float, spread: float) -> float:
    """Return the mean over [x - spread/2, x + spread/2] of stripes: 1 on [0, width) of every period, 0
    elsewhere."""
    a = (x - 0.5 * spread) / period
    b = (x + 0.5 * spread) / period
    w = width / period
    integral = wp.floor(b) * w + wp.min(b - wp.floor(b), w) - wp.floor(a) * w - wp.min(a - wp.floor(a), w)
    return integral / (b - a)


@wp.func
def printed(cells: wp.array(dtype=wp.uint8), tag: TagData, x: float, y: float, spread: float) -> float:
    """Return the reflectance of a tag's print around a point, averaged over a square of at most one cell.

    Args:
        cells: Bitmaps of all tags, 1 for white.
        tag: The tag.
        x: Coordinate to the right of the tag's middle [m].
        y: Coordinate above the tag's middle [m].
        spread: Width of the square [m].
    """
    w = wp.clamp(spread / tag.cell, 1.0e-3, 1.0)
    u = x / tag.cell + 0.5 * float(tag.cells) - 0.5 * w
    v = 0.5 * float(tag.cells) - y / tag.cell - 0.5 * w
    column = int(wp.floor(u))
    row = int(wp.floor(v))
    first_u = wp.min((float(column) + 1.0 - u) / w, 1.0)
    first_v = wp.min((float(row) + 1.0 - v) / w, 1.0)
    white = float(0.0)
    for k in range(4):
        i = row + k // 2
        j = column + k % 2
        share_v = wp.where(k // 2 == 0, first_v, 1.0 - first_v)
        share_u = wp.where(k % 2 == 0, first_u, 1.0 - first_u)
        inside = i >= 0 and i < tag.cells and j >= 0 and j < tag.cells
        ink = float(1.0)
        if inside:
            ink = float(int(cells[tag.offset + i * tag.cells + j]))
        white += share_v * share_u * ink
    return tag.black + (tag.white - tag.black) * white


@wp.func
def near_ray(origin: wp.vec3, ray: wp.vec3, centre: wp.vec3, radius: float) -> bool:
    """Return whether a ray hits a sphere.

    Args:
        origin: Origin of the ray, surface frame [m].
        ray: Its unit direction.
        centre: Centre of the sphere, surface frame [m].
        radius: Radius of the sphere [m].
    """
    to = centre - origin
    along = wp.dot(to, ray)
    return wp.dot(to, to) - along * along < radius * radius and along > -radius


@wp.func
def meet_tag(
    cells: wp.array(dtype=wp.uint8),
    tag: TagData,
    origin: wp.vec3,
    ray: wp.vec3,
    t: float,
    angle: float,
    travelled: float,
) -> Surfel:
    """Return the point where a ray hits a tag.

    Args:
        cells: Bitmaps of all tags.
        tag: The tag.
        origin: Origin of the ray, surface frame [m].
        ray: Its unit direction.
        t: Time as a fraction of the exposure, 0 to 1.
        angle: Width of the ray's part of the pixel per distance travelled [rad].
        travelled: Path length before the origin that adds to that width [m].
    """
    hit = Surfel()
    hit.distance = NOTHING
    centre = tag.start
    q = tag.q_start
    if tag.moving != 0:
        centre = (1.0 - t) * tag.start + t * tag.end
        q = wp.normalize((1.0 - t) * tag.q_start + t * tag.q_end)
    if not near_ray(origin, ray, centre, 1.4143 * tag.half):
        return hit
    o = wp.quat_rotate_inv(q, origin - centre)
    d = wp.quat_rotate_inv(q, ray)
    if wp.abs(d[2]) < 1.0e-6:
        return hit
    s = -o[2] / d[2]
    x = o[0] + s * d[0]
    y = o[1] + s * d[1]
    if s <= 0.0 or wp.abs(x) > tag.half or wp.abs(y) > tag.half:
        return hit
    hit.distance = s
    reflectance = BACK
    if d[2] < 0.0:
        reflectance = printed(cells, tag, x, y, angle * (travelled + s))
    hit.radiance = wp.vec3(reflectance, reflectance, reflectance)
    return hit


@wp.func
def tiles(basin: BasinData, x: float, y: float, face: int, spread: float) -> wp.vec3:
    """Return the reflectance of tiles around a point of a face, coordinates and spread in metres."""
    if basin.tile <= 0.0:
        return basin.colour
    column = int(wp.floor(x / basin.tile))
    row = int(wp.floor(y / basin.tile))
    key = wp.rand_init(face * 7919 + column, row)
    # Tiles far smaller than the averaging square have no visible variation.
    visible = wp.clamp(basin.tile / wp.max(spread, 1.0e-6) - 1.0, 0.0, 1.0)
    joint_x = share(x, basin.tile, basin.joint, spread)
    joint_y = share(y, basin.tile, basin.joint, spread)
    joint = joint_x + joint_y - joint_x * joint_y
    tile = (1.0 + visible * basin.variation * wp.randn(key)) * basin.colour
    return (1.0 - joint) * tile + joint * basin.joint_colour


@wp.func
def on_deck(basin: BasinData, p: wp.vec3) -> bool:
    """Return whether a point of the surface, basin axes, lies beside the pool. The point is in [m]."""
    beside = bool(False)
    for a in range(3):
        if a != basin.up and (p[a] < 0.0 or p[a] > basin.size[a]):
            beside = True
    return beside


@wp.func
def meet_basin(basin: BasinData, p: wp.vec3, d: wp.vec3, angle: float, travelled: float) -> Surfel:
    """Return the point where a ray from inside hits the basin.

    Args:
        basin: The tiled box.
        p: Origin of the ray, basin axes [m].
        d: Its unit direction, basin axes.
        angle: Width of the ray's part of the pixel per distance travelled [rad].
        travelled: Path length before p that adds to that width [m].
    """
    hit = Surfel()
    hit.distance = NOTHING
    face = int(0)
    for a in range(3):
        if wp.abs(d[a]) > 1.0e-9:
            s = (wp.where(d[a] > 0.0, basin.size[a], 0.0) - p[a]) / d[a]
            if s < hit.distance:
                hit.distance = s
                face = a
    hit.distance = wp.max(hit.distance, 0.0)
    at = p + hit.distance * d
    spread = wp.max(angle * (travelled + hit.distance), 1.0e-5)
    shade = float(0.85)
    if face == basin.up:
        shade = 1.0
    colour = tiles(basin, at[(face + 1) % 3], at[(face + 2) % 3], face, spread)
    hit.radiance = shade * colour
    return hit


# The scene in the layout of the ray caster.


@wp.struct
class SceneData:
    """Everything that rays can hit, surface frame."""

    camera_height: float  # above the still surface [m]
    index_near: float  # refractive index on the camera's side
    index_far: float  # refractive index of the water
    layer_thickness: wp.array(dtype=float)  # of the window, from the camera [m]
    layer_index: wp.array(dtype=float)  # refractive index of each layer
    waves: wp.array(dtype=SurfaceWave)
    attenuation: wp.vec3  # [1/m]
    veil: wp.vec3  # radiance of infinitely deep water [-]
    sky: float  # radiance of the sky [-]
    basin: BasinData
    tags: wp.array(dtype=TagData)
    cells: wp.array(dtype=wp.uint8)
    shutter: float  # [s]
    spot: float  # [px]


ON_TOP = wp.constant(1.0e-3)
"""Distance behind a wall up to which a tag counts as lying on it: attached tags have the wall's coordinates
[m]."""

HORIZON = wp.constant(-1.0e-3)
"""Vertical component above which rays are rendered dark, as are directions outside the lens' view (zero)."""


@wp.struct
class RefractedRay:
    """A ray after the surface."""

    origin: wp.vec3  # [m]
    ray: wp.vec3  # unit direction; zero after total reflection
    transmitted: float  # transmitted fraction of the light


@wp.func
def meet_tags(
    scene: SceneData, origin: wp.vec3, ray: wp.vec3, t: float, angle: float, travelled: float
) -> Surfel:
    """Return the first tag that a ray hits.

    Args:
        scene: The scene with its tags.
        origin: Origin of the ray, surface frame [m].
        ray: Its unit direction.
        t: Time as a fraction of the exposure, 0 to 1.
        angle: Width of the ray's part of the pixel per distance travelled [rad].
        travelled: Path length before the origin that adds to that width [m].
    """
    first = Surfel()
    first.distance = NOTHING
    for i in range(scene.tags.shape[0]):
        hit = meet_tag(scene.cells, scene.tags[i], origin, ray, t, angle, travelled)
        if hit.distance < first.distance:
            first = hit
    return first


@wp.func
def enter_water(scene: SceneData, origin: wp.vec3, ray: wp.vec3, normal: wp.vec3) -> RefractedRay:
    """Refract a ray through the surface, or through the layers of a window, by Snell's and Fresnel's laws.

    Args:
        scene: The scene with refractive indices and layers.
        origin: Point on the near face, surface frame [m].
        ray: Unit direction in air.
        normal: Unit normal of the face towards the camera, surface frame [-].
    """
    out = RefractedRay()
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
def under_water(
    scene: SceneData, origin: wp.vec3, ray: wp.vec3, t: float, angle: float, travelled: float, tagged: bool
) -> wp.vec3:
    """Return the radiance that reaches the surface from below [-].

    Args:
        scene: The scene.
        origin: Origin of the ray [m].
        ray: Its unit direction.
        t: Time as a fraction of the exposure.
        angle: Width of the ray's part of the pixel per distance, in the water [rad].
        travelled: Path length before the origin that adds to that width [m].
        tagged: True if tags may be near.
    """
    p = scene.basin.R_bs * (origin - scene.basin.origin)
    hit = meet_basin(scene.basin, p, scene.basin.R_bs * ray, angle, travelled)
    if tagged:
        tag = meet_tags(scene, origin, ray, t, angle, travelled)
        if tag.distance < hit.distance + ON_TOP:
            hit = tag
    return through_water(hit.radiance, scene.attenuation, scene.veil, hit.distance)


@wp.func
def radiance_along(
    scene: SceneData, patch: Patch, ray: wp.vec3, t: float, angle: float, tagged: bool
) -> wp.vec3:
    """Return the radiance that the camera receives from one direction at one instant [-].

    Args:
        scene: The scene.
        patch: The surface around the pixel.
        ray: Unit direction from the camera.
        t: Time as a fraction of the exposure.
        angle: Width of the ray's part of the pixel [rad].
        tagged: True if tags may be near.
    """
    eye = wp.vec3(0.0, 0.0, scene.camera_height)
    after = (t - 0.5) * scene.shutter
    reach = distance_to(patch, scene.camera_height, ray, after)
    surface = eye + reach * ray
    basin_point = scene.basin.R_bs * (surface - scene.basin.origin)
    in_air = Surfel()
    in_air.distance = NOTHING
    if tagged:
        in_air = meet_tags(scene, eye, ray, t, angle, 0.0)
    if in_air.distance < reach:
        return in_air.radiance
    if on_deck(scene.basin, basin_point):
        return scene.basin.deck_colour
    normal = normal_of(patch, surface[0], surface[1], after)
    bent = enter_water(scene, surface, ray, normal)
    glare = (1.0 - bent.transmitted) * scene.sky
    below = wp.vec3(0.0)
    if bent.transmitted > 0.0:
        ratio = scene.index_near / scene.index_far
        below = under_water(scene, bent.origin, bent.ray, t, ratio * angle, reach / ratio, tagged)
    return bent.transmitted * below + wp.vec3(glare, glare, glare)


@wp.func
def moment(i: int, j: int, n: int, start: float) -> float:
    """Return the time at which a ray of a pixel is cast, as a fraction of the exposure.

    Each of n² equal intervals of the exposure has one ray; the rays of a row, and of a column, are spread
    over all of it.

    Args:
        i: Column of the ray in its pixel.
        j: Row of the ray.
        n: Rays per row and column.
        start: Random offset of the pixel in [0, 1), which decorrelates the sampling error of neighbouring
            pixels.
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
    """Return the mean radiance of a pixel. Arguments as of `cast`, with the surface around the pixel."""
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
    """Compute the mean radiance of the pixels of a rectangle.

    Each thread renders a block of 2 x 2 pixels, whose rays share the surface's Taylor series. Blocks start at
    even rows and columns, independently of the rectangle.

    Args:
        scene: The scene.
        corner_rays: Directions through the pixels' corners, zero outside the lens' field of view.
        samples: Rays along each axis of each pixel; 0 for one ray that ignores all tags.
        first_row: First row of the rectangle.
        first_column: First column of the rectangle.
        radiance: Result over the rectangle [-].
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
