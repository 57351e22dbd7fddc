"""Importer of ArduSub logs as streams: pulses or axes, attitude, inertial measurements, depth, velocity,
battery, arming."""

from __future__ import annotations

import contextlib
import io
import json
import math
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from finssim.control.ardusub import FULL, NEUTRAL
from finssim.core.importer import Importer
from finssim.core.mcap_files import intact_mcap, without_profile
from finssim.trials.conversion import GRAVITY
from finssim.trials.findings import CalibrationError, Finding, finding
from finssim.trials.importers.ardusub_outputs import STICK_CHANNELS, mixed_pulses, outputs_of
from finssim.trials.importers.assemble import Stream, in_our_axes
from finssim.trials.importers.column_map import ArduSubMap, LogFrame
from finssim.trials.importers.log import Request, TrialStreams
from finssim.trials.trial import Array
from finssim.vehicles import Vehicle
from finssim.vehicles.autopilot import DEMANDS, FRAMES

__all__ = ["ARDUPILOT", "ArduPilotLog", "velocity_stream"]

# Messages of ArduPilot logs: DataFlash `.BIN` and telemetry `.tlog`, through pymavlink, and recordings of BlueOS.

DATAFLASH = b"\xa3\x95"
"""First bytes of a DataFlash log."""

AUTOPILOT = 1
"""MAVLink component of the autopilot."""

NO_AUTOPILOT = 8
"""MAV_AUTOPILOT_INVALID, sent in the heartbeats of ground stations and cameras."""

WRONG_CLOCK = 5.0
"""Difference between a stamp and its time of receipt above which the stamp belongs to another clock [s]."""


@dataclass(frozen=True)
class ArduPilotLog:
    """Content of a log, by kind of message."""

    shown: str
    telemetry: bool
    """True for a `.tlog` or a recording of BlueOS, which was not written by the autopilot."""
    times: dict[str, Array] = field(default_factory=dict)
    """Kind -> times [s], (n,)."""
    messages: dict[str, list[dict[str, Any]]] = field(default_factory=dict)
    """Kind -> fields of each message, (n,)."""
    parameters: dict[str, float] = field(default_factory=dict)
    """Parameters of the autopilot in its units, with their last values."""
    counts: Counter[str] = field(default_factory=Counter)
    """Kind -> number of messages in the log, read or not."""

    def has(self, kind: str) -> bool:
        """Return whether there are at least two messages of a kind."""
        return len(self.messages.get(kind, ())) >= 2

    def numbers(self, kind: str, name: str) -> Array:
        """Return a field of every message of a kind, NaN where it is missing, (n,). It has the unit of the log."""
        return np.array([_number(message.get(name)) for message in self.messages[kind]], dtype=float)

    def stream(self, kind: str, channels: dict[str, Array], *findings: Finding) -> Stream:
        """Return columns at the times of a kind of message. Channels have the units of a trial."""
        source = f"{self.shown} {kind}"
        return Stream(source=source, t=self.times[kind], channels=channels, findings=findings)

    def some(self, kind: str, name: str, value: int | str) -> ArduPilotLog:
        """Return the log with only the messages of a kind whose field has a value; with all if none has the field."""
        if not any(name in message for message in self.messages.get(kind, ())):
            return self
        keep = [i for i, message in enumerate(self.messages[kind]) if message.get(name) == value]
        return replace(
            self,
            times={**self.times, kind: self.times[kind][keep]},
            messages={**self.messages, kind: [self.messages[kind][i] for i in keep]},
        )


