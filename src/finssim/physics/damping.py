"""Damping wrench of the Fossen models (paper, eq. 2)."""

import warp as wp

from finssim.physics.types import angular, join, linear, mat66, vec6


@wp.func
def damping_wrench(nu_r: vec6, D1: mat66, D2: mat66) -> vec6:
    """Return the damping wrench on a submerged body, about the point at which the coefficients hold.

    tau_D = -[D1 + D2 diag(|nu_r|)] nu_r            (paper, eq. 2; its Du is `finssim.physics.terms.surge_damping`)

    Args:
        nu_r: Velocity of that point relative to the water, body frame [m/s, rad/s].
        D1: Linear damping, 6x6 [N s/m, N m s/rad].
        D2: Quadratic damping, 6x6 [N s²/m², N m s²/rad²].

    Returns:
        Wrench about the same point, body frame [N, N m].
    """
    return -(D1 * nu_r + D2 * wp.cw_mul(wp.abs(nu_r), nu_r))


@wp.func
def twist_at(nu: vec6, r: wp.vec3) -> vec6:
    """Return the twist at a point r of the body from the twist at its origin, body frame: [v + ω × r; ω]."""
    omega = angular(nu)
    return join(linear(nu) + wp.cross(omega, r), omega)


@wp.func
def wrench_from(tau: vec6, r: wp.vec3) -> vec6:
    """Return the wrench about the body origin from the wrench about a point r, body frame: [F; K + r × F]."""
    force = linear(tau)
    return join(force, angular(tau) + wp.cross(r, force))
