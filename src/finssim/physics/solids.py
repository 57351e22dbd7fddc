"""Contact with solids in the water: penalty forces on points and spheres of the vehicle's hull.

The hull consists of the eight corners of its envelope box, as for contact with pool walls, and of spheres inside the
box, whose surfaces lie a tenth of the least half extent inside its faces. Flat solids touch only the corners, and thin
solids cannot pass between them.
"""

# mypy: disable-error-code="arg-type,attr-defined,call-overload,index,no-any-return"
# mypy: disable-error-code="no-untyped-call,operator,return-value,valid-type"

import warp as wp

from finssim.physics.contact import penalty_force
from finssim.physics.types import angular, join, linear, vec6

BOX, SPHERE, CAPSULE, CYLINDER, PLANE, MESH, HEIGHTFIELD = (wp.constant(k) for k in range(7))
FARTHEST = wp.constant(1.0e3)
"""Greatest distance at which solids are searched [m]."""
NEIGHBOURS = 32
"""Largest number of nearby solids in a vehicle's list; with more, all solids of the world are tested."""


@wp.struct
class Solids:
    """Solids of every world: the kinds are the same in all worlds, poses and sizes differ."""

    kind: wp.array(dtype=int)  # BOX ... HEIGHTFIELD
    size: wp.array(dtype=wp.vec3)  # half extents; radius and half length [m]; of a mesh: 1 if closed
    bound: wp.array(dtype=float)  # radius of the bounding sphere around its origin [m]
    mesh: wp.array(dtype=wp.uint64)  # mesh identifiers
    heights: wp.array2d(dtype=float)  # heights of the heightfield: z by (y, x) [m]
    gentle: float  # cosine of the heightfield's steepest slope
    shape: wp.array(dtype=int)  # index of each solid in `pose` and `scale`
    pose: wp.array2d(dtype=wp.transform)  # to world [m], by (world, shape)
    scale: wp.array2d(dtype=float)  # factor on the size, by (world, shape)
    draws: wp.array(dtype=int)  # number that changes with the poses of a world
    drawn: wp.array2d(dtype=int)  # its value at the last search, by (world, vehicle)
    near: wp.array3d(dtype=int)  # indices of the solids near at that search, by (world, vehicle, NEIGHBOURS)
    count: wp.array2d(dtype=int)  # number of these
    reach: wp.array2d(dtype=float)  # distance from the searched position up to which the list is complete [m]
    stiffness: float  # per point or sphere of the hull [N/m]
    damping: float  # per point, against approach only [N s/m]
    friction: float  # Coulomb coefficient [-]
    step: float  # longest integration step during contact [s]
    force: wp.array2d(dtype=float)  # greatest contact force on a vehicle in the last control step [N]


@wp.func
def box_distance(x: wp.vec3, half: wp.vec3) -> wp.vec4:
    """Return the normal and signed distance of a box.

    Args:
        x: A point, box axes [m].
        half: Half extents [m].

    Returns:
        Gradient of the distance, box axes, and the distance, negative inside [m].
    """
    q = wp.abs(x) - half
    sign = wp.vec3(wp.sign(x[0]), wp.sign(x[1]), wp.sign(x[2]))
    out = wp.vec3(wp.max(q[0], 0.0), wp.max(q[1], 0.0), wp.max(q[2], 0.0))
    d = wp.length(out)
    if d > 0.0:
        n = wp.cw_mul(sign, out) / d
        return wp.vec4(n[0], n[1], n[2], d)
    if q[0] > q[1] and q[0] > q[2]:
        return wp.vec4(sign[0], 0.0, 0.0, q[0])
    if q[1] > q[2]:
        return wp.vec4(0.0, sign[1], 0.0, q[1])
    return wp.vec4(0.0, 0.0, sign[2], q[2])


