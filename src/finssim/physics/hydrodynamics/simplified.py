"""Simplified hydrodynamics (paper, eq. 5): only restoring forces and damping of the body's own velocity."""

# mypy: disable-error-code="valid-type"

import warp as wp

from finssim.physics.hydrodynamics.fossen import fossen_wrench
from finssim.physics.hydrodynamics.mesh import HullMesh
from finssim.physics.hydrostatics import BodyMotion, WaterWrench
from finssim.physics.plant import VehicleParameters
from finssim.physics.water import Flow, WaterArrays


@wp.func
def simplified_wrench(
    plant: wp.array2d(dtype=VehicleParameters),
    hull: HullMesh,
    water: WaterArrays,
    w: int,
    v: int,
    body: BodyMotion,
    flow: Flow,
) -> WaterWrench:
    """Return the hydrostatic and damping wrench: tau_H + tau_D(nu)                       (paper, eq. 5)

    Added mass, its Coriolis terms and moving water are deliberately omitted: neither a current nor accelerating water
    acts on this model (its displaced mass of water is 0).

    Args:
        plant: Parameters.
        hull: Not used here.
        water: Density and gravity.
        w: World.
        v: Vehicle.
        body: Pose and motion; its twist relative to the water is not used.
        flow: Water at the body origin; only the vertical component of its velocity is used.

    Returns:
        Same as `fossen_wrench`, with a displaced mass of 0.
    """
    own = BodyMotion()
    own.position = body.position
    own.q = body.q
    own.up = body.up
    own.nu = body.nu
    own.nu_r = body.nu
    out = fossen_wrench(plant, hull, water, w, v, own, flow)
    out.displaced = 0.0
    return out
