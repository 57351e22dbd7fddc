"""Physical parameters of a simulated vehicle in one Warp struct; kernels index them by (world, vehicle)."""

# mypy: disable-error-code="no-untyped-call,return-value,index,misc,no-untyped-def,operator"
# mypy: disable-error-code="untyped-decorator,valid-type"

import warp as wp

from finssim.physics.inertia import invert_spd
from finssim.physics.types import MAX_THRUSTERS, mat66, mat68, vec6, vec8


@wp.struct
class VehicleParameters:
    """Parameters of one vehicle in one world. Randomisation changes their values without recompilation."""

    mass: float  # [kg]
    r_g: wp.vec3  # centre of gravity, body frame [m]
    inertia: wp.mat33  # about the body origin, body axes [kg m²]
    volume: float  # displaced when submerged [m³]
    r_b: wp.vec3  # centre of buoyancy, body frame [m]
    surface_half_height: float  # [m]
    half_size: wp.vec3  # half extents of the envelope [m]
    M_A: mat66  # added mass about the body origin [kg, kg m, kg m²]
    M_inv: mat66  # inverse of M_RB + M_A [1/kg, 1/(kg m), 1/(kg m²)]
    G: mat68  # M_inv B: thruster forces to acceleration, submerged [1/kg, 1/(kg m)]
    r_m: wp.vec3  # point about which inertia is nearly diagonal, body frame [m], computed by `refresh_plant`
    relax: vec6  # relaxation of a substep per slope of the damping [s/kg, s/(kg m²)], computed by `refresh_plant`
    relax_1: vec6  # contribution of linear damping to the relaxation [-], computed by `refresh_plant`
    relax_2: vec6  # contribution of quadratic damping, per speed on the same axis [s/m, s/rad]
    relax_v: vec6  # contribution of damping away from the origin, per linear speed [s/m]
    r_h: wp.vec3  # point at which the damping coefficients hold, body frame [m]
    D1: mat66  # linear damping at r_h [N s/m, N s, N m s]
    D2: mat66  # quadratic damping at r_h [N s²/m², N s²/m, N s², N m s²]
    form_drag: float  # form drag coefficient of the mesh model [-]
    skin_drag: float  # skin drag coefficient of the mesh model [-]
    hull: int  # index of the hull mesh, for the mesh model
    B: mat68  # thruster forces to the wrench about the body origin [-, m]
    force_min: vec8  # [N]
    force_max: vec8  # [N]
    dead_minus: vec8  # commands between dead_minus and dead_plus have no effect [N]
    dead_plus: vec8  # [N]
    play: vec8  # smallest difference from the target that moves the actuator, in its unit
    gain: vec8  # ratio of delivered to nominal thrust; 0 for a failed thruster
    time_constant: vec8  # [s]
    slew: vec8  # [N/s] or, for a speed lag, [rad/s²]
    alpha: vec8  # fraction 1 - exp(-substep / time_constant), computed by `refresh_plant`
    beta: vec8  # the same fraction for the mean over a substep, computed by `refresh_plant`
    delay: float  # command delay [s]
    speed_lag: int  # 1: lag and slew limit act on propeller speed, 0: on force
    c_plus: vec8  # [N s²/rad²]
    c_minus: vec8  # [N s²/rad²]


@wp.struct
class VehicleCommand:
    """Thruster commands and external wrench of one vehicle."""

    thrust: vec8  # commanded thruster force [N]; commanded value of other actuators [rad, m³ or m]
    disturbance: vec6  # extra wrench about the body origin, body frame [N, N m]


@wp.func
def mass_matrix(mass: float, r_g: wp.vec3, inertia: wp.mat33, M_A: mat66) -> mat66:
    """Return the mass matrix M_RB + M_A about the body origin                      (Fossen 2021, eq. 3.49)

    Args:
        mass: [kg].
        r_g: Centre of gravity, body frame [m].
        inertia: About the body origin, body axes [kg m²].
        M_A: Added mass about the body origin, body axes [kg, kg m, kg m²].

    Returns:
        Body axes [kg, kg m, kg m²].
    """
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


RELAXATION = 0.6
"""Weight c of implicit damping in a substep of the midpoint rule (see `finssim.sim.midpoint`)."""