@wp.func
def ball_distance(x: wp.vec3, radius: float) -> wp.vec4:
    """Return the normal and signed distance [m] of a sphere about the origin; see `box_distance`.

    Args:
        x: A point [m].
        radius: [m].
    """
    r = wp.length(x)
    n = x / wp.max(r, 1.0e-9)
    return wp.vec4(n[0], n[1], n[2], r - radius)


@wp.func
def cylinder_distance(x: wp.vec3, radius: float, half: float) -> wp.vec4:
    """Return the normal and signed distance [m] of a cylinder along z; see `box_distance`.

    Args:
        x: A point, cylinder axes [m].
        radius: [m].
        half: Half its length [m].
    """
    r = wp.length(wp.vec2(x[0], x[1]))
    radial = wp.vec3(x[0], x[1], 0.0) / wp.max(r, 1.0e-9)
    # In the half plane through its axis and the point, the cylinder is a box.
    flat = box_distance(wp.vec3(r, 0.0, x[2]), wp.vec3(radius, 1.0e6, half))
    n = flat[0] * radial + wp.vec3(0.0, 0.0, flat[2])
    return wp.vec4(n[0], n[1], n[2], flat[3])


@wp.func
def heightfield_depth(solids: Solids, size: wp.vec3, x: wp.vec3, radius: float) -> wp.vec4:
    """Return the normal of a heightfield and the depth of a sphere in it: h - z of its lowest point, over the normal's
    z.

    The potential ½ k (h - z)² then has exactly the force k depth n: contact conserves energy on any slope.

    Args:
        solids: Solids with the heights.
        size: Half extents along x and y [m].
        x: Centre of the sphere, heightfield axes [m].
        radius: [m].

    Returns:
        Normal, and depth [m]; above the ground it is negative, with a magnitude below the distance.
    """
    columns = solids.heights.shape[1]
    rows = solids.heights.shape[0]
    if wp.abs(x[0]) > size[0] or wp.abs(x[1]) > size[1]:
        # The ground has no contact from the side; contact begins at its edge.
        beyond = wp.max(wp.abs(x[0]) - size[0], wp.abs(x[1]) - size[1])
        return wp.vec4(0.0, 0.0, 1.0, -wp.max(beyond, 1.0e-6))
    per_x = float(columns - 1) / (2.0 * size[0])
    per_y = float(rows - 1) / (2.0 * size[1])
    u = (x[0] + size[0]) * per_x
    v = (x[1] + size[1]) * per_y
    i = wp.min(int(u), columns - 2)
    j = wp.min(int(v), rows - 2)
    fx = u - float(i)
    fy = v - float(j)
    # The same triangles as in the ray caster: the diagonal runs from the least x and y to the greatest.
    low = solids.heights[j, i]
    high = solids.heights[j + 1, i + 1]
    side = solids.heights[j, i + 1]
    along = side - low
    beside = high - side
    if fx < fy:
        side = solids.heights[j + 1, i]
        beside = side - low
        along = high - side
    deep = low + fx * along + fy * beside + radius - x[2]
    slope = wp.vec3(-along * per_x, -beside * per_y, 1.0)
    steep = wp.length(slope)
    n = slope / steep
    return wp.vec4(n[0], n[1], n[2], wp.where(deep > 0.0, deep * steep, deep * solids.gentle))


