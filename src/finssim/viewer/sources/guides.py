"""The wanted motion, as poses and lines to draw."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from finssim.control.guidance import Guide, Station
from finssim.geometry.rotations import quat_from_yaw
from finssim.robot.goals import check_reachable, guide_of
from finssim.vehicles import Vehicle
from finssim.viewer.frame import Pose, nowhere

POINTS = 240
"""Of a trajectory's line."""
STATION, TRAJECTORY = "0.8,0.3,-0.6,45", "ellipse"
"""Where to go if nobody says."""


def guide_for(goal: str | None, trajectory: str | None, task: str | None, vehicle: Vehicle) -> Guide:
    """The goal or the trajectory of a command line; one of the task if none is given.

    Raises:
        GoalError, ControlError: One that cannot be read, or that the vehicle may not go to.
    """
    if goal is None and trajectory is None:
        goal, trajectory = (None, TRAJECTORY) if task == "t2" else (STATION, None)
    guide = guide_of(goal, trajectory)
    check_reachable(guide, vehicle)
    return guide


def goal_pose(guide: Guide, t: float) -> Pose:
    """Where the vehicle should be at a time since the start [s]."""
    reference = guide.at(t)
    return Pose(np.asarray(reference.position, float), np.asarray(quat_from_yaw(float(reference.yaw))))


def path_of(guide: Guide) -> npt.NDArray[np.float64]:
    """The line of a trajectory, (k, 3) [m]; no points for a station."""
    if not math.isfinite(guide.duration):
        return nowhere()
    return np.asarray(guide.at(np.linspace(0.0, guide.duration, POINTS)).position)


def start_of(guide: Guide) -> Station:
    """Where a vehicle begins: at the start of a trajectory, or in the middle, 0.5 m deep, for a station."""
    if not math.isfinite(guide.duration):
        return Station((0.0, 0.0, -0.5), 0.0)
    first = guide.at(0.0)
    x, y, z = first.position.tolist()
    return Station((x, y, z), float(first.yaw))
