"""Control: wrench allocation, action modes and the PID baseline, the same in simulation and on the robot."""

__all__ = ["ControlError"]


class ControlError(ValueError):
    """A controller, an action mode or an allocation refuses its arguments; the message states what to change."""
