"""Contact with the walls and floor of the pool: penalty forces on the corners of the vehicle's envelope."""

# mypy: disable-error-code="arg-type,call-overload,index,no-any-return,operator"

import warp as wp

from finssim.physics.lanes import sum_in_lanes
from finssim.physics.types import angular, join, linear, vec6

CORNERS = 8
"""Number of corners of the envelope box."""


@wp.struct
class PoolWalls:
    """Rectangular pool, centred on the world's z axis, and the contact parameters of its walls."""

    present: int
    half_length: float  # half extent along world x [m]
    half_width: float  # half extent along world y [m]
    depth: float  # floor at z = -depth [m]
    stiffness: float  # per corner [N/m]
    damping: float  # per corner, against approach only [N s/m]
    friction: float  # Coulomb coefficient [-]


@wp.func
def penalty_force(
    penetration: float, v: wp.vec3, n: wp.vec3, stiffness: float, damping: float, friction: float, slip: float
) -> wp.vec3:
    """Return the contact force of a surface on a point: spring, damping against approach, and Coulomb friction.

    The normal force is never attractive.

    Args:
        penetration: Depth of the point behind the surface [m]; the force is zero unless it is positive.
        v: Velocity of the point [m/s].
        n: Unit normal of the surface, out of the solid, in the same axes.
        stiffness: [N/m].
        damping: [N s/m].
        friction: Coulomb coefficient [-].
        slip: Speed below which friction is linear, so that it is dissipative and continuous at rest [m/s].

    Returns:
        Force on the point, in the same axes [N].
    """
    if penetration <= 0.0:
        return wp.vec3(0.0)
    v_n = wp.dot(v, n)
    normal = stiffness * penetration - damping * wp.min(v_n, 0.0)
    v_t = v - v_n * n
    return normal * n - friction * normal * v_t / wp.max(wp.length(v_t), slip)


@wp.func
def wall_force(penetration: float, v: wp.vec3, n: wp.vec3, walls: PoolWalls) -> wp.vec3:
    """Return the contact force of one wall on one corner, see `penalty_force`.

    Args:
        penetration: Depth of the corner behind the wall [m]; the force is zero unless it is positive.
        v: Velocity of the corner, world frame [m/s].
        n: Unit normal of the wall, into the water, world frame.
        walls: Stiffness, damping and friction.

    Returns:
        Force on the corner, world frame [N].
    """
    return penalty_force(penetration, v, n, walls.stiffness, walls.damping, walls.friction, 0.01)


@wp.func
def walls_within(walls: PoolWalls, position: wp.vec3, q: wp.quat, half_size: wp.vec3, reach: float) -> bool:
    """Return whether a wall or the floor is nearer to the vehicle's envelope box than `reach`.

    Args:
        walls: The pool.
        position: Body origin, world frame [m].
        q: Attitude, body to world.
        half_size: Half extents of the envelope about the body origin, body axes [m].
        reach: Distance [m]; 0 tests for contact.
    """
    if walls.present == 0:
        return False
    # Half extents of the rotated box along the world's axes: most vehicles near a wall do not touch it.
    R = wp.quat_to_matrix(q)
    extent = wp.vec3(
        wp.dot(wp.abs(R[0]), half_size), wp.dot(wp.abs(R[1]), half_size), wp.dot(wp.abs(R[2]), half_size)
    )
    return (
        wp.abs(position[0]) + extent[0] + reach > walls.half_length
        or wp.abs(position[1]) + extent[1] + reach > walls.half_width
        or position[2] - extent[2] - reach < -walls.depth
    )


@wp.func
def corner_wrench(
    i: int, walls: PoolWalls, position: wp.vec3, q: wp.quat, nu: vec6, half_size: wp.vec3
) -> vec6:
    """Return `contact_wrench` of corner i of the box, 0 to 7, body frame [N, N m]; same arguments."""
    R = wp.quat_to_matrix(q)
    sx = 1.0 - 2.0 * float(i & 1)
    sy = 1.0 - 2.0 * float((i >> 1) & 1)
    sz = 1.0 - 2.0 * float((i >> 2) & 1)
    r = wp.cw_mul(wp.vec3(sx, sy, sz), half_size)
    x = position + R * r
    v_w = R * (linear(nu) + wp.cross(angular(nu), r))
    f = wall_force(-(x[2] + walls.depth), v_w, wp.vec3(0.0, 0.0, 1.0), walls)
    side_x = wp.sign(x[0])
    f += wall_force(wp.abs(x[0]) - walls.half_length, v_w, wp.vec3(-side_x, 0.0, 0.0), walls)
    side_y = wp.sign(x[1])
    f += wall_force(wp.abs(x[1]) - walls.half_width, v_w, wp.vec3(0.0, -side_y, 0.0), walls)
    f_b = wp.transpose(R) * f
    return join(f_b, wp.cross(r, f_b))


@wp.func
def corners_wrench(walls: PoolWalls, position: wp.vec3, q: wp.quat, nu: vec6, half_size: wp.vec3) -> vec6:
    """Return `contact_wrench` of a box that touches a wall, body frame [N, N m]; same arguments."""
    tau = vec6()
    # A variable, so that the loop is not unrolled: contact is rare and would make the code longer for every vehicle.
    corners = int(CORNERS)
    for i in range(corners):
        tau += corner_wrench(i, walls, position, q, nu, half_size)
    return tau


sum_in_lanes(corners_wrench, corner_wrench, few=CORNERS)


@wp.func
def contact_wrench(walls: PoolWalls, position: wp.vec3, q: wp.quat, nu: vec6, half_size: wp.vec3) -> vec6:
    """Return the wrench of walls and floor on the eight corners of the vehicle's envelope box.

    Args:
        walls: The pool.
        position: Body origin, world frame [m].
        q: Attitude, body to world.
        nu: Twist, body frame [m/s, rad/s].
        half_size: Half extents of the envelope about the body origin, body axes [m].

    Returns:
        Wrench about the body origin, body frame [N, N m].
    """
    if not walls_within(walls, position, q, half_size, 0.0):
        return vec6()
    return corners_wrench(walls, position, q, nu, half_size)
