"""`rclpy.callback_groups`: accepted and met: callbacks run one at a time, which every group allows."""

__all__ = ["CallbackGroup", "MutuallyExclusiveCallbackGroup", "ReentrantCallbackGroup"]


class CallbackGroup:
    """Callbacks that may or may not run at the same time."""


class MutuallyExclusiveCallbackGroup(CallbackGroup):
    """Callbacks that must not run at the same time."""


class ReentrantCallbackGroup(CallbackGroup):
    """Callbacks that may run at the same time, and here do not."""
