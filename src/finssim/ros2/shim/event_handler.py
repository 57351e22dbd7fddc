"""`rclpy.event_handler`: what middleware tells of an endpoint; here, that publishers come and go."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

__all__ = ["QoSSubscriptionMatchedInfo", "SubscriptionEventCallbacks"]


class QoSSubscriptionMatchedInfo(NamedTuple):
    """Publishers that a subscription was matched with, and how that changed since it was told last."""

    total_count: int
    """All that ever were."""
    total_count_change: int
    current_count: int
    current_count_change: int


class SubscriptionEventCallbacks:
    """What to call for a subscription's events: of those of rclpy only `matched`."""

    def __init__(
        self, *, matched: Callable[[QoSSubscriptionMatchedInfo], None] | None = None, **others: Any
    ) -> None:
        unknown = {name for name, callback in others.items() if callback is not None} - {
            "use_default_callbacks"
        }
        if unknown:
            raise TypeError(f"the event '{min(unknown)}' needs a sourced ROS 2: leave it out")
        self.matched = matched
