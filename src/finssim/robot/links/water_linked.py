"""Water Linked A50 and A125 DVLs: JSON lines over TCP in the manufacturer's published formats (json_v1 to json_v3.2).

`DvlClient` receives lines from a DVL and `decode_line` decodes them. For a simulated DVL, `encode_velocity` and
`DeadReckoning` create reports, `DvlServer` sends them and executes a client's commands, and `serve_about` is its web
page. The DVL's axes on the wire are x forward, y right, z down.
"""

from __future__ import annotations

import json
import math
import re
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import numpy as np
import numpy.typing as npt

from finssim.core.frames import FROM_FOSSEN, TO_FOSSEN
from finssim.core.rotations import quat_rotate, quat_to_euler
from finssim.robot.links.frames import LinkError
from finssim.robot.links.transports import Address, TcpServer, TcpTransport
from finssim.robot.messages import VELOCITY, NavigationAid

__all__ = [
    "PORT", "SETTINGS", "DeadReckoning", "DvlClient", "DvlServer", "DvlVelocity", "decode_line", "encode_velocity",
    "serve_about",
]  # fmt: skip

PORT = 16171
"""TCP port of a DVL."""

_FORMAT, _UNTIMED = "json_v3.2", ("json_v1", "json_v2")
_FASTEST, _OLDEST, _HIGHEST = 10.0, 5.0, 300.0
"""Greatest speed [m/s], age [s] and altitude [m] that either DVL can report."""
_MICROSECONDS = 1e17
"""Greatest plausible Unix time [µs]."""
_LONGEST_LINE = 1 << 16
"""Greatest length of a line [bytes]; a report has about 1 kB."""


@dataclass(frozen=True)
class DvlVelocity(NavigationAid):
    """A velocity over the floor, with the other values of its report."""

    altitude: float
    """Distance to the floor along the DVL's z axis [m]; NaN if not reported."""
    fom: float
    """Figure of merit, the DVL's own estimate of the error [m/s]; NaN if not reported."""


def decode_line(line: bytes, counts: Counter[str] | None = None) -> DvlVelocity | None:
    """Decode one line of a DVL; never raise an exception, for any content.

    Args:
        line: One JSON object.
        counts: Counters by kind: `velocity` for returned ones, and `velocity without times` for those of firmware
            before json_v3; `no bottom lock`, `implausible`, `not a report`; other reports, such as `position_local` and
            `response`, under their type.

    Returns:
        Velocity over the floor in our axes of the DVL (x forward, y left, z up), with its age by the DVL's own clock,
        or 0 s if the firmware sends no times; None for everything else, and for a velocity through the water.
    """
    counts = Counter() if counts is None else counts
    report = _object(line)
    # The first firmware has no types, and neither it nor json_v2 has times.
    kind = report.get("type", "velocity" if "velocity_valid" in report else None)
    if kind != "velocity" or report.get("tracking_mode", "bottom") != "bottom":
        named = str(kind) if kind in ("velocity_water", "position_local", "response") else "not a report"
        counts["velocity_water" if kind == "velocity" else named] += 1
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
    """Return the JSON object in a line; empty if there is none."""
    try:
        value = json.loads(line)
    except (ValueError, RecursionError):
        return {}
    return value if isinstance(value, dict) else {}


