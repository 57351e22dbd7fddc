"""The motion of one trial of a robot, by the truth or by an estimate; its measures, published or the task's own."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from finssim.control.guidance import Guide
from finssim.control.tracking import Track
from finssim.experiments.metrics import ERRORS, MAX_GAP, measure_tracking, measure_trial
from finssim.geometry.rotations import (
    quat_conjugate,
    quat_from_yaw,
    quat_inverse_rotate,
    quat_multiply,
    quat_to_rotvec,
)
from finssim.pool.task_site import Referee
from finssim.tasks import Task
from finssim.vehicles import Vehicle

__all__ = ["PERIOD", "Motion", "follows", "localization_errors", "measure", "on_grid", "score"]

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
    nu: Array | None = None
    """Velocity of the body origin, body frame [m/s, rad/s], (T, 6); None where it is not measured."""
    thrust: Array | None = None
    """Of each thruster [N], (T, n); None where not known."""
    action: Array | None = None
    """What was done from then on, in [-1, 1], (T, size); None where not known."""

    def at(self, t: float) -> Track:
        """Where the vehicle was at a time [s], between the samples; velocities that are not measured are differences
        over a `PERIOD` to either side."""
        position = self._between(self.position, t)
        quaternion = self._attitude(t)
        if self.nu is not None:
            return Track(position, quaternion, self._between(self.nu, t))
        first, last = max(t - PERIOD, float(self.t[0])), min(t + PERIOD, float(self.t[-1]))
        way = self._between(self.position, last) - self._between(self.position, first)
        turn = quat_to_rotvec(quat_multiply(quat_conjugate(self._attitude(first)), self._attitude(last)))
        linear = np.asarray(quat_inverse_rotate(quaternion, way))
        return Track(position, quaternion, np.concatenate([linear, turn]) / max(last - first, 1e-9))

    def done(self, t: float) -> Array:
        """What was done from a time on [s], by the last decision before it; empty where not known."""
        if self.action is None or t < self.t[0] - 1e-3:
            return np.zeros(0)
        done: Array = self.action[int(np.searchsorted(self.t, t + 1e-3)) - 1]
        return done

    def _attitude(self, t: float) -> Array:
        if self.quaternion is None:
            return np.asarray(quat_from_yaw(float(np.interp(t, self.t, np.unwrap(self.yaw)))))
        flips = np.cumprod(
            np.where(np.sum(self.quaternion[1:] * self.quaternion[:-1], axis=1) < 0.0, -1.0, 1.0)
        )
        q = self._between(self.quaternion * np.concatenate([[1.0], flips])[:, None], t)
        return q / np.linalg.norm(q)

    def _between(self, columns: Array, t: float) -> Array:
        return np.array([np.interp(t, self.t, column) for column in columns.T])


def follows(task: Task) -> bool:
    """Whether it follows a reference that is known ahead."""
    return hasattr(task, "knot_spacing")


def score(
    task: Task, vehicle: Vehicle, guide: Guide, motion: Motion, done: Motion, duration: float
) -> tuple[dict[str, float | None], str]:
    """How the task itself measures an episode of one vehicle that was played elsewhere.

    Args:
        task: Fitted to the vehicle.
        vehicle: Which was driven.
        guide: Where the task's goal is, by the time from the start.
        motion: By which it is measured, from the start.
        done: With the actions.
        duration: Up to when it was played [s].

    Returns:
        Its metrics, None where there is none; and why there are none, in a sentence, which counts without success.
    """
    size = 0 if done.action is None else done.action.shape[1]
    referee = Referee(task, [vehicle], guide=guide, start=motion.at(0.0), action_size=size or None)
    (name,), fault = task.agents, ""
    times = np.concatenate([[0.0], motion.t, [duration]])
    widest = int(np.argmax(np.diff(times)))
    if times[widest + 1] - times[widest] > MAX_GAP:
        fault = f"no position from {times[widest]:.1f} to {times[widest + 1]:.1f} s"
    for k in range(round(duration / task.control_step) if not fault else 0):
        actions = {name: done.done(k * task.control_step)}
        referee.look({name: motion.at((k + 1) * task.control_step)}, actions)
        if referee.over:
            break
    if not referee.over:
        unknown: dict[str, float | None] = dict.fromkeys(referee.metrics())
        return unknown | ({"success": 0.0} if "success" in unknown else {}), fault or "ended early"
    return {key: x if math.isfinite(x) else None for key, x in referee.metrics().items()}, ""


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
