"""Frames of the motor controller's protocol: one table that encodes, decodes and finds them in a stream of bytes.

Published layout of the FinsROV hardware bridge, all little endian; the CRC is CRC16-MODBUS of everything between the
magic and itself.
"""

from __future__ import annotations

import math
import re
import struct
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import IntFlag
from functools import cached_property, lru_cache
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from finssim.robot.messages import CommandEcho, NavigationAid, Telemetry, ThrusterCommand

# Fields of a frame in wire order: the only description, for both encoding and decoding.


class LinkError(ValueError):
    """An address or a message is invalid; the text states what, where and what to do."""


class Field(NamedTuple):
    """One entry of a frame; all are little endian."""

    name: str
    """Attribute of the message; with a `constant`, a name within the frame only."""
    code: str
    """Code of `struct`: ? B H I f."""
    meaning: str
    """Meaning with its unit, for the table of the documentation."""
    values: int = 1
    """Number of values; 0: one per motor output; `OTHERS`: one per actuator besides thrusters."""
    constant: int | None = None
    """Value that is always sent; None: that of the message."""
    order: tuple[int, ...] = ()
    """Index in the message of each value on the wire; empty: the same order."""


OTHERS = -1
"""`Field.values` of a field with one value per actuator besides thrusters."""


@dataclass(frozen=True)
class Layout:
    """One kind of frame: magic, header, payload, CRC16 of header and payload, tail."""

    title: str
    message: type
    """Type of the decoded message."""
    magic: bytes
    header: tuple[Field, ...]
    """Header fields; a field `length` counts the bytes of the payload."""
    payload: tuple[Field, ...]
    tail: bytes = b""
    optional: str = ""
    """Name of the last field if a frame may end before it; its decoded value is then None."""


class TelemetryLayout:
    """A layout for given numbers of motor outputs and of other actuators, with or without its optional field, so that
    its length is known."""

    def __init__(self, layout: Layout, outputs: int, others: int = 0, *, complete: bool = True) -> None:
        """
        Args:
            layout: The kind of frame.
            outputs: Number of motor outputs of the vehicle.
            others: Number of actuators of the vehicle besides thrusters.
            complete: False: without the optional field.
        """
        payload = layout.payload if complete else layout.payload[:-1]
        numbers = {0: outputs, OTHERS: others}
        self.counts = {f.name: numbers.get(f.values, f.values) for f in (*layout.header, *payload)}
        """Number of values of each field by its name."""
        length = struct.calcsize("<" + self._codes(payload))
        header = tuple(f._replace(constant=length) if f.name == "length" else f for f in layout.header)
        self.layout, self.fields = layout, (*header, *payload)
        self.absent = {} if complete else {layout.optional: None}
        self._body = struct.Struct("<" + self._codes(self.fields))
        self.crc_at = len(layout.magic) + self._body.size
        self.size = self.crc_at + 2 + len(layout.tail)

    @cached_property
    def prefix(self) -> bytes:
        """First bytes of every such frame: the magic and the constants directly after it."""
        body = b""
        for field in self.fields:
            if field.constant is None:
                break
            body += struct.pack("<" + field.code, field.constant)
        return self.layout.magic + body

    @cached_property
    def _places(self) -> tuple[tuple[str, int, int, tuple[int, ...]], ...]:
        """Name, first value, one past the last (0: a single value) and order of a message's fields."""
        places, at = [], 0
        for field in self.fields:
            count = self.counts[field.name]
            if field.constant is None:
                alone = field.values == 1
                order = tuple(field.order.index(i) for i in range(count)) if field.order else ()
                places.append((field.name, at, 0 if alone else at + count, order))
            at += count
        return tuple(places)

    def encode(self, message: Any) -> bytes:
        """Return the bytes of a message; raise LinkError for a number that does not fit the field, or is not
        finite."""
        numbers = self._numbers(message)
        try:
            if not math.isfinite(sum(numbers)):
                self._refuse_not_finite(message)
            body = self._body.pack(*numbers)
        except (struct.error, OverflowError, TypeError) as problem:
            raise LinkError(
                f"{self.layout.title}: {message} does not fit the frame ({problem}): send numbers within its fields"
            ) from None
        return self.layout.magic + body + struct.pack("<H", crc16_modbus(body)) + self.layout.tail

    def _numbers(self, message: Any) -> list[Any]:
        """Return the values of all fields in wire order."""
        numbers: list[Any] = []
        for name, _, _, values, constant, order in self.fields:
            if constant is not None:
                numbers.append(constant)
                continue
            value = getattr(message, name)
            if values == 1:
                numbers.append(value)
                continue
            if len(value) != self.counts[name]:
                raise LinkError(
                    f"{self.layout.title}: {name} has {len(value)} values, expected {self.counts[name]}"
                )
            numbers.extend([value[i] for i in order] if order else value)
        return numbers

    def _refuse_not_finite(self, message: Any) -> None:
        """Raise LinkError for the first field with a number that is not finite, if there is one."""
        for field in self.fields:
            if field.code != "f":
                continue
            value = getattr(message, field.name)
            if not all(map(math.isfinite, (value,) if field.values == 1 else value)):
                raise LinkError(
                    f"{self.layout.title}: {field.name} is {value}, expected finite numbers: "
                    "stop the motors instead of sending it"
                )

    def decode(self, frame: bytes, at: int = 0) -> Any | None:
        """Return the message of the frame that begins at `at`, whose CRC is correct; None if a number is not
        finite."""
        values = self._body.unpack_from(frame, at + len(self.layout.magic))
        # Single precision cannot overflow the sum, so it is finite if all of them are.
        if not math.isfinite(sum(values)):
            return None
        decoded: dict[str, Any] = dict(self.absent)
        for name, first, end, order in self._places:
            part = values[first:end] if end else values[first]
            decoded[name] = tuple([part[i] for i in order]) if order else part
        return self.layout.message(**decoded)

    def _codes(self, fields: tuple[Field, ...]) -> str:
        return "".join(f"{self.counts[f.name]}{f.code}" for f in fields)


