"""`rclpy.service`: answers requests."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from finssim.ros2.codec import Message
from finssim.ros2.shim.endpoint import Endpoint, check_callback
from finssim.ros2.wire.services import ServerEnd

__all__ = ["Service"]


class Service(Endpoint):
    """Answers requests with a callback. Made by `Node.create_service`."""

    def __init__(
        self, node: Any, srv_type: Any, srv_name: str, callback: Callable[[Any, Any], Any], qos_profile: Any
    ) -> None:
        check_callback(callback, takes=2)
        quality = self._settle(node, srv_type.Request, srv_name, qos_profile)
        self.srv_type, self.srv_name, self.callback = srv_type, self.topic_name, callback
        self._end = ServerEnd(node.context.participant, self.srv_name, srv_type.TYPE, self._answer, quality)
        self.wires = (self._end.reader, self._end.writer)
        self.take = self._end.take

    def _answer(self, request: Message) -> Message:
        reply = self.callback(request, self.srv_type.Response())
        if not isinstance(reply, self.srv_type.Response):
            raise TypeError(
                f"{self.srv_name}: the callback gave {reply!r}: let it return the response it was given"
            )
        return reply

    def destroy(self) -> None:
        """Stop answering."""
        self.node.destroy_service(self)