def read_log(path: Path, kinds: frozenset[str], *, received: bool = False) -> ArduPilotLog:
    """Return the messages of some kinds; a truncated log is read up to its end.

    Args:
        path: `.BIN`, `.tlog`, or `.mcap` of BlueOS.
        kinds: Names of the kinds of message.
        received: True to time telemetry by its receipt instead of the autopilot's stamps.

    Raises:
        CalibrationError: There are no such messages: the file is not a log, or is empty.
        ModuleNotFoundError: pymavlink is not installed.
    """
    try:
        with path.open("rb") as file:
            dataflash = file.read(2) == DATAFLASH
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be read: {error.strerror or error}") from None
    log = ArduPilotLog(path.name, not dataflash)
    clock = _Clock(received)
    for kind, message, receipt in _messages(
        path, dataflash, kinds | {"PARM", "PARAM_VALUE", "HEARTBEAT"}, log.counts
    ):
        if kind == "PARM":
            log.parameters[message["Name"]] = float(message["Value"])
        elif kind == "PARAM_VALUE":
            log.parameters[message["param_id"]] = float(message["param_value"])
        if kind in kinds:
            log.messages.setdefault(kind, []).append(message)
            clock.add(kind, message, receipt)
    log.times.update(clock.times() if log.telemetry else clock.boot_times())
    if not log.messages:
        raise CalibrationError(
            f"{path}: contains no usable messages: expected an ArduSub log, .BIN or .tlog, or a .mcap of "
            "BlueOS' recorder or of ROS 2"
        )
    return log


class _Clock:
    """Clock that aligns the autopilot's stamps with the times of receipt."""

    def __init__(self, received: bool) -> None:
        self.received = received
        self.receipts: dict[str, list[float]] = {}
        self.stamps: dict[str, list[float]] = {}
        self.boots: dict[str, list[int]] = {}
        self.offsets = [math.inf]
        self.last = -math.inf

    def add(self, kind: str, message: dict[str, Any], receipt: float) -> None:
        stamp = _stamp(message)
        if math.isfinite(stamp) and "VISION" not in kind:
            if stamp < self.last - 1.0:  # the autopilot restarted
                self.offsets.append(math.inf)
            self.last = stamp
            # The message with the shortest delay determines the difference between the clocks.
            self.offsets[-1] = min(self.offsets[-1], receipt - stamp)
        self.receipts.setdefault(kind, []).append(receipt)
        self.stamps.setdefault(kind, []).append(stamp)
        self.boots.setdefault(kind, []).append(len(self.offsets) - 1)

    def boot_times(self) -> dict[str, Array]:
        """Return the unchanged stamps, for a log that the autopilot wrote itself."""
        return {kind: np.array(stamps) for kind, stamps in self.stamps.items()}

    def times(self) -> dict[str, Array]:
        by_kind = {}
        for kind, receipts in self.receipts.items():
            receipt = np.array(receipts)
            stamped = np.array(self.stamps[kind]) + np.array(self.offsets)[self.boots[kind]]
            ours = np.isfinite(stamped) & (np.abs(stamped - receipt) < WRONG_CLOCK) & (not self.received)
            by_kind[kind] = np.where(ours, stamped, receipt)
        return by_kind


def _stamp(message: dict[str, Any]) -> float:
    """Return the seconds since the autopilot started; NaN if the message contains no stamp."""
    for name, unit in (("TimeUS", 1e-6), ("time_boot_ms", 1e-3), ("time_usec", 1e-6), ("usec", 1e-6)):
        if message.get(name):
            return float(message[name]) * unit
    return math.nan


def _messages(
    path: Path, dataflash: bool, kinds: frozenset[str], counts: Counter[str]
) -> Iterator[tuple[str, dict[str, Any], float]]:
    """Yield kind, fields and time of receipt [s] of each message of the autopilot, and count all kinds."""
    if path.suffix.lower() == ".mcap":
        yield from _recorded(path, kinds, counts)
        return
    from pymavlink import DFReader, mavutil

    complaints = io.StringIO()  # pymavlink prints the bytes that it skips at a truncation
    with contextlib.redirect_stderr(complaints), contextlib.redirect_stdout(complaints):
        try:
            if dataflash:
                log = DFReader.DFReader_binary(str(path))
            else:
                log = mavutil.mavlogfile(str(path), robust_parsing=True)
        except Exception as error:  # pymavlink raises any kind of error
            raise CalibrationError(f"{path}: not an ArduPilot log: {error}") from None
        systems: set[int] = set()
        try:
            while True:
                try:
                    message = log.recv_match(type=sorted(kinds)) if dataflash else log.recv_msg()
                except Exception:  # the same, at the end of a truncated log
                    break
                if message is None:
                    break
                kind = message.get_type()
                counts[kind] += 1
                if kind not in kinds:
                    continue
                fields = message.to_dict()
                if not dataflash:
                    sender = message.get_srcSystem(), message.get_srcComponent()
                    if not _of_autopilot(sender, kind, fields, systems):
                        continue
                yield kind, fields, float(message._timestamp)
            if dataflash:
                names = {number: kind for number, kind in log.id_to_name.items() if log.counts[number]}
                counts.update(
                    {kind: log.counts[number] for number, kind in names.items() if kind not in kinds}
                )
        finally:
            close = getattr(log, "close", None)
            if close is not None:
                close()


