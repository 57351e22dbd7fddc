"""Physics-mesh hydrodynamics (paper, eq. 3-4): buoyancy and drag of a hull mesh clipped at the water surface."""

# mypy: disable-error-code="assignment,valid-type"

import warp as wp

from finssim.physics.hydrodynamics.mesh import HullMesh, mesh_displacement, mesh_drag, mesh_inflow
from finssim.physics.hydrostatics import WaterWrench, hydrostatic_wrench
from finssim.physics.plant import VehicleParameters
from finssim.physics.types import linear, vec6
from finssim.physics.water import Flow, WaterArrays


@wp.func
def mesh_wrench(
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
    """Wrench of the part of a hull mesh below the instantaneous surface: buoyancy, form drag and skin drag.

    The surface is the plane tangent to the waves above the body origin; the water's velocity varies linearly over the
    hull. The vehicle file's displaced volume and centre of buoyancy hold when wholly submerged, and the mesh says how
    they change at the surface: a mesh without the vehicle's insides still floats it right.

    Args:
        plant: Parameters.
        hull: Hull meshes.
        water: Density and gravity.
        w: World.
        v: Vehicle.
        position: Body origin, world frame [m].
        q: Attitude, body to world.
        up: World z axis in the body frame.
        nu: Twist, body frame [m/s, rad/s].
        nu_r: The same relative to the water, body frame [m/s, rad/s].
        flow: Water at the body origin.

    Returns:
        Wrench about the body origin, the mass of water displaced and the part under water.
    """
    kind = plant[w, v].hull
    normal = up
    G = wp.mat33(0.0)
    if water.moving != 0:
        normal = wp.quat_rotate_inv(q, flow.normal)
        R = wp.quat_to_matrix(q)
        G = wp.transpose(R) * flow.gradient * R
    height = flow.normal[2] * (position[2] - flow.elevation)
    wet = mesh_displacement(hull, kind, normal, height)
    out = WaterWrench()
    out.wet = wet[0] / hull.volume[kind]
    water_b = linear(nu) - linear(nu_r)
    if out.wet > 0.0 and out.wet < 1.0:
        out.wet_rate = mesh_inflow(hull, kind, nu_r, normal, height) / hull.volume[kind]
    out.displaced = water.density * plant[w, v].volume * out.wet
    center = wp.vec3(wet[1], wet[2], wet[3]) + plant[w, v].r_b - hull.centroid[kind]
    weight = plant[w, v].mass * water.gravity
    tau = hydrostatic_wrench(weight, out.displaced * water.gravity, plant[w, v].r_g, center, up)
    form = plant[w, v].form_drag
    tau += mesh_drag(hull, kind, nu, water_b, G, water.density, form, plant[w, v].skin_drag, normal, height)
    out.tau = tau
    return out
