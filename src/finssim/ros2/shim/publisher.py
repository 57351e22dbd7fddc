"""`rclpy.publisher`: the sending end of a topic."""

from __future__ import annotations

from typing import Any

from finssim.ros2.codec import HEADER, Message
from finssim.ros2.shim.endpoint import Endpoint
from finssim.ros2.shim.exceptions import InvalidHandle

__all__ = ["Publisher"]


class Publisher(Endpoint):
    """Sends messages of one type. Made by `Node.create_publisher`."""

    def __init__(self, node: Any, msg_type: type[Message], topic: str, qos_profile: Any) -> None:
        quality = self._settle(node, msg_type, topic, qos_profile)
        self._writer = node.context.participant.writer(f"rt{self.topic_name}", msg_type.TYPE, quality)
        self._codec = node.context.participant.codec
        self.wires = (self._writer,)

    def publish(self, msg: Message | bytes) -> None:
        """Send a message, or ready CDR bytes.

        Raises:
            InvalidHandle: It was destroyed.
            TypeError: A message of another type.
            MessageError: One with a field that does not fit.
        """
        if self._writer.closed:
            raise InvalidHandle(f"the publisher of {self.topic_name} was destroyed: make another")
        if type(msg) is self.msg_type:
            buffer = self._codec.serialize(msg)
        elif isinstance(msg, bytes) and msg[:2] == HEADER[:2]:
            buffer = bytearray(msg) + bytes(-len(msg) % 4)
        else:
            raise TypeError(f"{self.topic_name} carries {self.msg_type.TYPE}, found {type(msg).__name__}")
        if not self._writer.write(buffer):
            self.node.get_logger().warning(
                f"a message on {self.topic_name} was left out: readers are too slow",
                throttle_duration_sec=1.0,
            )

    def get_subscription_count(self) -> int:
        """How many subscriptions are known to get it."""
        return int(self._writer.matched())

    def destroy(self) -> None:
        """Leave the topic."""
        self.node.destroy_publisher(self)
