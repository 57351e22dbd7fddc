"""Lock-step: the robot's software and a world advance in turns, as fast as both can compute.

Over a stream every message is its length (u32), a kind (u8) and a body, all little endian:

    1 request   until f64, n u32, n frames
    2 delivery  time f64, n u32, n x (arrival f64, frame), m u32, m pictures
    3 refusal   a sentence, UTF-8: the world cannot continue

A frame or a picture is its length (u32) and bytes; those of a picture are as on the UDP wire, uncompressed.
"""

from __future__ import annotations

import itertools
import socket
import struct
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from typing import Protocol

from finssim.robot.interrupt import interruptible
from finssim.robot.messages import Delivery, Picture
from finssim.robot.pictures import decode_picture, encode_picture
from finssim.robot.runtime import Runtime

REQUEST, DELIVERY, REFUSAL = 1, 2, 3
LONGEST = 256 * 2**20
"""Greatest length of a message [bytes]."""

_F8, _U4, _KIND = struct.Struct("<d"), struct.Struct("<I"), struct.Struct("<IB")
_ARRIVED = struct.Struct("<dI")


class LockstepError(ValueError):
    """The other end is missing, has closed the connection, or does not use this protocol."""


def encode_request(until: float, sent: Sequence[bytes]) -> bytes:
    """Return a request to advance a world to a time [s] with the frames that the robot sent to its motor
    controller."""
    parts = [_F8.pack(until), _U4.pack(len(sent))]
    for frame in sent:
        parts += (_U4.pack(len(frame)), frame)
    return _message(REQUEST, parts)


def decode_request(kind: int, body: bytes) -> tuple[float, tuple[bytes, ...]]:
    """Return time [s] and frames of a request.

    Raises:
        LockstepError: The message is not a request.
    """
    if kind != REQUEST:
        raise LockstepError(
            f"message of kind {kind}, expected a request ({REQUEST}): is the robot of this version?"
        )
    reader = _Reader(body)
    (until,), (n,) = reader.take(_F8), reader.take(_U4)
    return until, tuple(reader.block(reader.take(_U4)[0]) for _ in range(n))


def encode_delivery(delivery: Delivery) -> bytes:
    """Return the response to a request."""
    parts = [_F8.pack(delivery.time), _U4.pack(len(delivery.frames))]
    for arrival, frame in delivery.frames:
        parts += (_ARRIVED.pack(arrival, len(frame)), frame)
    parts.append(_U4.pack(len(delivery.pictures)))
    for picture in delivery.pictures:
        data = encode_picture(picture)
        parts += (_U4.pack(len(data)), data)
    return _message(DELIVERY, parts)


def encode_refusal(sentence: str) -> bytes:
    """Return the response that the world cannot continue, with the reason."""
    return _message(REFUSAL, [sentence.encode()])


def decode_delivery(kind: int, body: bytes) -> Delivery:
    """Return the content of a response.

    Raises:
        LockstepError: The response is a refusal, whose sentence is the message, or not a delivery.
    """
    if kind == REFUSAL:
        raise LockstepError(body.decode(errors="replace"))
    if kind != DELIVERY:
        raise LockstepError(
            f"message of kind {kind}, expected a delivery ({DELIVERY}): is it a FinsSim pool?"
        )
    reader = _Reader(body)
    (time,), (n,) = reader.take(_F8), reader.take(_U4)
    frames = []
    for _ in range(n):
        arrival, size = reader.take(_ARRIVED)
        frames.append((arrival, reader.block(size)))
    (m,) = reader.take(_U4)
    return Delivery(time, tuple(frames), tuple(_picture(reader) for _ in range(m)))


def receive(connection: socket.socket) -> tuple[int, bytes] | None:
    """Return kind and body of the next message; None if the other end has closed between two messages.

    Raises:
        LockstepError: The other end closed within a message, or the message is invalid.
        OSError: The connection broke or was silent for longer than its timeout.
    """
    head = _exactly(connection, _KIND.size)
    if head is None:
        return None
    size, kind = _KIND.unpack(head)
    if kind not in (REQUEST, DELIVERY, REFUSAL) or size > LONGEST:
        raise LockstepError("what came is no lock-step message: is the other end a FinsSim of this version?")
    body = _exactly(connection, size) if size else b""
    if body is None:
        raise LockstepError("the other end closed within a message")
    return kind, body


def _message(kind: int, parts: Sequence[bytes]) -> bytes:
    body = b"".join(parts)
    return _KIND.pack(len(body), kind) + body


def _picture(reader: _Reader) -> Picture:
    posted = decode_picture(reader.block(reader.take(_U4)[0]))
    if posted is None:
        raise LockstepError("a picture cannot be read: is the other end of this version?")
    return posted.picture


def _exactly(connection: socket.socket, size: int) -> bytes | None:
    """Return exactly `size` bytes; None if the connection ended before the first."""
    buffer = bytearray(size)
    view, at = memoryview(buffer), 0
    while at < size:
        n = connection.recv_into(view[at:])
        if n == 0:
            if at == 0:
                return None
            raise LockstepError("the other end closed within a message")
        at += n
    return bytes(buffer)


class _Reader:
    """Reader of the values of a body in order."""

    def __init__(self, body: bytes) -> None:
        self._body, self._at = body, 0

    def take(self, form: struct.Struct) -> tuple[float, ...] | tuple[int, ...]:
        return form.unpack(self.block(form.size))

    def block(self, size: int) -> bytes:
        start, self._at = self._at, self._at + size
        if self._at > len(self._body):
            raise LockstepError("a message ends before what it announces: is the other end of this version?")
        return self._body[start : self._at]


