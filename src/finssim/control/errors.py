"""The one exception of the control package."""


class ControlError(ValueError):
    """A controller, an action mode or an allocation was given something it refuses: the message says what to change."""
