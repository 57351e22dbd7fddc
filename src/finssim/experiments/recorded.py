"""`finssim evaluate RECORD.mcap`: what a robot did, measured as in simulation, by its own estimate or by a truth."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from finssim.calibration.trials.table_file import read_table
from finssim.control.guidance import Guide, Reference, Track
from finssim.control.trajectories import load_trajectory
from finssim.experiments.driven import SAME_GOAL, Drive, read_drive, station_at, trajectory_of
from finssim.experiments.metrics import (
    ERRORS,
    MAX_GAP,
    T1_SETPOINTS,
    in_room,
    measure_tracking,
    measure_trial,
)
from finssim.experiments.trials import DURATION, TrackingTrials, Trials
from finssim.geometry.rotations import (
    quat_conjugate,
    quat_from_yaw,
    quat_inverse_rotate,
    quat_multiply,
    quat_to_rotvec,
    quat_yaw,
)
from finssim.pool.task_site import Referee
from finssim.pool.virtual_pool import read_truth
from finssim.robot.record_reader import open_record
from finssim.tasks import Task
from finssim.tasks.observer import fitted_task
from finssim.vehicles import Vehicle
from finssim.viewer.frame import ViewError
from finssim.viewer.sources.alignment import offset_between
from finssim.viewer.sources.series import PoseSeries
from finssim.yaml_file import json_value

__all__ = ["RecordedError", "RecordedTrial", "measured_records", "read_record"]

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


PUBLISHED = ("t1", "t2")
"""Tasks that are measured as in the paper; every other one measures itself."""
EARLY = 0.5
"""A trial that lacks more than this of its end was stopped [s]."""


class RecordedError(ValueError):
    """A record or a truth that cannot be measured."""


@dataclass(frozen=True)
class RecordedTrial:
    """What one record shows."""

    path: Path
    guide: Guide
    pilot: dict[str, Any]
    """Who steered, as the record describes it."""
    estimate: Motion
    """What the robot knew at its decisions."""
    motion: Motion
    """By which it is measured: the truth, or the estimate."""
    stopped: bool
    """Whether it ended before its time."""
    duration: float
    """Up to when it is measured [s]."""
    offset: float | None
    """Added to the truth's times to put them on the robot's clock [s]; None without a truth."""

    def measures(self, task: str, vehicle: Vehicle) -> dict[str, Any]:
        """What `motion.measure` says of T1 and T2 and the task of itself, and how far the estimate was from the truth.

        Raises:
            ControlError: The task cannot score what was played elsewhere.
        """
        if task in PUBLISHED:
            fault = "ended early" if self.stopped else ""
            row = measure(task, self.guide, self.motion, vehicle.force_limits, stopped=self.stopped)
        else:
            fitted = fitted_task(task, vehicle)
            row, fault = score(fitted, vehicle, self.guide, self.motion, self.estimate, self.duration)
        return {
            **row,
            "fault": fault,
            "localization": None if self.offset is None else localization_errors(self.motion, self.estimate),
            "clock_offset_s": self.offset,
        }


def read_record(
    path: Path,
    task: str,
    vehicle: Vehicle,
    *,
    guide: Guide | None = None,
    truth: Path | None = None,
    duration: float = DURATION,
) -> RecordedTrial:
    """The trial of a record, from the start of its guide's time.

    Args:
        path: MCAP file of `finssim run`, `experiment --robot` or the ROS 2 graph.
        task: Of one vehicle: its name, or FILE.py:CLASS of one's own.
        vehicle: The very one that was driven.
        guide: What was followed, of a task that follows a reference; by the record's own words if None.
        truth: Truth file of a virtual pool, or a table (.csv, .parquet) of motion capture, world frame: columns t [s],
            x, y, z of the body origin [m], and qx, qy, qz, qw or yaw [rad]. Its clock may be any: it is laid over the
            robot's where the distance between the two motions is least.
        duration: Of a trial of t1 [s].

    Raises:
        RecordedError: A task of several vehicles, a record of a drive by hand, of several goals, without what the task
            needs, or a truth of another run.
        RecordError, DriveError, ControlError: The record or the task cannot be used.
        CalibrationError, TruthError: The truth cannot be read.
    """
    fitted = fitted_task(task, vehicle)
    if len(fitted.vehicles) > 1:
        raise RecordedError(
            f"task '{task}' has {len(fitted.vehicles)} vehicles and {path} is of one: finssim pool --task and finssim "
            "experiment stack score it as it is played"
        )
    drive = read_drive(path, vehicle)
    pilot = _pilot(path)
    steered = drive.stretch >= 0
    if not (steered & (drive.since >= 0.0)).any():
        raise RecordedError(f"{path}: the robot was never armed with its state known: nothing was done in it")
    if task not in PUBLISHED and not drive.action.shape[1]:
        raise RecordedError(
            f"{path}: does not tell what the pilot did, in [-1, 1], which '{task}' scores: record a run of this version"
        )
    if follows(fitted):
        the_guide = guide or trajectory_of(drive, vehicle)
    else:
        the_guide = GoalHistory.of(drive, steered) if fitted.moving else _station(drive, steered, task)
    longest = {"t1": duration, "t2": math.inf}.get(task, fitted.time_limit)
    whole = min(the_guide.duration, longest)
    rows = steered & (drive.since >= 0.0) & (drive.since <= whole + 1e-6)
    estimate = Motion(
        t=drive.since[rows],
        position=drive.position[rows],
        yaw=np.asarray(quat_yaw(drive.quaternion[rows])),
        quaternion=drive.quaternion[rows],
        nu=drive.nu[rows],
        thrust=drive.force[rows],
        action=drive.action[rows],
    )
    last = float(estimate.t[-1])
    stopped = last < whole - EARLY
    played = last if stopped else whole
    motion, offset = estimate, None
    if truth is not None:
        motion, offset = _truth(truth, drive, played)
    about = pilot or {"name": drive.driver}
    return RecordedTrial(path, the_guide, about, estimate, motion, stopped, played, offset)


def measured_records(
    records: Sequence[Path],
    task: str,
    vehicle: Vehicle,
    *,
    trajectory: str | Path | None = None,
    truth: Path | None = None,
) -> tuple[dict[str, Any], list[dict[str, Any]], Trials | TrackingTrials | None]:
    """What an evaluation says of records: who and where, the measures by trial, and of t1 and t2 the motions to draw.

    Args:
        records: MCAP files.
        task: As of `read_record`.
        vehicle: The very one that was driven.
        trajectory: Name or file of what was followed; the record's own if None.
        truth: As of `read_record`, of one record or of all.

    Raises:
        RecordedError: As `read_record`, or the records are of several controllers.
    """
    guide = None if trajectory is None else load_trajectory(trajectory, vehicle=vehicle)
    found = [read_record(path, task, vehicle, guide=guide, truth=truth) for path in records]
    pilots = [trial.pilot for trial in found]
    if any(pilot != pilots[0] for pilot in pilots):
        names = ", ".join(dict.fromkeys(str(pilot.get("name")) for pilot in pilots))
        raise RecordedError(
            f"the records are of several controllers ({names}): evaluate those of one at a time"
        )
    measures = [
        {
            "trial": i,
            **_goal_named(task, trial.guide, vehicle),
            "record": trial.path.name,
            **trial.measures(task, vehicle),
        }
        for i, trial in enumerate(found)
    ]
    described = {
        "controller": {"kind": "pid", "action": "wrench6", "hydrodynamics": "calibrated"} | pilots[0],
        "task": task,
        "vehicle": {"name": vehicle.name, "sha256": vehicle.sha256},
        "hydrodynamics": "calibrated",
        "plant": {
            "name": "record",
            "title": f"as recorded, by {'its own estimate' if truth is None else truth.name}",
        },
        "records": [
            {"file": t.path.name, "sha256": hashlib.sha256(t.path.read_bytes()).hexdigest()} for t in found
        ],
        "truth": None if truth is None else truth.name,
    }
    return described, measures, _trials(found, task, vehicle) if task in PUBLISHED else None


def _pilot(path: Path) -> dict[str, Any]:
    """Who steered, as the record says; nothing where it does not."""
    with open_record(path) as record:
        text = record.metadata.get("pilot", "{}")
    try:
        return dict(json_value(text, RecordedError, str(path)))
    except (ValueError, TypeError):
        raise RecordedError(
            f"{path}: its 'pilot' is '{text[:60]}', expected a mapping: not a record of ours"
        ) from None


@dataclass(frozen=True)
class GoalHistory:
    """Where a moving goal was, as the record has it; it is a guide."""

    t: Array
    """Time since the start [s], (T,)."""
    goal: Array
    """x, y, z [m] and yaw without jumps [rad], world frame, (T, 4)."""
    name: str = "recorded"
    duration: float = math.inf

    @classmethod
    def of(cls, drive: Drive, steered: NDArray[np.bool_]) -> GoalHistory:
        """Of what was done.

        Raises:
            RecordedError: There was no goal.
        """
        goals, rows = _goals(drive, steered), steered & (drive.since >= 0.0)
        return cls(drive.since[rows], np.column_stack([goals[:, :3], np.unwrap(goals[:, 3])]))

    def at(self, t: ArrayLike) -> Reference:
        """The goal between the decisions."""
        rates = np.gradient(self.goal, self.t, axis=0) if len(self.t) > 1 else np.zeros_like(self.goal)
        pose, rate = (
            np.stack([np.interp(np.asarray(t, float), self.t, column) for column in rows.T], axis=-1)
            for rows in (self.goal, rates)
        )
        return Reference(pose[..., :3], rate[..., :3], pose[..., 3], rate[..., 3])


def _goals(drive: Drive, steered: NDArray[np.bool_]) -> Array:
    """Where the vehicle should have been, by decision."""
    if not drive.has_goal:
        raise RecordedError(f"{drive.path}: was driven by hand to no goal: a record of finssim run has one")
    return drive.goal[steered & (drive.since >= 0.0)]


def _station(drive: Drive, steered: NDArray[np.bool_], task: str) -> Guide:
    """The one goal that was held, or the dock."""
    goals = _goals(drive, steered)
    if float(np.abs(goals - goals[0]).max()) > SAME_GOAL:
        raise RecordedError(
            f"{drive.path}: its goal moves, and '{task}' has one: measure it with --task t2 or t3, or record each "
            "station by itself"
        )
    return station_at(goals[0])


def _goal_named(task: str, guide: Guide, vehicle: Vehicle) -> dict[str, str]:
    """What a trial of t1 and t2 went to, for its row."""
    if task not in PUBLISHED:
        return {}
    return {"setpoint": _setpoint(guide, vehicle)} if task == "t1" else {"trajectory": guide.name}


def _setpoint(guide: Guide, vehicle: Vehicle) -> str:
    """Name of the published setpoint that a station is, else its numbers."""
    goal = _row(guide)
    known = {name: in_room(pose, vehicle) for name, pose in T1_SETPOINTS.items()}
    near = (name for name, pose in known.items() if np.abs(pose - goal).max() <= SAME_GOAL)
    return next(near, ",".join(f"{x:.3g}" for x in _goal(guide)))


def _row(guide: Guide) -> Array:
    goal = guide.at(0.0)
    return np.array([*goal.position, float(goal.yaw)])


def _goal(guide: Guide) -> list[float]:
    x, y, z, yaw = _row(guide).tolist()
    return [x, y, z, math.degrees(yaw)]


def _truth(path: Path, drive: Drive, until: float) -> tuple[Motion, float]:
    """The true motion from the guide's start to a time after it [s], and what was added to its times."""
    time, position, yaw, quaternion, nu = _table(path)
    try:
        offset = offset_between(PoseSeries(drive.time, drive.position, drive.quaternion), time, position)
    except ViewError as error:
        raise RecordedError(f"{path}: {error}") from None
    t = time + offset - (drive.time[0] - drive.since[0])
    rows = (t >= 0.0) & (t <= until + 1e-6)
    return (
        Motion(
            t=t[rows],
            position=position[rows],
            yaw=yaw[rows],
            quaternion=None if quaternion is None else quaternion[rows],
            nu=None if nu is None else nu[rows],
        ),
        offset,
    )


