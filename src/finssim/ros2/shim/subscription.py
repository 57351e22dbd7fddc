"""`rclpy.subscription`: the receiving end of a topic."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from finssim.ros2.codec import Message
from finssim.ros2.errors import Ros2Error
from finssim.ros2.shim.endpoint import Endpoint, check_callback
from finssim.ros2.shim.event_handler import QoSSubscriptionMatchedInfo, SubscriptionEventCallbacks

__all__ = ["Subscription"]


class Subscription(Endpoint):
    """Calls back with each message of a topic. Made by `Node.create_subscription`."""

    def __init__(
        self,
        node: Any,
        msg_type: type[Message],
        topic: str,
        callback: Callable[[Any], None],
        qos_profile: Any,
        raw: bool = False,
        event_callbacks: SubscriptionEventCallbacks | None = None,
    ) -> None:
        check_callback(callback, takes=1)
        quality = self._settle(node, msg_type, topic, qos_profile)
        self.callback, self.raw = callback, raw
        self._reader = node.context.participant.reader(f"rt{self.topic_name}", msg_type.TYPE, quality)
        self._codec = node.context.participant.codec
        self.wires = (self._reader,)
        self._on_match = event_callbacks.matched if event_callbacks is not None else None
        if self._on_match is not None:
            self._reader.watch_matches()

    def take(self) -> Callable[[], None] | None:
        """What calls back with news of publishers, or the oldest waiting message; None without either."""
        if self._on_match is not None:
            info = QoSSubscriptionMatchedInfo(*self._reader.matches())
            if info.total_count_change or info.current_count_change:
                return partial(self._on_match, info)
        sample = self._reader.take()
        if sample is None:
            return None
        data = sample[0]
        return lambda: self._deliver(data)

    def get_publisher_count(self) -> int:
        """How many publishers are known."""
        return int(self._reader.matched())

    def destroy(self) -> None:
        """Leave the topic."""
        self.node.destroy_subscription(self)

    def _deliver(self, data: bytes) -> None:
        if self.raw:
            self.callback(data)
            return
        try:
            message = self._codec.deserialize(bytearray(data), self.msg_type.TYPE)
        except Ros2Error as error:
            self.node.get_logger().error(f"{self.topic_name}: dropped: {error}", throttle_duration_sec=1.0)
            return
        self.callback(message)