@lru_cache(maxsize=64)
def forms(layout: Layout, outputs: int, others: int = 0) -> tuple[TelemetryLayout, ...]:
    """Return every form of a layout for given numbers of motor outputs and of other actuators, the complete one first;
    none of version 2 without other actuators."""
    if not others and any(f.values == OTHERS for f in layout.payload):
        return ()
    complete = TelemetryLayout(layout, outputs, others)
    return (complete, TelemetryLayout(layout, outputs, complete=False)) if layout.optional else (complete,)


@lru_cache(maxsize=64)
def _crc_terms(length: int) -> tuple[npt.NDArray[np.uint16], npt.NDArray[np.int64], int]:
    """Return the contribution of each byte of a message of that length to its CRC (256 numbers per position in a row),
    the start of each position in them, and the CRC of zeros alone. The CRC is linear: contributions are combined by
    exclusive or."""
    single = np.arange(256, dtype=np.uint16)
    for _ in range(8):
        single = np.where(single & 1, (single >> 1) ^ 0xA001, single >> 1).astype(np.uint16)
    terms, crc = np.empty((length, 256), np.uint16), 0xFFFF
    for position in range(length - 1, -1, -1):
        behind = (
            single
            if position == length - 1
            else (terms[position + 1] >> 8) ^ single[terms[position + 1] & 0xFF]
        )
        terms[position] = behind
        crc = (crc >> 8) ^ int(single[crc & 0xFF])
    return terms.ravel(), 256 * np.arange(length), crc


def crc16_modbus(data: bytes) -> int:
    """Return the CRC16-MODBUS: polynomial x¹⁶ + x¹⁵ + x² + 1 reflected (0xA001), initial value 0xFFFF; 0x4B37 for
    "123456789"."""
    terms, position, of_zeros = _crc_terms(len(data))
    return of_zeros ^ int(np.bitwise_xor.reduce(terms[position + np.frombuffer(data, np.uint8)]))


@dataclass(frozen=True)
class DebugConfig:
    """Messages that the host requests from the motor controller besides telemetry."""

    sequence: int
    """Counter, modulo 2¹⁶."""
    mask: int
    """Bit 0 (`DEBUG_ECHO`): a `CommandEcho` for commands."""
    decimation: int
    """Number of commands per echo."""


Message: TypeAlias = Telemetry | CommandEcho | NavigationAid | ThrusterCommand | DebugConfig

DEBUG_ECHO = 1
"""Bit of `DebugConfig.mask`: echo commands."""


class StatusFlag(IntFlag):
    """Bits of `Telemetry.flags`; bits 16 to 23 are the low byte of the count of commands (`command_count`)."""

    COMMAND_RECEIVED = 1 << 24
    """A command was received since the controller started."""
    ECHO_ON = 1 << 25
    """Echoes were requested."""
    DIRECT_THRUSTERS = 1 << 26
    """The host's command drives the motors, enabled."""
    TARGET_RPM = 1 << 27
    """A target speed is not zero."""
    THROTTLE = 1 << 28
    """A throttle is not zero."""
    MOTOR_HANDLER = 1 << 29
    """The motor loop is running."""
    RPM_CONTROL = 1 << 30
    """Speeds are controlled, not throttles."""
    DIAGNOSTICS = 1 << 31
    """Bits 16 to 30 are valid."""


