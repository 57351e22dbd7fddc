"""ROS 2 for FinsSim: the real wire without a ROS installation, one source for messages, names and frames."""

from __future__ import annotations

from typing import TYPE_CHECKING

from finssim.core.lazy import exports

if TYPE_CHECKING:
    from finssim.extensions.ros2.backend import activate

__all__ = [
    "MessageError",
    "Ros2Error",
    "activate",
]

__getattr__, __dir__ = exports(__name__)


class Ros2Error(ValueError):
    """A setting, name or definition of ROS 2 cannot be used; the message is one sentence that states what to do."""


class MessageError(AssertionError):
    """A value does not fit its field. Real rclpy asserts here, so code written for it may expect an AssertionError."""
