"""The physical parameters of a simulated vehicle, as one Warp struct; kernels take them by (world, vehicle)."""

# mypy: disable-error-code="index,misc,no-untyped-def,operator,untyped-decorator,valid-type"

import warp as wp

from finssim.physics.inertia import invert_spd
from finssim.physics.types import MAX_THRUSTERS, mat66, mat68, vec6, vec8


@wp.struct
class VehicleParameters:
    """Parameters of one vehicle of one world. Randomisation writes them; nothing is ever recompiled."""

    mass: float  # [kg]
    r_g: wp.vec3  # centre of gravity, body frame [m]
    inertia: wp.mat33  # about the body origin, body axes [kg m²]
    volume: float  # displaced when submerged [m³]
    r_b: wp.vec3  # centre of buoyancy, body frame [m]
    surface_half_height: float  # [m]
    half_size: wp.vec3  # half extents of the envelope [m]
    M_A: mat66  # added mass about the body origin
    M_inv: mat66  # inverse of M_RB + M_A
    r_h: wp.vec3  # point where the damping coefficients hold, body frame [m]
    D1: mat66
    D2: mat66
    Du: mat66
    form_drag: float
    skin_drag: float
    hull: int  # which hull mesh, for the mesh model
    B: mat68  # thruster forces to the wrench about the body origin
    force_min: vec8  # [N]
    force_max: vec8
    dead_minus: vec8  # commands between dead_minus and dead_plus give nothing [N]
    dead_plus: vec8
    gain: vec8  # delivered over nominal thrust; 0 is a dead thruster
    time_constant: vec8  # [s]
    slew: vec8  # [N/s] or, for a speed lag, [rad/s²]
    alpha: vec8  # 1 - exp(-substep / time_constant), kept by `refresh_plant`
    delay: float  # command delay [s]
    speed_lag: int  # 1: lag and slew act on propeller speed, 0: on force
    c_plus: vec8  # [N s²/rad²]
    c_minus: vec8


@wp.struct
class VehicleCommand:
    """What acts on one vehicle from outside."""

    thrust: vec8  # commanded thruster force [N]
    disturbance: vec6  # extra wrench about the body origin, body frame [N, N m]


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
def refresh_plant(
    plant: wp.array2d(dtype=VehicleParameters), substep: float, mask: wp.array(dtype=int), world_offset: int
):
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
    M = mass_matrix(plant[w, v].mass, plant[w, v].r_g, plant[w, v].inertia, plant[w, v].M_A)
    plant[w, v].M_inv = invert_spd(M)
    alpha = vec8()
    tau = plant[w, v].time_constant
    for k in range(MAX_THRUSTERS):
        alpha[k] = wp.where(tau[k] > 0.0, 1.0 - wp.exp(-substep / wp.max(tau[k], 1.0e-9)), 1.0)
    plant[w, v].alpha = alpha
