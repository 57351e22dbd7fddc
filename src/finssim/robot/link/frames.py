"""The frames of the motor controller's protocol, as one table that the encoder, the decoder and the page share.

Published layout of the FinsROV hardware bridge, all little endian; the CRC is CRC16-MODBUS of everything between the
magic and itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntFlag
from typing import TypeAlias

from finssim.robot.link.layout import Field, Layout, LinkError, crc16_modbus, forms
from finssim.robot.messages import CommandEcho, NavigationAid, Telemetry, ThrusterCommand

__all__ = [
    "COMMAND",
    "DEBUG_CONFIG",
    "DEBUG_ECHO",
    "ECHO",
    "LAYOUTS",
    "NAVIGATION",
    "TELEMETRY",
    "DebugConfig",
    "LinkError",
    "Message",
    "RejectFlag",
    "StatusFlag",
    "command_count",
    "crc16_modbus",
    "encode_command",
    "encode_debug_config",
    "encode_echo",
    "encode_navigation",
    "encode_telemetry",
]


@dataclass(frozen=True)
class DebugConfig:
    """What the host asks the motor controller to send beside telemetry."""

    sequence: int
    """Counts up, modulo 2¹⁶."""
    mask: int
    """Bit 0 (`DEBUG_ECHO`): a `CommandEcho` for commands."""
    decimation: int
    """One echo for this many commands."""


Message: TypeAlias = Telemetry | CommandEcho | NavigationAid | ThrusterCommand | DebugConfig

DEBUG_ECHO = 1
"""Bit of `DebugConfig.mask`: echo commands."""


class StatusFlag(IntFlag):
    """Bits of `Telemetry.flags`; bits 16 to 23 are the low byte of the count of commands (`command_count`)."""

    COMMAND_RECEIVED = 1 << 24
    """A command has come since the controller started."""
    ECHO_ON = 1 << 25
    """Echoes have been asked for."""
    DIRECT_THRUSTERS = 1 << 26
    """The host's command drives the motors, enabled."""
    TARGET_RPM = 1 << 27
    """A target speed is not zero."""
    THROTTLE = 1 << 28
    """A throttle is not zero."""
    MOTOR_HANDLER = 1 << 29
    """The motor loop has run."""
    RPM_CONTROL = 1 << 30
    """Speeds are controlled, not throttles."""
    DIAGNOSTICS = 1 << 31
    """Bits 16 to 30 mean something."""


class RejectFlag(IntFlag):
    """Bits of `CommandEcho.reject_flags`: why a command does not turn the motors."""

    DISABLED = 2
    TIMEOUT = 4
    BAD_FRAME = 8


def command_count(flags: int) -> int:
    """Low byte of the count of commands that the controller has received, out of `Telemetry.flags`."""
    return (flags >> 16) & 0xFF


def _head(kind: int) -> tuple[Field, ...]:
    """What telemetry, echo and debug configuration begin with after their magic."""
    return (
        Field("type", "B", "kind of frame", constant=kind),
        Field("version", "B", "of the layout", constant=1),
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
        Field("enable", "?", "0: motors off, whatever follows"),
        Field("normalised", "f", "part of the full-scale shaft speed, -1 to 1, per motor output", values=0),
    ),
    tail=b"\xbb",
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
        Field("std", "f", "of a position per axis [m] and of its yaw [rad]; 0: not known", values=2),
    ),
)
LAYOUTS = (COMMAND, TELEMETRY, ECHO, NAVIGATION, DEBUG_CONFIG)
"""Every kind of frame: the first and the last go to the motor controller, the others come from it."""


def encode_command(command: ThrusterCommand) -> bytes:
    """Frame of a command, 5 + 4 n bytes for n motor outputs: 37 for eight.

    Raises:
        LinkError: A value is not finite or beyond [-1, 1].
    """
    if any(abs(value) > 1.0 for value in command.normalised):
        raise LinkError(
            f"thruster command: normalised is {command.normalised}, expected numbers from -1 to 1: "
            "limit the force before it becomes a command"
        )
    return forms(COMMAND, _outputs(command.normalised))[0].encode(command)


def encode_telemetry(telemetry: Telemetry) -> bytes:
    """Frame of a snapshot, 66 + 4 n bytes, or 66 where `motor_rpm` is None; raises LinkError as `Form.encode`."""
    if telemetry.motor_rpm is None:
        return forms(TELEMETRY, 0)[1].encode(telemetry)
    return forms(TELEMETRY, _outputs(telemetry.motor_rpm))[0].encode(telemetry)


def encode_echo(echo: CommandEcho) -> bytes:
    """Frame of an echo, 36 + 8 n bytes; raises LinkError as `Form.encode`."""
    return forms(ECHO, _outputs(echo.received))[0].encode(echo)


def encode_navigation(aid: NavigationAid) -> bytes:
    """Frame of a navigation aid, 35 bytes; raises LinkError as `Form.encode`."""
    return forms(NAVIGATION, 0)[0].encode(aid)


def encode_debug_config(sequence: int, mask: int, decimation: int) -> bytes:
    """Frame that asks for echoes: `mask` DEBUG_ECHO or 0, one echo for `decimation` commands; 18 bytes."""
    return forms(DEBUG_CONFIG, 0)[0].encode(DebugConfig(sequence, mask, decimation))


def _outputs(values: Sequence[float]) -> int:
    if not values:
        raise LinkError("a frame for no motor output: give one value per output of the motor controller")
    return len(values)
