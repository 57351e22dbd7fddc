"""A virtual pool for robots in other processes: in real time, a port for each, or in lock-step over TCP."""

from __future__ import annotations

import math
import socket
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, replace
from typing import Protocol

from finssim.pool.fleet import Fleet, Medium, one_picture
from finssim.pool.pictures import UdpSender
from finssim.pool.virtual_pool import PoolClockError, VirtualPool
from finssim.robot.link.transports import Address, TcpServer, Transport, bound_socket, resolved
from finssim.robot.link.water_linked import DvlServer
from finssim.robot.lockstep import (
    LockstepError,
    decode_request,
    encode_delivery,
    encode_refusal,
    receive,
)
from finssim.robot.messages import Picture
from finssim.robot.team import decode_track

__all__ = ["GroundLinks", "LockstepServer", "MediumServer", "Pace", "serve_realtime"]


TICK = 0.003
"""Between looks at the wire [s]."""
MOST_BEHIND = 0.2
"""A pool that is further behind gives up that time [s]: its clock stands still instead, as on a stopped computer."""


class Clocked(Protocol):
    """A camera that must know when the pool's clock began."""

    start: float


@dataclass
class Pace:
    """How well a pool kept real time."""

    duration: float = 0.0
    """Of the pool's clock [s]."""
    late: float = 0.0
    """The most that the pool was behind at a tick [s]."""
    given_up: float = 0.0
    """Time that the pool stood still because it was too far behind [s]."""
    received: int = 0
    """Frames from the robot."""
    sent: int = 0
    """Frames to it."""
    pictures: int = 0
    """That were sent from this process."""

    @property
    def sentence(self) -> str:
        """What a person wants to know."""
        kept = f"gave up {self.given_up:.2f} s" if self.given_up else "kept real time"
        return (
            f"{self.duration:.1f} s, {kept}, at most {1e3 * self.late:.0f} ms late; "
            f"{self.received} frames in, {self.sent} out"
        )


class LockstepServer:
    """A pool whose clock goes on as far as its one robot asks, and ends when the robot leaves."""

    def __init__(self, address: tuple[str, int]) -> None:
        """Listen.

        Args:
            address: Host and port; port 0 takes a free one (see `address`).

        Raises:
            LinkError: It cannot be bound.
        """
        self._listener = bound_socket(socket.SOCK_STREAM, address)
        self._listener.listen(1)
        self.address: tuple[str, int] = self._listener.getsockname()

    def serve(self, world: VirtualPool, *, duration: float = math.inf) -> str:
        """Wait for a robot and serve it; nobody else is let in.

        Args:
            world: The pool.
            duration: Longest time of the pool's clock [s]; a request beyond it is refused.

        Returns:
            Why it ended, in a few words.
        """
        connection, robot = self._listener.accept()
        self.close()
        with connection:
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            try:
                while (message := receive(connection)) is not None:
                    until, sent = decode_request(*message)
                    if until > duration + 1e-9:
                        connection.sendall(encode_refusal(f"the pool ends at {duration:g} s, as it was told"))
                        return "the time is over"
                    connection.sendall(encode_delivery(world.exchange(until, sent)))
            except (LockstepError, PoolClockError) as problem:
                with suppress(OSError):  # it may not wait for the answer
                    connection.sendall(encode_refusal(str(problem)))
                return f"{robot[0]}:{robot[1]} was refused: {problem}"
            except OSError as problem:
                return f"the robot has gone: {problem.strerror or problem}"
        return "the robot has left"

    def close(self) -> None:
        """Stop listening."""
        self._listener.close()


MOST_CALLERS = 8
"""Ground stations that are answered over UDP: those that called last."""
LARGEST = 2048
"""Bytes taken of a datagram."""
MOST_FRAMES = 1024
"""Taken of UDP by one call, so that a flood cannot hold the loop up."""


