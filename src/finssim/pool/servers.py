"""Servers of a virtual pool for robots in other processes: lock-step, an autopilot's router, messages of a team."""

from __future__ import annotations

import math
import select
import socket
from collections import deque
from collections.abc import Sequence
from contextlib import ExitStack, closing, suppress

from finssim.pool.fleet import Medium
from finssim.pool.virtual_pool import PoolClockError, VirtualPool
from finssim.robot.links.transports import Address, TcpServer, bound_socket, resolved
from finssim.robot.links.water_linked import DvlServer, serve_about
from finssim.robot.lockstep import LockstepError, decode_request, encode_delivery, encode_refusal, receive
from finssim.robot.team import decode_track

MOST_CALLERS = 8
"""Largest number of UDP ground stations, or of connections before lock-step: the latest ones are kept."""
GUEST_PATIENCE = 2.0
"""Time within which a robot's first request must arrive completely [s]."""


class LockstepServer:
    """Server of a pool whose clock advances as its only robot requests, and which ends when the robot leaves."""

    def __init__(self, address: tuple[str, int]) -> None:
        """Listen for robots.

        Args:
            address: Host and port; port 0 selects a free one (see `address`).

        Raises:
            LinkError: It cannot be bound.
        """
        self._listener = bound_socket(socket.SOCK_STREAM, address)
        self._listener.listen(1)
        self.address: tuple[str, int] = self._listener.getsockname()

    def serve(self, world: VirtualPool, *, duration: float = math.inf) -> str:
        """Wait for a robot and serve it; no other robot is accepted.

        The robot is the first client that sends a valid request. Clients that disconnect, send nothing or send
        something else are closed, and the pool continues to listen.

        Args:
            world: The pool.
            duration: Longest time of the pool's clock [s]; later requests are refused.

        Returns:
            Reason for the end, in a few words.
        """
        connection, request = self._first_request()
        self.close()
        with connection:
            robot = connection.getpeername()
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            try:
                message: tuple[int, bytes] | None = request
                while message is not None:
                    until, sent = decode_request(*message)
                    if until > duration + 1e-9:
                        connection.sendall(
                            encode_refusal(f"the pool ends at {duration:g} s, its given duration")
                        )
                        return "the time is over"
                    connection.sendall(encode_delivery(world.exchange(until, sent)))
                    message = receive(connection)
            except (LockstepError, PoolClockError) as problem:
                with suppress(OSError):  # the robot may be gone
                    connection.sendall(encode_refusal(str(problem)))
                return f"{robot[0]}:{robot[1]} was refused: {problem}"
            except OSError as problem:
                return f"the robot has gone: {problem.strerror or problem}"
        return "the robot has left"

    def _first_request(self) -> tuple[socket.socket, tuple[int, bytes]]:
        """Wait for the first valid request of any client; the other clients are closed."""
        guests: list[socket.socket] = []
        robot: socket.socket | None = None
        try:
            while True:
                ready, _, _ = select.select([self._listener, *guests], [], [])
                if self._listener in ready:
                    guests.append(self._listener.accept()[0])
                    guests[-1].settimeout(GUEST_PATIENCE)
                    if len(guests) > MOST_CALLERS:
                        guests.pop(0).close()
                for guest in [guest for guest in guests if guest in ready]:
                    try:
                        if (message := receive(guest)) is not None:
                            decode_request(*message)
                            robot = guest
                            robot.settimeout(None)
                            return robot, message
                    except LockstepError as problem:
                        with suppress(OSError):  # the client may be gone
                            guest.sendall(encode_refusal(str(problem)))
                    except OSError:
                        pass
                    guests.remove(guest)
                    guest.close()
        finally:
            for guest in guests:
                if guest is not robot:
                    guest.close()

    def close(self) -> None:
        """Stop listening."""
        self._listener.close()


LARGEST = 2048
"""Bytes read of a datagram."""
MOST_FRAMES = 1024
"""Largest number of UDP frames read in one call, so that a flood cannot block the loop."""