@wp.func
def solid_depth(solids: Solids, k: int, x: wp.vec3, radius: float, reach: float) -> wp.vec4:
    """Return the normal of a solid and the depth of a sphere in it.

    Args:
        solids: All solids.
        k: Index of the solid.
        x: Centre of the sphere, axes of the solid [m].
        radius: Radius of the sphere; 0 for a point [m].
        reach: Greatest distance at which the surface of a mesh is searched [m].

    Returns:
        Normal out of the solid, axes of the solid, and the depth of the sphere's deepest point [m]; outside it is
        negative, with a magnitude of at most the distance.
    """
    kind = solids.kind[k]
    size = solids.size[k]
    face = wp.vec4(0.0, 0.0, 1.0, x[2])
    if kind == HEIGHTFIELD:
        return heightfield_depth(solids, size, x, radius)
    if kind == BOX:
        face = box_distance(x, size)
    elif kind == SPHERE:
        face = ball_distance(x, size[0])
    elif kind == CAPSULE:
        face = ball_distance(x - wp.vec3(0.0, 0.0, wp.clamp(x[2], -size[1], size[1])), size[0])
    elif kind == CYLINDER:
        face = cylinder_distance(x, size[0], size[1])
    elif kind == MESH:
        face = wp.vec4(0.0, 0.0, 1.0, reach)
        query = wp.mesh_query_point_no_sign(solids.mesh[k], x, reach)
        if query.result:
            nearest = wp.mesh_eval_position(solids.mesh[k], query.face, query.u, query.v)
            outside = float(1.0)
            if size[0] > 0.0:
                signed = wp.mesh_query_point_sign_normal(solids.mesh[k], x, reach)
                outside = signed.sign
            way = x - nearest
            d = wp.length(way)
            n = outside * way / wp.max(d, 1.0e-9)
            face = wp.vec4(n[0], n[1], n[2], outside * d)
    return wp.vec4(face[0], face[1], face[2], radius - face[3])


@wp.func
def scaled_depth(solids: Solids, k: int, scale: float, x: wp.vec3, radius: float, reach: float) -> wp.vec4:
    """Return `solid_depth` of a solid that is enlarged by the factor `scale`.

    Args:
        solids: All solids.
        k: Index of the solid.
        scale: Factor on its size [-].
        x: Centre of the sphere, axes of the solid [m].
        radius: Radius of the sphere [m].
        reach: Greatest distance at which the surface of a mesh is searched [m].
    """
    face = solid_depth(solids, k, x / scale, radius / scale, reach / scale)
    return wp.vec4(face[0], face[1], face[2], scale * face[3])


@wp.func
def spheres_along(half: float, least: float) -> int:
    """Return the number of spheres in a row within the hull, at most 1.4 radii apart.

    Args:
        half: Half extent of the envelope along the row [m].
        least: Its least half extent [m].
    """
    return wp.min(1 + int(wp.ceil(2.0 * (half - least) / (1.26 * least) - 1.0e-3)), 8)


@wp.func
def hull_sphere(i: int, half_size: wp.vec3) -> wp.vec4:
    """Return centre, body frame, and radius of part i of the hull [m]: 0 to 7 are corners of radius 0, then spheres
    follow.

    Args:
        i: Index of the part, less than 8 plus the product of `spheres_along` of the three axes.
        half_size: Half extents of the envelope about the body origin, body axes [m].
    """
    if i < 8:
        sign = wp.vec3(
            1.0 - 2.0 * float(i & 1), 1.0 - 2.0 * float((i >> 1) & 1), 1.0 - 2.0 * float((i >> 2) & 1)
        )
        corner = wp.cw_mul(sign, half_size)
        return wp.vec4(corner[0], corner[1], corner[2], 0.0)
    least = wp.min(half_size)
    k = i - 8
    r = wp.vec3(0.0)
    for axis in range(3):
        n = spheres_along(half_size[axis], least)
        if n > 1:
            r[axis] = (2.0 * float(k % n) / float(n - 1) - 1.0) * (half_size[axis] - least)
        k = k // n
    return wp.vec4(r[0], r[1], r[2], 0.9 * least)


@wp.func
def solids_within(clearing: wp.vec4, position: wp.vec3, half_size: wp.vec3, reach: float) -> bool:
    """Return whether a solid may be nearer to the vehicle's envelope than `reach`.

    Args:
        clearing: Ball of free water: its centre, world frame, and its radius [m].
        position: Body origin, world frame [m].
        half_size: Half extents of the envelope about the body origin, body axes [m].
        reach: Distance [m].
    """
    away = position - wp.vec3(clearing[0], clearing[1], clearing[2])
    return wp.length(away) + wp.length(half_size) + reach > clearing[3]


