"""Water Linked A50 and A125 Doppler logs: JSON lines over TCP, as their makers publish them (json_v1 to json_v3.1).

`DvlClient` brings lines from a log and `decode_line` reads them; `encode_velocity` writes a report and `DvlServer`
sends it, for a log that is simulated. The log's axes on the wire are x forward, y right, z down.
"""

from __future__ import annotations

import json
import math
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from finssim.core.frames import FROM_FOSSEN, TO_FOSSEN
from finssim.robot.links.transports import Address, TcpServer, TcpTransport
from finssim.robot.messages import VELOCITY, NavigationAid

__all__ = ["PORT", "DvlClient", "DvlServer", "DvlVelocity", "decode_line", "encode_velocity"]

PORT = 16171
"""TCP port of a log."""

_FORMAT, _UNTIMED = "json_v3.1", ("json_v1", "json_v2")
_FASTEST, _OLDEST, _HIGHEST = 10.0, 5.0, 300.0
"""Speed [m/s], age [s] and altitude [m] beyond what either log can report."""
_MICROSECONDS = 1e17
"""Times beyond are no Unix times [us]."""
_LONGEST_LINE = 1 << 16
"""A report has about 1 kB [bytes]."""


@dataclass(frozen=True)
class DvlVelocity(NavigationAid):
    """A velocity over the floor, with the other values of its report."""

    altitude: float
    """Distance to the floor along the log's z axis [m]; NaN if not reported."""
    fom: float
    """Figure of merit, the log's own estimate of the error [m/s]; NaN if not reported."""


def decode_line(line: bytes, counts: Counter[str] | None = None) -> DvlVelocity | None:
    """Read one line of a log. Whatever it holds, nothing is raised.

    Args:
        line: One JSON object.
        counts: Counts what comes: `velocity` for those returned, and `velocity without times` for those of firmware
            before json_v3; `no bottom lock`, `implausible`, `not a report`; other reports, such as `position_local` and
            `response`, under their type.

    Returns:
        Velocity over the floor in our axes of the log (x forward, y left, z up), with the age that the log's own clock
        gives it, 0 s where the firmware sends no times; None for everything else, and for a velocity through the water.
    """
    counts = Counter() if counts is None else counts
    report = _object(line)
    # The first firmware has no types, and neither it nor json_v2 has times.
    kind = report.get("type", "velocity" if "velocity_valid" in report else None)
    if kind != "velocity" or report.get("tracking_mode", "bottom") != "bottom":
        recognised = kind in ("velocity", "velocity_water", "position_local", "response")
        counts["velocity_water" if kind == "velocity" else kind if recognised else "not a report"] += 1
        return None
    if report.get("velocity_valid") is not True:
        counts["no bottom lock"] += 1
        return None
    v = [_number(report.get(axis), -_FASTEST, _FASTEST) for axis in ("vx", "vy", "vz")]
    times = [report.get(f"time_of_{event}") for event in ("validity", "transmission")]
    measured, sent = (_number(time, 0.0, _MICROSECONDS) for time in times)
    untimed = times == [None, None] and report.get("format", "json_v1") in _UNTIMED
    age = 0.0 if untimed else 1e-6 * (sent - measured)
    if not (all(math.isfinite(value) for value in v) and 0.0 <= age <= _OLDEST):
        counts["implausible"] += 1
        return None
    counts["velocity without times" if untimed else "velocity"] += 1
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
"""Angle of the four beams from the log's z axis [rad]."""
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
    """Complete lines of a stream of bytes; one that grows beyond `_LONGEST_LINE` is dropped."""

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


class DvlClient(TcpTransport):
    """The connection to a log, a `Transport` of complete lines."""

    title = "Water Linked DVL"

    def __init__(self, host: str, port: int = PORT, *, clock: Callable[[], float] = time.monotonic) -> None:
        """
        Args:
            host: Name or IPv4 address; a name is looked up once, now.
            port: TCP port.
            clock: Tells the time between attempts [s].

        Raises:
            LinkError: There is no such host.
        """
        super().__init__((host, port), clock=clock)
        self._lines = _Lines()

    def pieces(self, data: bytes | None) -> list[bytes]:
        """Return the lines that these bytes complete; None restarts."""
        if data is None:
            self._lines = _Lines()
        return [] if data is None else self._lines.feed(data)


class DvlServer:
    """A log's TCP server: reports to everyone who is connected; commands are refused. No call waits."""

    def __init__(self, address: Address = ("127.0.0.1", PORT)) -> None:
        """Listen.

        Args:
            address: Host and port, reached from this machine alone by default; port 0 takes a free one (see
                `address`).

        Raises:
            LinkError: It cannot be bound.
        """
        self._server = TcpServer(address, _Lines)
        self.address: Address = self._server.address

    def poll(self) -> None:
        """Let new clients in and refuse their commands; call it often."""
        for client, lines, data in self._server.receive():
            for line in lines.feed(data):
                self._server.send(_line(_refusal(_object(line))), client)

    def send(self, line: bytes) -> None:
        """Send a report to every client.

        Args:
            line: With its newline. A client that does not read is let go.
        """
        self.poll()
        for client in list(self._server.clients):
            self._server.send(line, client)

    def close(self) -> None:
        """Let everyone go and stop listening."""
        self._server.close()


def _refusal(request: dict[str, Any]) -> dict[str, Any]:
    """The response to a command: a simulated log has no settings."""
    command = request.get("command")
    return {
        "response_to": command if isinstance(command, str) else "",
        "success": False,
        "error_message": "a simulated log takes no commands",
        "result": None,
        "format": _FORMAT,
        "type": "response",
    }