MAVLINK_TOPIC = re.compile(r"mavlink/(\d+)/(\d+)/([A-Z0-9_]+)")
"""Topic in a recording of BlueOS: system, component and kind of a message."""


def _recorded(
    path: Path, kinds: frozenset[str], counts: Counter[str]
) -> Iterator[tuple[str, dict[str, Any], float]]:
    """Yield the messages of an MCAP file of BlueOS' recorder, which stores messages of its MAVLink server as JSON."""
    from mcap.reader import NonSeekingReader

    systems: set[int] = set()
    with intact_mcap(path, []) as complete, complete.open("rb") as file:
        messages = NonSeekingReader(file).iter_messages(log_time_order=False)
        while True:
            try:
                _, channel, message = next(messages)
            except Exception:  # at the end, or at the truncation of a log, raised by any layer of the reader
                return
            topic = MAVLINK_TOPIC.fullmatch(channel.topic)
            counts[topic[3] if topic else channel.topic] += 1
            if topic is None or topic[3] not in kinds:
                continue
            try:
                fields = {name: _plain(value) for name, value in json.loads(message.data)["message"].items()}
            except (ValueError, KeyError, TypeError, AttributeError):
                continue
            if _of_autopilot((int(topic[1]), int(topic[2])), topic[3], fields, systems):
                yield topic[3], fields, 1e-9 * message.log_time


def _plain(value: Any) -> Any:
    """Return a field in pymavlink's form: numbers for names and sets of flags, text for lists of characters."""
    from pymavlink.dialects.v20 import ardupilotmega

    if isinstance(value, dict):
        return value["bits"] if "bits" in value else _plain(value.get("type"))
    if isinstance(value, list) and value and all(isinstance(letter, str) for letter in value):
        return "".join(value).split("\0")[0]
    if isinstance(value, str):
        flags = [getattr(ardupilotmega, name.strip(), None) for name in value.split("|")]
        return sum(flags) if all(isinstance(flag, int) for flag in flags) else value.split("\0")[0]
    return value


def _of_autopilot(sender: tuple[int, int], kind: str, fields: dict[str, Any], systems: set[int]) -> bool:
    """Return whether the vehicle's autopilot sent a message; position sensors and pilots use the same link.

    Args:
        sender: System and component.
        kind: Kind of the message.
        fields: Fields of the message.
        systems: Systems with an autopilot; the sender of an autopilot's heartbeat is added.
    """
    if kind == "HEARTBEAT":
        if fields.get("autopilot") == NO_AUTOPILOT:
            return False
        systems.add(sender[0])
    if kind.startswith("VISION") or kind == "MANUAL_CONTROL":
        return True
    return sender[1] == AUTOPILOT and (not systems or sender[0] in systems)


def _number(value: Any) -> float:
    return float(value) if isinstance(value, (int, float)) else math.nan


# Velocity and position in ArduSub logs: estimates of the autopilot, and measurements of a DVL or camera.

VELOCITY_KINDS = frozenset(
    "XKF1 NKF1 XKF4 NKF4 VISO LOCAL_POSITION_NED EKF_STATUS_REPORT VISION_POSITION_DELTA".split()
)

