"""How frames travel: to the motor controller over UDP or a serial line, to nobody, or between two ends in memory."""

from __future__ import annotations

from collections import deque
from typing import Protocol
from urllib.parse import parse_qs, urlsplit

from finssim.robot.link.layout import LinkError
from finssim.robot.link.serial_port import SerialTransport
from finssim.robot.link.udp import UdpTransport

__all__ = ["DEFAULT_BIND", "DryRun", "MemoryTransport", "Transport", "memory_pair", "open_transport"]

DEFAULT_BIND = "127.0.0.1:54321"
"""Address of the robot's own end."""


class Transport(Protocol):
    """One end of the wire. No call blocks, and none raises for what happens on the wire."""

    def send(self, data: bytes) -> None:
        """Put a frame on the wire; one that cannot leave is counted and forgotten, never kept for later."""

    def receive(self) -> list[bytes]:
        """Everything that has come since the last call: datagrams, or pieces of a stream."""

    def close(self) -> None:
        """Let go of the wire; what is sent afterwards goes nowhere."""

    def describe(self) -> str:
        """The wire and how it fares, in a few words."""


class DryRun:
    """No wire: takes every frame, and nothing ever comes."""

    def __init__(self) -> None:
        self.sent = 0
        self.last = b""

    def send(self, data: bytes) -> None:
        """Count the frame and keep it as `last`."""
        self.sent += 1
        self.last = data

    def receive(self) -> list[bytes]:
        """Nothing."""
        return []

    def close(self) -> None:
        """Nothing to let go of."""

    def describe(self) -> str:
        """How many frames went nowhere."""
        return f"dry run, {self.sent} frames sent to nobody"


class MemoryTransport:
    """One of two ends in one process; what waits beyond 4096 frames pushes out the oldest, as a socket loses some."""

    def __init__(self, inbox: deque[bytes], outbox: deque[bytes]) -> None:
        self._inbox, self._outbox, self._open = inbox, outbox, True

    def send(self, data: bytes) -> None:
        """Lay the frame before the other end."""
        if self._open:
            self._outbox.append(bytes(data))

    def receive(self) -> list[bytes]:
        """What the other end has sent, oldest first."""
        found = list(self._inbox) if self._open else []
        self._inbox.clear()
        return found

    def close(self) -> None:
        """Stop taking and giving."""
        self._open = False

    def describe(self) -> str:
        """In memory, open or closed."""
        return "in memory" if self._open else "in memory, closed"


def memory_pair() -> tuple[MemoryTransport, MemoryTransport]:
    """Two ends: what goes in at one comes out at the other."""
    one: deque[bytes] = deque(maxlen=4096)
    other: deque[bytes] = deque(maxlen=4096)
    return MemoryTransport(one, other), MemoryTransport(other, one)


def open_transport(address: str, bind: str = DEFAULT_BIND) -> Transport:
    """The wire that an address names.

    Args:
        address: "udp://HOST:PORT" of the motor controller, "serial:DEVICE" or "serial:DEVICE?baud=57600", "dry-run".
        bind: "ADDRESS:PORT" of this end, for UDP.

    Raises:
        LinkError: It names no wire, or the wire cannot be opened.
    """
    kind, _, rest = address.partition(":")
    if kind == "udp" and rest.startswith("//"):
        return UdpTransport(host_port(bind, "bind"), host_port(rest[2:], address))
    if kind == "serial" and rest:
        parts = urlsplit(rest)
        baud = parse_qs(parts.query).get("baud", ["115200"])[-1]
        if not baud.isdecimal():
            raise LinkError(f"{address}: baud is {baud!r}, expected a whole number such as 115200")
        return SerialTransport(parts.path, int(baud))
    if address == "dry-run":
        return DryRun()
    raise LinkError(f"unknown wire {address!r}: give udp://HOST:PORT, serial:DEVICE or dry-run")


def host_port(text: str, where: str) -> tuple[str, int]:
    """Host and port of "HOST:PORT"; raises LinkError that begins with `where`."""
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65535:
        raise LinkError(f"{where}: {text!r} is no HOST:PORT: give for example 127.0.0.1:58766")
    return host, int(port)
