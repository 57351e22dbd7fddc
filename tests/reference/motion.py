"""The equation of motion of one vehicle, all three models, over a batch of states.

M_RB nu_dot + C_RB(nu) nu + M_A nu_r_dot + C_A(nu_r) nu_r + D(nu_r) nu_r + g = tau + tau_FK    (Fossen 2021, chapter 10)
"""

from dataclasses import dataclass

import numpy as np

from reference.body import (
    added_mass_coriolis,
    rigid_body_coriolis,
    rigid_body_mass,
    rotation,
    skew,
    times,
    transformation,
)
from reference.hull import displacement, drag, unsigned_cross
from reference.water import flow


@dataclass(frozen=True)
class Numbers:
    """Parameters of a vehicle in the equation, float64, about the body origin."""

    density: float
    gravity: float
    mass: float
    r_g: np.ndarray
    inertia_g: np.ndarray
    volume: float
    r_b: np.ndarray
    half_height: float
    M_RB: np.ndarray
    M_A: np.ndarray
    r_h: np.ndarray
    D1: np.ndarray
    D2: np.ndarray
    Du: np.ndarray
    form: float
    skin: float
    corners: np.ndarray | None


def numbers(vehicle, model):
    """Read a vehicle."""
    body, chosen = vehicle.body, vehicle.hydrodynamics[model]
    r_g, r_h = np.array(body.center_of_gravity, float), np.array(chosen.reference_point, float)
    inertia_g = np.array(body.inertia, float)
    H = transformation(r_h)
    M_A = H.T @ np.array(chosen.added_mass, float) @ H * (model != "simplified")
    zero = np.zeros((6, 6))
    corners = None
    if model == "mesh":
        vertices, faces = vehicle.hull_mesh()
        corners = vertices[faces]
    return Numbers(
        vehicle.water.density, vehicle.water.gravity, body.mass, r_g, inertia_g,
        body.displaced_volume, np.array(body.center_of_buoyancy, float), body.surface_half_height,
        rigid_body_mass(body.mass, r_g, inertia_g), M_A, r_h,
        *(np.array(getattr(chosen, name, zero), float) for name in
          ("linear_damping", "quadratic_damping", "surge_damping")),
        getattr(chosen, "form_drag", 0.0), getattr(chosen, "skin_drag", 0.0), corners,
    )  # fmt: skip


def wrench_of_force(r, force):
    """Return [F; r × F]."""
    return np.concatenate([force, np.cross(r, force)], axis=-1)


def damping(n, nu_r):
    """Return the wrench about the body origin of the damping matrices, which apply at r_h."""
    H = transformation(n.r_h)
    nu_h = nu_r @ H.T
    D = n.D1 + n.D2 * np.abs(nu_h)[..., None, :] + n.Du * np.abs(nu_h[..., :1, None])
    return -times(D, nu_h) @ H, times(np.abs(D), np.abs(nu_h)) @ np.abs(H)


def coriolis_size(M, nu):
    """Return the magnitudes of the terms of C(nu) nu without cancellation: |ω| ⊗ |p| and |v| ⊗ |p| + |ω| ⊗
    |h|."""
    momentum = np.abs(nu) @ np.abs(M).T
    v, omega, p, h = np.abs(nu[:, :3]), np.abs(nu[:, 3:]), momentum[:, :3], momentum[:, 3:]
    return np.concatenate(
        [unsigned_cross(omega, p), unsigned_cross(v, p) + unsigned_cross(omega, h)], axis=-1
    )


def submersion(n, height):
    """Return the submerged share of the volume from the height of the centre of buoyancy.

    It is 0 above half_height and 1 below it.
    """
    s = np.clip((n.half_height - height) / (2.0 * n.half_height), 0.0, 1.0)
    return 3.0 * s**2 - 2.0 * s**3


DEEP = np.array([[0.0, 0.0, 1.0]]), np.array([-1e3])
"""Normal and height of a water surface far above the body."""


def growth_under_water(n, model, up, surface, height, height_b, nu_r, dt=1e-6):
    """Return the rate of the submerged share of the volume [1/s].

    It is a central difference along the motion through the water.

    Args:
        n: Result of `numbers`.
        model: calibrated, mesh or simplified.
        up: World z axis in the body frame (N, 3).
        surface: Normal of the water surface in the body frame (N, 3).
        height: Height of the body origin above that plane (N,).
        height_b: Height of the centre of buoyancy above the surface, straight up (N,).
        nu_r: Velocity relative to the water (N, 6).
        dt: Time step of the difference [s].
    """

    def share(t):
        if model == "mesh":
            turned = surface - t * np.cross(nu_r[:, 3:], surface)
            moved = height + t * (surface * nu_r[:, :3]).sum(-1)
            return displacement(n.corners, turned, moved)[0]
        speed = (up * (nu_r[:, :3] + np.cross(nu_r[:, 3:], n.r_b))).sum(-1)
        return submersion(n, height_b + t * speed)

    whole = displacement(n.corners, *DEEP)[0] if model == "mesh" else 1.0
    return (share(dt) - share(-dt)) / (2.0 * dt * whole)