HORIZONTAL_VELOCITY, RELATIVE_POSITION, ABSOLUTE_POSITION, STANDING_STILL = 2, 8, 16, 128
"""Flags of the filter's state; the last one means that it assumes a constant position without measuring it."""

ESTIMATES = {
    "XKF1": ("XKF4", "SS", ("VN", "VE", "VD", "PN", "PE", "PD")),
    "NKF1": ("NKF4", "SS", ("VN", "VE", "VD", "PN", "PE", "PD")),
    "LOCAL_POSITION_NED": ("EKF_STATUS_REPORT", "flags", ("vx", "vy", "vz", "x", "y", "z")),
}
"""Kind of message -> kind with the state of its filter, field of that state, and the fields of velocity and
position."""

LEAST_USABLE = 0.2
"""Fraction of the estimates that must be based on a measurement of position or velocity."""


def velocity_stream(log: ArduPilotLog, source: Literal["auto", "ekf", "vision", "none"]) -> Stream | None:
    """Return velocity from position deltas if there are any, otherwise velocity and position estimated by the
    autopilot.

    The estimate is omitted where the filter had no measurement of horizontal position or velocity: it then
    assumes that the vehicle is stationary.
    """
    if source == "none":
        return None
    if source in ("auto", "vision"):
        deltas = _position_deltas(log)
        if deltas is not None or source == "vision":
            return deltas
    return _estimate(log)


def _position_deltas(log: ArduPilotLog) -> Stream | None:
    """Return velocity from position deltas over their time intervals, body frame."""
    if log.has("VISO"):
        kind, dt = "VISO", log.numbers("VISO", "dt")
        delta = np.stack([log.numbers(kind, f"PosD{axis}") for axis in "XYZ"], axis=-1)
    elif log.has("VISION_POSITION_DELTA"):
        kind = "VISION_POSITION_DELTA"
        dt = 1e-6 * log.numbers(kind, "time_delta_usec")
        delta = np.array([message["position_delta"] for message in log.messages[kind]], dtype=float)
    else:
        return None
    good = dt > 1e-3
    velocity = np.where(good[:, None], delta / np.where(good, dt, 1.0)[:, None], np.nan)
    # A delta is the mean over the interval before its stamp.
    channels = dict(zip("uvw", velocity.T, strict=True))
    stream = log.stream(kind, channels, finding("velocity_at_sensor", kind=kind))
    return in_our_axes(replace(stream, t=stream.t - 0.5 * np.where(good, dt, 0.0)), FRD)


def _estimate(log: ArduPilotLog) -> Stream | None:
    kind = next((kind for kind in ESTIMATES if log.has(kind)), None)
    if kind is None:
        return None
    status, flag_name, names = ESTIMATES[kind]
    first_core = log.some(kind, "C", 0).some(status, "C", 0)
    usable = HORIZONTAL_VELOCITY | RELATIVE_POSITION
    flags = _held(first_core, status, flag_name, first_core.times[kind], usable).astype(np.int64)
    moving = (flags & HORIZONTAL_VELOCITY > 0) & (flags & STANDING_STILL == 0)
    if moving.mean() < LEAST_USABLE:
        unusable = finding("velocity_left_out", kind=kind, share=1.0 - moving.mean())
        return first_core.stream(kind, {}, unusable)
    placed = moving & (flags & (RELATIVE_POSITION | ABSOLUTE_POSITION) > 0)
    values = [first_core.numbers(kind, name) for name in names]
    channels = {c: np.where(moving, v, np.nan) for c, v in zip(("vx", "vy", "vz"), values[:3], strict=True)}
    if placed.any():
        channels |= {c: np.where(placed, v, np.nan) for c, v in zip("xyz", values[3:], strict=True)}
    return in_our_axes(first_core.stream(kind, channels, finding("velocity_estimated", kind=kind)), FRD)


def _held(log: ArduPilotLog, kind: str, name: str, t: Array, otherwise: float) -> Array:
    """Return a field at other times, each value held until the next; a constant if the log has no such message."""
    if not log.messages.get(kind):
        return np.full(len(t), otherwise)
    held = np.searchsorted(log.times[kind], t, side="right") - 1
    return log.numbers(kind, name)[np.maximum(held, 0)]


