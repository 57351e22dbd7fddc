"""Control: wrench allocation, action modes and the PID baseline, the same in simulation and on the robot."""

__all__ = ["ControlError"]


class ControlError(ValueError):
    """A controller, an action mode or an allocation was given something it refuses: the message says what to change."""