def whole_frames(data: bytearray) -> list[bytes]:
    """Cut the MAVLink frames that are complete off a stream, and what is before the first one."""
    frames: list[bytes] = []
    while True:
        starts = [i for i in (data.find(b"\xfd"), data.find(b"\xfe")) if i >= 0]
        del data[: min(starts, default=len(data))]
        if len(data) < 3:
            return frames
        length = 12 + data[1] + 13 * (data[2] & 1) if data[0] == 0xFD else 8 + data[1]
        if len(data) < length:
            return frames
        frames.append(bytes(data[:length]))
        del data[:length]


class GroundLinks:
    """The router of an autopilot: its frames go to all ground stations, theirs to it and to each other.

    Over UDP stations are those told of and whoever sends, over TCP whoever connects; lines of the Doppler log go to its
    own clients. A `Transport`: no call waits.

    Attributes:
        address: UDP, of this end.
        tcp: Where stations connect.
        dvl: The log's server.
    """

    def __init__(self, bind: Address, stations: Sequence[Address], tcp: Address, dvl: Address) -> None:
        """Open all; port 0 takes a free one.

        Args:
            bind: UDP, of this end.
            stations: UDP, that frames go to before they have sent anything.
            tcp: To listen at.
            dvl: For the Doppler log.

        Raises:
            LinkError: One cannot be bound or found.
        """
        self._fixed = [resolved(station) for station in stations]
        self._callers: deque[Address] = deque(maxlen=MOST_CALLERS)
        with ExitStack() as stack:
            self._socket = stack.enter_context(bound_socket(socket.SOCK_DGRAM, bind))
            self._socket.setblocking(False)
            self._streams = stack.enter_context(closing(TcpServer(tcp, bytearray)))
            self.dvl = stack.enter_context(closing(DvlServer(dvl)))
            self._stack = stack.pop_all()
        self.address: Address = self._socket.getsockname()
        self.tcp = self._streams.address

    def receive(self) -> list[bytes]:
        """Whole frames of all stations, which the other stations get too."""
        self.dvl.poll()
        frames: list[bytes] = []
        with suppress(BlockingIOError, ConnectionError):
            while len(frames) < MOST_FRAMES:
                data, sender = self._socket.recvfrom(LARGEST)
                if sender not in (*self._fixed, *self._callers):
                    self._callers.append(sender)  # and forget the one that came first, if they are too many
                frames += self._pass_on(bytearray(data), sender)
        for station, stream, data in self._streams.receive():
            stream += data
            frames += self._pass_on(stream, station)
        return frames

    def send(self, data: bytes) -> None:
        """Send a frame to every station, or a line to the log's clients."""
        if data[:1] == b"{":
            self.dvl.send(data)
        else:
            self._broadcast(data)

    def close(self) -> None:
        """Let everyone go."""
        self._stack.close()

    def describe(self) -> str:
        """Who is there."""
        return f"{len(self._callers)} stations over UDP, {len(self._streams.clients)} over TCP"

    def _pass_on(self, stream: bytearray, source: object) -> list[bytes]:
        frames = whole_frames(stream)
        for frame in frames:
            self._broadcast(frame, source)
        return frames

    def _broadcast(self, frame: bytes, source: object = None) -> None:
        """To all stations but the source."""
        for address in [*self._fixed, *self._callers]:
            if address != source:
                with suppress(OSError):  # nobody listens there yet
                    self._socket.sendto(frame, address)
        for station in list(self._streams.clients):
            if station is not source:
                self._streams.send(frame, station)


RATE = 60.0
"""Steps a second of the software of vehicles that the task commands [Hz]."""


