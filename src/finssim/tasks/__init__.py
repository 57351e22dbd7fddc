"""Tasks, and the batched environment that runs any of them."""

from typing import TYPE_CHECKING

from finssim.core.lazy import exports

if TYPE_CHECKING:
    from finssim.core.registry import TASKS
    from finssim.tasks.arrays import TaskArrays
    from finssim.tasks.catalogue import make, numeric_tasks, task_named
    from finssim.tasks.check import check_task
    from finssim.tasks.communication import Communication
    from finssim.tasks.environment import Environment, EnvironmentSetupError, Step
    from finssim.tasks.measurement import MeasurementNoise
    from finssim.tasks.moving_target import MovingTarget
    from finssim.tasks.sensing import Sensing
    from finssim.tasks.station_keeping import StationKeeping
    from finssim.tasks.task import Task
    from finssim.tasks.terms import ObservationPart, RewardTerm, Terms, action_effort, place_at_rest
    from finssim.tasks.torch_task import Start, TorchTask, Worlds
    from finssim.tasks.trajectory_tracking import TrajectoryTracking, follow

__all__ = [
    "Communication",
    "Environment",
    "EnvironmentSetupError",
    "MeasurementNoise",
    "MovingTarget",
    "ObservationPart",
    "RewardTerm",
    "Sensing",
    "Start",
    "StationKeeping",
    "Step",
    "TASKS",
    "Task",
    "TaskArrays",
    "Terms",
    "TorchTask",
    "TrajectoryTracking",
    "Worlds",
    "action_effort",
    "check_task",
    "follow",
    "make",
    "numeric_tasks",
    "place_at_rest",
    "task_named",
]

__getattr__, __dir__ = exports(__name__)
