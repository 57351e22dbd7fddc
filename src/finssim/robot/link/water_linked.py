"""Water Linked A50 and A125 Doppler logs: JSON lines over TCP, as their makers publish them (json_v3.1).

`DvlClient` brings lines from a log and `decode_line` reads them; `encode_velocity` writes a report and `DvlServer`
sends it, for a log that is simulated. The log's axes on the wire are x forward, y right, z down.
"""

from __future__ import annotations

import errno
import json
import logging
import math
import select
import socket
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from finssim.geometry.frames import FROM_FOSSEN, TO_FOSSEN
from finssim.robot.link.transports import Address, TcpServer, resolved
from finssim.robot.messages import VELOCITY, NavigationAid

__all__ = ["PORT", "DvlClient", "DvlServer", "DvlVelocity", "decode_line", "encode_velocity"]

PORT = 16171
"""TCP port of a log."""

_LOG = logging.getLogger("finssim.robot.link")
_FORMAT = "json_v3.1"
_FASTEST, _OLDEST, _HIGHEST = 10.0, 5.0, 300.0
"""Speed [m/s], age [s] and altitude [m] beyond what either log can report."""
_MICROSECONDS = 1e17
"""Times beyond are no Unix times [us]."""
_LONGEST_LINE = 1 << 16
"""A report has about 1 kB [bytes]."""
_BYTES_AT_ONCE = 1 << 18
"""Bytes taken by one call, so that a flood cannot hold the loop up."""
_SILENCE, _RETRY, _PATIENCE = 5.0, 1.0, 3.0
"""A log that says nothing for so long has gone (an unplugged cable ends no connection); between attempts to reach it;
longest wait for an attempt [s]."""


@dataclass(frozen=True)
class DvlVelocity(NavigationAid):
    """A velocity over the floor, with what else its report tells."""

    altitude: float
    """Distance to the floor along the log's z axis [m]; NaN if not reported."""
    fom: float
    """Figure of merit, the log's own estimate of the error [m/s]; NaN if not reported."""


def decode_line(line: bytes, counts: Counter[str] | None = None) -> DvlVelocity | None:
    """Read one line of a log. Whatever it holds, nothing is raised.

    Args:
        line: One JSON object.
        counts: Counts what comes: `velocity` for those returned; `no bottom lock`, `implausible`, `not a report`; other
            reports, such as `position_local` and `response`, under their type.

    Returns:
        Velocity over the floor in our axes of the log (x forward, y left, z up), with the age that the log's own clock
        gives it; None for everything else, and for a velocity through the water.
    """
    counts = Counter() if counts is None else counts
    report = _object(line)
    kind = report.get("type")
    if kind != "velocity" or report.get("tracking_mode", "bottom") != "bottom":
        known = kind in ("velocity", "velocity_water", "position_local", "response")
        counts["velocity_water" if kind == "velocity" else kind if known else "not a report"] += 1
        return None
    if report.get("velocity_valid") is not True:
        counts["no bottom lock"] += 1
        return None
    v = [_number(report.get(axis), -_FASTEST, _FASTEST) for axis in ("vx", "vy", "vz")]
    measured = _number(report.get("time_of_validity"), 0.0, _MICROSECONDS)
    sent = _number(report.get("time_of_transmission"), 0.0, _MICROSECONDS)
    age = 1e-6 * (sent - measured)
    if not (all(math.isfinite(value) for value in v) and 0.0 <= age <= _OLDEST):
        counts["implausible"] += 1
        return None
    counts["velocity"] += 1
    x, y, z = FROM_FOSSEN.vector(v).tolist()
    altitude = _number(report.get("altitude"), 0.0, _HIGHEST)
    fom = _number(report.get("fom"), 0.0, _FASTEST)
    return DvlVelocity(0, VELOCITY, age, (x, y, z), (0.0, 0.0), altitude, fom)


def _object(line: bytes) -> dict[str, Any]:
    """The JSON object in a line; empty if there is none."""
    try:
        value = json.loads(line)
    except (ValueError, RecursionError):
        return {}
    return value if isinstance(value, dict) else {}


