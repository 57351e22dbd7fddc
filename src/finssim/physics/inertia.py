"""Inertial terms: Coriolis and centripetal wrench of the rigid body and of the added mass."""

# mypy: disable-error-code="arg-type,operator"

import warp as wp

from finssim.physics.types import angular, join, linear, mat66, mat66d, vec6, vec6d, vec9


@wp.func
def coriolis_wrench(momentum: vec6, nu: vec6) -> vec6:
    """Return the Coriolis and centripetal wrench C(nu) nu of any symmetric 6x6 inertia.

    C(nu) nu = [ω × p ;  v × p + ω × h],   [p; h] = M nu      (Kirchhoff; Fossen 2021, theorem 3.2)

    Args:
        momentum: M nu, linear and angular momentum about the body origin, body frame [kg m/s, kg m²/s].
        nu: Twist that the momentum belongs to, body frame [m/s, rad/s]; relative to the water for added mass.

    Returns:
        C(nu) nu, body frame [N, N m]; it does no work on nu.
    """
    omega = angular(nu)
    p = linear(momentum)
    return join(wp.cross(omega, p), wp.cross(linear(nu), p) + wp.cross(omega, angular(momentum)))


@wp.func
def rigid_body_momentum(mass: float, r_g: wp.vec3, inertia: wp.mat33, nu: vec6) -> vec6:
    """Return the momentum M_RB nu about the body origin.

    Args:
        mass: Dry mass [kg].
        r_g: Centre of gravity from the body origin, body frame [m].
        inertia: Inertia about the body origin, body axes [kg m²].
        nu: Twist of the body, body frame [m/s, rad/s].

    Returns:
        Linear and angular momentum, body frame [kg m/s, kg m²/s].
    """
    v = linear(nu)
    omega = angular(nu)
    return join(mass * (v + wp.cross(omega, r_g)), inertia * omega + mass * wp.cross(r_g, v))


@wp.func
def symmetric_inertia(x: vec9) -> wp.mat33:
    """Return the symmetric matrix of the last six numbers of x [kg m²]: xx, yy, zz, xy, xz, yz."""
    return wp.mat33(x[3], x[6], x[7], x[6], x[4], x[8], x[7], x[8], x[5])


@wp.func
def water_acceleration_wrench(
    M_A: mat66,
    r_b: wp.vec3,
    water_b: wp.vec3,
    rate_at_body: wp.vec3,
    material_acceleration: wp.vec3,
    omega: wp.vec3,
    displaced: float,
) -> vec6:
    """Return the wrench of accelerating water on a body: M_A d(nu_c)/dt and the Froude-Krylov force.

    M_A [a_x - ω × v_c; 0] + [m_w a_c; r_b × m_w a_c],  a_x = (∂/∂t + x_dot·∇) v_c,  a_c = (∂/∂t + v_c·∇) v_c

    The second part is the pressure gradient that accelerates the water itself: because of it, a neutrally buoyant body
    at rest relative to the water stays at rest relative to it, whatever its added mass.

    Args:
        M_A: Added mass about the body origin [kg, kg m, kg m²].
        r_b: Centre of buoyancy, body frame [m].
        water_b: Velocity of the water v_c, body frame [m/s].
        rate_at_body: Rate of the water's velocity at the moving body: a_x, body frame [m/s²].
        material_acceleration: Acceleration of the water a_c, body frame [m/s²].
        omega: Angular velocity of the body, body frame [rad/s].
        displaced: Mass of the displaced water, m_w [kg].

    Returns:
        Wrench about the body origin, body frame [N, N m].
    """
    f = displaced * material_acceleration
    return M_A * join(rate_at_body - wp.cross(omega, water_b), wp.vec3(0.0)) + join(f, wp.cross(r_b, f))


@wp.func
def invert_spd(M: mat66) -> mat66:
    """Return the inverse of a symmetric positive definite 6x6 matrix, by Gauss-Jordan elimination in float64.

    A positive definite matrix needs no pivoting. With float64, six digits of the result are correct at the condition
    numbers of real vehicles (up to 1e8).
    """
    A = mat66d()
    X = mat66d()
    for i in range(6):
        for j in range(6):
            A[i, j] = wp.float64(M[i, j])
            X[i, j] = wp.float64(0.0)
        X[i, i] = wp.float64(1.0)
    for k in range(6):
        pivot = wp.float64(1.0) / A[k, k]
        for j in range(6):
            A[k, j] = A[k, j] * pivot
            X[k, j] = X[k, j] * pivot
        for i in range(6):
            if i != k:
                factor = A[i, k]
                for j in range(6):
                    A[i, j] = A[i, j] - factor * A[k, j]
                    X[i, j] = X[i, j] - factor * X[k, j]
    out = mat66()
    for i in range(6):
        for j in range(6):
            out[i, j] = wp.float32(wp.float64(0.5) * (X[i, j] + X[j, i]))
    return out


@wp.func
def solve_spd(M: mat66, b: vec6) -> vec6:
    """Return x with M x = b for a symmetric positive definite M, by elimination in float64; see `invert_spd`.

    The unit of x is the unit of b divided by the unit of M.
    """
    A = mat66d()
    x = vec6d()
    for i in range(6):
        x[i] = wp.float64(b[i])
        for j in range(6):
            A[i, j] = wp.float64(M[i, j])
    # Warp unrolls loops of constant length, so conditions on their counters have no cost.
    pivots = vec6d()
    for k in range(6):
        pivot = wp.float64(1.0) / A[k, k]
        pivots[k] = pivot
        for i in range(6):
            if i > k:
                factor = pivot * A[k, i]
                x[i] = x[i] - factor * x[k]
                for j in range(6):
                    if j >= i:
                        A[i, j] = A[i, j] - factor * A[k, j]
    out = vec6()
    for n in range(6):
        i = 5 - n
        total = x[i]
        for j in range(6):
            if j > i:
                total = total - A[i, j] * x[j]
        x[i] = total * pivots[i]
        out[i] = wp.float32(x[i])
    return out
