"""Every kind of frame equals one packed by hand, and values that do not fit a frame are refused."""

import dataclasses
import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from finssim.robot.links.frames import (
    DEBUG_ECHO,
    HOST,
    MCU,
    Decoder,
    LinkError,
    RejectFlag,
    StatusFlag,
    command_count,
    crc16_modbus,
    encode_command,
    encode_debug_config,
    encode_echo,
    encode_telemetry,
)
from finssim.robot.messages import CommandEcho, Telemetry, ThrusterCommand
from robot.links import wire

TELEMETRY = Telemetry(
    sequence=7,
    mcu_ms=123_456,
    quaternion=(0.0, 0.0, 0.6, 0.8),
    gyro=(0.25, -0.5, 1.0),
    accel=(0.0, 0.0, 9.75),
    depth=0.5,
    pressure=106_000.0,
    flags=0x8112_0000,
    motor_rpm=(0.0, 100.0, -200.0, 300.0, -400.0, 500.0, -600.0, 700.0),
)
ECHO = CommandEcho(8, 123_460, 18, 123_450, 0xBEEF, True, False, 4, (0.5,) * 8, (0.0,) * 8, 1, 10)
COMMAND = ThrusterCommand(True, (0.0, 0.125, -0.25, 0.5, -0.5, 0.75, -1.0, 1.0))


def test_the_crc_is_modbus():
    """The check value of the CRC catalogues is 0x4B37 for the digits 1 to 9."""
    assert crc16_modbus(b"123456789") == wire.crc_bitwise(b"123456789") == 0x4B37


@given(st.binary(max_size=300))
def test_the_crc_is_that_of_single_bits(data):
    """The table for pairs of bytes gives the bitwise result, also for odd lengths."""
    assert crc16_modbus(data) == wire.crc_bitwise(data) == wire.crc_bytewise(data)


def test_a_command_is_these_bytes():
    """0xAA, enable, eight floats, CRC, 0xBB: 37 bytes."""
    frame = encode_command(COMMAND)
    floats = "00000000 0000003e 000080be 0000003f 000000bf 0000403f 000080bf 0000803f"
    assert frame[:-3] == bytes.fromhex("aa 01" + floats)
    assert frame[-1:] == b"\xbb"
    assert len(frame) == 37
    assert frame == wire.command_bytes(COMMAND)


def test_telemetry_is_these_bytes():
    """A5 5A, type 1, version 1, 84 bytes of payload, wxyz on the wire for xyzw in the message: 98 bytes."""
    frame = encode_telemetry(TELEMETRY)
    assert frame[:12] == bytes.fromhex("a55a 01 01 5400 0700 40e20100")
    assert struct.unpack_from("<4f", frame, 12) == pytest.approx((0.8, 0.0, 0.0, 0.6))
    assert len(frame) == 98
    assert frame == wire.telemetry_bytes(TELEMETRY)


def test_telemetry_of_an_older_firmware_ends_before_the_speeds():
    """52 bytes of payload, 66 in all."""
    older = dataclasses.replace(TELEMETRY, motor_rpm=None)
    frame = encode_telemetry(older)
    assert frame[4:6] == b"\x34\x00"
    assert len(frame) == 66
    assert frame == wire.telemetry_bytes(older)


def test_an_echo_is_these_bytes():
    """A5 5A, type 2, 86 bytes of payload: 100 bytes."""
    frame = encode_echo(ECHO)
    assert frame[:12] == bytes.fromhex("a55a 02 01 5600 0800 44e20100")
    assert len(frame) == 100
    assert frame == wire.echo_bytes(ECHO)


def test_a_debug_configuration_is_these_bytes():
    """AC CA, type 1, version 1, 8 bytes of payload, two of them reserved: 16 bytes including the CRC."""
    frame = encode_debug_config(sequence=3, mask=DEBUG_ECHO, decimation=10)
    assert frame[:-2] == bytes.fromhex("acca 01 01 0800 0300 01000000 0a00 0000")
    assert frame[-2:] == struct.pack("<H", wire.crc_bitwise(frame[2:-2]))


@given(st.integers(1, 12).flatmap(lambda n: st.tuples(wire.commands(n), wire.telemetries(n), wire.echoes(n))))
def test_any_number_of_outputs_is_packed_as_by_hand(messages):
    """For vehicles with other motors the arrays grow and nothing else moves."""
    command, telemetry, echo = messages
    assert encode_command(command) == wire.command_bytes(command)
    assert encode_telemetry(telemetry) == wire.telemetry_bytes(telemetry)
    assert encode_echo(echo) == wire.echo_bytes(echo)


