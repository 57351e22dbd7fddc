"""Simplified hydrodynamics (paper, eq. 5): restoring and damping of the body's own velocity, nothing else."""

# mypy: disable-error-code="valid-type"

import warp as wp

from finssim.physics.hydrodynamics.fossen import fossen_wrench
from finssim.physics.hydrodynamics.mesh import HullMesh
from finssim.physics.hydrostatics import WaterWrench
from finssim.physics.plant import VehicleParameters
from finssim.physics.types import vec6
from finssim.physics.water import Flow, WaterArrays


@wp.func
def simplified_wrench(
    plant: wp.array2d(dtype=VehicleParameters),
    hull: HullMesh,
    water: WaterArrays,
    w: int,
    v: int,
    position: wp.vec3,
    q: wp.quat,
    up: wp.vec3,
    nu: vec6,
    nu_r: vec6,
    flow: Flow,
) -> WaterWrench:
    """Hydrostatic and damping wrench: tau_H + tau_D(nu)                               (paper, eq. 5)

    Added mass, its Coriolis terms and moving water are left out on purpose: a current does not act on this model, and
    accelerating water does not either (no water counts as displaced).

    Args:
        plant: Parameters.
        hull: Not used here.
        water: Density and gravity.
        w: World.
        v: Vehicle.
        position: Body origin, world frame [m].
        q: Attitude, body to world.
        up: World z axis in the body frame, a unit vector.
        nu: Twist, body frame [m/s, rad/s].
        nu_r: The same relative to the water, body frame [m/s, rad/s]; not used here.
        flow: Water at the body origin; of its velocity only the vertical part counts here.

    Returns:
        As of `fossen_wrench`, with no water displaced.
    """
    out = fossen_wrench(plant, hull, water, w, v, position, q, up, nu, nu, flow)
    out.displaced = 0.0
    return out
