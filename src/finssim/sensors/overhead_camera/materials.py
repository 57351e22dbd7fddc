"""What light meets in and around the pool: printed tags, matt boxes, and the tiled basin, each for one ray.

Texture is averaged over the ray's share of the pixel, a square of a given width, in closed form.
"""
# mypy: ignore-errors

import warp as wp

NOTHING = wp.constant(1.0e9)
"""Distance to what a ray does not meet [m]."""

BACK = wp.constant(0.45)
"""Reflectance of a tag's unprinted side."""


@wp.struct
class Surfel:
    """The first thing on a ray's way."""

    distance: float  # [m], NOTHING if there is none
    radiance: wp.vec3  # that it sends back


@wp.struct
class TagData:
    """A tag, surface frame, at the start and the end of the exposure."""

    start: wp.vec3  # middle [m]
    end: wp.vec3
    q_start: wp.quat  # tag to surface frame, xyzw
    q_end: wp.quat
    moving: int
    cell: float  # [m]
    half: float  # from the middle to the rim's edge [m]
    cells: int  # along one side of the bitmap
    offset: int  # of its bitmap in the array of all cells
    white: float
    black: float


@wp.struct
class BodyData:
    """A box, surface frame, at the start and the end of the exposure."""

    start: wp.vec3  # middle [m]
    end: wp.vec3
    q_start: wp.quat  # body to surface frame, xyzw
    q_end: wp.quat
    moving: int
    half: wp.vec3  # half edge lengths [m]
    colour: wp.vec3


@wp.struct
class BasinData:
    """The tiled box. Basin axes are the pool's, its origin the lower corner."""

    R_bs: wp.mat33  # surface frame to basin axes
    origin: wp.vec3  # surface frame [m]
    size: wp.vec3  # [m]
    up: int  # axis closest to the interface's normal
    up_sign: float  # 1 if that axis points to the camera's side, else -1
    tile: float  # [m], 0 for none
    joint: float  # [m]
    colour: wp.vec3
    joint_colour: wp.vec3
    variation: float
    lanes: wp.array(dtype=float)  # middles of the lane lines along `lane_axis`, from the lower corner [m]
    lane_axis: int
    lane_width: float  # [m]
    lane_colour: wp.vec3
    deck_colour: wp.vec3


@wp.func
def share(x: float, period: float, width: float, spread: float) -> float:
    """Mean over [x - spread/2, x + spread/2] of stripes: 1 on [0, width) of every period, 0 elsewhere."""
    a = (x - 0.5 * spread) / period
    b = (x + 0.5 * spread) / period
    w = width / period
    integral = wp.floor(b) * w + wp.min(b - wp.floor(b), w) - wp.floor(a) * w - wp.min(a - wp.floor(a), w)
    return integral / (b - a)


@wp.func
def overlap(x: float, low: float, high: float, spread: float) -> float:
    """Share of [x - spread/2, x + spread/2] within [low, high]."""
    return wp.max(wp.min(x + 0.5 * spread, high) - wp.max(x - 0.5 * spread, low), 0.0) / spread


@wp.func
def printed(cells: wp.array(dtype=wp.uint8), tag: TagData, x: float, y: float, spread: float) -> float:
    """Reflectance of a tag's print around a point, averaged over a square of at most one cell.

    Args:
        cells: Bitmaps of all tags, 1 for white.
        tag: The tag.
        x: To the right of its middle [m].
        y: Above its middle [m].
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
    """Whether a ray passes a sphere.

    Args:
        origin: Of the ray, surface frame [m].
        ray: Its unit direction.
        centre: Of the sphere, surface frame [m].
        radius: Of the sphere [m].
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
    """Where a ray meets a tag.

    Args:
        cells: Bitmaps of all tags.
        tag: The tag.
        origin: Of the ray, surface frame [m].
        ray: Its unit direction.
        t: Time as a fraction of the exposure, 0 to 1.
        angle: Width of the ray's share of the pixel per distance travelled [rad].
        travelled: Distance before the origin that counts for that width [m].
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
def meet_body(body: BodyData, origin: wp.vec3, ray: wp.vec3, t: float) -> Surfel:
    """Where a ray enters a box; its upper faces are lighter than its sides. Arguments as of `meet_tag`."""
    hit = Surfel()
    hit.distance = NOTHING
    centre = body.start
    q = body.q_start
    if body.moving != 0:
        centre = (1.0 - t) * body.start + t * body.end
        q = wp.normalize((1.0 - t) * body.q_start + t * body.q_end)
    if not near_ray(origin, ray, centre, wp.length(body.half)):
        return hit
    o = wp.quat_rotate_inv(q, origin - centre)
    d = wp.quat_rotate_inv(q, ray)
    enter = float(0.0)
    leave = NOTHING
    normal = wp.vec3(0.0)
    for a in range(3):
        if wp.abs(d[a]) < 1.0e-9:
            if wp.abs(o[a]) > body.half[a]:
                return hit
        else:
            side = -wp.sign(d[a])
            near = (side * body.half[a] - o[a]) / d[a]
            leave = wp.min(leave, (-side * body.half[a] - o[a]) / d[a])
            if near > enter:
                enter = near
                normal = wp.vec3(0.0)
                normal[a] = side
    if enter <= 0.0 or enter > leave:
        return hit
    hit.distance = enter
    up = wp.quat_rotate(q, normal)
    hit.radiance = (0.65 + 0.35 * up[2]) * body.colour
    return hit


@wp.func
def tiles(basin: BasinData, x: float, y: float, face: int, spread: float) -> wp.vec3:
    """Reflectance of tiles around a point of a face, coordinates and spread in metres."""
    if basin.tile <= 0.0:
        return basin.colour
    column = int(wp.floor(x / basin.tile))
    row = int(wp.floor(y / basin.tile))
    key = wp.rand_init(face * 7919 + column, row)
    # Tiles far smaller than the ray's square average out.
    visible = wp.clamp(basin.tile / wp.max(spread, 1.0e-6) - 1.0, 0.0, 1.0)
    joint_x = share(x, basin.tile, basin.joint, spread)
    joint_y = share(y, basin.tile, basin.joint, spread)
    joint = joint_x + joint_y - joint_x * joint_y
    tile = (1.0 + visible * basin.variation * wp.randn(key)) * basin.colour
    return (1.0 - joint) * tile + joint * basin.joint_colour


@wp.func
def on_deck(basin: BasinData, p: wp.vec3) -> bool:
    """Whether a point of the surface, basin axes, lies beside the pool."""
    beside = bool(False)
    for a in range(3):
        if a != basin.up and (p[a] < 0.0 or p[a] > basin.size[a]):
            beside = True
    return beside


@wp.func
def meet_basin(basin: BasinData, p: wp.vec3, d: wp.vec3, angle: float, travelled: float) -> Surfel:
    """Where a ray from inside leaves the basin.

    Args:
        basin: The tiled box.
        p: Origin of the ray, basin axes [m].
        d: Its unit direction, basin axes.
        angle: Width of the ray's share of the pixel per distance travelled [rad].
        travelled: Distance before p that counts for that width [m].
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
    if face == basin.up and d[face] * basin.up_sign < 0.0:
        for i in range(basin.lanes.shape[0]):
            low = basin.lanes[i] - 0.5 * basin.lane_width
            dark = overlap(at[basin.lane_axis], low, low + basin.lane_width, spread)
            colour = (1.0 - dark) * colour + dark * basin.lane_colour
    hit.radiance = shade * colour
    return hit
