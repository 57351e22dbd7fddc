"""Episodes of a drive: its stretches at a task's period, seen by the task's own observation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from finssim.control.guidance import Guide, Station
from finssim.control.modes import Thruster8, Wrench6
from finssim.control.trajectories import PUBLISHED_NAMES, TRAJECTORIES, load_trajectory
from finssim.experiments.driven.actions import actions_of
from finssim.experiments.driven.drive import Drive, DriveError
from finssim.geometry.rotations import quat_yaw
from finssim.learning.demonstrations import Episode
from finssim.tasks.observer import Observer
from finssim.vehicles import Vehicle

__all__ = ["END", "SAME_GOAL", "episodes_of", "indices_of", "station_at", "trajectory_of"]

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

END = "end"
"""In place of a goal: where a stretch ended."""
NEAR = 0.25
"""A decision may lie so far from the task's grid of times, in parts of its period."""
SAME_GOAL = 1.0e-3
"""Recorded goals that differ by no more are one, or lie on the trajectory [m, rad]."""


class _Seen(NamedTuple):
    """The estimate at one decision."""

    position: Array
    quaternion: Array
    nu: Array


def episodes_of(
    drive: Drive, observer: Observer, mode: Thruster8 | Wrench6, vehicle: Vehicle, *,
    goal: Station | str | None = None,
) -> list[Episode]:  # fmt: skip
    """Demonstrations of a drive; none where it has no stretch of two decisions.

    Rewards are not known: they are NaN. An episode is never `terminated`; its measures are its `length` in steps and
    `began`, the robot's time of its first decision [s].

    Args:
        drive: What was done.
        observer: How the task is observed.
        mode: In which it is acted.
        vehicle: Which was driven.
        goal: In place of the recorded one: a station, or `END`; of a task that follows a trajectory its name or file.

    Raises:
        DriveError: Decisions further apart than the task's, no goal, or commands that the mode cannot ask for.
    """
    task, period = observer.task, observer.task.control_step
    if drive.period > period * (1.0 + 1e-6):
        raise DriveError(
            f"{drive.path}: {drive.driver} decided every {drive.period:g} s, expected at most {period:g} s, the period "
            f"of {task.name}: it cannot be taken for a controller of that task"
        )
    guide_of = _guides(drive, vehicle, task.moving, goal)
    stretches = indices_of(drive, period, split_goals=not task.moving and goal is None)
    if not stretches:
        return []
    try:
        actions = actions_of(drive.force[np.concatenate(stretches)], mode, vehicle)
    except DriveError as error:
        raise DriveError(f"{drive.path}: {error}") from None
    found, first = [], 0
    for rows in stretches:
        guide = guide_of(rows)
        observer.restart()
        seen = [_Seen(drive.position[i], drive.quaternion[i], drive.nu[i]) for i in rows]
        times = np.nan_to_num(drive.since[rows])
        observation = [observer.observe(s, guide, float(t)) for s, t in zip(seen, times, strict=True)]
        found.append(
            Episode(
                observation=np.array(observation, dtype=np.float32),
                action=actions[first : first + len(rows) - 1],
                reward=np.full(len(rows) - 1, np.nan, dtype=np.float32),
                terminated=False,
                metrics={"length": float(len(rows) - 1), "began": float(drive.time[rows[0]])},
            )
        )
        first += len(rows)
    return found


def indices_of(drive: Drive, period: float, *, split_goals: bool) -> list[Indices]:
    """Decisions, one a period, of each stretch that has at least two.

    Args:
        drive: What was done.
        period: [s]
        split_goals: Whether another goal begins another stretch.
    """
    number = drive.stretch
    changed = np.diff(number) != 0
    if split_goals:
        changed = changed | (np.abs(np.diff(drive.goal, axis=0)) > SAME_GOAL).any(axis=1)
    runs = np.split(np.arange(len(number)), np.flatnonzero(changed) + 1)
    pieces = [piece for run in runs if number[run[0]] >= 0 for piece in _on_grid(run, drive.time, period)]
    return [piece for piece in pieces if len(piece) >= 2]


def _on_grid(run: Indices, time: Array, period: float) -> list[Indices]:
    """The decisions nearest to a grid of times that begins with the first; a new grid after every gap."""
    t = time[run]
    pieces, piece = [], [0]
    while (wanted := t[piece[0]] + len(piece) * period) <= t[-1] + 1e-6:
        after = int(np.searchsorted(t, wanted))
        near = max(after - 1, 0) if after == len(t) or wanted - t[after - 1] < t[after] - wanted else after
        if abs(t[near] - wanted) <= NEAR * period:
            piece.append(near)
        else:
            pieces.append(piece)
            piece = [after]
    return [run[p] for p in (*pieces, piece)]


def _guides(
    drive: Drive, vehicle: Vehicle, moving: bool, goal: Station | str | None
) -> Callable[[Indices], Guide]:
    """What tells a stretch's guide from the indices of its decisions."""
    if moving:
        trajectory = trajectory_of(drive, vehicle, None if goal is None else str(goal))
        return lambda rows: trajectory
    if isinstance(goal, Station):
        return lambda rows: goal
    if goal == END:
        return lambda rows: _ended(drive, rows)
    if not drive.has_goal:
        raise DriveError(
            f"{drive.path}: was driven by hand to no goal: give --goal x,y,z,yaw_deg, where to, or --goal {END}: where "
            "each stretch ended"
        )
    return lambda rows: station_at(drive.goal[rows[0]])


def station_at(goal: Sequence[float] | Array) -> Station:
    """The station of a goal: x, y, z [m], yaw [rad], world frame, (4,)."""
    x, y, z, yaw = map(float, goal)
    return Station((x, y, z), yaw)


def _ended(drive: Drive, rows: Indices) -> Station:
    return station_at((*drive.position[rows[-1]], float(quat_yaw(drive.quaternion[rows[-1]]))))


def _recorded_name(drive: Drive) -> str:
    """Name of the trajectory that the record says was followed: one of ours, since what a record names is no path."""
    if drive.guide not in (*TRAJECTORIES, *PUBLISHED_NAMES):
        raise DriveError(
            f"{drive.path}: followed '{drive.guide}', which is none of {', '.join(TRAJECTORIES)}: give --goal, the "
            "name or the file of what was followed"
        )
    return drive.guide


def trajectory_of(drive: Drive, vehicle: Vehicle, name: str | None = None) -> Guide:
    """The trajectory that was followed, checked against the recorded goals.

    Args:
        drive: What was done.
        vehicle: Which followed it: a published trajectory is as large as its room.
        name: Name or file; the recorded name if None.

    Raises:
        DriveError: The record does not tell, or its goals are not on the trajectory.
    """
    name = name or _recorded_name(drive)
    if np.isnan(drive.since).any():
        raise DriveError(f"{drive.path}: does not say when its trajectory began: not a record of finssim run")
    guide = load_trajectory(name, vehicle=vehicle)
    off = float(np.linalg.norm(guide.at(drive.since).position - drive.goal[:, :3], axis=1).max())
    if off > SAME_GOAL:
        raise DriveError(
            f"{drive.path}: its goals are up to {off:.3g} m off the trajectory '{name}': give --goal, the name or the "
            "file of what was followed"
        )
    return guide
