"""Transports of frames: to the motor controller over UDP or a serial line, or between two ends in memory."""

from __future__ import annotations

import errno
import logging
import math
import os
import select
import socket
import time
from collections import Counter, deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar
from urllib.parse import parse_qs, urlsplit

from finssim.robot.links.frames import LinkError

# UDP datagrams, to and from one peer only.


Address = tuple[str, int]

_LOG = logging.getLogger("finssim.robot.links")
_DATAGRAM = 2048
"""Greatest length of a motor controller's datagram [bytes]."""
_DATAGRAMS_AT_ONCE = 1024
"""Greatest number of datagrams per call, so that a flood cannot block the loop."""
_SILENT = 5.0
"""Silence after which a peer without a configured address counts as gone [s]."""
_NAMED = 64
"""Greatest number of refused senders that are counted separately; further ones are counted together."""


class UdpTransport:
    """Datagrams of one peer; those of any other address or port are refused, counted and logged once.

    Without a configured peer, the first sender of a datagram with a valid first byte becomes the peer; after a silence
    another sender can replace it.

    Note:
        `refused` counts by sender, `send_errors` the frames that could not be sent (no receiver, network down).
    """

    def __init__(
        self,
        bind: Address,
        peer: Address | None,
        *,
        longest: int = _DATAGRAM,
        buffer: int = 0,
        greeting: bytes = b"",
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """
        Args:
            bind: Local address and port; port 0 selects a free one (see `address`).
            peer: Host and port of the other end; the name is resolved once. None: the first sender.
            longest: Bytes read of a datagram; a longer one is truncated, and its checksum no longer matches.
            buffer: Requested size of the system's receive buffer [bytes]; the system's default if 0.
            greeting: Valid first bytes of the datagram of an unconfigured peer.
            clock: Clock for the peer's silence [s].

        Raises:
            LinkError: An address cannot be resolved, bound, or reached from `bind`.
        """
        self.peer = None if peer is None else resolved(peer)
        self._greeting, self._clock, self._heard = greeting if peer is None else b"", clock, -math.inf
        if peer is not None and self.peer is not None and (self.peer[0] == "0.0.0.0" or not self.peer[1]):
            raise LinkError(
                f"peer {peer[0]}:{peer[1]} is not one address and port: give those of the vehicle"
            )
        here = resolved(bind)
        if self.peer is not None and here[0].startswith("127.") and not self.peer[0].startswith("127."):
            raise LinkError(
                f"{peer[0]}:{peer[1]} is on another machine and this end is bound to {here[0]}, which only this "
                "machine reaches: bind the address that this machine has on the vehicle's network"
            )
        self.refused: Counter[Address | None] = Counter()
        self.send_errors = 0
        self._send_problem, self._longest = "", longest
        self._socket = bound_socket(socket.SOCK_DGRAM, here)
        self._socket.setblocking(False)
        if buffer:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer)
        self.address: Address = self._socket.getsockname()

    def send(self, data: bytes) -> None:
        """Send one datagram to the peer; one that cannot be sent is counted."""
        if self.peer is None:
            self.send_errors += 1
            return
        try:
            self._socket.sendto(data, self.peer)
            self._send_problem = ""
        except OSError as problem:
            self.send_errors += 1
            if str(problem) != self._send_problem:
                self._send_problem = str(problem)
                _LOG.warning("nothing leaves for %s: %s", _name(self.peer), problem)

    def receive(self, wait: float = 0.0) -> list[bytes]:
        """Return the datagrams of the peer, oldest first; at most 1024 are read in one call.

        Args:
            wait: Longest time to wait for one [s].
        """
        datagrams: list[bytes] = []
        if wait:
            select.select([self._socket], [], [], wait)
        for _ in range(_DATAGRAMS_AT_ONCE):
            try:
                data, sender = self._socket.recvfrom(self._longest)
            except BlockingIOError:
                break
            except (
                ConnectionError
            ):  # some systems report in this way that an earlier datagram had no receiver
                continue
            except OSError:  # closed
                break
            now = self._clock() if self._greeting else 0.0
            if (
                sender != self.peer
                and data[:1]
                and data[:1] in self._greeting
                and now - self._heard > _SILENT
            ):
                _LOG.info("hear %s", _name(sender))
                self.peer = sender
            if sender == self.peer:
                self._heard = now
                datagrams.append(data)
            else:
                self._refuse(sender)
        return datagrams

    def _refuse(self, sender: Address) -> None:
        key = sender if sender in self.refused or len(self.refused) < _NAMED else None
        if key not in self.refused:
            _LOG.warning(
                "refused a datagram from %s: this end listens to %s alone",
                _name(key) if key else "yet another sender, the last one named",
                _name(self.peer) if self.peer is not None else "who begins as an autopilot does",
            )
        self.refused[key] += 1

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def describe(self) -> str:
        """Return both addresses and the errors so far."""
        text = f"udp {_name(self.address)} to {_name(self.peer) if self.peer is not None else 'nobody yet'}"
        text += f", {self.send_errors} frames could not leave" if self.send_errors else ""
        return text + (f", {sum(self.refused.values())} datagrams of others refused" if self.refused else "")


