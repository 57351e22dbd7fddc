"""Calibrated Fossen hydrodynamics (paper, eq. 1-2): restoring forces and damping; the engine adds the added mass."""

# mypy: disable-error-code="valid-type"

import warp as wp

from finssim.physics.damping import damping_wrench, twist_at, wrench_from
from finssim.physics.hydrodynamics.mesh import HullMesh
from finssim.physics.hydrostatics import (
    BodyMotion,
    WaterWrench,
    hydrostatic_wrench,
    submerged_fraction,
    submersion_rate,
)
from finssim.physics.kinematics import point_velocity
from finssim.physics.plant import VehicleParameters
from finssim.physics.water import Flow, WaterArrays


@wp.func
def fossen_wrench(
    plant: wp.array2d(dtype=VehicleParameters),
    hull: HullMesh,
    water: WaterArrays,
    w: int,
    v: int,
    body: BodyMotion,
    flow: Flow,
) -> WaterWrench:
    """Return the hydrostatic and damping wrench of a submerged or surfaced vehicle.

    tau_H + tau_D(nu_r)                     (paper, eq. 1)

    The terms in M_A are part of the equation of motion. The damping that is coupled to surge is a separate term, which
    the kernel evaluates only for vehicles that have it.

    Args:
        plant: Parameters.
        hull: Not used here.
        water: Density and gravity.
        w: World.
        v: Vehicle.
        body: Pose and motion.
        flow: Water at the body origin.

    Returns:
        Wrench about the body origin, mass of displaced water and submerged fraction.
    """
    r_b = plant[w, v].r_b
    height = body.position[2] + wp.dot(body.up, r_b) - flow.elevation
    wet = submerged_fraction(height, plant[w, v].surface_half_height)
    out = WaterWrench()
    out.wet = wet
    if wp.abs(height) < plant[w, v].surface_half_height:
        climb = wp.dot(body.up, point_velocity(body.nu, r_b)) - flow.velocity[2]
        out.wet_rate = submersion_rate(height, plant[w, v].surface_half_height, climb)
    out.displaced = water.density * plant[w, v].volume * wet
    r_h = plant[w, v].r_h
    tau_D = damping_wrench(twist_at(body.nu_r, r_h), plant[w, v].D1, plant[w, v].D2)
    weight = plant[w, v].mass * water.gravity
    tau_H = hydrostatic_wrench(weight, out.displaced * water.gravity, plant[w, v].r_g, r_b, body.up)
    out.tau = tau_H + wet * wrench_from(tau_D, r_h)
    return out