def whole_frames(data: bytearray) -> list[bytes]:
    """Remove the complete MAVLink frames from a stream and return them; bytes before the first frame are dropped."""
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
    """Router of an autopilot: its frames go to all ground stations, and theirs go to it and to each other.

    UDP stations are the configured ones and all senders, TCP stations all connected clients; lines of the Doppler log
    go to the log's own clients. This is a `Transport`: no call blocks.

    Attributes:
        address: UDP address of this end.
        tcp: TCP address for stations.
        dvl: Server of the Doppler log.
    """

    def __init__(
        self,
        bind: Address,
        stations: Sequence[Address],
        tcp: Address,
        dvl: Address,
        page: Address | None = None,
    ) -> None:
        """Open all sockets; port 0 selects a free one.

        Args:
            bind: UDP address of this end.
            stations: UDP stations that receive frames before they have sent anything.
            tcp: TCP address to listen on.
            dvl: TCP address of the Doppler log.
            page: TCP address of the log's web page; None for no page.

        Raises:
            LinkError: An address cannot be bound or resolved.
        """
        self._fixed = [resolved(station) for station in stations]
        self._callers: deque[Address] = deque(maxlen=MOST_CALLERS)
        with ExitStack() as stack:
            self._socket = stack.enter_context(bound_socket(socket.SOCK_DGRAM, bind))
            self._socket.setblocking(False)
            self._streams = stack.enter_context(closing(TcpServer(tcp, bytearray)))
            self.dvl = stack.enter_context(closing(DvlServer(dvl)))
            if page is not None:
                server = serve_about(page)
                stack.callback(server.server_close)
                stack.callback(server.shutdown)
            self._stack = stack.pop_all()
        self.address: Address = self._socket.getsockname()
        self.tcp = self._streams.address

    def receive(self) -> list[bytes]:
        """Return complete frames of all stations, and forward them to the other stations."""
        self.dvl.poll()
        frames: list[bytes] = []
        with suppress(BlockingIOError, ConnectionError):
            while len(frames) < MOST_FRAMES:
                data, sender = self._socket.recvfrom(LARGEST)
                if sender not in (*self._fixed, *self._callers):
                    self._callers.append(sender)  # drops the oldest station if there are too many
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
        """Close all connections."""
        self._stack.close()

    def describe(self) -> str:
        """Return the number of connected stations as text."""
        return f"{len(self._callers)} stations over UDP, {len(self._streams.clients)} over TCP"

    def _pass_on(self, stream: bytearray, source: object) -> list[bytes]:
        frames = whole_frames(stream)
        for frame in frames:
            self._broadcast(frame, source)
        return frames

    def _broadcast(self, frame: bytes, source: object = None) -> None:
        """Send a frame to all stations except its source."""
        for address in [*self._fixed, *self._callers]:
            if address != source:
                with suppress(OSError):  # no receiver at this address yet
                    self._socket.sendto(frame, address)
        for station in list(self._streams.clients):
            if station is not source:
                self._streams.send(frame, station)


class MediumServer:
    """End of a medium for robots in other processes: replies to a name go to its latest sender."""

    def __init__(self, address: tuple[str, int], medium: Medium, names: tuple[str, ...]) -> None:
        """Listen for messages.

        Args:
            address: Host and port; port 0 selects a free one (see `address`).
            medium: Medium that carries the messages.
            names: Names of the allowed senders.

        Raises:
            LinkError: It cannot be bound.
        """
        self._medium, self._names = medium, frozenset(names)
        self._robots: dict[str, tuple[str, int]] = {}
        self._socket = bound_socket(socket.SOCK_DGRAM, address)
        self._socket.setblocking(False)
        self.address: tuple[str, int] = self._socket.getsockname()

    def poll(self, now: float) -> None:
        """Receive new messages and send arrived ones, at a time of the site's clock [s]."""
        with suppress(BlockingIOError, ConnectionError):
            while True:
                data, sender = self._socket.recvfrom(LARGEST)
                heard = decode_track(data, now)
                if heard is not None and heard[0] in self._names:
                    self._robots[heard[0]] = sender
                    self._medium.send(now, heard[0], data)
        for name in self._names:  # messages for a robot that has not sent anything yet are lost
            for data in self._medium.receive(now, name):
                if name in self._robots:
                    with suppress(OSError):
                        self._socket.sendto(data, self._robots[name])

    def close(self) -> None:
        """Stop listening."""
        self._socket.close()
