"""The midpoint rule with one evaluation of the forces per substep: order 2, and stable for stiff damping.

A substep h from (x, q, nu) advances the pose by half a step, extrapolates the twist, and uses the exact mean
thrust T:

    nu_m = nu + e h (g + r_c),   g = r + G T,   e = 1/2 + (h |ω|)²/4
    a    = nu_dot(x + h/2 x_dot, q + h/2 q_dot, nu_m, T, t + h/2)
    nu'  = nu + h a',   a' = g + (1 + θ)⁻¹ (a - g),   θ_i = c h (M⁻¹)_ii d_i
    x'   = x + h/2 (x_dot + x_dot'),   q' = q ⊗ exp(h (ω + ω')/4),   r' = a' - G T

r is the mean acceleration of the last substep without thrust and contacts, r_c that by contacts (that by
walls at most until nu_m is 0), G = M⁻¹ B, and d_i the slope of the damping on axis i, d1 + 2 d2 |nu_r|, at
the point r_m where inertia is nearly diagonal. For forces that are linear in nu and θ = 0 this is the
two-step Adams-Bashforth method.

Order: r differs by O(h) from its value one step later, so nu_m differs by O(h²) from the twist at mid-step,
and a' differs from a by θ (a - g) = O(h) O(h): the error of a substep is O(h³). The first substep of an
episode is computed twice, the first time for r alone. The excess of e over 1/2 is O(h²) too.

Damping: for nu_dot = -λ nu, z = h λ, and θ = c z, two steps are related by

    (1 + θ) (nu'' - nu') = -z (3/2 nu' - 1/2 nu) + θ (nu' - nu)

which is unstable from z = 1 if θ = 0. With θ the growth factor is -1 at z = 1 + 2 c z, never for c >= 1/2,
and for z to infinity the factors solve s² - (2 - 3/(2c)) s + 1 - 1/(2c) = 0: |s| = 0.41 at c = 0.6, which
leaves a margin of a fifth for underestimated d_i. c = 1/2 would be the trapezoidal rule.

Rotation: for nu_dot = i f nu the two-step method grows by (f h)⁴/4 a step, and e = 1/2 + ε reduces that by ε
(f h)². In a body that rotates at ω, vectors rotate at |ω| in body axes: the e above cancels this growth, and
overcompensates it for slower rotations.

Contacts: stiff and short, they are not extrapolated. Near a wall or dock the a' of a substep is kept
constant, and the vehicle moves under a' and the contact accelerations by the leapfrog rule (half a drift, a
kick, half a drift) in shorter steps.
"""

# mypy: disable-error-code="no-any-return,operator"

import warp as wp

from finssim.physics.damping import twist_at
from finssim.physics.inertia import solve_spd
from finssim.physics.plant import VehicleParameters, mass_matrix
from finssim.physics.types import angular, symmetric_times, vec6

WALL_STEP = 0.0125
"""Longest step in which contacts with walls are integrated [s]; a substep near a wall is divided
accordingly."""
DOCK_STEP = 0.005
"""Longest step in which contacts are integrated if there is a dock, whose springs are stiffer [s]."""


@wp.struct
class StateDerivative:
    """Result of the equation of motion in one state."""

    nu_dot: vec6  # body frame [m/s², rad/s²]
    relaxation: vec6  # ratio θ of each axis
    wet: float  # wet fraction of the vehicle's volume


@wp.struct
class ContactLoads:
    """Wrench and forces of walls, a dock and the solids of a world on a vehicle."""

    tau: vec6  # wrench about the body origin, body frame [N, N m]
    push: float  # magnitude of the dock's force [N]
    strike: float  # magnitude of the force of the world's solids [N]


@wp.func
def lead_of(nu: vec6, h: float) -> float:
    """Return the fraction e of a substep h [s] over which the twist nu, body frame [m/s, rad/s], is
    extrapolated.

    e = 1/2 + (h |ω|)²/4
    """
    omega = angular(nu)
    return 0.5 + 0.25 * h * h * wp.dot(omega, omega)


@wp.func
def relaxation_of(plant: wp.array2d(dtype=VehicleParameters), w: int, v: int, nu_r: vec6) -> vec6:
    """Return θ [-] of each axis at the twist nu_r relative to the water, body frame [m/s, rad/s]; see
    `refresh_plant`."""
    nu_h = wp.abs(twist_at(nu_r, plant[w, v].r_m))
    theta = plant[w, v].relax_1 + wp.cw_mul(plant[w, v].relax_2, nu_h)
    return theta + (nu_h[0] + nu_h[1] + nu_h[2]) * plant[w, v].relax_v


@wp.func
def relaxed(nu_dot: vec6, guess: vec6, theta: vec6, r: wp.vec3) -> vec6:
    """Return (nu_dot + θ guess) / (1 + θ) on each axis of the point r, where inertia and damping are nearly
    diagonal.

    Args:
        nu_dot: Derivative of the twist in the middle of the substep, body frame [m/s², rad/s²].
        guess: Extrapolated derivative, g in the module docstring [m/s², rad/s²].
        theta: θ of each axis at r [-].
        r: The point, body frame [m].

    Returns:
        Derivative of the twist over the substep, body frame [m/s², rad/s²].
    """
    change = twist_at(nu_dot - guess, r)
    return guess + twist_at(wp.cw_div(change, theta + vec6(1.0, 1.0, 1.0, 1.0, 1.0, 1.0)), -r)


@wp.func
def yielding(plant: wp.array2d(dtype=VehicleParameters), w: int, v: int, wet: float, tau: vec6) -> vec6:
    """Return the acceleration by an added wrench tau [N, N m] of a vehicle with the wet fraction `wet`, body
    frame."""
    if wet == 1.0:
        return symmetric_times(plant[w, v].M_inv, tau)
    M = mass_matrix(plant[w, v].mass, plant[w, v].r_g, plant[w, v].inertia, wet * plant[w, v].M_A)
    return solve_spd(M, tau)