@wp.func
def free_water(solids: Solids, w: int, v: int, position: wp.vec3, around: float) -> float:
    """Return the radius of the largest ball of free water around a vehicle [m], and store the list of nearby solids.

    Args:
        solids: All solids.
        w: Index of the world.
        v: Index of the vehicle.
        position: Body origin, world frame [m].
        around: Radius within which a solid is nearby [m].
    """
    free = float(FARTHEST)
    count = int(0)
    for k in range(solids.kind.shape[0]):
        pose = solids.pose[w, solids.shape[k]]
        scale = solids.scale[w, solids.shape[k]]
        horizon = wp.max(free, around)
        if wp.length(position - wp.transform_get_translation(pose)) - scale * solids.bound[k] < horizon:
            x = wp.transform_point(wp.transform_inverse(pose), position)
            distance = -scaled_depth(solids, k, scale, x, 0.0, horizon)[3]
            free = wp.min(free, distance)
            if distance < around:
                if count < wp.static(NEIGHBOURS):
                    solids.near[w, v, count] = k
                count += 1
    solids.count[w, v] = count
    return free


@wp.func
def solids_wrench(
    solids: Solids,
    clearing: wp.vec4,
    w: int,
    v: int,
    position: wp.vec3,
    q: wp.quat,
    nu: vec6,
    half_size: wp.vec3,
) -> vec6:
    """Return the wrench of the solids of a world on a vehicle's hull.

    Args:
        solids: All solids.
        clearing: Ball of free water: its centre and radius [m]; see `solids_within`.
        w: Index of the world.
        v: Index of the vehicle.
        position: Body origin, world frame [m].
        q: Attitude, body to world.
        nu: Twist, body frame [m/s, rad/s].
        half_size: Half extents of the envelope about the body origin, body axes [m].

    Returns:
        Wrench about the body origin, body frame [N, N m].
    """
    if not solids_within(clearing, position, half_size, 0.0):
        return vec6()
    velocity = linear(nu)
    omega = angular(nu)
    force = wp.vec3(0.0)
    moment = wp.vec3(0.0)
    around = wp.length(half_size)
    least = wp.min(half_size)
    parts = 8 + spheres_along(half_size[0], least) * spheres_along(half_size[1], least) * spheres_along(
        half_size[2], least
    )
    count = solids.count[w, v]
    away = wp.length(position - wp.vec3(clearing[0], clearing[1], clearing[2]))
    listed = count <= wp.static(NEIGHBOURS) and away <= solids.reach[w, v]
    if not listed:
        count = solids.kind.shape[0]
    for j in range(count):
        k = int(j)
        if listed:
            k = solids.near[w, v, j]
        pose = solids.pose[w, solids.shape[k]]
        scale = solids.scale[w, solids.shape[k]]
        if wp.length(position - wp.transform_get_translation(pose)) < scale * solids.bound[k] + around:
            to_solid = wp.transform_inverse(pose)
            origin = wp.transform_point(to_solid, position)
            R = wp.quat_to_matrix(wp.transform_get_rotation(to_solid) * q)
            if scaled_depth(solids, k, scale, origin, 0.0, 2.0 * around)[3] > -around:
                for i in range(parts):
                    part = hull_sphere(i, half_size)
                    r = wp.vec3(part[0], part[1], part[2])
                    face = scaled_depth(solids, k, scale, origin + R * r, part[3], 2.0 * around)
                    if face[3] > 0.0:
                        n = wp.vec3(face[0], face[1], face[2])
                        r = r - part[3] * (wp.transpose(R) * n)  # contact point of the sphere
                        v_s = R * (velocity + wp.cross(omega, r))
                        f = wp.transpose(R) * penalty_force(
                            face[3], v_s, n, solids.stiffness, solids.damping, solids.friction, 0.01
                        )
                        force += f
                        moment += wp.cross(r, f)
    return join(force, moment)
