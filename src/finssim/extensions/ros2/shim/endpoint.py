"""Publishers, subscriptions, services and clients as in rclpy, with events, futures and callback groups."""

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
    """Publishers matched with a subscription, and the change since the last event."""

    total_count: int
    """Number of publishers that were ever matched."""
    total_count_change: int
    current_count: int
    current_count_change: int


class SubscriptionEventCallbacks:
    """Callbacks of a subscription's events; of those of rclpy, only `matched` is supported."""

    def __init__(
        self, *, matched: Callable[[QoSSubscriptionMatchedInfo], None] | None = None, **others: Any
    ) -> None:
        unknown = {name for name, callback in others.items() if callback is not None} - {
            "use_default_callbacks"
        }
        if unknown:
            raise TypeError(f"the event '{min(unknown)}' needs a sourced ROS 2: omit it")
        self.matched = matched


# `rclpy.callback_groups`: all are accepted, since callbacks run one at a time, which every group allows.


class CallbackGroup:
    """Group of callbacks."""


class MutuallyExclusiveCallbackGroup(CallbackGroup):
    """Group of callbacks that must not run at the same time."""


class ReentrantCallbackGroup(CallbackGroup):
    """Group of callbacks that may run at the same time, which they do not here."""


# `rclpy.serialization`: messages to bytes and back.


def serialize_message(message: Message) -> bytes:
    """Return the CDR bytes of a message."""
    return bytes(codec_of().serialize(message))


def deserialize_message(data: bytes, message_type: type[Message]) -> Any:
    """Return a message of a class from its CDR bytes."""
    return codec_of().deserialize(bytearray(data), message_type.TYPE)


# `rclpy.task`: results of calls in progress.


class Future(Limited):
    """Result that arrives while an executor spins. It cannot be awaited: coroutines need a sourced ROS 2."""

    def __init__(self, *, executor: Any = None) -> None:
        self._finished = False
        self._result: Any = None
        self._exception: BaseException | None = None
        self._cancelled = False
        self._callbacks: list[Callable[[Future], Any]] = []

    def done(self) -> bool:
        """Return whether it has a result, or was cancelled."""
        return self._finished

    def cancelled(self) -> bool:
        """Return whether it was cancelled."""
        return self._cancelled

    def result(self) -> Any:
        """Return the result; None until then. Raises the exception of a failed call."""
        if self._exception is not None:
            raise self._exception
        return self._result

    def exception(self) -> BaseException | None:
        """Return its exception."""
        return self._exception

    def set_result(self, result: Any) -> None:
        """Set its result."""
        self._result = result
        self._finish()

    def set_exception(self, exception: BaseException) -> None:
        """Set its exception."""
        self._exception = exception
        self._finish()

    def cancel(self) -> None:
        """Cancel it."""
        if not self.done():
            self._cancelled = True
            self._finish()

    def add_done_callback(self, callback: Callable[[Future], Any]) -> None:
        """Call a function with this future once it is done, immediately if it is done already."""
        if self.done():
            callback(self)
        else:
            self._callbacks.append(callback)

    def _finish(self) -> None:
        self._finished = True
        callbacks, self._callbacks = self._callbacks, []
        for callback in callbacks:
            callback(self)


# Common base of publishers, subscriptions, services and clients.