def acceleration(n, model, position, q, nu, tau, water=None, t=0.0, thrust=None):
    """Return nu_dot, and a bound of the sum of its terms' magnitudes, for rounding.

    Args:
        n: Result of `numbers`.
        model: calibrated, mesh or simplified.
        position: Position, world frame (N, 3).
        q: Attitude, xyzw (N, 4).
        nu: Velocity (N, 6).
        tau: Other wrenches about the body origin, body frame (N, 6).
        water: `finssim.sim.Water` without drift; still if None.
        t: Time [s].
        thrust: Wrench of the thrusters (N, 6), which fades with the emerged part of the volume.

    Returns:
        nu_dot (N, 6) and |M⁻¹| |M| |M⁻¹| Σ |wrenches| (N, 6).
    """
    R = rotation(q)
    Rt = np.swapaxes(R, -1, -2)
    up = R[..., 2, :]
    N = len(nu)
    elevation, surface, height = np.zeros(N), up, position[:, 2]
    v_c, a_x, a_c, G_b = np.zeros((N, 3)), np.zeros((N, 3)), np.zeros((N, 3)), np.zeros((N, 3, 3))
    if water is not None:
        around = flow(water, n.gravity, position, t)
        elevation, surface = around.elevation, times(Rt, around.normal)
        height = around.normal[:, 2] * (position[:, 2] - elevation)
        v_c, local = times(Rt, around.velocity), around.acceleration
        # Rate of the water's velocity due to the body's motion, and due to the water's own.
        a_x = times(Rt, local + times(around.gradient, times(R, nu[:, :3])))
        a_c = times(Rt, local + times(around.gradient, around.velocity))
        G_b = Rt @ around.gradient @ R
    nu_r = nu - np.concatenate([v_c, np.zeros((N, 3))], -1)
    omega = nu[:, 3:]

    terms = [tau, wrench_of_force(n.r_g, -n.mass * n.gravity * up)]
    if model == "mesh":
        whole = displacement(n.corners, *DEEP)
        volume, center = displacement(n.corners, surface, height)
        wet = volume / whole[0]
        displaced = n.density * n.volume * wet
        terms.append(wrench_of_force(center - whole[1] + n.r_b, displaced[:, None] * n.gravity * up))
        tau_D, size_D = drag(n.corners, surface, height, nu, v_c, G_b, n.density, n.form, n.skin)
    else:
        wet = submersion(n, position[:, 2] + up @ n.r_b - elevation)
        displaced = n.density * n.volume * wet
        terms.append(wrench_of_force(n.r_b, displaced[:, None] * n.gravity * up))
        tau_D, size_D = (wet[:, None] * x for x in damping(n, nu if model == "simplified" else nu_r))
    if thrust is not None:
        terms.append(wet[:, None] * thrust)
    terms.append(-times(rigid_body_coriolis(n.mass, n.r_g, n.inertia_g, nu), nu))
    sizes = [coriolis_size(n.M_RB, nu), size_D]
    if model != "simplified":
        v_c_dot = a_x - times(skew(omega), v_c)  # in the turning body frame
        height_b = position[:, 2] + up @ n.r_b - elevation
        growth = np.maximum(growth_under_water(n, model, up, surface, height, height_b, nu_r), 0.0)
        terms += [
            -wet[:, None] * times(added_mass_coriolis(n.M_A, nu_r), nu_r),
            wet[:, None] * times(n.M_A, np.concatenate([v_c_dot, np.zeros((N, 3))], -1)),
            wrench_of_force(n.r_b, displaced[:, None] * a_c),
            -growth[:, None] * times(n.M_A, nu_r),
        ]
        sizes.append(coriolis_size(n.M_A, np.abs(nu_r) + np.abs(nu)))
    if thrust is not None:
        sizes.append(np.abs(thrust))  # the engine adds and removes the effect of submerged thrusters
    total = sum(terms) + tau_D
    size = sum(np.abs(x) for x in terms) + sum(sizes)
    M = n.M_RB + wet[:, None, None] * n.M_A
    M_inv = np.linalg.inv(M)
    A = np.abs(M_inv)
    return times(M_inv, total), times(A @ np.abs(M) @ A, size)


def energy(n, model, position, q, nu):
    """Return kinetic energy with added mass plus potential energy of weight and buoyancy, in still water (N,) [J].

    T + m g z_g + U_b, with T = ½ nuᵀ (M_RB + s M_A) nu of the wet share s, and U_b the work against buoyancy:
    -ρ g ∫ z dV over the wet hull, or of the faded volume -ρ g V ∫ s dz; a hull whose centroid is not the centre of
    buoyancy is shifted by the difference, if it is submerged.
    """
    R = rotation(q)
    up = R[..., 2, :]
    if model == "mesh":
        wet = displacement(n.corners, up, position[:, 2])[0] / displacement(n.corners, *DEEP)[0]
    else:
        wet = submersion(n, position[:, 2] + up @ n.r_b)
    kinetic = 0.5 * np.einsum("ni,nij,nj->n", nu, n.M_RB + wet[:, None, None] * n.M_A, nu)
    weight = n.mass * n.gravity * (position[:, 2] + up @ n.r_g)
    full = n.density * n.gravity * n.volume
    if model == "mesh":
        whole = displacement(n.corners, *DEEP)
        volume, center = displacement(n.corners, up, position[:, 2])
        height = position[:, 2] + np.einsum("ni,ni->n", up, center) + up @ (n.r_b - whole[1][0])
        return kinetic, weight, -full * volume / whole[0] * height
    s = (n.half_height - position[:, 2] - up @ n.r_b) / (2.0 * n.half_height)
    c = np.clip(s, 0.0, 1.0)
    # ∫ s(z) dz from above: 2 H (c³ - c⁴/2), plus 2 H (s - 1) where wholly under water.
    return kinetic, weight, full * 2.0 * n.half_height * (c**3 - 0.5 * c**4 + np.maximum(s - 1.0, 0.0))