def _table(path: Path) -> tuple[Array, Array, Array, Array | None, Array | None]:
    """Times [s], positions [m], headings [rad], orientations and velocities of a truth; None where it has none."""
    if path.suffix.lower() not in (".csv", ".txt", ".tsv", ".parquet"):
        found = read_truth(path)
        return found.time, found.position, np.asarray(quat_yaw(found.quaternion)), found.quaternion, found.nu
    columns = read_table(path).numbers
    attitude = ("qx", "qy", "qz", "qw")
    turned = set(attitude) <= set(columns)
    if not {"t", "x", "y", "z"} <= set(columns) or not (turned or "yaw" in columns):
        raise RecordedError(
            f"{path}: columns {', '.join(columns)[:80]}, expected t [s], x, y, z [m] (world frame, body origin) and "
            "qx, qy, qz, qw or yaw [rad]"
        )
    names = ("t", "x", "y", "z", *(attitude if turned else ("yaw",)))
    rows = np.stack([columns[name] for name in names], axis=1)
    rows = rows[np.isfinite(rows).all(axis=1)]  # a body that the cameras did not see has empty cells
    if len(rows) < 2 or np.any(np.diff(rows[:, 0]) <= 0.0):
        raise RecordedError(
            f"{path}: {len(rows)} rows with all numbers, expected 2 or more with t increasing"
        )
    quaternion = rows[:, 4:8] if turned else None
    yaw = rows[:, 4] if quaternion is None else np.asarray(quat_yaw(quaternion))
    return rows[:, 0], rows[:, 1:4], yaw, quaternion, None


def _trials(found: Sequence[RecordedTrial], task: str, vehicle: Vehicle) -> Trials | TrackingTrials:
    """The motions on one grid, for figures."""
    guides = tuple(trial.guide for trial in found)
    longest = DURATION if task == "t1" else max(guide.duration for guide in guides)
    t, position, yaw = on_grid([trial.motion for trial in found], longest)
    if task == "t1":
        return Trials(
            tuple(_setpoint(guide, vehicle) for guide in guides),
            np.stack([_row(guide) for guide in guides]),
            t,
            position,
            yaw,
        )
    shape = (len(t), len(found))
    unknown = np.full((*shape, 4), np.nan), np.full((*shape, len(vehicle.thrusters)), np.nan)
    return TrackingTrials(guides, t, position, *unknown, vehicle.force_limits)
