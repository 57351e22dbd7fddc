"""Currents, and linear waves from their potential φ = (A ω / k) cosh k(z+h) / sinh kh · sin θ."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Flow:
    """Water at points (..., 3) and one time, world frame."""

    velocity: np.ndarray
    acceleration: np.ndarray
    gradient: np.ndarray
    elevation: np.ndarray
    normal: np.ndarray


def flow(water, gravity, position, t):
    """Return the flow of a `finssim.sim.Water` without drift; above z = 0 it is that at z = 0.

    θ = k·x - ω t + φ0,  ∇φ = velocity,  ∂∇φ/∂t = acceleration,  η = A cos θ.
    """
    x = np.asarray(position, float)
    z = np.minimum(x[..., 2], 0.0)
    v = np.asarray(water.current) + z[..., None] * np.asarray(water.shear)
    a = np.zeros_like(x)
    G = np.zeros((*x.shape, 3)) + np.outer(water.shear, [0.0, 0.0, 1.0])
    eta = np.zeros(x.shape[:-1])
    slope = np.zeros((*x.shape[:-1], 2))
    h = water.depth
    for wave in water.waves:
        k = 2.0 * np.pi / wave.wavelength
        omega = np.sqrt(gravity * k * np.tanh(k * h))
        d = np.array([np.cos(wave.heading), np.sin(wave.heading)])
        theta = k * (x[..., :2] @ d) - omega * t + wave.phase
        b = wave.amplitude * omega / k / np.sinh(k * h)  # φ = b cosh k(z+h) sin θ
        C, S = np.cosh(k * (z + h)), np.sinh(k * (z + h))
        c, s = np.cos(theta), np.sin(theta)
        e = np.array([d[0], d[1], 1.0])
        v = v + b * k * np.stack([C * c, C * c, S * s], -1) * e
        a = a + b * k * omega * np.stack([C * s, C * s, -S * c], -1) * e
        hessian = np.empty((*x.shape, 3))
        hessian[..., :2, :2] = (-C * s)[..., None, None] * np.outer(d, d)
        hessian[..., 2, :2] = hessian[..., :2, 2] = (S * c)[..., None] * d
        hessian[..., 2, 2] = C * s
        G = G + b * k * k * hessian
        eta = eta + wave.amplitude * c
        slope = slope - (wave.amplitude * k * s)[..., None] * d
    normal = np.concatenate([-slope, np.ones((*slope.shape[:-1], 1))], -1)
    return Flow(v, a, G, eta, normal / np.linalg.norm(normal, axis=-1, keepdims=True))