def _number(value: Any, lowest: float, highest: float) -> float:
    """A number as it came; NaN for anything else, and for one out of range."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if number and lowest <= value <= highest else math.nan


BEAM_ANGLE = math.radians(22.5)
"""Of the four beams from the log's z axis [rad]."""
_AZIMUTHS = np.radians([45.0, 135.0, 225.0, 315.0])
_ACROSS = math.tan(BEAM_ANGLE) * np.stack([np.cos(_AZIMUTHS), np.sin(_AZIMUTHS)], axis=1)
_BEAMS = math.cos(BEAM_ANGLE) * np.column_stack([_ACROSS, np.ones(4)])
_NO_LOCK_FOM = 2.66
"""Figure of merit of a published report without bottom lock [m/s]."""


def encode_velocity(
    velocity: Sequence[float] | npt.NDArray[np.float64] | None,
    *,
    altitude: float = math.nan,
    measured: float,
    sent: float,
    interval: float,
    std: Sequence[float] = (2e-4, 2e-4, 1e-4),
) -> bytes:
    """A velocity-and-transducer report, as a log sends it.

    Args:
        velocity: Over the floor, our axes of the log [m/s], (3,); None without bottom lock.
        altitude: Distance to the floor along the log's z axis [m].
        measured: When the floor reflected it, Unix time [s].
        sent: When the report leaves, Unix time [s].
        interval: Since the last report [s].
        std: Standard deviation per axis that the log believes in [m/s], (3,).

    Returns:
        The line with its newline.
    """
    valid = velocity is not None
    v = TO_FOSSEN.vector([0.0, 0.0, 0.0] if velocity is None else velocity)
    distance = altitude / math.cos(BEAM_ANGLE) if valid and math.isfinite(altitude) else -1.0
    beam = {"velocity": 0.0, "distance": distance, "rssi": -30.0, "nsd": -90.0, "beam_valid": valid}
    report = {
        "time": 1e3 * interval,
        **dict(zip(("vx", "vy", "vz"), v.tolist(), strict=True)),
        "fom": float(np.linalg.norm(std)) if valid else _NO_LOCK_FOM,
        "covariance": np.diag(np.square(std) * valid).tolist(),
        "altitude": altitude if distance >= 0.0 else -1.0,
        "transducers": [
            {"id": i, **beam, "velocity": along} for i, along in enumerate((_BEAMS @ v).tolist())
        ],
        "velocity_valid": valid,
        "status": 0,
        "format": _FORMAT,
        "type": "velocity",
        "time_of_validity": round(1e6 * measured),
        "time_of_transmission": round(1e6 * sent),
    }
    return _line(report)


def _line(value: dict[str, Any]) -> bytes:
    return json.dumps(value, separators=(",", ":")).encode() + b"\n"