FRD = LogFrame(body="FRD", world="NED")

INERTIAL = ("RAW_IMU", "SCALED_IMU", "SCALED_IMU2", "SCALED_IMU3")
PRESSURES = ("SCALED_PRESSURE", "SCALED_PRESSURE2", "SCALED_PRESSURE3")
KINDS = VELOCITY_KINDS | frozenset(
    "ATT IMU IMU2 IMU3 BARO BAR2 BAR3 RCOU RCO2 BAT CURR ARM EV SERVO_OUTPUT_RAW ATTITUDE SYS_STATUS BATTERY_STATUS "
    "HEARTBEAT RAW_IMU SCALED_IMU SCALED_IMU2 SCALED_IMU3 SCALED_PRESSURE SCALED_PRESSURE2 SCALED_PRESSURE3 MODE RCIN "
    "RC_CHANNELS MANUAL_CONTROL NAMED_VALUE_FLOAT".split()
)

ARMED_EVENT, DISARMED_EVENT = 10, 11
ARMED_FLAG = 128
"""MAV_MODE_FLAG_SAFETY_ARMED."""


def read(path: Path, request: Request) -> TrialStreams:
    """Return the content of an ArduSub log, one stream for each kind of message.

    Args:
        path: `.BIN`, `.tlog`, or `.mcap` of BlueOS.
        request: Map, and the vehicle whose thrusters the outputs drive; without a vehicle, pulses are named
            by output number. A passive trial has no pulses.

    Raises:
        CalibrationError: The file is not a log, or its outputs cannot be assigned.
        ModuleNotFoundError: pymavlink is not installed.
    """
    requested = request.mapped.ardusub
    log = read_log(path, KINDS, received=requested.stamps == "received")
    streams = [
        _attitude(log),
        _inertial(log, requested),
        _depth(log, requested),
        _voltage(log),
        _arming(log),
        velocity_stream(log, requested.velocity),
    ]
    usable = with_inputs(log, request, [s for s in streams if s is not None and len(s.t) >= 2])
    if not any(stream.channels for stream in usable):
        raise CalibrationError(f"{path.name}: contains no attitude, rates, depth, velocity or outputs")
    used = {stream.source.removeprefix(f"{path.name} ") for stream in usable}
    used |= {"PARM", "PARAM_VALUE", "HEARTBEAT", "MODE", "FMT", "EV", "XKF4", "NKF4", "EKF_STATUS_REPORT"}
    rest = [f"{kind} ({count})" for kind, count in sorted(log.counts.items()) if kind not in used]
    if rest:
        usable[0] = usable[0].noting(finding("not_read", items=f"messages {', '.join(rest)}"))
    return TrialStreams(usable)


def with_inputs(log: ArduPilotLog, request: Request, streams: list[Stream]) -> list[Stream]:
    """Return the streams of a log with the pulses of its outputs, or those computed by the mixer from the
    pilot's axes.

    Raises:
        CalibrationError: The outputs do not match the vehicle's thrusters.
    """
    if request.passive:
        return streams
    streams = [*streams, *_pulses(log, request.mapped.ardusub, request.vehicle)]
    if request.vehicle is None or any("pwm_" in name for stream in streams for name in stream.channels):
        return streams
    return _driven_by_sticks(log, request.mapped.ardusub, request.vehicle, streams)


def _attitude(log: ArduPilotLog) -> Stream | None:
    """Return roll, pitch, yaw; in telemetry also the rates, which the autopilot has corrected for bias."""
    if log.has("ATT"):
        angles = [np.radians(log.numbers("ATT", name)) for name in ("Roll", "Pitch", "Yaw")]
        channels, kind = {}, "ATT"
    elif log.has("ATTITUDE"):
        angles = [log.numbers("ATTITUDE", name) for name in ("roll", "pitch", "yaw")]
        channels = {
            c: log.numbers("ATTITUDE", n)
            for c, n in zip("pqr", ("rollspeed", "pitchspeed", "yawspeed"), strict=True)
        }
        kind = "ATTITUDE"
    else:
        return None
    channels |= dict(zip(("roll", "pitch", "yaw"), angles, strict=True))
    return in_our_axes(log.stream(kind, channels), FRD)


