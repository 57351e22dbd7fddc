"""Offset and scale of a pressure sensor against depths known by other means."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.fit import Estimate
from finssim.calibration.uncertainty import Evidence, intervals, trial_covariance

__all__ = ["SALT", "DepthFit", "fit_depth"]

Array = NDArray[np.float64]

SALT = 1.025
"""Density of sea water over that of fresh water: what a sensor set to the wrong one is wrong by."""

FEWEST = 5
BLOCKS = 12
TUKEY = 4.685
ROUNDS = 10
UNSURE_OFFSET = 0.02
"""Half width of the 95 % interval beyond which the offset does not count as told [m]."""

UNSURE_SCALE = 0.02
"""The same for the scale: less than what fresh and salt water differ by."""


@dataclass(frozen=True, kw_only=True)
class DepthFit:
    """reading = scale · depth + offset."""

    offset: float
    """[m]"""
    scale: float
    """1 where the depths span too little to tell."""
    estimates: dict[str, Estimate]
    """depth.offset [m] and depth.scale [-]."""
    span: float
    """Of the known depths [m]."""
    rms: float
    """Of what is left over, robust [m]."""
    rejected: int
    """Samples without weight."""
    advice: tuple[str, ...]


def fit_depth(
    known: ArrayLike, reading: ArrayLike, *, known_std: float = 0.0, blocks: int = BLOCKS
) -> DepthFit:
    """Offset, and scale if the depths span enough, by robust least squares (Tukey).

    The scale is told apart from 1 or kept at 1; then the offset is that of a sensor without an error of scale.

    Args:
        known: Depths of the pressure port below the surface [m], (n,), in order of time.
        reading: What the sensor said [m], (n,).
        known_std: An error that all known depths share, such as that of the water level [m]; widens the offset's
            interval.
        blocks: Consecutive parts whose disagreement gives the intervals.

    Raises:
        CalibrationError: Fewer than five pairs.
    """
    x, y = np.asarray(known, float), np.asarray(reading, float)
    good = np.isfinite(x) & np.isfinite(y)
    x, y = x[good], y[good]
    if len(x) < FEWEST:
        raise CalibrationError(f"{len(x)} pairs of known depth and reading, expected at least {FEWEST}")
    middle = float(x.mean())
    theta, half, weight, rms = _robust(np.column_stack([np.ones_like(x), x - middle]), y - x, blocks)
    told = bool(half[1] < UNSURE_SCALE)
    scale = 1.0 + theta[1] if told else 1.0
    if told:
        at_zero = np.column_stack([np.ones_like(x), x])
        theta, half, weight, rms = _robust(at_zero, y - x, blocks)
    else:
        theta, half0, weight, rms = _robust(np.ones((len(x), 1)), y - x, blocks)
        half = np.array([half0[0], half[1]])
    offset = float(theta[0])
    wide = float(np.hypot(half[0], 1.96 * known_std))
    estimates = _estimates(offset, wide, scale, float(half[1]), told)
    span = float(np.ptp(x))
    return DepthFit(
        offset=offset,
        scale=float(scale),
        estimates=estimates,
        span=span,
        rms=rms,
        rejected=int(np.sum(weight <= 0.0)),
        advice=_advice(estimates["depth.scale"], span, told),
    )


def _robust(A: Array, y: Array, blocks: int) -> tuple[Array, Array, Array, float]:
    """Estimates, half widths of their 95 % intervals, weights and robust rms."""
    weight = np.ones(len(y))
    theta = np.zeros(A.shape[1])
    for _ in range(ROUNDS):
        root = np.sqrt(weight)
        theta, *_ = np.linalg.lstsq(root[:, None] * A, root * y, rcond=None)
        residual = y - A @ theta
        sigma = max(1.4826 * float(np.median(np.abs(residual))), 1e-9)
        weight = np.clip(1.0 - (residual / (TUKEY * sigma)) ** 2, 0.0, None) ** 2
    parts = np.array_split(np.arange(len(y)), min(blocks, len(y) // 2))
    evidence = Evidence(
        names=("offset", "scale")[: A.shape[1]],
        normal=np.array([(A[p] * weight[p, None]).T @ A[p] for p in parts]) / sigma**2,
        score=np.array([A[p].T @ (weight[p] * residual[p]) for p in parts]) / sigma**2,
        unit="blocks",
    )
    half = intervals(np.zeros(A.shape[1]), trial_covariance(evidence))[:, 1]
    return theta, half, weight, float(np.sqrt(np.average(residual**2, weights=weight)))


def _estimates(offset: float, wide: float, scale: float, half: float, told: bool) -> dict[str, Estimate]:
    return {
        "depth.offset": Estimate(
            name="depth.offset",
            estimate=offset,
            ci95=(offset - wide, offset + wide),
            unit="m",
            identifiable=wide < UNSURE_OFFSET,
            note="" if wide < UNSURE_OFFSET else "rests on too few or too noisy depths",
        ),
        "depth.scale": Estimate(
            name="depth.scale",
            estimate=scale,
            ci95=(float(scale - half), float(scale + half)),
            unit="-",
            identifiable=told,
            note="" if told else "the depths span too little: taken as 1",
        ),
    }


def _advice(scale: Estimate, span: float, told: bool) -> tuple[str, ...]:
    if not told:
        return (
            f"the depths span {100.0 * span:.0f} cm: too little to tell the scale, so that fresh and salt water "
            f"({100.0 * (SALT - 1.0):.1f} %) look alike: dive to two depths half a metre apart, or more",
        )
    low, high = scale.ci95
    if low <= 1.0 <= high:
        return ()
    if low <= SALT <= high:
        return ("the sensor reads as if set to fresh water in salt water: set its water density",)
    if low <= 1.0 / SALT <= high:
        return ("the sensor reads as if set to salt water in fresh water: set its water density",)
    return (
        f"the sensor's scale is {scale.estimate:.3f}, and no water explains it: check its setting and the survey",
    )