DEFAULT_PORT = 58768
"""Port of a pool on this machine for a robot in lock-step."""
LAST_FRAMES = 3
"""Number of frames without thrust at the end of a run."""


class Exchange(Protocol):
    """A world whose time advances only on request."""

    def exchange(self, until: float, sent: Sequence[bytes]) -> Delivery:
        """Advance the world.

        Args:
            until: New time, robot's clock [s].
            sent: Datagrams to the motor controller, sent at the time of the last call.

        Returns:
            Everything that reached the robot's computer meanwhile.
        """


class Carrier(Protocol):
    """Carrier of datagrams between robots."""

    def send(self, now: float, sender: str, datagram: bytes) -> None:
        """Send a datagram at a time [s]."""

    def receive(self, now: float, name: str) -> Sequence[bytes]:
        """Return the datagrams that have reached a robot by a time [s]."""


class LockstepClient:
    """A world in another process, over TCP."""

    def __init__(self, address: str = f"127.0.0.1:{DEFAULT_PORT}", *, timeout: float = 60.0) -> None:
        """Connect.

        Args:
            address: HOST:PORT of `finssim pool --lockstep`.
            timeout: Longest silence [s].

        Raises:
            LockstepError: There is no response at this address.
        """
        host, _, port = address.rpartition(":")
        self.address = address
        try:
            self._connection = socket.create_connection((host or "127.0.0.1", int(port)), timeout=timeout)
        except (OSError, ValueError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or error
            raise LockstepError(
                f"no world in lock-step at {address} ({reason}): start one with finssim pool --lockstep"
            ) from None
        self._connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def exchange(self, until: float, sent: Sequence[bytes]) -> Delivery:
        """Advance the world; see `Exchange`.

        Raises:
            LockstepError: The world refused, did not respond or closed the connection.
        """
        try:
            self._connection.sendall(encode_request(until, sent))
            message = receive(self._connection)
        except OSError as error:
            reason = "silent for too long" if isinstance(error, TimeoutError) else error.strerror or error
            raise LockstepError(
                f"the world at {self.address} does not answer ({reason}): check the output of its process"
            ) from None
        if message is None:
            raise LockstepError(f"the world at {self.address} is gone: check the output of its process")
        return decode_delivery(*message)

    def close(self) -> None:
        """Close the connection to the world."""
        self._connection.close()

    def __enter__(self) -> LockstepClient:
        return self

    def __exit__(self, *problem: object) -> None:
        self.close()


def run_lockstep(
    runtime: Runtime,
    world: Exchange,
    duration: float,
    *,
    rate: float = 60.0,
    start: float = 0.0,
    gentle: bool = False,
    show: Callable[[Runtime], None] = lambda runtime: None,
    until: Callable[[Runtime], bool] = lambda runtime: False,
) -> float:
    """Run a robot in a world until the time is over or `until` returns True; then stop its thrusters.

    Args:
        runtime: The robot.
        world: Its world, at the time `start`.
        duration: Duration [s].
        rate: Steps per second [Hz].
        start: Robot's clock at the beginning [s].
        gentle: True if Ctrl-C and SIGTERM end the run as its duration does. Otherwise they interrupt it, so that an
            interrupted trial is not taken for a complete one.
        show: Called after every step.
        until: Called after every step; the run ends if it returns True.

    Returns:
        Robot's clock at the end [s].
    """
    return run_together(
        {"": (runtime, world)}, duration, rate=rate, start=start, gentle=gentle, show=lambda: show(runtime),
        until=lambda: until(runtime),
    )  # fmt: skip


def run_together(
    stacks: Mapping[str, tuple[Runtime, Exchange]],
    duration: float,
    *,
    carrier: Carrier | None = None,
    rate: float = 60.0,
    start: float = 0.0,
    gentle: bool = False,
    show: Callable[[], None] = lambda: None,
    until: Callable[[], bool] = lambda: False,
) -> float:
    """Run several robots, each in its world, on one clock; see `run_lockstep`.

    Args:
        stacks: Robot and world by name.
        duration: Duration [s].
        carrier: Carrier of messages between the robots; None: they exchange no messages.
        rate: Steps per second [Hz].
        start: Robots' clock at the beginning [s].
        gentle: See `run_lockstep`.
        show: Called after every step of all.
        until: Called after every step of all; the run ends if it returns True.

    Returns:
        Robots' clock at the end [s].
    """
    now: float = start
    sent: dict[str, list[bytes]] = {name: [] for name in stacks}
    with interruptible() if gentle else nullcontext(lambda: False) as interrupted:
        for k in itertools.count(1):
            if interrupted() or k > duration * rate + 1e-6:
                break
            deliveries = {
                name: world.exchange(start + k / rate, sent[name]) for name, (_, world) in stacks.items()
            }
            for name, (runtime, _) in stacks.items():
                delivery = deliveries[name]
                now = delivery.time
                heard = carrier.receive(now, name) if carrier is not None else ()
                sent[name] = runtime.step(now, delivery.frames, delivery.pictures, heard)
                runtime.sent(now)
            for name, (runtime, _) in stacks.items() if carrier is not None else ():
                for datagram in runtime.team_datagrams:
                    carrier.send(now, name, datagram)
            show()
            if until():
                break
    # A world that has ended is already stopped: only one that continues needs the last frames.
    last = [
        world.exchange(now + 1.0 / rate, runtime.stop(now, LAST_FRAMES)).time
        for runtime, world in stacks.values()
    ]
    return last[0]
