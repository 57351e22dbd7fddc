"""The motion of one trial of a robot, by the truth or by an estimate, and the published measures of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from finssim.control.guidance import Guide
from finssim.experiments.metrics import ERRORS, measure_tracking, measure_trial

__all__ = ["PERIOD", "Motion", "localization_errors", "measure", "on_grid"]

Array = NDArray[np.float64]

PERIOD = 0.1
"""Between the samples of a common grid [s]."""


@dataclass(frozen=True, kw_only=True)
class Motion:
    """Samples of a trial in the order of their times; world frame, SI, NaN where unknown."""

    t: Array
    """Time since the guide's start [s], (T,)."""
    position: Array
    """Body origin [m], (T, 3)."""
    yaw: Array
    """Heading [rad], (T,)."""
    quaternion: Array | None = None
    """Body to world, xyzw, (T, 4); None where roll and pitch are not known."""
    thrust: Array | None = None
    """Of each thruster [N], (T, n); None where not known."""


def measure(
    task: str, guide: Guide, motion: Motion, limits: tuple[ArrayLike, ArrayLike], *, stopped: bool
) -> dict[str, Any]:
    """What `measure_trial` says of a trial of T1, with its goal, or `measure_tracking` of one of T2, with `success`.

    Args:
        task: t1 or t2.
        guide: Station or trajectory.
        motion: From the guide's start.
        limits: Lower and upper limit of each thruster [N], (n,) each.
        stopped: Whether it ended before its time: errors of half a way say nothing of the other half.
    """
    if task == "t1":
        at = guide.at(0.0)
        x, y, z = map(float, at.position)
        measures = measure_trial(motion.t, motion.position, motion.yaw, (x, y, z, float(at.yaw)))
        return {"goal": [x, y, z, math.degrees(at.yaw)], **measures}
    measures = measure_tracking(
        motion.t,
        motion.position,
        guide,
        quaternion=motion.quaternion,
        thrust=motion.thrust,
        limits=limits,
    )
    if stopped:
        measures |= dict.fromkeys(ERRORS)
    return {"success": bool(measures["complete"]) and not stopped, **measures}


def localization_errors(truth: Motion, estimate: Motion) -> dict[str, float] | None:
    """Errors of an estimate at its own times: rms in 3-D and horizontally [m], and in heading [°]; None without any."""
    t = estimate.t
    inside = (t >= truth.t[:1].max(initial=0.0)) & (t <= truth.t[-1:].max(initial=-1.0))
    inside &= np.isfinite(estimate.position).all(axis=1)
    if not inside.any():
        return None
    true = np.stack([np.interp(t[inside], truth.t, column) for column in truth.position.T], axis=1)
    error = estimate.position[inside] - true
    turn = estimate.yaw[inside] - np.interp(t[inside], truth.t, np.unwrap(truth.yaw))
    turn = (turn + math.pi) % (2.0 * math.pi) - math.pi
    return {
        "position_m": float(np.sqrt(np.mean(np.sum(error**2, axis=1)))),
        "horizontal_m": float(np.sqrt(np.mean(np.sum(error[:, :2] ** 2, axis=1)))),
        "heading_deg": math.degrees(float(np.sqrt(np.mean(turn**2)))),
    }


def on_grid(motions: Sequence[Motion], duration: float) -> tuple[Array, Array, Array]:
    """Motions on one grid of times; NaN after a trial that ended early.

    Args:
        motions: Of n trials, their samples no more than `PERIOD` apart.
        duration: Of the grid [s].

    Returns:
        Times [s], (T,); positions [m], (T, n, 3); headings [rad], (T, n).
    """
    t: Array = np.arange(round(duration / PERIOD) + 1, dtype=np.float64) * PERIOD
    position, yaw = np.full((len(t), len(motions), 3), np.nan), np.full((len(t), len(motions)), np.nan)
    for i, motion in enumerate(motions):
        if not len(motion.t):
            continue
        # The motion's own first and last samples lie within a period of the grid's.
        inside = (t >= motion.t[0] - PERIOD) & (t <= motion.t[-1] + PERIOD)
        for axis in range(3):
            position[inside, i, axis] = np.interp(t[inside], motion.t, motion.position[:, axis])
        yaw[inside, i] = np.interp(t[inside], motion.t, np.unwrap(motion.yaw))
    return t, position, yaw
