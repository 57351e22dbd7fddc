"""Tasks, and the batched environment that runs any of them."""

from finssim.tasks.environment import Environment, EnvironmentSetupError, Step
from finssim.tasks.measurement import MeasurementNoise
from finssim.tasks.reference import follow
from finssim.tasks.station_keeping import StationKeeping
from finssim.tasks.task import ObservationPart, Task
from finssim.tasks.trajectory_tracking import TrajectoryTracking

TASKS = {"t1": StationKeeping, "t2": TrajectoryTracking}
"""Every task by the name that commands take; call it for the task with its default settings."""

__all__ = [
    "TASKS",
    "Environment",
    "EnvironmentSetupError",
    "MeasurementNoise",
    "ObservationPart",
    "StationKeeping",
    "Step",
    "Task",
    "TrajectoryTracking",
    "follow",
]
