"""Calibrated Fossen hydrodynamics (paper, eq. 1-2): restoring, damping and added mass in moving water."""

import warp as wp
from finssim.physics.hydrodynamics.mesh import HullMesh

from finssim.physics.damping import damping_wrench, twist_at, wrench_from
from finssim.physics.hydrostatics import hydrostatic_wrench, submerged_fraction
from finssim.physics.inertia import coriolis_wrench
from finssim.physics.plant import Plant
from finssim.physics.types import join, vec6
from finssim.physics.water import Flow, WaterArrays


@wp.func
def relative_twist(nu: vec6, water_b: wp.vec3) -> vec6:
    """Twist relative to the water; water_b is the water's velocity in the body frame [m/s]."""
    return nu - join(water_b, wp.vec3(0.0))


@wp.func
def water_acceleration_wrench(
    plant: Plant, w: int, v: int, water_b: wp.vec3, a_b: wp.vec3, omega: wp.vec3, mass: float
) -> vec6:
    """Wrench of accelerating water on a body: M_A d(nu_c)/dt + Froude-Krylov force.

    M_A [a_c - ω × v_c; 0] + [ρ V a_c; r_b × ρ V a_c]

    The second part is the pressure gradient that accelerates the water itself: with it a neutral body at rest in the
    water keeps moving with it, whatever its added mass.

    Args:
        plant: Parameters.
        w: World.
        v: Vehicle.
        water_b: Velocity of the water, body frame [m/s].
        a_b: Acceleration of the water, body frame [m/s²].
        omega: Angular velocity of the body, body frame [rad/s].
        mass: Mass of the water displaced, ρ V [kg].

    Returns:
        Wrench about the body origin, body frame [N, N m].
    """
    f = mass * a_b
    spin = wp.vec3(0.0)
    return plant.M_A[w, v] * join(a_b - wp.cross(omega, water_b), spin) + join(f, wp.cross(plant.r_b[w, v], f))


@wp.func
def fossen_wrench(
    plant: Plant,
    hull: HullMesh,
    water: WaterArrays,
    w: int,
    v: int,
    position: wp.vec3,
    q: wp.quat,
    nu: vec6,
    flow: Flow,
) -> vec6:
    """Hydrodynamic and hydrostatic wrench, without the part of added mass that multiplies nu_dot.

    tau_H + tau_D(nu_r) - C_A(nu_r) nu_r + M_A d(nu_c)/dt                            (paper, eq. 1)

    The term -M_A nu_dot is on the left-hand side of the equation of motion: M_RB + M_A is solved as one matrix.

    Args:
        plant: Parameters.
        hull: Not used here.
        water: Density and gravity.
        w: World.
        v: Vehicle.
        position: Body origin, world frame [m].
        q: Attitude, body to world.
        nu: Twist, body frame [m/s, rad/s].
        flow: Water at the body origin.

    Returns:
        Wrench about the body origin, body frame [N, N m].
    """
    up = wp.quat_rotate_inv(q, wp.vec3(0.0, 0.0, 1.0))
    r_b = plant.r_b[w, v]
    height = position[2] + wp.dot(up, r_b) - flow.elevation
    wet = submerged_fraction(height, plant.surface_half_height[w, v])
    displaced = water.density * plant.volume[w, v] * wet
    tau = hydrostatic_wrench(plant.mass[w, v] * water.gravity, displaced * water.gravity, plant.r_g[w, v], r_b, up)
    nu_r = nu
    if water.moving != 0:
        water_b = wp.quat_rotate_inv(q, flow.velocity)
        omega = wp.vec3(nu[3], nu[4], nu[5])
        nu_r = relative_twist(nu, water_b)
        a_b = wp.quat_rotate_inv(q, flow.acceleration)
        tau += water_acceleration_wrench(plant, w, v, water_b, a_b, omega, displaced)
    r_h = plant.r_h[w, v]
    tau_D = damping_wrench(twist_at(nu_r, r_h), plant.D1[w, v], plant.D2[w, v], plant.Du[w, v])
    return tau + wet * wrench_from(tau_D, r_h) - coriolis_wrench(plant.M_A[w, v] * nu_r, nu_r)