def _number(value: Any, lowest: float, highest: float) -> float:
    """Return a number within its range; NaN for anything else."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if number and lowest <= value <= highest else math.nan


BEAM_ANGLE = math.radians(22.5)
"""Angle of the four beams from the DVL's z axis [rad]."""
_AZIMUTHS = np.radians([135.0, -135.0, -45.0, 45.0])
"""Azimuths of beams 0 to 3, from x towards y [rad]."""
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
    """Return a velocity-and-transducer report in the DVL's format.

    Args:
        velocity: Over the floor, our axes of the DVL [m/s], (3,); None without bottom lock.
        altitude: Distance to the floor along the DVL's z axis [m].
        measured: Time of the reflection by the floor, Unix time [s].
        sent: Time of sending, Unix time [s].
        interval: Time since the last report [s].
        std: Standard deviation per axis that the DVL reports [m/s], (3,).

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
        "tracking_mode": "bottom",
        "status": 0,
        "format": _FORMAT,
        "type": "velocity",
        "time_of_validity": round(1e6 * measured),
        "time_of_transmission": round(1e6 * sent),
    }
    return _line(report)


class DeadReckoning:
    """Position of a DVL from its own velocities and attitude, as reported in `position_local`.

    Its axes are those of the DVL at the last reset: x forward, y right, z down; `DvlServer` transforms reports to them.
    """

    def __init__(self) -> None:
        self._position = np.zeros(3)
        self._time, self._due = math.nan, -math.inf

    def take(
        self, time: float, velocity: npt.ArrayLike | None, quaternion: npt.ArrayLike, stamp: float
    ) -> list[bytes]:
        """Integrate a velocity, and return a report if one is due, otherwise nothing.

        Args:
            time: Time of measurement [s].
            velocity: Over the floor, our axes of the DVL [m/s], (3,); None without bottom lock: the position is
                constant.
            quaternion: The DVL's axes to the world, x y z w, (4,).
            stamp: Unix time of the report [s].
        """
        if velocity is not None and 0.0 < time - self._time < LONGEST_STEP:
            self._position = self._position + (time - self._time) * quat_rotate(quaternion, velocity)
        self._time = time
        if time < self._due - 1e-9:
            return []
        self._due = time + LOCAL_PERIOD
        q = np.asarray(quaternion, float)
        roll, pitch, yaw = (math.degrees(a) for a in quat_to_euler(np.append(TO_FOSSEN.vector(q[:3]), q[3])))
        place = dict(zip("xyz", TO_FOSSEN.vector(self._position).tolist(), strict=True))
        angles = {"roll": roll, "pitch": pitch, "yaw": yaw}
        status = {"type": "position_local", "status": int(velocity is None), "format": _FORMAT}
        return [_line({"ts": stamp, **place, "std": LOCAL_STD, **angles, **status})]


LOCAL_PERIOD, LONGEST_STEP, LOCAL_STD = 0.2, 1.0, 0.01
"""Time between two reports of the position [s], longest time over which a velocity is integrated [s], and the reported
standard deviation [m]."""


def _line(value: dict[str, Any]) -> bytes:
    return json.dumps(value, separators=(",", ":")).encode() + b"\n"


class _Lines:
    """Assembler of complete lines from a stream of bytes; a line longer than `_LONGEST_LINE` is dropped."""

    def __init__(self) -> None:
        self._rest, self._skipping = b"", False

    def feed(self, data: bytes) -> list[bytes]:
        """Return the lines that these bytes complete, without their newlines."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        if self._skipping and lines:
            del lines[0]
            self._skipping = False
        if len(self._rest) > _LONGEST_LINE:
            self._rest, self._skipping = b"", True
        return [line.strip() for line in lines if line.strip() and len(line) <= _LONGEST_LINE]


class DvlClient(TcpTransport):
    """Connection to a DVL, a `Transport` of complete lines."""

    title = "Water Linked DVL"

    def __init__(self, host: str, port: int = PORT, *, clock: Callable[[], float] = time.monotonic) -> None:
        """Resolve the address.

        Args:
            host: Name or IPv4 address; a name is resolved once, now.
            port: TCP port.
            clock: Clock for the attempts to connect [s].

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
    """TCP server of a simulated DVL: reports to all connected clients, and responses to commands. No call waits.

    Attributes:
        address: Address of the server.
        settings: Settings as in `get_config`. The speed of sound scales velocities and distances, relative to 1475 m/s;
            the mounting offset rotates velocities; without acoustics there are none. The others have no effect.
    """

    def __init__(self, address: Address = ("127.0.0.1", PORT)) -> None:
        """Listen.

        Args:
            address: Host and port, by default reachable only from this machine; port 0 selects a free one (see
                `address`).

        Raises:
            LinkError: The address cannot be bound.
        """
        self.settings = {name: value for name, (value, _) in SETTINGS.items()}
        self._newest: dict[str, Any] = {}
        self._start: dict[str, Any] = {}
        self._server = TcpServer(address, _Lines)
        self.address: Address = self._server.address

    def poll(self) -> None:
        """Accept new clients and respond to commands; call it often."""
        for client, lines, data in self._server.receive():
            for line in lines.feed(data):
                self._server.send(_line(self._answer(_object(line))), client)

    def _answer(self, request: dict[str, Any]) -> dict[str, Any]:
        """Execute a command and return its response."""
        command = request.get("command")
        error, result = "", None
        if command == "get_config":
            result = dict(self.settings)
        elif command == "set_config":
            error = self._set(request.get("parameters"))
        elif command == "reset_dead_reckoning":
            self._start = self._newest
        elif command not in ("calibrate_gyro", "trigger_ping"):
            error = "unknown command"
        return {
            "response_to": command if isinstance(command, str) else "",
            "success": not error,
            "error_message": error,
            "result": result,
            "format": _FORMAT,
            "type": "response",
        }

    def _set(self, wanted: Any) -> str:
        """Apply settings, all or none; return what is wrong with them."""
        if not isinstance(wanted, dict) or not wanted:
            return "expected parameters: an object of settings"
        for name, value in wanted.items():
            if name not in SETTINGS:
                return f"unknown setting {name}; available: {', '.join(SETTINGS)}"
            if not SETTINGS[name][1](value):
                return f"{name} cannot be {value!r}"[:200]
        self.settings |= wanted
        return ""

    def _as_set(self, line: bytes) -> bytes:
        """Return a report modified by the settings and the last reset; empty if there is none."""
        sound, turn = float(self.settings["speed_of_sound"]), float(self.settings["mounting_rotation_offset"])
        report = _object(line)
        if report.get("type") == "position_local":
            self._newest = report
            return _line(_since(report, self._start)) if self._start else line
        if not self.settings["acoustic_enabled"]:
            return b""
        if sound == SETTINGS["speed_of_sound"][0] and turn == 0.0:
            return line
        scale, angle = sound / SETTINGS["speed_of_sound"][0], math.radians(turn)
        x, y = scale * report["vx"], scale * report["vy"]
        report["vx"] = math.cos(angle) * x - math.sin(angle) * y
        report["vy"] = math.sin(angle) * x + math.cos(angle) * y
        report["vz"] *= scale
        report["altitude"] *= scale if report["altitude"] > 0.0 else 1.0
        for beam in report["transducers"]:
            beam["velocity"] *= scale
            beam["distance"] *= scale if beam["distance"] > 0.0 else 1.0
        return _line(report)

    def send(self, line: bytes) -> None:
        """Send a report to every client.

        Args:
            line: Report with its newline. A client that does not read is disconnected.
        """
        self.poll()
        report = self._as_set(line) if line[:1] == b"{" else line
        for client in list(self._server.clients) if report else ():
            self._server.send(report, client)

    def close(self) -> None:
        """Disconnect all clients and stop listening."""
        self._server.close()


def _since(report: dict[str, Any], start: dict[str, Any]) -> dict[str, Any]:
    """Return a local position relative to an earlier one, in the DVL's axes at that time."""
    yaw = math.radians(start["yaw"])
    x, y = report["x"] - start["x"], report["y"] - start["y"]
    return report | {
        "x": math.cos(yaw) * x + math.sin(yaw) * y,
        "y": math.cos(yaw) * y - math.sin(yaw) * x,
        "z": report["z"] - start["z"],
        "yaw": math.degrees(math.remainder(math.radians(report["yaw"]) - yaw, math.tau)),
    }


