"""Attitude and position kinematics, eta_dot = J(eta) nu, with unit quaternions xyzw (Fossen 2021, eq. 2.68)."""

# mypy: disable-error-code="arg-type,call-overload,index,no-any-return,operator"

import warp as wp

from finssim.physics.types import angular, linear, vec6


@wp.func
def quaternion_rate(q: wp.quat, omega: wp.vec3) -> wp.quat:
    """Return the rate of the body-to-world quaternion.

    q_dot = 1/2 q ⊗ (omega, 0)

    Args:
        q: Attitude, body to world, xyzw, unit length.
        omega: Angular velocity, body frame [rad/s].

    Returns:
        Rate of the four components [1/s].
    """
    return q * wp.quat(0.5 * omega[0], 0.5 * omega[1], 0.5 * omega[2], 0.0)


@wp.func
def rotate_by(q: wp.quat, omega: wp.vec3, h: float) -> wp.quat:
    """Return the attitude after rotation at a constant body rate for a time h: q ⊗ exp(h omega / 2), exactly.

    Args:
        q: Attitude, body to world, xyzw, unit length.
        omega: Angular velocity, body frame [rad/s].
        h: Time [s].

    Returns:
        The new attitude, of unit length up to rounding: normalise it from time to time.
    """
    half = 0.5 * h * omega
    s2 = wp.dot(half, half)
    # sin(a)/a and cos(a) as series: exact to float32 rounding up to a = 1 (115° per step).
    s4 = s2 * s2
    sinc = (1.0 - s2 * (1.0 / 6.0)) + s4 * ((1.0 / 120.0) - s2 * (1.0 / 5040.0) + s4 * (1.0 / 362880.0))
    cosine = (1.0 - s2 * 0.5) + s4 * (
        (1.0 / 24.0) - s2 * (1.0 / 720.0) + s4 * ((1.0 / 40320.0) - s2 * (1.0 / 3628800.0))
    )
    if s2 > 1.0:
        a = wp.sqrt(s2)
        sinc = wp.sin(a) / a
        cosine = wp.cos(a)
    return q * wp.quat(sinc * half[0], sinc * half[1], sinc * half[2], cosine)


@wp.func
def up_in_body(q: wp.quat) -> wp.vec3:
    """Return the world z axis in the body frame, a unit vector: the last row of R(q)."""
    return wp.vec3(
        2.0 * (q[0] * q[2] - q[3] * q[1]),
        2.0 * (q[1] * q[2] + q[3] * q[0]),
        1.0 - 2.0 * (q[0] * q[0] + q[1] * q[1]),
    )


@wp.func
def position_rate(q: wp.quat, nu: vec6) -> wp.vec3:
    """Return the velocity of the body origin in the world frame [m/s], from the body-frame twist nu."""
    v = linear(nu)
    i = wp.vec3(q[0], q[1], q[2])
    t = 2.0 * wp.cross(i, v)
    return v + q[3] * t + wp.cross(i, t)


@wp.func
def point_velocity(nu: vec6, r: wp.vec3) -> wp.vec3:
    """Return the velocity of a point fixed in the body, v + omega × r, body frame [m/s]; r is relative to the
    origin [m]."""
    return linear(nu) + wp.cross(angular(nu), r)
