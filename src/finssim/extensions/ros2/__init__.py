"""ROS 2 for FinsSim: native DDS without a ROS installation, and one source for messages, names and frames."""

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
    """Setting, name or definition of ROS 2 that cannot be used; the message states in one sentence how to
    correct it."""


class MessageError(AssertionError):
    """Value that does not fit its field. Real rclpy asserts here, so code written for it may expect an
    AssertionError."""
