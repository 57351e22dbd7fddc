"""Funnel that a vehicle can enter: a block with a conical and a cylindrical bore, with penalty forces on the hull.

Dock axes: the origin is the centre of the throat, where cone and tube meet; x points into the tube.
"""

# mypy: disable-error-code="arg-type,call-overload,index,no-any-return,operator,return-value,valid-type"

import warp as wp

from finssim.physics.contact import penalty_force
from finssim.physics.types import angular, join, linear, vec6

HULL_POINTS = 21
"""Number of contact points of a hull: the nose, and the four corners of the envelope's cross-section at five
stations."""


@wp.struct
class Funnel:
    """One funnel in every world; all funnels have the same shape."""

    mouth_radius: float  # [m]
    throat_radius: float  # [m]
    cone_length: float  # [m]
    tube_length: float  # [m]
    outer_radius: float  # of the block [m]
    back: float  # thickness behind the tube's end [m]
    stiffness: float  # per point of the hull [N/m]
    damping: float  # per point, against approach only [N s/m]
    friction: float  # Coulomb coefficient [-]
    slip: float  # speed below which friction is linear [m/s]
    position: wp.array(dtype=wp.vec3)  # of the throat, by world, world frame [m]
    quaternion: wp.array(dtype=wp.quat)  # dock axes to world
    force: wp.array2d(dtype=float)  # greatest contact force on a vehicle in the last control step [N]
    impulse: wp.array2d(dtype=float)  # integral of its size over that control step [N s]


@wp.func
def funnel_depth(funnel: Funnel, x: wp.vec3) -> wp.vec4:
    """Return the nearest face of the block to a point inside it.

    Args:
        funnel: Shape of the funnel.
        x: The point, dock axes [m].

    Returns:
        Normal of the face, out of the block, and the point's depth behind it [m]; all zero for a point outside the
        block.
    """
    r = wp.length(wp.vec2(x[1], x[2]))
    ahead = x[0] + funnel.cone_length
    behind = funnel.tube_length + funnel.back - x[0]
    aside = funnel.outer_radius - r
    if ahead <= 0.0 or behind <= 0.0 or aside <= 0.0:
        return wp.vec4(0.0)
    radial = wp.vec3(0.0, x[1], x[2]) / wp.max(r, 1.0e-9)
    slope = (funnel.mouth_radius - funnel.throat_radius) / funnel.cone_length
    stretch = wp.sqrt(1.0 + slope * slope)
    beyond_end = x[0] - funnel.tube_length
    beyond_wall = r - funnel.throat_radius
    beyond_cone = (beyond_wall + slope * x[0]) / stretch
    axis = wp.vec3(1.0, 0.0, 0.0)
    # First the bore: the solid is outside both tube and cone, and behind the tube's end.
    depth = wp.min(beyond_wall, beyond_cone)
    n = wp.where(beyond_cone < beyond_wall, -(radial + slope * axis) / stretch, -radial)
    if beyond_end > 0.0:
        inset = wp.max(beyond_wall, 0.0)
        depth = wp.sqrt(beyond_end * beyond_end + inset * inset)
        n = -(beyond_end * axis + inset * radial) / depth
    if depth <= 0.0:
        return wp.vec4(0.0)
    if ahead < depth:
        depth = ahead
        n = -axis
    if aside < depth:
        depth = aside
        n = radial
    if behind < depth:
        depth = behind
        n = axis
    return wp.vec4(n[0], n[1], n[2], depth)


@wp.func
def hull_point(i: int, half_size: wp.vec3) -> wp.vec3:
    """Return point i of the hull, body frame [m]: 0 is the nose, 1 to 4 are the front corners, and so on to the
    stern."""
    if i == 0:
        return wp.vec3(half_size[0], 0.0, 0.0)
    k = i - 1
    along = 1.0 - 0.5 * float(k >> 2)
    sy = 1.0 - 2.0 * float(k & 1)
    sz = 1.0 - 2.0 * float((k >> 1) & 1)
    return wp.cw_mul(wp.vec3(along, sy, sz), half_size)


@wp.func
def funnel_within(funnel: Funnel, w: int, position: wp.vec3, half_size: wp.vec3, reach: float) -> bool:
    """Return whether the bounding spheres of a world's funnel and of the vehicle are nearer to each other than `reach`.

    Args:
        funnel: Shape, and poses by world.
        w: Index of the world.
        position: Body origin, world frame [m].
        half_size: Half extents of the envelope about the body origin, body axes [m].
        reach: Distance [m].
    """
    long = 0.5 * (funnel.cone_length + funnel.tube_length + funnel.back)
    middle = wp.quat_rotate(funnel.quaternion[w], wp.vec3(long - funnel.cone_length, 0.0, 0.0))
    limit = wp.sqrt(long * long + funnel.outer_radius * funnel.outer_radius) + wp.length(half_size) + reach
    return wp.length_sq(position - funnel.position[w] - middle) <= limit * limit


@wp.func
def funnel_wrench(
    funnel: Funnel, w: int, position: wp.vec3, q: wp.quat, nu: vec6, half_size: wp.vec3
) -> vec6:
    """Return the wrench of a world's funnel on a vehicle's hull.

    Args:
        funnel: Shape, and poses by world.
        w: Index of the world.
        position: Body origin, world frame [m].
        q: Attitude, body to world.
        nu: Twist, body frame [m/s, rad/s].
        half_size: Half extents of the envelope about the body origin, body axes [m].

    Returns:
        Wrench about the body origin, body frame [N, N m]; its force is the total contact force of the block.
    """
    if not funnel_within(funnel, w, position, half_size, 0.0):
        return vec6()
    q_d = funnel.quaternion[w]
    origin = wp.quat_rotate_inv(q_d, position - funnel.position[w])
    R = wp.quat_to_matrix(wp.quat_inverse(q_d) * q)
    v = linear(nu)
    omega = angular(nu)
    force = wp.vec3(0.0)
    moment = wp.vec3(0.0)
    points = int(HULL_POINTS)  # a variable, so that the loop is not unrolled
    for i in range(points):
        r = hull_point(i, half_size)
        face = funnel_depth(funnel, origin + R * r)
        if face[3] > 0.0:
            n = wp.vec3(face[0], face[1], face[2])
            v_d = R * (v + wp.cross(omega, r))
            f = wp.transpose(R) * penalty_force(
                face[3], v_d, n, funnel.stiffness, funnel.damping, funnel.friction, funnel.slip
            )
            force += f
            moment += wp.cross(r, f)
    return join(force, moment)
