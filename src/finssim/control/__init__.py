"""Control: wrench allocation, action modes and the PID baseline, identical in simulation and on the robot."""

from typing import TYPE_CHECKING

from finssim.core.lazy import exports

if TYPE_CHECKING:
    from finssim.control.allocation import Allocator
    from finssim.control.course import CoursePilot
    from finssim.control.guidance import Goal, Known, Station, Track
    from finssim.control.modes import action_mode
    from finssim.control.path_following import LineOfSight, Waypoints
    from finssim.control.policy import Policy
    from finssim.control.trajectories import TRAJECTORIES, load_trajectory

__all__ = [
    "Allocator",
    "ControlError",
    "CoursePilot",
    "Goal",
    "Known",
    "LineOfSight",
    "Policy",
    "Station",
    "TRAJECTORIES",
    "Track",
    "Waypoints",
    "action_mode",
    "load_trajectory",
]

__getattr__, __dir__ = exports(__name__)


class ControlError(ValueError):
    """Invalid arguments of a controller, an action mode or an allocation; the message states what to change."""
