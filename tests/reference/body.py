"""Rotations, transformation of points, mass and Coriolis matrices (Fossen 2021, sections 2.2, 3.3 and appendix C)."""

import numpy as np


def skew(a):
    """S(a) with S(a) b = a × b, (..., 3, 3)."""
    a = np.asarray(a, float)
    S = np.zeros((*a.shape[:-1], 3, 3))
    S[..., 0, 1], S[..., 0, 2], S[..., 1, 2] = -a[..., 2], a[..., 1], -a[..., 0]
    return S - np.swapaxes(S, -1, -2)


def rotation(q):
    """R(q) = I + 2 η S(ε) + 2 S(ε)², body to world, for unit quaternions (ε, η) (..., 4)  (Fossen 2021, 2.2)."""
    q = np.asarray(q, float)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    S = skew(q[..., :3])
    return np.eye(3) + 2.0 * q[..., 3, None, None] * S + 2.0 * S @ S


def transformation(r):
    """H(r) = [[I, S(r)ᵀ], [0, I]]: the twist at r from the twist at the origin  (Fossen 2021, appendix C)."""
    H = np.eye(6)
    H[:3, 3:] = skew(np.asarray(r, float)).T
    return H


def rigid_body_mass(mass, r_g, inertia_g):
    """M_RB = H(r_g)ᵀ diag(m I, I_g) H(r_g) about the body origin  (Fossen 2021, section 3.3)."""
    H = transformation(r_g)
    M_g = np.zeros((6, 6))
    M_g[:3, :3], M_g[3:, 3:] = mass * np.eye(3), inertia_g
    return H.T @ M_g @ H


def rigid_body_coriolis(mass, r_g, inertia_g, nu):
    """C_RB(nu) = H(r_g)ᵀ [[m S(ω), 0], [0, -S(I_g ω)]] H(r_g), free of linear velocity  (Fossen 2021, section 3.3)."""
    omega = nu[..., 3:]
    H = transformation(r_g)
    C = np.zeros((*nu.shape[:-1], 6, 6))
    C[..., :3, :3] = mass * skew(omega)
    C[..., 3:, 3:] = -skew(omega @ np.asarray(inertia_g, float).T)
    return H.T @ C @ H


def added_mass_coriolis(M_A, nu_r):
    """C_A(nu_r) = [[0, -S(A11 v + A12 ω)], [-S(A11 v + A12 ω), -S(A21 v + A22 ω)]]  (Fossen 2021, theorem 3.2)."""
    momentum = nu_r @ M_A.T
    C = np.zeros((*nu_r.shape[:-1], 6, 6))
    C[..., :3, 3:] = C[..., 3:, :3] = -skew(momentum[..., :3])
    C[..., 3:, 3:] = -skew(momentum[..., 3:])
    return C


def times(A, x):
    """A x over a batch."""
    return (np.asarray(A) @ np.asarray(x)[..., None])[..., 0]
