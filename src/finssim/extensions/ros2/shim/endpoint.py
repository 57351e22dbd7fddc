"""Publishers, subscriptions, services and clients as rclpy has them, their events, answers and callback groups."""

from __future__ import annotations

import inspect
import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

from finssim.extensions.ros2 import Ros2Error
from finssim.extensions.ros2.codec import HEADER, Message, codec_of
from finssim.extensions.ros2.limits import Limited
from finssim.extensions.ros2.shim.exceptions import InvalidHandle
from finssim.extensions.ros2.shim.qos import quality_of
from finssim.extensions.ros2.wire import ClientEnd, Quality, ServerEnd


class QoSSubscriptionMatchedInfo(NamedTuple):
    """Publishers that a subscription was matched with, and the change since the last event."""

    total_count: int
    """All that ever were."""
    total_count_change: int
    current_count: int
    current_count_change: int


class SubscriptionEventCallbacks:
    """Callbacks of a subscription's events: of those of rclpy only `matched`."""

    def __init__(
        self, *, matched: Callable[[QoSSubscriptionMatchedInfo], None] | None = None, **others: Any
    ) -> None:
        unknown = {name for name, callback in others.items() if callback is not None} - {
            "use_default_callbacks"
        }
        if unknown:
            raise TypeError(f"the event '{min(unknown)}' needs a sourced ROS 2: omit it")
        self.matched = matched


# `rclpy.callback_groups`: accepted and met: callbacks run one at a time, which every group allows.


class CallbackGroup:
    """Callbacks that may or may not run at the same time."""


class MutuallyExclusiveCallbackGroup(CallbackGroup):
    """Callbacks that must not run at the same time."""


class ReentrantCallbackGroup(CallbackGroup):
    """Callbacks that may run at the same time, and here do not."""


# `rclpy.serialization`: messages to bytes and back.


def serialize_message(message: Message) -> bytes:
    """CDR bytes of a message."""
    return bytes(codec_of().serialize(message))


def deserialize_message(data: bytes, message_type: type[Message]) -> Any:
    """A message of a class from its CDR bytes."""
    return codec_of().deserialize(bytearray(data), message_type.TYPE)


# `rclpy.task`: answers that have yet to come.


class Future(Limited):
    """An answer that comes while some executor spins. Not to be awaited: coroutines need a sourced ROS 2."""

    def __init__(self, *, executor: Any = None) -> None:
        self._finished = False
        self._result: Any = None
        self._exception: BaseException | None = None
        self._cancelled = False
        self._callbacks: list[Callable[[Future], Any]] = []

    def done(self) -> bool:
        """Return whether it has a result, or never will."""
        return self._finished

    def cancelled(self) -> bool:
        """Return whether it was cancelled."""
        return self._cancelled

    def result(self) -> Any:
        """The answer; None until then. Raises what the asked one raised."""
        if self._exception is not None:
            raise self._exception
        return self._result

    def exception(self) -> BaseException | None:
        """Return its exception."""
        return self._exception

    def set_result(self, result: Any) -> None:
        """Give the answer."""
        self._result = result
        self._finish()

    def set_exception(self, exception: BaseException) -> None:
        """Set its exception."""
        self._exception = exception
        self._finish()

    def cancel(self) -> None:
        """Stop waiting."""
        if not self.done():
            self._cancelled = True
            self._finish()

    def add_done_callback(self, callback: Callable[[Future], Any]) -> None:
        """Call a function with this future once it is done, immediately if it is."""
        if self.done():
            callback(self)
        else:
            self._callbacks.append(callback)

    def _finish(self) -> None:
        self._finished = True
        callbacks, self._callbacks = self._callbacks, []
        for callback in callbacks:
            callback(self)


# What publishers, subscriptions, services and clients share.


class Endpoint(Limited):
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
    except ValueError:  # one of Python's own, which has no message
        return
    try:
        signature.bind(*range(takes))
    except TypeError:
        raise RuntimeError(f"the callback takes {signature}, expected {takes} arguments") from None


# `rclpy.publisher`: the sending end of a topic.


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
        """Return the number of known subscriptions."""
        return int(self._writer.matched())

    def destroy(self) -> None:
        """Leave the topic."""
        self.node.destroy_publisher(self)


# `rclpy.subscription`: the receiving end of a topic.


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
        """Return the callback with news of publishers, or with the oldest waiting message; None without either."""
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
        """Return the number of known publishers."""
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


# `rclpy.service`: answers requests.


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


# `rclpy.client`: asks a service.


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

    def service_is_ready(self) -> bool:
        """Return whether a server is known."""
        return self._end.ready()

    def wait_for_service(self, timeout_sec: float | None = None) -> bool:
        """Wait until a server is known; whether one is. The timeout is in [s]."""
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
        """Return the callback with the next answer; None without one."""
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
