"""What publishers, subscriptions, services and clients share."""

from __future__ import annotations

import inspect
from typing import Any

from finssim.ros2.codec import Message
from finssim.ros2.shim.qos import quality_of
from finssim.ros2.wire.quality import Quality

__all__ = ["Endpoint", "check_callback"]


class Endpoint:
    """One end of a topic."""

    node: Any
    msg_type: type[Message]
    topic_name: str
    """Full name, remapped."""
    wires: tuple[Any, ...] = ()
    """Its readers and writers on the wire."""

    @property
    def topic(self) -> str:
        """Full name, remapped."""
        return self.topic_name

    def close(self) -> None:
        """Leave the wire; the node does this."""
        for wire in self.wires:
            wire.close()

    def tell_mismatches(self) -> None:
        """Log each peer that newly turned out not to fit."""
        for wire in self.wires:
            policy = wire.incompatible()
            if policy:
                self.node.get_logger().warning(
                    f"New {'subscription' if hasattr(wire, 'write') else 'publisher'} discovered on topic "
                    f"'{self.topic_name}' with incompatible QoS: no messages will pass: give both ends the same "
                    f"{POLICY_WORDS.get(policy, policy)} (last incompatible policy: {policy})"
                )

    def _settle(self, node: Any, msg_type: Any, topic: str, qos_profile: Any) -> Quality:
        """Take over the arguments; returns the policies."""
        if not (isinstance(msg_type, type) and issubclass(msg_type, Message)):
            raise TypeError(
                f"{topic}: {msg_type!r} is no message type: import one from a package such as nav_msgs.msg"
            )
        self.node, self.msg_type, self.topic_name = node, msg_type, node.resolve_topic_name(topic)
        return quality_of(qos_profile)


POLICY_WORDS = {
    "RELIABILITY": "reliability",
    "DURABILITY": "durability",
    "DEADLINE": "deadline",
    "LIVELINESS": "liveliness",
}


def check_callback(callback: Any, takes: int) -> None:
    """Refuse what would silently never run, or fail when it does.

    Raises:
        TypeError: Not callable, or a coroutine function.
        RuntimeError: It does not take that many arguments.
    """
    if not callable(callback):
        raise TypeError(f"the callback is a {type(callback).__name__}: give a function")
    if inspect.iscoroutinefunction(callback):
        raise TypeError("a coroutine as callback needs a sourced ROS 2: give an ordinary function")
    try:
        signature = inspect.signature(callback)
    except ValueError:  # one of Python's own, which tells nothing
        return
    try:
        signature.bind(*range(takes))
    except TypeError:
        raise RuntimeError(f"the callback takes {signature}, expected {takes} arguments") from None