class Endpoint(Limited):
    """Endpoint of a topic or service."""

    node: Any
    msg_type: type[Message]
    topic_name: str
    """Full name of the topic, remapped."""
    wires: tuple[Any, ...] = ()
    """Its readers and writers on the network."""

    @property
    def topic(self) -> str:
        """Full name of the topic, remapped."""
        return self.topic_name

    def close(self) -> None:
        """Leave the network; called by the node."""
        for wire in self.wires:
            wire.close()

    def log_mismatches(self) -> None:
        """Log each newly discovered peer with incompatible QoS."""
        for wire in self.wires:
            policy = wire.incompatible()
            if policy:
                self.node.get_logger().warning(
                    f"New {'subscription' if hasattr(wire, 'write') else 'publisher'} discovered on topic "
                    f"'{self.topic_name}' with incompatible QoS: no messages will pass: give both ends the same "
                    f"{POLICY_WORDS.get(policy, policy)} (last incompatible policy: {policy})"
                )

    def _settle(self, node: Any, msg_type: Any, topic: str, qos_profile: Any) -> Quality:
        """Store the arguments; return the policies."""
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
    """Refuse a callback that would silently never run, or fail when it runs.

    Raises:
        TypeError: The object is not callable, or a coroutine function.
        RuntimeError: It does not accept the number of arguments.
    """
    if not callable(callback):
        raise TypeError(f"the callback is a {type(callback).__name__}: give a function")
    if inspect.iscoroutinefunction(callback):
        raise TypeError("a coroutine as callback needs a sourced ROS 2: give an ordinary function")
    try:
        signature = inspect.signature(callback)
    except ValueError:  # one of Python's own, which has no signature
        return
    try:
        signature.bind(*range(takes))
    except TypeError:
        raise RuntimeError(f"the callback takes {signature}, expected {takes} arguments") from None


# `rclpy.publisher`: the sending end of a topic.


class Publisher(Endpoint):
    """Sender of messages of one type, created by `Node.create_publisher`."""

    def __init__(self, node: Any, msg_type: type[Message], topic: str, qos_profile: Any) -> None:
        quality = self._settle(node, msg_type, topic, qos_profile)
        self._writer = node.context.participant.writer(f"rt{self.topic_name}", msg_type.TYPE, quality)
        self._codec = node.context.participant.codec
        self.wires = (self._writer,)

    def publish(self, msg: Message | bytes) -> None:
        """Send a message, or serialized CDR bytes.

        Raises:
            InvalidHandle: The publisher was destroyed.
            TypeError: The message is of another type.
            MessageError: A field does not fit.
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
        """Destroy the publisher."""
        self.node.destroy_publisher(self)


# `rclpy.subscription`: the receiving end of a topic.


class Subscription(Endpoint):
    """Receiver that calls back with each message of a topic, created by `Node.create_subscription`."""

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
        """Return the callback for a change of publishers, or for the oldest waiting message; None if there is
        neither."""
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
        """Destroy the subscription."""
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


# `rclpy.service`: answers to requests.


class Service(Endpoint):
    """Server that answers requests with a callback, created by `Node.create_service`."""

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
        """Destroy the service."""
        self.node.destroy_service(self)


# `rclpy.client`: calls of a service.


class Client(Endpoint):
    """Client of a service, created by `Node.create_client`.

    Note:
        Responses arrive only from services on Cyclone DDS: with another middleware a service seems ready but never
        answers. Give each call a time limit.
    """

    def __init__(self, node: Any, srv_type: Any, srv_name: str, qos_profile: Any) -> None:
        quality = self._settle(node, srv_type.Request, srv_name, qos_profile)
        self.srv_type, self.srv_name = srv_type, self.topic_name
        self._end = ClientEnd(node.context.participant, self.srv_name, srv_type.TYPE, quality)
        self.wires = (self._end.reader, self._end.writer)
        self._pending: dict[int, Future] = {}

    def call_async(self, request: Message) -> Future:
        """Call the service; the response arrives while an executor spins."""
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
        """Wait until a server is known, and return whether one is. The timeout is in [s]."""
        end = time.monotonic() + (float("inf") if timeout_sec is None else timeout_sec)
        while not self._end.ready():
            if time.monotonic() >= end or not self.node.context.ok():
                return False
            time.sleep(0.01)
        return True

    def remove_pending_request(self, future: Future) -> None:
        """Discard a call."""
        self._pending = {n: f for n, f in self._pending.items() if f is not future}

    def take(self) -> Callable[[], None] | None:
        """Return the callback for the next response; None if there is none."""
        answer = self._end.take()
        if answer is None:
            return None
        future = self._pending.pop(answer[0], None)
        if future is None:  # a call that was discarded
            return lambda: None
        return lambda: future.set_result(answer[1])

    def destroy(self) -> None:
        """Destroy the client; open calls are cancelled."""
        self.node.destroy_client(self)

    def close(self) -> None:
        for future in self._pending.values():
            future.cancel()
        super().close()