def _instance(log: ArduPilotLog, first: str, others: str, number: int) -> tuple[str, ArduPilotLog]:
    """Return the kind of message of sensor `number`, from 0, and the log with only its messages of that kind."""
    kind = f"{others}{number + 1}" if number and log.has(f"{others}{number + 1}") else first
    return kind, log.some(kind, "I", number)


def _inertial(log: ArduPilotLog, requested: ArduSubMap) -> Stream | None:
    """Return the specific force, and in DataFlash logs the rates."""
    if not log.telemetry:
        kind, instance = _instance(log, "IMU", "IMU", requested.imu)
        if not log.has(kind):
            return None
        if not instance.has(kind):
            raise CalibrationError(
                f"{log.shown}: contains no IMU {requested.imu}: give 'ardusub: {{imu: 0}}'"
            )
        channels = {f"a{axis.lower()}": instance.numbers(kind, f"Acc{axis}") for axis in "XYZ"}
        channels |= {
            name: instance.numbers(kind, f"Gyr{axis}") for name, axis in zip("pqr", "XYZ", strict=True)
        }
        return in_our_axes(instance.stream(kind, channels), FRD)
    for kind in INERTIAL:
        if log.has(kind) and np.any(log.numbers(kind, "zacc")):
            # [milli-g], and zero in every field that the sensor lacks
            channels = {f"a{axis}": 1e-3 * GRAVITY * log.numbers(kind, f"{axis}acc") for axis in "xyz"}
            return in_our_axes(log.stream(kind, channels), FRD)
    return None


def _depth(log: ArduPilotLog, requested: ArduSubMap) -> Stream | None:
    """Return the depth from the pressure sensor that the autopilot treats as external."""
    primary = int(log.parameters.get("BARO_PRIMARY", log.parameters.get("GND_PRIMARY", 1)))
    chosen = primary if requested.barometer is None else requested.barometer
    if log.telemetry:
        return _depth_from_pressure(log, chosen)
    kind, instance = _instance(log, "BARO", "BAR", chosen)
    if not instance.has(kind):
        return None
    of = finding("depth_of_barometer", number=chosen)
    return instance.stream(kind, {"depth": -instance.numbers(kind, "Alt")}, of)


def _depth_from_pressure(log: ArduPilotLog, chosen: int) -> Stream | None:
    kind = PRESSURES[chosen] if chosen < len(PRESSURES) else ""
    if not log.has(kind):
        return None
    pressure = 100.0 * log.numbers(kind, "press_abs")  # [hPa]
    ground = log.parameters.get(f"BARO{chosen + 1}_GND_PRESS", 0.0)
    if ground <= 0.0:
        # `trial_of` knows the surface pressure and the density.
        return log.stream(kind, {"pressure": pressure})
    # 9800 Pa for a metre of fresh water, as in the autopilot.
    depth = (pressure - ground) / (9800.0 * log.parameters.get("BARO_SPEC_GRAV", 1.0))
    return log.stream(kind, {"depth": depth}, finding("depth_of_message", kind=kind, ground=ground))


def _voltage(log: ArduPilotLog) -> Stream | None:
    for kind, name, unit in (
        ("BAT", "Volt", 1.0),
        ("CURR", "Volt", 1.0),
        ("SYS_STATUS", "voltage_battery", 1e-3),
    ):
        if not log.has(kind):
            continue
        instance = log.some(kind, "Instance", 0)
        volts = unit * instance.numbers(kind, name)
        measured = (volts > 1.0) & (volts < 65.0)  # 0 and 65.535 V mean "not measured"
        if measured.sum() >= 2:
            return instance.stream(kind, {"voltage": volts}).selected(measured)
    return None