class RejectFlag(IntFlag):
    """Bits of `CommandEcho.reject_flags`: reasons why a command does not turn the motors."""

    DISABLED = 2
    TIMEOUT = 4
    BAD_FRAME = 8


def command_count(flags: int) -> int:
    """Return the low byte of the count of commands that the controller has received, from `Telemetry.flags`."""
    return (flags >> 16) & 0xFF


def _head(kind: int, version: int = 1) -> tuple[Field, ...]:
    """Return the first fields of telemetry, echo and debug configuration after their magic."""
    return (
        Field("type", "B", "kind of frame", constant=kind),
        Field("version", "B", "of the layout", constant=version),
        Field("length", "H", "bytes between the header and the CRC"),
        Field("sequence", "H", "counts frames, modulo 2¹⁶"),
    )


_MCU_MS = Field("mcu_ms", "I", "the controller's clock, modulo 2³² [ms]")

COMMAND = Layout(
    "thruster command",
    ThrusterCommand,
    magic=b"\xaa",
    header=(),
    payload=(
        Field("enable", "?", "0: motors off, regardless of the rest"),
        Field("normalised", "f", "part of the full-scale shaft speed, -1 to 1, per motor output", values=0),
    ),
    tail=b"\xbb",
)
COMMAND_2 = Layout(
    "command of thrusters and other actuators",
    ThrusterCommand,
    magic=b"\xac\xca",
    header=_head(2, 2)[:3],
    payload=(
        Field("enable", "?", "0: motors off and other actuators at their `off`, regardless of the rest"),
        COMMAND.payload[1],
        Field("setpoints", "f", "per other actuator [rad, m³ or m]; limited to its travel", values=OTHERS),
    ),
)
TELEMETRY = Layout(
    "telemetry",
    Telemetry,
    magic=b"\xa5\x5a",
    header=(*_head(1), _MCU_MS),
    payload=(
        Field("quaternion", "f", "IMU frame to level world, w x y z", values=4, order=(3, 0, 1, 2)),
        Field("gyro", "f", "angular rate, IMU frame, x y z [rad/s]", values=3),
        Field("accel", "f", "specific force, IMU frame, x y z [m/s²]", values=3),
        Field("depth", "f", "of the pressure port, positive down [m]"),
        Field("pressure", "f", "absolute [Pa]"),
        Field("flags", "I", "status bits"),
        Field(
            "motor_rpm", "f", "shaft speed per motor output [rpm]; an older firmware ends before it", values=0
        ),
    ),
    optional="motor_rpm",
)
TELEMETRY_2 = Layout(
    "telemetry with other actuators",
    Telemetry,
    magic=b"\xa5\x5a",
    header=(*_head(1, 2), _MCU_MS),
    payload=(
        *TELEMETRY.payload[:-1],
        TELEMETRY.payload[-1]._replace(meaning="shaft speed per motor output [rpm]"),
        Field("actuators", "f", "value per other actuator [rad, m³ or m]", values=OTHERS),
    ),
)
ECHO = Layout(
    "command echo",
    CommandEcho,
    magic=b"\xa5\x5a",
    header=(*_head(2), _MCU_MS),
    payload=(
        Field("command_count", "I", "commands received since the start"),
        Field("receive_ms", "I", "the controller's clock when the command came [ms]"),
        Field("command_crc", "H", "CRC of the command"),
        Field("enabled", "?", "as the command had it"),
        Field("accepted", "?", "whether the motors follow it"),
        Field("reject_flags", "I", "why not"),
        Field("received", "f", "as the command had them, per motor output", values=0),
        Field("applied", "f", "what the motors were given, per motor output", values=0),
        Field("debug_mask", "I", "as configured"),
        Field("decimation", "H", "as configured"),
    ),
)
DEBUG_CONFIG = Layout(
    "debug configuration",
    DebugConfig,
    magic=b"\xac\xca",
    header=_head(1),
    payload=(
        Field("mask", "I", "bit 0: echo commands"),
        Field("decimation", "H", "one echo for this many commands"),
        Field("reserved", "H", "not looked at", constant=0),
    ),
)
NAVIGATION = Layout(
    "navigation aid",
    NavigationAid,
    magic=b"\xa5\x5a",
    header=_head(3),
    payload=(
        Field("kind", "B", "1 velocity, 2 heading, 3 position, 4 pose"),
        Field("age", "f", "since it was measured [s]"),
        Field(
            "values",
            "f",
            "by kind: velocity [m/s]; heading [rad], 0, 0; x y z [m]; x y [m] yaw [rad]",
            values=3,
        ),
        Field(
            "std", "f", "of a velocity [m/s] or position [m] per axis, of yaw [rad]; 0: not known", values=2
        ),
    ),
)
LAYOUTS = (COMMAND, COMMAND_2, TELEMETRY, TELEMETRY_2, ECHO, NAVIGATION, DEBUG_CONFIG)
"""Every kind of frame: commands and the last one go to the motor controller, the others come from it."""


