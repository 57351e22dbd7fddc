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

    Args and returns are those of `fossen_wrench`.
    """
    out = fossen_wrench(plant, hull, water, w, v, position, q, up, nu, nu, flow)
    out.displaced = 0.0
    return out