def _arming(log: ArduPilotLog) -> Stream | None:
    """Return the words `armed` and `disarmed`; the state before the first event is its opposite."""
    if log.has("HEARTBEAT"):
        armed = [bool(int(mode) & ARMED_FLAG) for mode in log.numbers("HEARTBEAT", "base_mode")]
        return _arming_stream(log, "HEARTBEAT", list(log.times["HEARTBEAT"]), armed)
    times, armed = [], []
    if "ARM" in log.messages:
        times, armed = list(log.times["ARM"]), [bool(x) for x in log.numbers("ARM", "ArmState")]
    else:
        for t, event in zip(log.times.get("EV", ()), log.messages.get("EV", ()), strict=True):
            if event.get("Id") in (ARMED_EVENT, DISARMED_EVENT):
                times.append(float(t))
                armed.append(event["Id"] == ARMED_EVENT)
    if not times:
        return None
    begin = min(float(t[0]) for t in log.times.values() if len(t))
    return _arming_stream(log, "ARM", [min(begin, times[0] - 1e-3), *times], [not armed[0], *armed])


def _arming_stream(log: ArduPilotLog, kind: str, times: list[float], armed: list[bool]) -> Stream:
    labels = np.array(["armed" if on else "disarmed" for on in armed], dtype=np.str_)
    return Stream(source=f"{log.shown} {kind}", t=np.array(times), words={"arming": labels})


def _pulses(log: ArduPilotLog, requested: ArduSubMap, vehicle: Vehicle | None) -> list[Stream]:
    """Return pwm_NAME of each thruster, mirrored about neutral where needed so that longer pulses push along
    its axis."""
    kind, field = ("SERVO_OUTPUT_RAW", "servo{}_raw") if log.telemetry else ("RCOU", "C{}")
    port = log.some(kind, "port", 0)
    if not port.has(kind):
        return []
    if vehicle is not None:
        try:
            outputs, of = outputs_of(vehicle, log.parameters, requested.outputs)
        except CalibrationError as error:
            raise CalibrationError(f"{log.shown}: {error}") from None
    else:
        outputs = {n: (f"C{n}", 1) for n in range(1, 17) if np.any(port.numbers(kind, field.format(n)) > 0.0)}
        of = finding("pulses_unnamed")
    channels = {}
    for output, (name, sign) in outputs.items():
        pulse = port.numbers(kind, field.format(output))
        channels[f"pwm_{name}"] = np.where(pulse > 0.0, NEUTRAL + sign * (pulse - NEUTRAL), np.nan)
    return [port.stream(kind, channels, of)]


MANUAL = 19
"""Number of the mode in which the pilot's axes reach the mixer unchanged."""
USUAL_YAW = 3.375
"""ACRO_YAW_P at which the yaw axis is unchanged."""


def _driven_by_sticks(
    log: ArduPilotLog, requested: ArduSubMap, vehicle: Vehicle, streams: list[Stream]
) -> list[Stream]:
    """Return the streams with pwm_NAME from the pilot's axes, if the log has no outputs, without samples of
    other modes.

    Raises:
        CalibrationError: The frame's motors do not match the vehicle's thrusters.
    """
    axes = _axes(log, requested)
    named = [number for number, (name, _) in FRAMES.items() if name == _frame_name(requested, vehicle)]
    config = int(log.parameters.get("FRAME_CONFIG", named[0] if named else -1))
    if axes is None or config not in FRAMES:
        return streams
    kind, t, demands = axes
    motors = range(1, len(FRAMES[config][1]) + 1)
    directions = {f"MOT_{n}_DIRECTION": log.parameters.get(f"MOT_{n}_DIRECTION", 1.0) for n in motors}
    parameters = {**log.parameters, "FRAME_CONFIG": float(config), **directions}
    signs = tuple(int(sign) for sign in directions.values())
    standing = np.where(_armed(log, t)[:, None], demands, 0.0)
    try:
        channels, mapped = mixed_pulses(vehicle, standing, parameters, signs, requested.outputs)
    except CalibrationError as error:
        raise CalibrationError(f"{log.shown}: {error}") from None
    note = finding("sticks_mixed", frame=FRAMES[config][0], gain=1.0)
    pulses = log.stream(kind, channels, note, mapped)
    # The only gaps of a held command are those of the complete recording.
    manual_streams, other = [], 0
    for stream in (*streams, pulses):
        manual = (_mode(log, stream.t) == MANUAL) | ~_armed(log, stream.t)
        other += int((~manual).sum())
        manual_streams.append(stream.selected(manual))
    if other:
        share = other / sum(len(stream.t) for stream in (*streams, pulses))
        manual_streams[-1] = manual_streams[-1].noting(finding("other_modes_left_out", share=share))
    return [stream for stream in manual_streams if len(stream.t) >= 2]