def _between(low: float, high: float) -> Callable[[Any], bool]:
    return lambda value: math.isfinite(_number(value, low, high))


def _truth(value: Any) -> bool:
    return isinstance(value, bool)


_RANGE_MODE = re.compile(r"auto|=[0-4]|[0-4]<=[0-4]|wt")

SETTINGS: dict[str, tuple[Any, Callable[[Any], bool]]] = {
    "speed_of_sound": (1475.0, _between(1000.0, 2000.0)),
    "acoustic_enabled": (True, _truth),
    "dark_mode_enabled": (False, _truth),
    "mounting_rotation_offset": (0.0, _between(0.0, 360.0)),
    "range_mode": ("auto", lambda value: isinstance(value, str) and bool(_RANGE_MODE.fullmatch(value))),
    "periodic_cycling_enabled": (True, _truth),
}
"""Settings of a DVL: initial values, and functions that validate new ones."""


def serve_about(address: Address) -> ThreadingHTTPServer:
    """Start the DVL's web page in a thread: `/api/v1/about` and `/api/v1/about/status`, by which BlueOS finds a DVL.

    Args:
        address: Host and port; a real DVL has port 80; port 0 selects a free one (`server_address`).

    Returns:
        The server; `shutdown` and `server_close` end it.

    Raises:
        LinkError: The address cannot be bound.
    """
    pages = {
        "/api/v1/about": {
            "chipid": "0x0",
            "hardware_revision": 4,
            "is_ready": True,
            "name": "DVL",
            "product_id": 0,
            "product_name": "DVL A50 (FinsSim)",
            "variant": "Standard",
            "version": "2.4.0",
            "version_short": "2.4.0",
        },
        "/api/v1/about/status": {"temperature": 20.0},
    }

    class WebInterface(BaseHTTPRequestHandler):
        timeout = 5.0

        def do_GET(self) -> None:
            page = pages.get(self.path.rstrip("/"))
            body = json.dumps(page if page is not None else {"error": "not found"}).encode()
            self.send_response(200 if page is not None else 404)
            self.send_header("Content-Type", "application/json")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: Any) -> None:
            """Print nothing."""

    try:
        server = ThreadingHTTPServer(address, WebInterface)
    except OSError as error:
        raise LinkError(f"cannot serve the log's page at {address[0]}:{address[1]}: {error}") from None
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, daemon=True).start()
    return server