def resolved(address: Address) -> Address:
    """Return the IPv4 address of a host name."""
    try:
        (*_, endpoint), *_ = socket.getaddrinfo(*address, family=socket.AF_INET, type=socket.SOCK_DGRAM)
    except OSError as problem:
        raise LinkError(
            f"{address[0]}: no such host ({problem.strerror}): give a name or an IPv4 address"
        ) from None
    return str(endpoint[0]), int(endpoint[1])


def _name(address: Address) -> str:
    return f"{address[0]}:{address[1]}"


# A server port for several clients.


State = TypeVar("State")
"""State of a client on the server."""


def bound_socket(kind: int, address: tuple[str, int]) -> socket.socket:
    """Return a socket of a kind (`socket.SOCK_...`) bound to host and port; port 0 selects a free one.

    Raises:
        LinkError: The address cannot be bound.
    """
    out = socket.socket(socket.AF_INET, kind)
    out.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, int(kind == socket.SOCK_STREAM))
    try:
        out.bind(address)
    except OSError as problem:
        out.close()
        raise LinkError(
            f"cannot bind {address[0]}:{address[1]} ({problem.strerror or problem}): "
            "end the program that has it, or give another port"
        ) from None
    return out


class TcpServer(Generic[State]):
    """A port for several clients. No call waits, and a client that does not read is disconnected.

    Attributes:
        clients: Connected clients, each with its state.
        address: Address of the server.
    """

    def __init__(self, address: Address, state: Callable[[], State], *, backlog: int = 8) -> None:
        """Listen.

        Args:
            address: Host and port; port 0 selects a free one.
            state: Creates the state of a client.
            backlog: Greatest number of clients; further ones are refused.

        Raises:
            LinkError: The address cannot be bound.
        """
        self.clients: dict[socket.socket, State] = {}
        self._state, self._most = state, backlog
        self._listener = bound_socket(socket.SOCK_STREAM, address)
        self._listener.listen(backlog)
        self._listener.setblocking(False)
        self.address: Address = self._listener.getsockname()

    def receive(self) -> list[tuple[socket.socket, State, bytes]]:
        """Accept new clients and drop closed ones; return the received data by client."""
        with suppress(OSError):
            while True:
                client, _ = self._listener.accept()
                client.setblocking(False)
                client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                if len(self.clients) < self._most:
                    self.clients[client] = self._state()
                else:
                    client.close()
        received = []
        for client, state in list(self.clients.items()):
            try:
                data = client.recv(_BYTES_AT_ONCE)
            except BlockingIOError:
                continue
            except OSError:
                data = b""
            if data:
                received.append((client, state, data))
            else:
                self._leave(client)
        return received

    def send(self, data: bytes, client: socket.socket) -> None:
        """Send to one client, if it is still connected."""
        try:
            if client in self.clients and client.send(data) < len(data):
                self._leave(client)
        except OSError:
            self._leave(client)

    def close(self) -> None:
        """Disconnect all clients and stop listening."""
        for client in list(self.clients):
            self._leave(client)
        self._listener.close()

    def _leave(self, client: socket.socket) -> None:
        self.clients.pop(client, None)
        client.close()


# A serial line, which may be unplugged and plugged in again.


_BYTES_AT_ONCE = 65536
"""Greatest number of bytes per call."""


