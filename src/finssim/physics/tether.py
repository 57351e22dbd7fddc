"""Drag of a straight, taut tether from an anchor to the vehicle."""

# mypy: disable-error-code="arg-type"

import warp as wp

from finssim.physics.types import join, vec6


@wp.struct
class Tether:
    """The tether of one vehicle; a diameter of 0 means none."""

    anchor: wp.vec3  # point where it enters the water, world frame [m]
    attachment: wp.vec3  # on the vehicle, body frame [m]
    diameter: float  # [m]
    drag_coefficient: float  # of a cylinder across the flow [-]
    wet_weight: float  # weight in water per length [N/m]; negative for a buoyant tether


@wp.func
def tether_wrench(
    tether: Tether, density: float, position: wp.vec3, q: wp.quat, nu: vec6, water: wp.vec3
) -> vec6:
    """Return the wrench of the tether on the vehicle: its part of the cross-flow drag, and half the wet weight.

    The tether is a straight line of length L whose transverse velocity grows linearly from 0 at the anchor to v_n at
    the vehicle. Its drag per length, ½ ρ C d |v_n s| v_n s at the fraction s, is carried by both ends. From the balance
    of moments, the vehicle carries ∫ ½ ρ C d |v_n| v_n s² · s L ds = ρ C d L |v_n| v_n / 8.

    Args:
        tether: Its geometry and coefficients.
        density: Density of the water [kg/m³].
        position: Body origin, world frame [m].
        q: Attitude, body to world.
        nu: Twist, body frame [m/s, rad/s].
        water: Water velocity, world frame [m/s].

    Returns:
        Wrench about the body origin, body frame [N, N m].
    """
    if tether.diameter <= 0.0:
        return vec6()
    r = tether.attachment
    v = wp.quat_rotate(q, wp.vec3(nu[0], nu[1], nu[2]) + wp.cross(wp.vec3(nu[3], nu[4], nu[5]), r)) - water
    along = position + wp.quat_rotate(q, r) - tether.anchor
    length = wp.length(along)
    direction = along / wp.max(length, 1.0e-6)
    v_n = v - wp.dot(v, direction) * direction
    drag = -0.125 * density * tether.drag_coefficient * tether.diameter * length * wp.length(v_n) * v_n
    force = wp.quat_rotate_inv(q, drag - wp.vec3(0.0, 0.0, 0.5 * tether.wet_weight * length))
    return join(force, wp.cross(r, force))