DERIVED = ("M_inv", "G", "r_m", "relax", "relax_1", "relax_2", "relax_v", "alpha", "beta")
"""Fields of `VehicleParameters` that `refresh_plant` computes."""


@wp.kernel(enable_backward=False)
def refresh_plant(
    plant: wp.array2d(dtype=VehicleParameters), substep: float, mask: wp.array(dtype=int), world_offset: int
):
    """Update the derived parameters in the worlds where mask is not 0.

    In a substep the lag removes the fraction alpha = 1 - exp(-h/T) of the difference; averaged over the substep it
    removes beta = 1 - alpha T/h. Without a lag, T = 0, forces are linear between their samples: alpha = 1, beta = 1/2.

    Args:
        plant: Parameters.
        substep: Physics step h [s].
        mask: Not 0 in the worlds to update, by world.
        world_offset: First world of this launch.
    """
    i, v = wp.tid()
    w = world_offset + i
    if mask[w] == 0:
        return
    M = mass_matrix(plant[w, v].mass, plant[w, v].r_g, plant[w, v].inertia, plant[w, v].M_A)
    M_inv = invert_spd(M)
    plant[w, v].M_inv = M_inv
    plant[w, v].G = M_inv * plant[w, v].B
    alpha = vec8()
    beta = vec8()
    tau = plant[w, v].time_constant
    for k in range(MAX_THRUSTERS):
        alpha[k] = 1.0
        beta[k] = 0.5
        if tau[k] > 0.0:
            x = substep / tau[k]
            alpha[k] = 1.0 - wp.exp(-x)
            # Below x = 0.05 the difference is less accurate than its series x/2 - x²/6 + x³/24.
            beta[k] = wp.where(x > 0.05, 1.0 - alpha[k] / x, x * (0.5 - x * (1.0 / 6.0 - x / 24.0)))
    plant[w, v].alpha = alpha
    plant[w, v].beta = beta
    p = inertia_center(M)
    plant[w, v].r_m = p
    r = plant[w, v].r_h - p
    d1 = diagonal_at_origin(wp.get_diag(plant[w, v].D1), r)
    d2 = 2.0 * wp.get_diag(plant[w, v].D2)
    dv = diagonal_at_origin(d2, r) - d2
    H = twist_shift(p)
    weight = substep * wp.static(RELAXATION) * wp.get_diag(H * M_inv * wp.transpose(H))
    none = vec6()
    plant[w, v].relax = weight
    plant[w, v].relax_1 = wp.cw_mul(weight, wp.max(d1, none))
    plant[w, v].relax_2 = wp.cw_mul(weight, wp.max(d2, none))
    plant[w, v].relax_v = wp.cw_mul(weight, wp.max(dv, none))


@wp.func
def inertia_center(M: mat66) -> wp.vec3:
    """Return the point about which a 6x6 inertia M [kg, kg m, kg m²] hardly couples translation and rotation [m].

    It is the mean of the points of the two axes.
    """
    return 0.5 * wp.vec3(
        M[1, 5] / M[1, 1] - M[2, 4] / M[2, 2],
        M[2, 3] / M[2, 2] - M[0, 5] / M[0, 0],
        M[0, 4] / M[0, 0] - M[1, 3] / M[1, 1],
    )


@wp.func
def diagonal_at_origin(d: vec6, r: wp.vec3) -> vec6:
    """Return the diagonal of Hᵀ diag(d) H: of a matrix that is diagonal at the point r, about the origin.

    Its unit is that of d; r is in [m].
    """
    x = r[0] * r[0]
    y = r[1] * r[1]
    z = r[2] * r[2]
    return d + vec6(0.0, 0.0, 0.0, d[1] * z + d[2] * y, d[0] * z + d[2] * x, d[0] * y + d[1] * x)


@wp.func
def twist_shift(r: wp.vec3) -> mat66:
    """Return H with nu(at r) = H nu(at the origin): [[1, -S(r)], [0, 1]]."""
    H = wp.identity(n=6, dtype=float)
    S = wp.skew(r)
    for i in range(3):
        for j in range(3):
            H[i, j + 3] = -S[i, j]
    return H
