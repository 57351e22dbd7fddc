"""Physics-mesh hydrodynamics (paper, eq. 3-4): buoyancy and drag of a hull mesh clipped at the water surface."""

import warp as wp

from finssim.physics.hydrodynamics.fossen import relative_twist, water_acceleration_wrench
from finssim.physics.hydrodynamics.mesh import HullMesh, mesh_displacement, mesh_drag
from finssim.physics.hydrostatics import hydrostatic_wrench
from finssim.physics.inertia import coriolis_wrench
from finssim.physics.plant import Plant
from finssim.physics.types import vec6
from finssim.physics.water import Flow, WaterArrays


@wp.func
def mesh_wrench(
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
    """Wrench of a hull mesh below the instantaneous surface: buoyancy, form and skin drag; added mass if the set has any.

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
        nu: Twist, body frame [m/s, rad/s].
        flow: Water at the body origin.

    Returns:
        Wrench about the body origin, body frame [N, N m], without -M_A nu_dot.
    """
    up = wp.quat_rotate_inv(q, wp.vec3(0.0, 0.0, 1.0))
    normal = wp.quat_rotate_inv(q, flow.normal)
    height = flow.normal[2] * (position[2] - flow.elevation)
    kind = plant.hull[w, v]
    wet = mesh_displacement(hull, kind, normal, height)
    displaced = water.density * plant.volume[w, v] * wet[0] / hull.volume[kind]
    shift = plant.r_b[w, v] - hull.centroid[kind]
    center = wp.vec3(wet[1], wet[2], wet[3]) + shift
    tau = hydrostatic_wrench(plant.mass[w, v] * water.gravity, displaced * water.gravity, plant.r_g[w, v], center, up)
    R = wp.quat_to_matrix(q)
    water_b = wp.vec3(0.0)
    G = wp.mat33(0.0)
    nu_r = nu
    if water.moving != 0:
        water_b = wp.transpose(R) * flow.velocity
        G = wp.transpose(R) * flow.gradient * R
        nu_r = relative_twist(nu, water_b)
        omega = wp.vec3(nu[3], nu[4], nu[5])
        tau += water_acceleration_wrench(plant, w, v, water_b, wp.transpose(R) * flow.acceleration, omega, displaced)
    form = plant.form_drag[w, v]
    tau += mesh_drag(hull, kind, nu, water_b, G, water.density, form, plant.skin_drag[w, v], normal, height)
    return tau - coriolis_wrench(plant.M_A[w, v] * nu_r, nu_r)
