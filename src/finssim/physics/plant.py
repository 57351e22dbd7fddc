"""The physical parameters of every simulated vehicle, as one struct of Warp arrays indexed by (world, vehicle)."""

import warp as wp

from finssim.physics.inertia import invert_spd
from finssim.physics.types import MAX_THRUSTERS, mat66, mat68, vec6, vec8


@wp.struct
class Plant:
    """Parameters of each vehicle of each world. Randomisation writes here; nothing is ever recompiled."""

    mass: wp.array2d(dtype=float)  # [kg]
    r_g: wp.array2d(dtype=wp.vec3)  # centre of gravity, body frame [m]
    inertia: wp.array2d(dtype=wp.mat33)  # about the body origin, body axes [kg m²]
    volume: wp.array2d(dtype=float)  # displaced when submerged [m³]
    r_b: wp.array2d(dtype=wp.vec3)  # centre of buoyancy, body frame [m]
    surface_half_height: wp.array2d(dtype=float)  # [m]
    half_size: wp.array2d(dtype=wp.vec3)  # half extents of the envelope [m]
    M_A: wp.array2d(dtype=mat66)  # added mass about the body origin
    M_inv: wp.array2d(dtype=mat66)  # inverse of M_RB + M_A
    r_h: wp.array2d(dtype=wp.vec3)  # point where the damping coefficients hold, body frame [m]
    D1: wp.array2d(dtype=mat66)
    D2: wp.array2d(dtype=mat66)
    Du: wp.array2d(dtype=mat66)
    form_drag: wp.array2d(dtype=float)
    skin_drag: wp.array2d(dtype=float)
    hull: wp.array2d(dtype=int)  # which hull mesh, for the mesh model
    B: wp.array2d(dtype=mat68)  # thruster forces to the wrench about the body origin
    force_min: wp.array2d(dtype=vec8)  # [N]
    force_max: wp.array2d(dtype=vec8)
    dead_minus: wp.array2d(dtype=vec8)  # commands between dead_minus and dead_plus give nothing [N]
    dead_plus: wp.array2d(dtype=vec8)
    gain: wp.array2d(dtype=vec8)  # delivered over nominal thrust; 0 is a dead thruster
    time_constant: wp.array2d(dtype=vec8)  # [s]
    slew: wp.array2d(dtype=vec8)  # [N/s] or, for a speed lag, [rad/s²]
    alpha: wp.array2d(dtype=vec8)  # 1 - exp(-substep / time_constant), kept by `refresh_plant`
    delay: wp.array2d(dtype=float)  # command delay [s]
    speed_lag: wp.array2d(dtype=int)  # 1: lag and slew act on propeller speed, 0: on force
    c_plus: wp.array2d(dtype=vec8)  # [N s²/rad²]
    c_minus: wp.array2d(dtype=vec8)


@wp.struct
class Command:
    """What acts on each vehicle from outside, indexed by (world, vehicle)."""

    thrust: wp.array2d(dtype=vec8)  # commanded thruster force [N]
    disturbance: wp.array2d(dtype=vec6)  # extra wrench about the body origin, body frame [N, N m]


@wp.func
def mass_matrix(mass: float, r_g: wp.vec3, inertia: wp.mat33, M_A: mat66) -> mat66:
    """M_RB + M_A about the body origin, with inertia about the body origin (Fossen 2021, eq. 3.49)."""
    M = mat66()
    S = mass * wp.skew(r_g)
    for i in range(3):
        for j in range(3):
            diagonal = wp.where(i == j, mass, 0.0)
            M[i, j] = M_A[i, j] + diagonal
            M[i, j + 3] = M_A[i, j + 3] - S[i, j]
            M[i + 3, j] = M_A[i + 3, j] + S[i, j]
            M[i + 3, j + 3] = M_A[i + 3, j + 3] + inertia[i, j]
    return M


@wp.kernel(enable_backward=False)
def refresh_plant(plant: Plant, substep: float, mask: wp.array(dtype=int), world_offset: int):
    """Bring the derived parameters up to date in the worlds where mask is not 0: M_inv and the lag's alpha.

    Args:
        plant: Parameters.
        substep: Physics step [s].
        mask: Which worlds, by world.
        world_offset: First world of this launch.
    """
    i, v = wp.tid()
    w = world_offset + i
    if mask[w] == 0:
        return
    M = mass_matrix(plant.mass[w, v], plant.r_g[w, v], plant.inertia[w, v], plant.M_A[w, v])
    plant.M_inv[w, v] = invert_spd(M)
    alpha = vec8()
    tau = plant.time_constant[w, v]
    for k in range(MAX_THRUSTERS):
        alpha[k] = wp.where(tau[k] > 0.0, 1.0 - wp.exp(-substep / wp.max(tau[k], 1.0e-9)), 1.0)
    plant.alpha[w, v] = alpha