def encode_command(command: ThrusterCommand) -> bytes:
    """Return the frame of a command, 5 + 4 n bytes for n motor outputs: 37 for eight; with m setpoints 9 + 4 (n + m),
    version 2.

    Raises:
        LinkError: A value is not finite or beyond [-1, 1].
    """
    if any(abs(value) > 1.0 for value in command.normalised):
        raise LinkError(
            f"thruster command: normalised is {command.normalised}, expected numbers from -1 to 1: "
            "limit the force before it becomes a command"
        )
    layout = COMMAND_2 if command.setpoints else COMMAND
    return forms(layout, _outputs(command.normalised), len(command.setpoints))[0].encode(command)


def encode_telemetry(telemetry: Telemetry) -> bytes:
    """Return the frame of a telemetry message, 66 + 4 n bytes, or 66 if `motor_rpm` is None; with m other actuators it
    is of version 2, 66 + 4 (n + m).

    Raises:
        LinkError: See `TelemetryLayout.encode`.
    """
    if telemetry.motor_rpm is None:
        return forms(TELEMETRY, 0)[1].encode(telemetry)
    layout = TELEMETRY_2 if telemetry.actuators else TELEMETRY
    return forms(layout, _outputs(telemetry.motor_rpm), len(telemetry.actuators))[0].encode(telemetry)


def encode_echo(echo: CommandEcho) -> bytes:
    """Return the frame of an echo, 36 + 8 n bytes; raise LinkError as `TelemetryLayout.encode`."""
    return forms(ECHO, _outputs(echo.received))[0].encode(echo)


def encode_navigation(aid: NavigationAid) -> bytes:
    """Return the frame of a navigation aid, 35 bytes; raise LinkError as `TelemetryLayout.encode`."""
    return forms(NAVIGATION, 0)[0].encode(aid)


def encode_debug_config(sequence: int, mask: int, decimation: int) -> bytes:
    """Return the frame that requests echoes: `mask` DEBUG_ECHO or 0, one echo for `decimation` commands; 18 bytes."""
    return forms(DEBUG_CONFIG, 0)[0].encode(DebugConfig(sequence, mask, decimation))


def _outputs(values: Sequence[float]) -> int:
    if not values:
        raise LinkError("a frame for no motor output: give one value per output of the motor controller")
    return len(values)


# Frames from a stream of bytes, which may be split or surrounded by garbage; invalid frames are never returned.


HOST = (TELEMETRY, TELEMETRY_2, ECHO, NAVIGATION)
"""Frames that the robot's computer reads."""
MCU = (COMMAND, COMMAND_2, DEBUG_CONFIG)
"""Frames that the motor controller reads."""

_HEADER = 6
"""Bytes of magic, type, version and length."""