class _Lines:
    """A stream of bytes as whole lines; one that grows beyond `_LONGEST_LINE` is dropped."""

    def __init__(self) -> None:
        self._rest, self._skipping = b"", False

    def feed(self, data: bytes) -> list[bytes]:
        """The lines that these bytes end, without their newlines."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        if self._skipping and lines:
            del lines[0]
            self._skipping = False
        if len(self._rest) > _LONGEST_LINE:
            self._rest, self._skipping = b"", True
        return [line.strip() for line in lines if line.strip() and len(line) <= _LONGEST_LINE]


class DvlClient:
    """The connection to a log, a `Transport` of whole lines; a lost log is tried again every second, without waiting.

    Attributes:
        connected: Whether the log is there now.
        connections: How often it was reached.
    """

    def __init__(self, host: str, port: int = PORT, *, clock: Callable[[], float] = time.monotonic) -> None:
        """
        Args:
            host: Name or IPv4 address; a name is looked up once, now.
            port: TCP port.
            clock: Tells the time between attempts [s].

        Raises:
            LinkError: There is no such host.
        """
        self.peer: Address = resolved((host, port))
        self.connected, self.connections, self.send_errors = False, 0, 0
        self._clock, self._next_try, self._since, self._closed = clock, -math.inf, 0.0, False
        self._socket: socket.socket | None = None
        self._lines = _Lines()

    def receive(self) -> list[bytes]:
        """The whole lines that have come since the last call, oldest first."""
        if not self._ready():
            return []
        assert self._socket is not None  # it is ready
        found: list[bytes] = []
        taken = 0
        try:
            while taken < _BYTES_AT_ONCE:
                data = self._socket.recv(_LONGEST_LINE)
                if not data:
                    raise ConnectionResetError("closed by the log")
                taken, self._since = taken + len(data), self._clock()
                found += self._lines.feed(data)
        except BlockingIOError:
            if self._clock() - self._since > _SILENCE:
                self._lose(f"silent for {_SILENCE:g} s")
        except OSError as problem:
            self._lose(str(problem))
        return found

    def send(self, data: bytes) -> None:
        """Send a command such as `{"command": "reset_dead_reckoning"}`; one that cannot leave whole is counted."""
        try:
            if not self._ready() or self._socket is None or self._socket.send(data) < len(data):
                self.send_errors += 1
        except OSError:
            self.send_errors += 1

    def close(self) -> None:
        """Leave the log for good."""
        self._closed = True
        self._drop()

    def describe(self) -> str:
        """Where the log is and whether it is there."""
        state = "closed" if self._closed else "connected" if self.connected else "not connected"
        return f"Water Linked DVL at {self.peer[0]}:{self.peer[1]}, {state}"

    def _ready(self) -> bool:
        """Whether there is a connection, after the next step of making one."""
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
                    self.connected, self._since, self._lines = True, now, _Lines()
                    self.connections += 1
                    _LOG.info("DVL %s:%d: connected", *self.peer)
            elif now - self._since > _PATIENCE:
                self._drop()
        return self.connected

    def _lose(self, why: str) -> None:
        _LOG.warning("DVL %s:%d: lost (%s); trying again every %g s", *self.peer, why, _RETRY)
        self._next_try = self._clock() + _RETRY
        self._drop()

    def _drop(self) -> None:
        gone, self._socket, self.connected = self._socket, None, False
        if gone is not None:
            gone.close()


_MOST_PINGS = 15
_CONFIG: dict[str, Any] = {
    "speed_of_sound": 1475.0,
    "acoustic_enabled": True,
    "dark_mode_enabled": False,
    "mounting_rotation_offset": 0.0,
    "range_mode": "auto",
    "periodic_cycling_enabled": True,
}
_RANGES = {"speed_of_sound": (1000.0, 2000.0), "mounting_rotation_offset": (0.0, 360.0)}


class DvlServer:
    """A log's TCP server: reports to everyone who is connected, and answers to commands. No call waits.

    Attributes:
        config: What `get_config` tells; nothing but `acoustic_enabled` changes what is sent.
        resets: How often dead reckoning was reset.
    """

    def __init__(self, address: Address = ("127.0.0.1", PORT)) -> None:
        """Listen.

        Args:
            address: Host and port, reached from this machine alone by default; port 0 takes a free one (see
                `address`).

        Raises:
            LinkError: It cannot be bound.
        """
        self.config, self.resets = dict(_CONFIG), 0
        self._pings = 0
        self._server = TcpServer(address, _Lines)
        self.address: Address = self._server.address

    def poll(self) -> None:
        """Let new clients in and answer their commands; call it often."""
        for client, lines, data in self._server.receive():
            for line in lines.feed(data):
                self._server.send(_line(self._answer(_object(line))), client)

    def send(self, line: bytes) -> None:
        """Send a report to every client, if the log pings: always, or once per `trigger_ping` where it is told not to.

        Args:
            line: With its newline. A client that does not read is let go.
        """
        self.poll()
        if not self.config["acoustic_enabled"]:
            if not self._pings:
                return
            self._pings -= 1
        for client in list(self._server.clients):
            self._server.send(line, client)

    def close(self) -> None:
        """Let everyone go and stop listening."""
        self._server.close()

    def _answer(self, request: dict[str, Any]) -> dict[str, Any]:
        command, error, result = request.get("command"), "", None
        if command == "reset_dead_reckoning":
            self.resets += 1
        elif command == "get_config":
            result = self.config
        elif command == "set_config":
            error = self._configure(request.get("parameters"))
        elif command == "trigger_ping":
            error = "the queue of pings is full" if self._pings == _MOST_PINGS else ""
            self._pings += not error
        elif command != "calibrate_gyro":
            error = "unknown command"
        return {
            "response_to": command if isinstance(command, str) else "",
            "success": not error,
            "error_message": error,
            "result": result,
            "format": _FORMAT,
            "type": "response",
        }

    def _configure(self, parameters: Any) -> str:
        """Take all settings or none; what is wrong with them, or nothing."""
        if not isinstance(parameters, dict) or not parameters:
            return "no parameters"
        for name, value in parameters.items():
            fits = type(value) is type(_CONFIG.get(name))
            if name in _RANGES:
                fits = math.isfinite(_number(value, *_RANGES[name]))
            if not fits:
                return f"{name}: unknown or out of range"
        self.config.update(parameters)
        return ""