def _frame_name(requested: ArduSubMap, vehicle: Vehicle) -> Any:
    return requested.frame or (vehicle.autopilot.frame if vehicle.autopilot is not None else None)


def _axes(log: ArduPilotLog, requested: ArduSubMap) -> tuple[str, Array, Array] | None:
    """Return kind of message, times and demands in the order of `DEMANDS`, (n, 6), from channels or from the
    joystick."""
    kind, name = ("RC_CHANNELS", "chan{}_raw") if log.telemetry else ("RCIN", "C{}")
    if log.has(kind):
        pulses = np.stack([log.numbers(kind, name.format(n)) for n in range(1, 7)])
        axes = np.where((pulses > 800.0) & (pulses < 2200.0), (pulses - NEUTRAL) / FULL, np.nan)
    elif log.has("MANUAL_CONTROL"):
        kind = "MANUAL_CONTROL"
        x, y, z, r, s, t = (np.nan_to_num(log.numbers(kind, name)) for name in "xyzrst")
        gain = _held(_gains(log), "NAMED_VALUE_FLOAT", "value", log.times[kind], requested.gain)
        scaled = gain * np.stack([(z - 500.0) / 500.0, r / 1000.0, x / 1000.0, y / 1000.0])
        axes = np.concatenate([np.stack([s, t]) / FULL, scaled])
    else:
        return None
    sticks = dict(zip(STICK_CHANNELS, axes.clip(-1.0, 1.0), strict=True))
    sticks["yaw"] = sticks["yaw"] * log.parameters.get("ACRO_YAW_P", USUAL_YAW) / USUAL_YAW
    return kind, log.times[kind], np.stack([sticks[demand] for demand in DEMANDS], axis=-1)


def _gains(log: ArduPilotLog) -> ArduPilotLog:
    """Return the log with PilotGain as its only named value."""
    kind = "NAMED_VALUE_FLOAT"
    if all(message.get("name") != "PilotGain" for message in log.messages.get(kind, ())):
        return replace(log, messages={**log.messages, kind: []})
    return log.some(kind, "name", "PilotGain")


def _mode(log: ArduPilotLog, t: Array) -> Array:
    """Return the number of the autopilot's mode at given times; MANUAL if the log has none."""
    kind, name = ("HEARTBEAT", "custom_mode") if log.telemetry else ("MODE", "ModeNum")
    return _held(log, kind, name, t, MANUAL)


def _armed(log: ArduPilotLog, t: Array) -> NDArray[np.bool_]:
    """Return whether the vehicle was armed at given times; always true if the log does not contain it."""
    arming = _arming(log)
    if arming is None:
        return np.ones(len(t), dtype=bool)
    held = np.searchsorted(arming.t, t, side="right") - 1
    return np.asarray(arming.words["arming"][np.maximum(held, 0)] == "armed")


def _recognises(path: Path, head: bytes) -> bool:
    """Return whether a file is a DataFlash log, telemetry, or an MCAP file of BlueOS' recorder, which has no
    profile."""
    return head.startswith(DATAFLASH) or path.suffix.lower() in (".bin", ".tlog") or without_profile(head)


ARDUPILOT = Importer(
    "trial", title="an ArduPilot log (.BIN, .tlog, .mcap of BlueOS)", recognises=_recognises, read=read
)