@pytest.mark.parametrize("wrong", [math.nan, math.inf, -math.inf, 1.0001, -3.0])
def test_a_command_that_is_no_share_of_full_speed_is_not_sent(wrong):
    """Values beyond ±1, not a number or infinite are refused before encoding."""
    with pytest.raises(LinkError, match="normalised"):
        encode_command(ThrusterCommand(True, (0.0, wrong)))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("sequence", 1 << 16),
        ("mcu_ms", -1),
        ("flags", 1 << 32),
        ("depth", 1e39),
        ("gyro", (0.0, math.nan, 0.0)),
    ],
)
def test_a_number_without_room_on_the_wire_is_refused(field, value):
    """Counters beyond their bits, depths beyond single precision and non-finite numbers are refused."""
    with pytest.raises(LinkError, match=r"telemetry: .*"):
        encode_telemetry(dataclasses.replace(TELEMETRY, **{field: value}))


def test_arrays_of_other_lengths_are_refused():
    """Refused are a quaternion of three numbers, an echo of eight outputs with seven applied, and an empty
    command."""
    with pytest.raises(LinkError, match="quaternion has 3 values, expected 4"):
        encode_telemetry(dataclasses.replace(TELEMETRY, quaternion=(0.0, 0.0, 1.0)))
    with pytest.raises(LinkError, match="applied has 7 values, expected 8"):
        encode_echo(dataclasses.replace(ECHO, applied=(0.0,) * 7))
    with pytest.raises(LinkError, match="no motor output"):
        encode_command(ThrusterCommand(False, ()))


def test_status_bits_are_where_the_firmware_has_them():
    """Bits 24 to 31 by name, the low byte of the command count in bits 16 to 23; reject flags 2, 4 and 8."""
    assert [flag.value.bit_length() - 1 for flag in StatusFlag] == list(range(24, 32))
    assert StatusFlag.COMMAND_RECEIVED == 1 << 24
    assert StatusFlag.DIAGNOSTICS & TELEMETRY.flags
    assert command_count(0x8112_0000) == 0x12
    assert [flag.value for flag in RejectFlag] == [2, 4, 8]


EXACT = dataclasses.replace(TELEMETRY, quaternion=(0.0, 0.0, 0.0, 1.0))


def test_with_other_actuators_frames_are_of_version_2():
    """Setpoints follow the thrusters of a command, values those of telemetry; the rest is as in version 1."""
    command = dataclasses.replace(COMMAND, setpoints=(0.25, -0.5, 2.0**-12))
    telemetry = dataclasses.replace(EXACT, actuators=(0.25, -0.5, 2.0**-12))
    assert encode_command(command) == wire.command_bytes(command) and len(wire.command_bytes(command)) == 53
    assert encode_telemetry(telemetry) == wire.telemetry_bytes(telemetry)
    assert len(encode_telemetry(telemetry)) == 98 + 12
    assert Decoder(MCU, 8, 3).feed(encode_command(command) + encode_command(COMMAND)) == [command, COMMAND]
    assert Decoder(HOST, 8, 3).feed(encode_telemetry(EXACT) + encode_telemetry(telemetry)) == [
        EXACT,
        telemetry,
    ]


def test_a_peer_of_version_1_finds_no_frame_in_version_2():
    """A peer of version 1 counts such frames as an unknown type, and reads known frames that follow."""
    for kinds, one, two in (
        (MCU, COMMAND, dataclasses.replace(COMMAND, setpoints=(0.1,))),
        (HOST, EXACT, dataclasses.replace(EXACT, actuators=(0.1,))),
    ):
        encode = encode_command if kinds is MCU else encode_telemetry
        decoder = Decoder(kinds)
        assert decoder.feed(encode(two) + encode(one)) == [one]
        assert decoder.refused["unknown_type"] == 1


def test_a_setpoint_that_is_no_number_is_not_sent():
    """As for thrusts, encoding is refused."""
    with pytest.raises(LinkError, match="setpoints is .*, expected finite numbers"):
        encode_command(dataclasses.replace(COMMAND, setpoints=(math.nan,)))
