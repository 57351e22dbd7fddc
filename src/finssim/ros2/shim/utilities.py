"""`rclpy.utilities`: the process's context, and arguments without those for ROS."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from finssim.ros2.shim.arguments import parse_arguments
from finssim.ros2.shim.context import Context

__all__ = ["get_default_context", "ok", "remove_ros_args", "shutdown", "try_shutdown"]

_default: list[Context] = []


def get_default_context() -> Context:
    """The context of `rclpy.init()`."""
    if not _default:
        _default.append(Context())
    return _default[0]


def renew_default_context() -> Context:
    """Replace the context after a shutdown, so that `rclpy.init()` can be called again."""
    _default.clear()
    return get_default_context()


def ok(*, context: Context | None = None) -> bool:
    """Whether the context is on the wire."""
    return (context or get_default_context()).ok()


def shutdown(*, context: Context | None = None) -> None:
    """Leave the wire."""
    (context or get_default_context()).shutdown()


def try_shutdown(*, context: Context | None = None) -> None:
    """Leave the wire if on it."""
    (context or get_default_context()).try_shutdown()


def remove_ros_args(args: Sequence[str] | None = None) -> list[str]:
    """A command line without what is for ROS."""
    return parse_arguments(sys.argv if args is None else args).rest
