"""Every task by name."""

from finssim.tasks.docking import Docking
from finssim.tasks.formation import Formation
from finssim.tasks.moving_target import MovingTarget
from finssim.tasks.pursuit import Pursuit
from finssim.tasks.station_keeping import StationKeeping
from finssim.tasks.task import Task
from finssim.tasks.team_pursuit import TeamPursuit
from finssim.tasks.trajectory_tracking import TrajectoryTracking

__all__ = ["TASKS"]

TASKS: dict[str, type[Task]] = {
    "t1": StationKeeping,
    "t2": TrajectoryTracking,
    "t3": MovingTarget,
    "docking": Docking,
    "pursuit": Pursuit,
    "team-pursuit": TeamPursuit,
    "formation": Formation,
}
"""Every task by the name that commands take; call it for the task with its default settings."""
