"""Yaw from the gyro, corrected by what the camera sees (paper, eq. 15), with the gyro's bias as a second state.

Pure functions over a leading `...` batch; yaw is left positive, about the vertical.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from finssim.geometry.rotations import wrap_angle

__all__ = [
    "YawInnovation",
    "YawNoise",
    "YawState",
    "capped",
    "correct",
    "innovation",
    "predict",
    "restarted",
    "yaw_rate",
]

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class YawState:
    """What the filter knows."""

    yaw: Array
    """[rad], in [-pi, pi), (...)."""
    bias: Array
    """What the gyro shows too much of yaw rate [rad/s], (...)."""
    P: Array
    """Covariance of yaw and bias, (..., 2, 2)."""


@dataclass(frozen=True)
class YawNoise:
    """Errors of the yaw rate."""

    rate: float = 1e-3
    """Noise density of the rate [rad/s/√Hz]."""
    bias_walk: float = 2e-5
    """Of its bias [rad/s²/√Hz]."""


@dataclass(frozen=True)
class YawInnovation:
    """What a measured yaw says that the prediction did not."""

    residual: Array
    """The short way round [rad], (...)."""
    S: Array
    """Its variance [rad²], (...)."""
    mahalanobis: Array
    """Squared, (...)."""


def yaw_rate(q: npt.ArrayLike, r: npt.ArrayLike, roll: npt.ArrayLike, pitch: npt.ArrayLike) -> Array:
    """Rate of yaw from body rates.

    psi_dot = (q sin φ + r cos φ) / cos θ

    Body rates are p = φ_dot - ψ_dot sin θ, q = θ_dot cos φ + ψ_dot sin φ cos θ, r = -θ_dot sin φ + ψ_dot cos φ cos θ
    for R = R_z(ψ) R_y(θ) R_x(φ), whichever way z points: the formula is that of Fossen's axes, and in ours r, q and ψ
    turn left, nose down and left. The rate p about body x does not enter.

    Args:
        q: Angular rate about body y [rad/s], (...).
        r: Angular rate about body z [rad/s], (...).
        roll: φ [rad], (...).
        pitch: θ [rad], (...); not near ±90 degrees, where yaw is not defined.
    """
    q, r, roll, pitch = (np.asarray(a, float) for a in (q, r, roll, pitch))
    return np.asarray((q * np.sin(roll) + r * np.cos(roll)) / np.cos(pitch))


def predict(state: YawState, rate: Array | float, dt: float, noise: YawNoise) -> YawState:
    """Yaw a time later.

    ψ <- ψ + (ω_z - b) dt                                                              (paper, eq. 15)

    Args:
        state: Before.
        rate: Rate of yaw as measured [rad/s], (...).
        dt: Time that passes [s].
        noise: Errors of the rate.
    """
    # P <- F P F' + Q with F = [1 -dt; 0 1], written out: for one vehicle the products of matrices cost most.
    w, old = noise.bias_walk**2, state.P
    cross, bias = old[..., 0, 1], old[..., 1, 1]
    P = np.empty(old.shape)
    P[..., 0, 0] = old[..., 0, 0] + dt * (dt * bias - 2.0 * cross + noise.rate**2) + w * dt**3 / 3.0
    P[..., 0, 1] = P[..., 1, 0] = cross - dt * bias - 0.5 * w * dt**2
    P[..., 1, 1] = bias + w * dt
    return YawState(wrap_angle(state.yaw + (rate - state.bias) * dt), state.bias, P)


def innovation(state: YawState, yaw: Array | float, variance: Array | float) -> YawInnovation:
    """Compare a measured yaw [rad] of that variance [rad²] with the prediction, (...) each."""
    residual = wrap_angle(np.asarray(yaw, float) - state.yaw)
    S = np.asarray(state.P[..., 0, 0] + variance)
    return YawInnovation(residual, S, np.asarray(residual**2 / S))


def correct(state: YawState, found: YawInnovation, variance: Array | float) -> YawState:
    """The state after a measured yaw, in Joseph's form.

    ψ <- ψ + K (ψ_vis - ψ),  K = P / (P + R), and likewise the bias                     (paper, eq. 15)
    """
    K = state.P[..., :, 0] / found.S[..., None]
    kept = np.eye(2) - K[..., :, None] * np.array([1.0, 0.0])
    P = kept @ state.P @ np.swapaxes(kept, -1, -2)
    P = P + np.asarray(variance)[..., None, None] * K[..., :, None] * K[..., None, :]
    step = K * found.residual[..., None]
    return YawState(
        wrap_angle(state.yaw + step[..., 0]),
        np.asarray(state.bias + step[..., 1]),
        0.5 * (P + np.swapaxes(P, -1, -2)),
    )


def restarted(state: YawState, yaw: Array | float, variance: Array | float, bias_std: float) -> YawState:
    """Start yaw at a measurement; the bias is kept, with at least the doubt it had at power-on if `bias_std` > 0."""
    P = np.zeros(state.P.shape)
    P[..., 0, 0] = variance
    P[..., 1, 1] = np.maximum(state.P[..., 1, 1], bias_std**2)
    return YawState(wrap_angle(yaw), state.bias, P)


def capped(state: YawState, variance: float) -> YawState:
    """Yaw no less certain than `variance` [rad²]: its row and column are scaled down together."""
    scale = np.ones(state.P.shape[:-1])
    scale[..., 0] = np.sqrt(np.minimum(1.0, variance / state.P[..., 0, 0]))
    return YawState(state.yaw, state.bias, state.P * scale[..., :, None] * scale[..., None, :])