class SerialTransport:
    """8N1 without flow control, opened exclusively; a lost device is reopened every second.

    Note:
        `send_errors` counts frames without a connection, `reconnects` how often it was restored.
    """

    def __init__(
        self,
        device: str,
        baud: int = 115200,
        *,
        retry: float = 1.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """
        Args:
            device: Path or name in the operating system.
            baud: Bits per second.
            retry: Time between attempts to open a lost device [s].
            clock: Clock for the attempts [s].

        Raises:
            LinkError: The device cannot be opened now.
        """
        self.device, self.baud, self.retry = device, baud, retry
        self.send_errors, self.reconnects = 0, 0
        self._clock, self._next_try, self._closed = clock, 0.0, False
        self._port: Any = None
        try:
            self._port = _opened(device, baud)
        except LinkError:
            raise
        except _problems(ValueError) as problem:
            raise LinkError(
                f"serial:{device}: cannot be opened at {baud} baud ({problem}): check the cable, the name, "
                "your right to use it and that no other program does"
            ) from None

    def send(self, data: bytes) -> None:
        """Write one frame; without a connection, or if the line is blocked, it is counted and dropped."""
        if not self._ready():
            self.send_errors += 1
            return
        try:
            if _written(self._port, data) < len(data):
                self._forget_waiting()
        except BlockingIOError:
            self._forget_waiting()
        except _problems() as problem:
            self.send_errors += 1
            self._lose(problem)

    def receive(self) -> list[bytes]:
        """Return the received bytes, as one piece or none; reopen a lost device when an attempt is due."""
        if not self._ready():
            return []
        try:
            data = bytes(self._port.read(_BYTES_AT_ONCE))
        except _problems() as problem:
            self._lose(problem)
            return []
        return [data] if data else []

    def close(self) -> None:
        """Close the device permanently."""
        self._closed = True
        self._drop()

    def describe(self) -> str:
        """Return device, speed and state of the connection."""
        state = "closed" if self._closed else "connected" if self._port else "not connected"
        return f"serial {self.device} at {self.baud} baud, {state}"

    def _ready(self) -> bool:
        """Return whether the device is open, after an attempt to open it if one is due."""
        now = self._clock()
        if self._port is None and not self._closed and now >= self._next_try:
            self._next_try = now + self.retry
            try:
                self._port = _opened(self.device, self.baud)
            except _problems():
                return False
            self.reconnects += 1
            _LOG.warning("serial %s: is back", self.device)
        return self._port is not None

    def _forget_waiting(self) -> None:
        """Drop bytes that a blocked line has not accepted: those commands would be outdated later."""
        self.send_errors += 1
        try:
            self._port.reset_output_buffer()
        except _problems() as problem:
            self._lose(problem)

    def _lose(self, problem: BaseException) -> None:
        _LOG.warning("serial %s: lost (%s); trying again every %g s", self.device, problem, self.retry)
        self._next_try = self._clock() + self.retry
        self._drop()

    def _drop(self) -> None:
        port, self._port = self._port, None
        if port is not None:
            try:
                port.close()
            except _problems() as problem:
                _LOG.debug("serial %s: closing a lost device: %s", self.device, problem)


def _opened(device: str, baud: int) -> Any:
    try:
        import serial
    except ImportError:
        raise LinkError(
            f"serial:{device}: needs pyserial, which is not installed: pip install 'finssim[hardware]'"
        ) from None
    return serial.Serial(device, baud, timeout=0, write_timeout=0, exclusive=True)


def _problems(*more: type[Exception]) -> tuple[type[Exception], ...]:
    """Return the exceptions of a lost device: `termios.error` is not an OSError, and some systems have no termios."""
    try:
        from termios import error
    except ImportError:
        return (OSError, *more)
    return (OSError, error, *more)


def _written(port: Any, data: bytes) -> int:
    """Return the number of accepted bytes; pyserial's own `write` waits on POSIX, even with a timeout of 0."""
    return os.write(port.fileno(), data) if os.name == "posix" else int(port.write(data))


# A TCP connection to a server, which may be lost and restored.


_SILENCE, _RETRY, _PATIENCE = 5.0, 1.0, 3.0
"""Silence after which a server counts as gone (an unplugged cable does not end a connection); time between attempts to
connect; longest duration of an attempt [s]."""
_MOST_AT_ONCE = 1 << 18
"""Greatest number of bytes per call, so that a flood cannot block the loop."""


class TcpTransport:
    """Connection to a server; a lost one is restored by attempts every second, without waiting.

    Attributes:
        connected: True if it is connected now.
        connections: Number of connections so far.
    """

    title = "tcp"
    """Name of the other end in messages."""

    def __init__(self, peer: Address, *, clock: Callable[[], float] = time.monotonic) -> None:
        """Resolve the address; the first call of `receive` or `send` connects.

        Args:
            peer: Host and port; a name is resolved once, now.
            clock: Clock for the attempts [s].

        Raises:
            LinkError: There is no such host.
        """
        self.peer: Address = resolved(peer)
        self.connected, self.connections, self.send_errors = False, 0, 0
        self._clock, self._next_try, self._since, self._closed = clock, -math.inf, 0.0, False
        self._socket: socket.socket | None = None

    def pieces(self, data: bytes | None) -> list[bytes]:
        """Return the pieces of received bytes; None: a new connection begins."""
        return [data] if data else []

    def receive(self) -> list[bytes]:
        """Return the data received since the last call, oldest first."""
        if not self._ready():
            return []
        assert self._socket is not None  # it is ready
        pieces: list[bytes] = []
        total = 0
        try:
            while total < _MOST_AT_ONCE:
                data = self._socket.recv(_BYTES_AT_ONCE)
                if not data:
                    raise ConnectionResetError("closed by the other end")
                total, self._since = total + len(data), self._clock()
                pieces += self.pieces(data)
        except BlockingIOError:
            if self._clock() - self._since > _SILENCE:
                self._lose(f"silent for {_SILENCE:g} s")
        except OSError as problem:
            self._lose(str(problem))
        return pieces

    def send(self, data: bytes) -> None:
        """Send bytes; incomplete sends are counted."""
        try:
            if not self._ready() or self._socket is None or self._socket.send(data) < len(data):
                self.send_errors += 1
        except OSError:
            self.send_errors += 1

    def close(self) -> None:
        """Close the connection permanently."""
        self._closed = True
        self._drop()

    def describe(self) -> str:
        """Return the address of the other end and the state of the connection."""
        state = "closed" if self._closed else "connected" if self.connected else "not connected"
        return f"{self.title} at {_name(self.peer)}, {state}"

    def _ready(self) -> bool:
        """Return whether it is connected, after the next step of connecting."""
        now = self._clock()
        if self._socket is None and not self._closed and now >= self._next_try:
            self._next_try, self._since = now + _RETRY, now
            self._socket = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
            self._socket.setblocking(False)
            problem = self._socket.connect_ex(self.peer)
            if problem not in (0, errno.EINPROGRESS, errno.EWOULDBLOCK):
                self._drop()
        if self._socket is not None and not self.connected:
            if select.select([], [self._socket], [], 0.0)[1]:
                if self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
                    self._drop()
                else:
                    self.connected, self._since = True, now
                    self.connections += 1
                    self.pieces(None)
                    _LOG.info("%s %s: connected", self.title, _name(self.peer))
            elif now - self._since > _PATIENCE:
                self._drop()
        return self.connected

    def _lose(self, reason: str) -> None:
        _LOG.warning(
            "%s %s: lost (%s); trying again every %g s", self.title, _name(self.peer), reason, _RETRY
        )
        self._next_try = self._clock() + _RETRY
        self._drop()

    def _drop(self) -> None:
        previous, self._socket, self.connected = self._socket, None, False
        if previous is not None:
            previous.close()


class _Beside:
    """A transport, and a second one that is only read: that of an autopilot and that of its DVL."""

    def __init__(self, wire: Transport, listening: Transport) -> None:
        self._wires = (wire, listening)
        self.send = wire.send

    def receive(self) -> list[bytes]:
        """Return the data received over both."""
        return [data for wire in self._wires for data in wire.receive()]

    def close(self) -> None:
        """Close both."""
        for wire in self._wires:
            wire.close()

    def describe(self) -> str:
        """Return the descriptions of both."""
        return "; ".join(wire.describe() for wire in self._wires)


@dataclass(frozen=True)
class MavlinkAddress:
    """Address of an autopilot: `mavlink://KIND:...?dvl=HOST:PORT&key=FILE`, KIND udpin, udpout, tcp or serial."""

    kind: str
    where: str
    dvl: str = ""
    """HOST or HOST:PORT of a Water Linked DVL; empty: none."""
    key: bytes = b""
    """Signing key; empty: none."""

    DEFAULT = "udpin:127.0.0.1:14550"
    """Address to which the autopilot of a virtual pool on this machine sends."""

    @classmethod
    def of(cls, address: str) -> MavlinkAddress:
        """Return the parsed address.

        Raises:
            LinkError: The address is invalid, or the key cannot be read.
        """
        rest, _, query = address.removeprefix("mavlink").removeprefix("://").partition("?")
        kind, _, target = (rest or cls.DEFAULT).partition(":")
        options = {name: values[-1] for name, values in parse_qs(query).items()}
        if kind not in ("udpin", "udpout", "tcp", "serial") or not target or options.keys() - {"dvl", "key"}:
            raise LinkError(
                f"{address}: give mavlink://udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or serial:DEVICE,BAUD, "
                "with ?dvl=HOST for a Water Linked log and &key=FILE for a signing key"
            )
        key = b""
        if "key" in options:
            try:
                key = Path(options["key"]).read_bytes()
            except OSError as problem:
                raise LinkError(
                    f"{options['key']}: the signing key cannot be read: {problem.strerror}"
                ) from None
        return cls(kind, target, options.get("dvl", "" if rest else "127.0.0.1"), key)

    def open(self) -> Transport:
        """Return the transport, together with that of the DVL.

        Raises:
            LinkError: It cannot be opened.
        """
        wire: Transport
        if self.kind == "serial":
            device, _, baud = self.where.partition(",")
            if baud and not baud.isdecimal():
                raise LinkError(f"serial:{self.where}: baud is {baud!r}, expected an integer such as 115200")
            wire = SerialTransport(device, int(baud or 115200))
        else:
            end = host_port(self.where, f"mavlink://{self.kind}")
            if self.kind == "udpin":
                wire = UdpTransport(end, None, greeting=b"\xfd\xfe")
            elif self.kind == "udpout":
                wire = UdpTransport(("127.0.0.1" if end[0].startswith("127.") else "0.0.0.0", 0), end)
            else:
                wire = TcpTransport(end)
        if not self.dvl:
            return wire
        from finssim.robot.links.water_linked import PORT, DvlClient

        host, port = host_port(self.dvl, "dvl") if ":" in self.dvl else (self.dvl, PORT)
        return _Beside(wire, DvlClient(host, port))


DEFAULT_BIND = "127.0.0.1:54321"
"""Local address of the robot."""


class Transport(Protocol):
    """One end of a link. No call blocks, and no event on the link raises an exception."""

    def send(self, data: bytes) -> None:
        """Send a frame; one that cannot be sent is counted and dropped, never sent later."""

    def receive(self) -> list[bytes]:
        """Return everything received since the last call: datagrams, or pieces of a stream."""

    def close(self) -> None:
        """Close the link; later frames are dropped."""

    def describe(self) -> str:
        """Return the address and the state of the link, in a few words."""


class MemoryTransport:
    """One of two ends in one process; beyond 4096 waiting frames the oldest is dropped, as by a socket."""

    def __init__(self, inbox: deque[bytes], outbox: deque[bytes]) -> None:
        self._inbox, self._outbox, self._open = inbox, outbox, True

    def send(self, data: bytes) -> None:
        """Append the frame to the queue of the other end."""
        if self._open:
            self._outbox.append(bytes(data))

    def receive(self) -> list[bytes]:
        """Return the frames from the other end, oldest first."""
        received = list(self._inbox) if self._open else []
        self._inbox.clear()
        return received

    def close(self) -> None:
        """Stop sending and receiving."""
        self._open = False

    def describe(self) -> str:
        """Return the description: in memory, open or closed."""
        return "in memory" if self._open else "in memory, closed"


def memory_pair() -> tuple[MemoryTransport, MemoryTransport]:
    """Return two connected ends."""
    first: deque[bytes] = deque(maxlen=4096)
    other: deque[bytes] = deque(maxlen=4096)
    return MemoryTransport(first, other), MemoryTransport(other, first)


def open_transport(address: str, bind: str = DEFAULT_BIND) -> Transport:
    """Open the transport of an address.

    Args:
        address: "udp://HOST:PORT" of the motor controller, "serial:DEVICE" or "serial:DEVICE?baud=57600", or that of
            an autopilot, see `MavlinkAddress`.
        bind: Local "ADDRESS:PORT", for UDP.

    Raises:
        LinkError: The address is invalid, or the transport cannot be opened.
    """
    kind, _, rest = address.partition(":")
    if kind == "udp" and rest.startswith("//"):
        return UdpTransport(host_port(bind, "bind"), host_port(rest[2:], address))
    if kind == "serial" and rest:
        parts = urlsplit(rest)
        baud = parse_qs(parts.query).get("baud", ["115200"])[-1]
        if not baud.isdecimal():
            raise LinkError(f"{address}: baud is {baud!r}, expected an integer such as 115200")
        return SerialTransport(parts.path, int(baud))
    if address.startswith("mavlink"):
        return MavlinkAddress.of(address).open()
    raise LinkError(f"unknown wire {address!r}: give udp://HOST:PORT, serial:DEVICE or mavlink://KIND:WHERE")


def host_port(text: str, label: str) -> tuple[str, int]:
    """Return host and port of "HOST:PORT"; raise a LinkError that begins with `label` if it is invalid."""
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65535:
        raise LinkError(f"{label}: {text!r} is no HOST:PORT: give for example 127.0.0.1:58766")
    return host, int(port)