class MediumServer:
    """A medium's end for robots in other processes: who sends under a name is answered under it."""

    def __init__(self, address: tuple[str, int], medium: Medium, names: tuple[str, ...]) -> None:
        """Listen.

        Args:
            address: Host and port; port 0 takes a free one (see `address`).
            medium: That carries the messages.
            names: Who may send.

        Raises:
            LinkError: It cannot be bound.
        """
        self._medium, self._names = medium, frozenset(names)
        self._robots: dict[str, tuple[str, int]] = {}
        self._socket = bound_socket(socket.SOCK_DGRAM, address)
        self._socket.setblocking(False)
        self.address: tuple[str, int] = self._socket.getsockname()

    def poll(self, now: float) -> None:
        """Take what has come and send what has arrived, at the site's clock [s]."""
        with suppress(BlockingIOError, ConnectionError):
            while True:
                data, sender = self._socket.recvfrom(LARGEST)
                heard = decode_track(data, now)
                if heard is not None and heard[0] in self._names:
                    self._robots[heard[0]] = sender
                    self._medium.send(now, heard[0], data)
        for name in self._names:  # what reaches a robot that has not spoken yet is lost
            for data in self._medium.receive(now, name):
                if name in self._robots:
                    with suppress(OSError):
                        self._socket.sendto(data, self._robots[name])

    def close(self) -> None:
        """Stop listening."""
        self._socket.close()


def serve_realtime(
    site: Fleet,
    transports: Mapping[str, Transport],
    messages: MediumServer | None = None,
    *,
    sinks: Sequence[UdpSender] = (),
    camera: Clocked | None = None,
    duration: float = math.inf,
    until: Callable[[Pace], bool] = lambda pace: False,
    over: Callable[[], None] = lambda: None,
    clock: Callable[[], float] = time.monotonic,
    wait: Callable[[float], None] = time.sleep,
) -> Pace:
    """Let a site live in real time until the time is over or `until` says so.

    Args:
        site: With robots in other processes, at time 0.
        transports: To the robot of each of these vehicles, by name, from the motor controllers' end.
        messages: Between the robots; None: they tell each other nothing.
        sinks: Take the one camera's pictures, one for each robot.
        camera: One that sends its pictures itself.
        duration: How long [s].
        until: Ends it where it says so; asked at every tick.
        over: Called once, when the site says that it is over; it lives on.
        clock: This machine's clock [s].
        wait: Waits so long [s].
    """
    pace, start, now = Pace(), clock(), 0.0
    sent: dict[str, list[bytes]] = {name: [] for name in site.runtimes}
    frames: dict[str, list[tuple[float, bytes]]] = {name: [] for name in site.runtimes}
    steps, told = 0, False
    while now < duration and not until(pace):
        behind = clock() - start - now
        if behind > MOST_BEHIND:
            pace.given_up += behind - TICK
            start += behind - TICK
        if camera is not None:
            camera.start = start
        now = min(max(clock() - start, now), duration)
        pictures: list[Picture] = []
        for name, transport in transports.items():
            received = transport.receive()
            delivery = site.worlds[name].exchange(now, received)
            pictures += delivery.pictures
            for _, frame in delivery.frames:
                transport.send(frame)
            pace.received, pace.sent = pace.received + len(received), pace.sent + len(delivery.frames)
        for picture in one_picture(pictures):
            for sink in sinks:
                sink.send(replace(picture, time=start + picture.time), clock())
                pace.pictures += 1
        due = now * RATE >= steps + 1
        for name, runtime in site.runtimes.items():
            delivery = site.worlds[name].exchange(now, sent[name])
            sent[name], frames[name] = [], frames[name] + list(delivery.frames)
            if due and site.medium is not None:
                sent[name] = runtime.step(now, frames[name], (), site.medium.receive(now, name))
                frames[name] = []
                for datagram in runtime.told:
                    site.medium.send(now, name, datagram)
        steps = math.floor(now * RATE)
        if messages is not None:
            messages.poll(now)
        site.turn(now, due)
        if site.over and not told:
            told = True
            over()
        pace.duration, done = now, clock() - start
        pace.late = max(pace.late, done - now) if now > 1.0 else pace.late
        wait(max(TICK - (done - now), 0.0))
    return pace
