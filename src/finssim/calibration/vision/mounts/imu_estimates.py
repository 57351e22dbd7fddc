"""Estimates of an IMU's mounting with their intervals, and what the motion leaves open."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.fit import Estimate

__all__ = ["UNSURE", "imu_advice", "imu_estimates"]

Array = NDArray[np.float64]

UNSURE = math.radians(5.0)
"""Half width of the 95 % interval of an angle beyond which it does not count as identified."""


def imu_estimates(theta: Array, ends: Array) -> dict[str, Estimate]:
    """By name.

    Args:
        theta: Turn about the body axes [rad] (3), gyro bias [rad/s] (3) and, if it was free, the time offset [s].
        ends: Of the 95 % intervals, (6 or 7, 2).
    """
    found = {}
    for i, axis in enumerate("xyz"):
        half = 0.5 * (ends[i, 1] - ends[i, 0])
        sure = bool(half < UNSURE)
        note = (
            "" if sure else f"the vehicle hardly turns about any axis but {axis}: this angle keeps the file's"
        )
        low, high = np.degrees(ends[i])
        found[f"imu.turn_{axis}"] = Estimate(
            name=f"imu.turn_{axis}",
            estimate=float(np.degrees(theta[i])),
            ci95=(float(low), float(high)),
            unit="deg",
            identifiable=sure,
            note=note,
        )
    for i, axis in enumerate("xyz", start=3):
        name = f"imu.gyro_bias_{axis}"
        ci = (float(ends[i, 0]), float(ends[i, 1]))
        found[name] = Estimate(
            name=name,
            estimate=float(theta[i]),
            ci95=ci,
            unit="rad/s",
            identifiable=bool(np.isfinite(ci).all()),
        )
    if len(theta) > 6:
        ci = (float(ends[6, 0]), float(ends[6, 1]))
        found["imu.time_offset"] = Estimate(
            name="imu.time_offset",
            estimate=float(theta[6]),
            ci95=ci,
            unit="s",
            identifiable=bool(ci[1] - ci[0] < 0.2),
        )
    return found


def imu_advice(estimates: dict[str, Estimate], rejected: float) -> tuple[str, ...]:
    """Sentences on what is not told; `rejected` is the share of windows without weight."""
    sentences = []
    unsure = [axis for axis in "xyz" if not estimates[f"imu.turn_{axis}"].identifiable]
    if unsure:
        sentences.append(
            f"the motion does not tell how the IMU is turned about body {' and '.join(unsure)}: rock the "
            "vehicle about at least two axes, by 10 degrees and more"
        )
    if rejected > 0.1:
        sentences.append(
            f"{100.0 * rejected:.0f} % of the windows disagree and have no weight: look at the attitude"
        )
    return tuple(sentences)
