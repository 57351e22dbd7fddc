"""`rclpy.client`: asks a service."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from finssim.ros2.codec import Message
from finssim.ros2.shim.endpoint import Endpoint
from finssim.ros2.shim.task import Future
from finssim.ros2.wire.services import ClientEnd

__all__ = ["Client"]


class Client(Endpoint):
    """Asks a service. Made by `Node.create_client`.

    Note:
        Answers come only from services under Cyclone DDS: under another middleware a service looks ready and stays
        silent. Give each call a time limit.
    """

    def __init__(self, node: Any, srv_type: Any, srv_name: str, qos_profile: Any) -> None:
        quality = self._settle(node, srv_type.Request, srv_name, qos_profile)
        self.srv_type, self.srv_name = srv_type, self.topic_name
        self._end = ClientEnd(node.context.participant, self.srv_name, srv_type.TYPE, quality)
        self.wires = (self._end.reader, self._end.writer)
        self._pending: dict[int, Future] = {}

    def call_async(self, request: Message) -> Future:
        """Ask; the answer comes while an executor spins."""
        if not isinstance(request, self.srv_type.Request):
            raise TypeError(
                f"{self.srv_name} takes {self.srv_type.Request.TYPE}, found {type(request).__name__}"
            )
        future = Future()
        self._pending[self._end.send(request)] = future
        return future

    def call(self, request: Message, timeout_sec: float | None = None) -> Any:
        """Ask and wait, while another thread spins: in a callback of the thread that spins it would never end.

        Raises:
            TimeoutError: No answer in time.
        """
        future = self.call_async(request)
        if not future.wait(timeout_sec):
            self.remove_pending_request(future)
            raise TimeoutError(
                f"{self.srv_name} did not answer within {timeout_sec} s: spin in another thread, and see whether the "
                "service runs under Cyclone DDS"
            )
        return future.result()

    def service_is_ready(self) -> bool:
        """Whether a server is known."""
        return self._end.ready()

    def wait_for_service(self, timeout_sec: float | None = None) -> bool:
        """Wait until a server is known; whether one is."""
        end = time.monotonic() + (float("inf") if timeout_sec is None else timeout_sec)
        while not self._end.ready():
            if time.monotonic() >= end or not self.node.context.ok():
                return False
            time.sleep(0.01)
        return True

    def remove_pending_request(self, future: Future) -> None:
        """Forget a call."""
        self._pending = {n: f for n, f in self._pending.items() if f is not future}

    def take(self) -> Callable[[], None] | None:
        """What hands over the next answer; None without one."""
        answer = self._end.take()
        if answer is None:
            return None
        future = self._pending.pop(answer[0], None)
        if future is None:  # a call that was given up
            return lambda: None
        return lambda: future.set_result(answer[1])

    def destroy(self) -> None:
        """Stop asking; open calls are cancelled."""
        self.node.destroy_client(self)

    def close(self) -> None:
        for future in self._pending.values():
            future.cancel()
        super().close()
