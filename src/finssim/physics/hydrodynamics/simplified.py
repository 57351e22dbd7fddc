"""Simplified hydrodynamics (paper, eq. 5): restoring and damping of the body's own velocity, nothing else."""

import warp as wp
from finssim.physics.hydrodynamics.mesh import HullMesh

from finssim.physics.damping import damping_wrench, twist_at, wrench_from
from finssim.physics.hydrostatics import hydrostatic_wrench, submerged_fraction
from finssim.physics.plant import Plant
from finssim.physics.types import vec6
from finssim.physics.water import Flow, WaterArrays


@wp.func
def simplified_wrench(
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
    """Hydrostatic and damping wrench: tau_H + tau_D(nu)                               (paper, eq. 5)

    Added mass, its Coriolis terms and moving water are left out on purpose; a current does not act on this model.

    Args:
        plant: Parameters.
        hull: Not used here.
        water: Density and gravity.
        w: World.
        v: Vehicle.
        position: Body origin, world frame [m].
        q: Attitude, body to world.
        nu: Twist, body frame [m/s, rad/s].
        flow: Only the surface elevation is used.

    Returns:
        Wrench about the body origin, body frame [N, N m].
    """
    up = wp.quat_rotate_inv(q, wp.vec3(0.0, 0.0, 1.0))
    r_b = plant.r_b[w, v]
    height = position[2] + wp.dot(up, r_b) - flow.elevation
    wet = submerged_fraction(height, plant.surface_half_height[w, v])
    buoyancy = water.density * water.gravity * plant.volume[w, v] * wet
    r_h = plant.r_h[w, v]
    tau_D = damping_wrench(twist_at(nu, r_h), plant.D1[w, v], plant.D2[w, v], plant.Du[w, v])
    tau_H = hydrostatic_wrench(plant.mass[w, v] * water.gravity, buoyancy, plant.r_g[w, v], r_b, up)
    return tau_H + wet * wrench_from(tau_D, r_h)
