"""Tasks, and the batched environment that runs any of them."""

from typing import TYPE_CHECKING

from finssim.core.lazy import exports

if TYPE_CHECKING:
    from finssim.core.registry import TASKS
    from finssim.tasks.catalogue import SEEING, make, task_named
    from finssim.tasks.environment import Environment, EnvironmentSetupError, Step
    from finssim.tasks.measurement import MeasurementNoise
    from finssim.tasks.moving_target import MovingTarget
    from finssim.tasks.sensing import Sensing
    from finssim.tasks.station_keeping import StationKeeping
    from finssim.tasks.task import Task
    from finssim.tasks.terms import ObservationPart
    from finssim.tasks.trajectory_tracking import TrajectoryTracking, follow

__all__ = [
    "SEEING",
    "TASKS",
    "Environment",
    "EnvironmentSetupError",
    "MeasurementNoise",
    "MovingTarget",
    "ObservationPart",
    "Sensing",
    "StationKeeping",
    "Step",
    "Task",
    "TrajectoryTracking",
    "follow",
    "make",
    "task_named",
]

__getattr__, __dir__ = exports(__name__)
