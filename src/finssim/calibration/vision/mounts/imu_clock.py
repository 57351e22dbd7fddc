"""How an IMU's clock lies to the pictures', by turns about the vertical: they need neither mounting nor tilt."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.fit import Estimate
from finssim.calibration.uncertainty import Evidence, intervals, trial_covariance
from finssim.calibration.vision.mounts.turns import Attitude
from finssim.geometry.rotations import quat_conjugate, quat_multiply, quat_to_rotvec

__all__ = ["imu_clock"]

Array = NDArray[np.float64]

LONGEST = 1.0
STEP = 0.02
FEWEST = 20
BLOCKS = 12
TUKEY = 4.685
ROUNDS = 8
UNSURE = 0.05
"""Half width of the 95 % interval beyond which the offset does not count as told [s]."""


def imu_clock(attitude: Attitude, up_p: Array, t: Array, vertical_rate: Array) -> Estimate | None:
    """What is to be added to the IMU's times, from turns between neighbouring pictures.

    n · log(R_2 R_1ᵀ) = ∫ ω · up dt over the same time, less a bias; ω and up in any one frame of the vehicle.

    Args:
        attitude: From the pixels; its tilt may be poor.
        up_p: n, upwards in the attitude's outer frame, (3,).
        t: Times of the IMU, increasing [s], (m,).
        vertical_rate: ω · up [rad/s], (m,).

    Returns:
        `imu.time_offset` [s], or None if there are too few pictures.
    """
    q = attitude.quaternion
    seen = quat_to_rotvec(quat_multiply(q[1:], quat_conjugate(q[:-1]))) @ up_p
    start, end = attitude.t[:-1], attitude.t[1:]
    known = (start > t[0] + LONGEST) & (end < t[-1] - LONGEST) & (end - start < 3.0)
    seen, start, end = seen[known], start[known], end[known]
    if len(seen) < FEWEST:
        return None
    heading = np.concatenate([[0.0], np.cumsum(0.5 * (vertical_rate[1:] + vertical_rate[:-1]) * np.diff(t))])

    def felt(offset: float) -> Array:
        return np.asarray(np.interp(end - offset, t, heading) - np.interp(start - offset, t, heading))

    trials = np.arange(-LONGEST, LONGEST + 1e-9, STEP)
    offset = float(min(trials, key=lambda x: np.sum(np.abs(seen - felt(x) - np.median(seen - felt(x))))))
    span, bias, A, residual, weight, sigma = end - start, 0.0, np.empty((0, 2)), seen, np.ones(len(seen)), 1.0
    for _ in range(ROUNDS):
        slope = (felt(offset + STEP / 4) - felt(offset - STEP / 4)) / (STEP / 2)
        A = np.column_stack([-span, slope])
        residual = seen - felt(offset) + bias * span
        sigma = max(1.4826 * float(np.median(np.abs(residual - np.median(residual)))), 1e-9)
        weight = np.clip(1.0 - (residual / (TUKEY * sigma)) ** 2, 0.0, None) ** 2
        root = np.sqrt(weight)
        step, *_ = np.linalg.lstsq(root[:, None] * A, root * residual, rcond=1e-9)
        bias, offset = bias + float(step[0]), offset + float(step[1])
    return _estimate(A, residual, weight / sigma**2, offset)


def _estimate(A: Array, residual: Array, weight: Array, offset: float) -> Estimate:
    parts = np.array_split(np.arange(len(A)), BLOCKS)
    evidence = Evidence(
        names=("bias", "offset"),
        normal=np.array([(A[p] * weight[p, None]).T @ A[p] for p in parts]),
        score=np.array([A[p].T @ (weight[p] * residual[p]) for p in parts]),
        unit="blocks",
    )
    half = float(intervals(np.zeros(2), trial_covariance(evidence))[1, 1])
    sure = math.isfinite(half) and half < UNSURE and abs(offset) <= LONGEST
    return Estimate(
        name="imu.time_offset",
        estimate=offset,
        ci95=(offset - half, offset + half),
        unit="s",
        identifiable=sure,
        note="" if sure else "the vehicle turns too evenly to tell the clocks apart: taken as 0",
    )