class Decoder:
    """Decoder of received bytes; it stores the beginning of a frame until its end arrives.

    A frame is accepted only with its magic, a known type, version and length, a correct CRC and finite numbers. If one
    of the first three is wrong, the search continues one byte further, so a valid frame is found behind any garbage, at
    the latest when the bytes that a false beginning announces (at most `longest`) have arrived.

    Note:
        `counts` has the numbers of `accepted` messages by class name; of `bad_crc`, `bad_length` and `unknown_type` of
        apparent beginnings; of `not_finite` frames; and of `skipped_bytes` outside of frames with a correct CRC.
    """

    def __init__(self, kinds: Iterable[Layout] = HOST, outputs: int = 8, others: int = 0) -> None:
        """
        Args:
            kinds: Layouts to decode, `HOST` or `MCU`.
            outputs: Number of motor outputs of the vehicle (`vehicle.mcu.outputs`).
            others: Number of actuators of the vehicle besides thrusters.
        """
        self.accepted: Counter[str] = Counter()
        self.refused: Counter[str] = Counter(bad_crc=0, bad_length=0, unknown_type=0, not_finite=0)
        self.skipped_bytes = 0
        self._rest = b""
        all_forms = [form for layout in kinds for form in forms(layout, outputs, others)]
        self.longest = max(form.size for form in all_forms)
        self._plain = {f.layout.magic[0]: f for f in all_forms if len(f.prefix) < _HEADER}
        self._headed = {f.prefix: f for f in all_forms if len(f.prefix) >= _HEADER}
        self._types = {prefix[:4] for prefix in self._headed}
        self._magic = _search(form.layout.magic for form in all_forms)

    @property
    def counts(self) -> dict[str, int | dict[str, int]]:
        """Numbers of accepted and refused frames so far."""
        return {"accepted": dict(self.accepted), **self.refused, "skipped_bytes": self.skipped_bytes}

    def feed(self, data: bytes) -> list[Message]:
        """Return the messages that `data` completes, in order; never raise an exception, for any bytes."""
        data, at = self._rest + data, 0
        messages: list[Message] = []
        while begin := self._magic.search(data, at):
            self.skipped_bytes += begin.start() - at
            at = begin.start()
            form = self._frame(data, at)
            if form is None:
                self._rest = data[at:]
                return messages
            if isinstance(form, str):
                self.refused[form] += 1
                self.skipped_bytes += 1
                at += 1
                continue
            message = form.decode(data, at)
            at += form.size
            if message is None:
                self.refused["not_finite"] += 1
            else:
                self.accepted[type(message).__name__] += 1
                messages.append(message)
        self.skipped_bytes += len(data) - at
        self._rest = b""
        return messages

    def _frame(self, data: bytes, at: int) -> TelemetryLayout | str | None:
        """Return the layout of the frame at a magic, the reason why there is none, or None if more bytes are
        needed."""
        form = self._plain.get(data[at])
        if form is None:
            prefix = data[at : at + _HEADER]
            form = self._headed.get(prefix)
            if len(prefix) >= 4 and prefix[:4] not in self._types:
                return "unknown_type"
            if form is None:
                return "bad_length" if len(prefix) == _HEADER else None
        end = at + form.crc_at
        if len(data) < at + form.size:
            return None
        if data[end + 2 : at + form.size] != form.layout.tail:
            return "bad_length"
        body = data[at + len(form.layout.magic) : end]
        return form if crc16_modbus(body) == data[end] | data[end + 1] << 8 else "bad_crc"


def _search(magics: Iterable[bytes]) -> re.Pattern[bytes]:
    """Return a pattern that finds possible beginnings of frames: a magic, or its first part at the end of the
    bytes."""
    parts = {
        re.escape(m) if len(m) == 1 else re.escape(m[:1]) + b"(?:" + re.escape(m[1:]) + rb"|\Z)"
        for m in magics
    }
    return re.compile(b"|".join(sorted(parts)))


class McuLink:
    """Link of `Runtime` to a motor controller: frames of thrusts out, telemetry in."""

    peer = "motor controller"
    watched: tuple[tuple[str, ...], ...] = (("gyro",), ("accel",))

    def __init__(self, outputs: int, others: int = 0) -> None:
        """
        Args:
            outputs: Number of motor outputs of the vehicle (`vehicle.mcu.outputs`).
            others: Number of actuators of the vehicle besides thrusters.
        """
        self._decoder = Decoder(outputs=outputs, others=others)
        self.let_in: tuple[float, float] | None = None
        self.calibrate_depth, self.highest = False, -math.inf
        self.notes: list[str] = []

    def feed(self, now: float, data: bytes) -> list[Message]:
        """Return the messages completed by bytes that arrived at a time [s]."""
        return self._decoder.feed(data)

    def prepare(self, now: float) -> str:
        """Return "": there is no device between the bridge and the motors. `now` is the time [s]."""
        return ""

    def alarm(self, now: float) -> str:
        """Return "": no other device can control the vehicle; the bridge checks its telemetry.

        `now` is the time [s].
        """
        return ""

    def pause(self, now: float) -> str:
        """Return "": a motor controller never requests a pause. `now` is the time [s]."""
        return ""

    def encode(self, now: float, command: ThrusterCommand, state: str) -> list[bytes]:
        """Return the frames to send at a time [s]: the bridge's command, in any state."""
        return [encode_command(command)]
