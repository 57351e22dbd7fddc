"""Simplified hydrodynamics (paper, eq. 5): restoring and damping of the body's own velocity, nothing else."""

# mypy: disable-error-code="valid-type"

import warp as wp

from finssim.physics.hydrodynamics.fossen import fossen_wrench
from finssim.physics.hydrodynamics.mesh import HullMesh
from finssim.physics.hydrostatics import Afloat, WaterWrench
from finssim.physics.plant import VehicleParameters
from finssim.physics.water import Flow, WaterArrays


@wp.func
def simplified_wrench(
    plant: wp.array2d(dtype=VehicleParameters),
    hull: HullMesh,
    water: WaterArrays,
    w: int,
    v: int,
    body: Afloat,
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
        body: Pose and motion; its twist relative to the water is not used.
        flow: Water at the body origin; of its velocity only the vertical part counts here.

    Returns:
        As of `fossen_wrench`, with no water displaced.
    """
    own = Afloat()
    own.position = body.position
    own.q = body.q
    own.up = body.up
    own.nu = body.nu
    own.nu_r = body.nu
    out = fossen_wrench(plant, hull, water, w, v, own, flow)
    out.displaced = 0.0
    return out
