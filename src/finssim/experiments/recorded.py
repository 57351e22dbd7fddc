"""`finssim evaluate RECORD.mcap`: what a robot did, measured as in simulation, by its own estimate or by a truth."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from finssim.calibration.trials.trial_files import read_table
from finssim.control.guidance import Guide, Reference
from finssim.experiments.driven import SAME_GOAL, Drive, read_drive, station_at, trajectory_of
from finssim.experiments.metrics import MAX_GAP, T1_SETPOINTS, in_room
from finssim.experiments.trials import DURATION, Motion, Trial, follows, localization_errors
from finssim.geometry.rotations import quat_from_yaw
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

__all__ = ["RecordedError", "RecordedTrial", "read_record"]

Array = NDArray[np.float64]

PUBLISHED = ("t1", "t2")
"""Tasks that are measured as in the paper; every other one measures itself."""
EARLY = 0.5
"""A trial that lacks more than this of its end was stopped [s]."""


class RecordedError(ValueError):
    """A record or a truth that cannot be measured."""


@dataclass(frozen=True, kw_only=True)
class RecordedTrial(Trial):
    """What one record shows."""

    path: Path
    pilot: dict[str, Any]
    """Who steered, as the record describes it."""
    estimate: Motion
    """What the robot knew at its decisions; the motion is the truth, where there is one, or the estimate."""
    stopped: bool
    """Whether it ended before its time."""
    duration: float
    """Up to when it is measured [s]."""
    offset: float | None
    """Added to the truth's times to put them on the robot's clock [s]; None without a truth."""

    def scores(self, task: str, vehicle: Vehicle) -> dict[str, Any]:
        """`measures` of T1 and T2 or what the task measures of itself, and how far the estimate was from the truth.

        Raises:
            ControlError: The task cannot score what was played elsewhere.
        """
        if task in PUBLISHED:
            fault = "ended early" if self.stopped else ""
            row = self.measures(task, vehicle.force_limits, stopped=self.stopped)
        else:
            row, fault = self._scored(fitted_task(task, vehicle), vehicle)
        return {
            **row,
            "fault": fault,
            "localization": None if self.offset is None else localization_errors(self.motion, self.estimate),
            "clock_offset_s": self.offset,
        }

    def _scored(self, task: Task, vehicle: Vehicle) -> tuple[dict[str, float | None], str]:
        """How a task measures an episode of one vehicle that was played elsewhere.

        Returns:
            Its metrics, None where there is none; and why there are none, in a sentence, which counts without success.
        """
        motion, actions = self.motion, self.estimate.action
        size = 0 if actions is None else actions.shape[1]
        referee = Referee(task, [vehicle], guide=self.guide, start=motion.at(0.0), action_size=size or None)
        (name,), fault = task.agents, ""
        times = np.concatenate([[0.0], motion.t, [self.duration]])
        widest = int(np.argmax(np.diff(times)))
        if times[widest + 1] - times[widest] > MAX_GAP:
            fault = f"no position from {times[widest]:.1f} to {times[widest + 1]:.1f} s"
        for k in range(round(self.duration / task.control_step) if not fault else 0):
            action = {name: self.estimate.action_at(k * task.control_step)}
            referee.look({name: motion.at((k + 1) * task.control_step)}, action)
            if referee.over:
                break
        if not referee.over:
            unknown: dict[str, float | None] = dict.fromkeys(referee.metrics())
            return unknown | ({"success": 0.0} if "success" in unknown else {}), fault or "ended early"
        return {key: x if math.isfinite(x) else None for key, x in referee.metrics().items()}, ""


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
    t = drive.motion.t
    if not (steered & (t >= 0.0)).any():
        raise RecordedError(f"{path}: the robot was never armed with its state known: nothing was done in it")
    if task not in PUBLISHED and not np.size(drive.motion.action):
        raise RecordedError(
            f"{path}: does not tell what the pilot did, in [-1, 1], which '{task}' scores: record a run of this version"
        )
    if follows(fitted):
        the_guide = guide or trajectory_of(drive, vehicle)
    else:
        the_guide = GoalHistory.of(drive, steered) if fitted.moving else _station(drive, steered, task)
    longest = {"t1": duration, "t2": math.inf}.get(task, fitted.time_limit)
    full = min(the_guide.duration, longest)
    estimate = drive.motion.between(steered & (t >= 0.0) & (t <= full + 1e-6))
    stopped = float(estimate.t[-1]) < full - EARLY
    until = float(estimate.t[-1]) if stopped else full
    motion, offset = (estimate, None) if truth is None else _truth(truth, drive, until)
    return RecordedTrial(
        name=_setpoint(the_guide, vehicle) if task == "t1" else the_guide.name,
        guide=the_guide,
        motion=motion,
        path=path,
        pilot=pilot or {"name": drive.driver},
        estimate=estimate,
        stopped=stopped,
        duration=until,
        offset=offset,
    )


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
        goals, rows = _goals(drive, steered), steered & (drive.motion.t >= 0.0)
        return cls(drive.motion.t[rows], np.column_stack([goals[:, :3], np.unwrap(goals[:, 3])]))

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
    return drive.goal[steered & (drive.motion.t >= 0.0)]


def _station(drive: Drive, steered: NDArray[np.bool_], task: str) -> Guide:
    """The one goal that was held, or the dock."""
    goals = _goals(drive, steered)
    if float(np.abs(goals - goals[0]).max()) > SAME_GOAL:
        raise RecordedError(
            f"{drive.path}: its goal moves, and '{task}' has one: measure it with --task t2 or t3, or record each "
            "station by itself"
        )
    return station_at(goals[0])


def _setpoint(guide: Guide, vehicle: Vehicle) -> str:
    """Name of the published setpoint that a station is, else its numbers."""
    start = guide.at(0.0)
    goal = np.array([*start.position, float(start.yaw)])
    published = {name: in_room(pose, vehicle) for name, pose in T1_SETPOINTS.items()}
    near = (name for name, pose in published.items() if np.abs(pose - goal).max() <= SAME_GOAL)
    return next(near, ",".join(f"{x:.3g}" for x in (*goal[:3], math.degrees(goal[3]))))


def _truth(path: Path, drive: Drive, until: float) -> tuple[Motion, float]:
    """The true motion from the guide's start to a time after it [s], and what was added to its times."""
    motion = _table(path)
    try:
        robot = PoseSeries(drive.time, drive.motion.position, drive.motion.quaternion)
        offset = offset_between(robot, motion.t, motion.position)
    except ViewError as error:
        raise RecordedError(f"{path}: {error}") from None
    t = motion.t + offset - (drive.time[0] - drive.motion.t[0])
    return replace(motion, t=t).between((t >= 0.0) & (t <= until + 1e-6)), offset


def _table(path: Path) -> Motion:
    """A truth, by its own clock."""
    if path.suffix.lower() not in (".csv", ".txt", ".tsv", ".parquet"):
        truth = read_truth(path)
        return Motion(t=truth.time, position=truth.position, quaternion=truth.quaternion, nu=truth.nu)
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
    quaternion = rows[:, 4:8] if turned else quat_from_yaw(rows[:, 4])
    return Motion(t=rows[:, 0], position=rows[:, 1:4], quaternion=quaternion, heading_only=not turned)
