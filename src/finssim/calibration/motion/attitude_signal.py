"""The attitude of a trial on a grid, and the angular rates that it implies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.motion.smoothing import smooth
from finssim.calibration.trials.trial import Trial
from finssim.geometry.rotations import quat_conjugate, quat_from_euler, quat_multiply, quat_rotate

__all__ = ["AttitudeSignal", "attitude_samples", "attitude_signal"]

Array = NDArray[np.float64]

QUATERNION = ("qx", "qy", "qz", "qw")
EULER = ("roll", "pitch", "yaw")


@dataclass(frozen=True, kw_only=True)
class AttitudeSignal:
    """Attitude on a grid of m times, as far as it is known."""

    quaternion: Array
    """Body to world, (m, 4); NaN where unknown, and everywhere if the tilt is not measured."""
    rates: Array
    """omega from the derivative of the attitude, body frame [rad/s], (m, 3); NaN where unknown."""
    rates_std: Array
    """Standard deviation of `rates` [rad/s], (3,)."""
    rates_slope_std: Array
    """Standard deviation of the slope of `rates` [rad/s²], (3,)."""
    turn: Array
    """Rotation to use for vectors: `quaternion`, or level with the measured heading, (m, 4); NaN where unknown."""
    heading: bool
    """Whether the heading is measured; where it is not, `quaternion` has heading 0 and only its tilt means anything."""
    tilt: bool
    """Whether roll and pitch are measured."""


def attitude_samples(trial: Trial) -> tuple[Array, Array, tuple[str, ...]]:
    """Attitude as sampled.

    Returns:
        Times (n,) [s], quaternions (n, 4) with 0 for angles that are not measured, and which of roll, pitch, yaw are.
    """
    if trial.has(*QUATERNION):
        q = np.stack([trial.channels[name] for name in QUATERNION], axis=-1)
        good = np.isfinite(q).all(axis=1)
        return trial.t[good], q[good], EULER
    given = tuple(name for name in EULER if trial.has(name))
    if "roll" in given and "pitch" not in given or "pitch" in given and "roll" not in given:
        given = tuple(name for name in given if name == "yaw")  # half a tilt is no attitude
    if not given:
        return np.empty(0), np.empty((0, 4)), ()
    t = max((trial.series(name)[0] for name in given), key=len)
    t = t[
        (t >= max(trial.series(n)[0][0] for n in given)) & (t <= min(trial.series(n)[0][-1] for n in given))
    ]
    angles = {name: np.interp(t, trial.series(name)[0], np.unwrap(trial.series(name)[1])) for name in given}
    zero = np.zeros(len(t))
    q = quat_from_euler(*(angles.get(name, zero) for name in EULER))
    flips = np.cumsum(np.sum(q[1:] * q[:-1], axis=-1) < 0.0) % 2 == 1
    q[1:][flips] *= -1.0
    return t, q, given


def attitude_signal(trial: Trial, at: Array, max_gap: float | None = None) -> AttitudeSignal:
    """The attitude of a trial, smoothed, at given times (m,)."""
    t, q, given = attitude_samples(trial)
    nothing = np.full((len(at), 4), np.nan)
    if len(t) < 2:
        return AttitudeSignal(
            quaternion=nothing,
            rates=nothing[:, :3],
            rates_std=np.full(3, np.nan),
            rates_slope_std=np.full(3, np.nan),
            turn=nothing,
            heading=False,
            tilt=False,
        )
    s = smooth(t, q, at, order=3, max_gap=max_gap, together=True)
    length = np.linalg.norm(s.value, axis=1, keepdims=True)
    quaternion = s.value / length
    # q_dot = q omega / 2, with omega in body axes; the length of q drops out of the vector part.
    rates = 2.0 * quat_multiply(quat_conjugate(quaternion), s.slope / length)[:, :3]
    stds = 2.0 * np.mean([s.slope_std, s.bend_std], axis=1)
    tilt, heading = "roll" in given, "yaw" in given
    measured = np.array([tilt, tilt, heading])
    rates[:, ~measured] = np.nan
    return AttitudeSignal(
        quaternion=quaternion if tilt else nothing,
        rates=rates,
        rates_std=np.where(measured, stds[0], np.nan),
        rates_slope_std=np.where(measured, stds[1], np.nan),
        turn=quaternion,
        heading=heading,
        tilt=tilt,
    )


def up_in_body(quaternion: Array) -> Array:
    """World z in the body frame, (m, 4) -> (m, 3)."""
    return quat_rotate(quat_conjugate(quaternion), np.array([0.0, 0.0, 1.0]))
