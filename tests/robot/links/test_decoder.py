"""Frames are found exactly as sent in streams that are split, preceded by garbage, cut or damaged."""

import dataclasses
import math
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from finssim.robot.links.frames import HOST, MCU, DebugConfig, Decoder
from robot.links import wire
from robot.links.test_frames import COMMAND, ECHO, TELEMETRY

TELEMETRY32 = wire.frame_at(wire.telemetry_bytes(TELEMETRY), 0, "host")[1]
"""Telemetry with its numbers in single precision."""
CONFIG = DebugConfig(3, 1, 10)
FRAMES = {
    "telemetry": (HOST, wire.telemetry_bytes(TELEMETRY), TELEMETRY32),
    "echo": (HOST, wire.echo_bytes(ECHO), ECHO),
    "command": (MCU, wire.command_bytes(COMMAND), COMMAND),
    "debug configuration": (MCU, wire.debug_config_bytes(CONFIG), CONFIG),
}
EACH = pytest.mark.parametrize(("kinds", "frame", "message"), FRAMES.values(), ids=FRAMES)
BEGINNINGS = (
    st.sampled_from(
        [b"\xa5", b"\xa5\x5a", b"\xa5\x5a\x01\x01\x54\x00", b"\xa5\x5a\x02\x01\x56\x00", b"\xa5\x5a\x03"]
    )
    | st.sampled_from(
        [b"\xaa", b"\xac", b"\xac\xca", b"\xac\xca\x01\x01\x08\x00", b"\xbb", b"\xac\xca\x01\x02"]
    )
    | st.binary(max_size=60)
)
GARBAGE = st.lists(BEGINNINGS, max_size=8).map(b"".join)


@given(st.lists(wire.telemetries() | wire.echoes(), max_size=5), st.lists(st.integers(1, 120), max_size=20))
def test_a_host_hears_what_was_sent_in_any_pieces(messages, cuts):
    """For any splitting of the bytes, messages come out whole, in order and once."""
    pack = {True: wire.echo_bytes, False: wire.telemetry_bytes}
    stream = b"".join(pack[hasattr(m, "applied")](m) for m in messages)
    decoder, found = Decoder(HOST), []
    for cut in (*cuts, len(stream)):
        found += decoder.feed(stream[:cut])
        stream = stream[cut:]
    assert found == messages
    assert decoder.skipped_bytes == 0


@given(
    st.lists(wire.commands(6) | wire.debug_configs(), max_size=5), st.lists(st.integers(1, 40), max_size=20)
)
def test_a_motor_controller_hears_what_was_sent_in_any_pieces(messages, cuts):
    """The same holds at the other end, for six outputs."""
    stream = b"".join(
        wire.command_bytes(m) if hasattr(m, "enable") else wire.debug_config_bytes(m) for m in messages
    )
    decoder, found = Decoder(MCU, outputs=6), []
    for cut in (*cuts, len(stream)):
        found += decoder.feed(stream[:cut])
        stream = stream[cut:]
    assert found == messages


@EACH
@given(garbage=GARBAGE)
def test_a_true_frame_behind_any_garbage_is_found(kinds, frame, message, garbage):
    """False beginnings in garbage announce at most `longest` bytes, and hide nothing that follows them."""
    decoder = Decoder(kinds)
    assert decoder.feed(garbage + frame + bytes(decoder.longest)) == [message]
    assert decoder.skipped_bytes == len(garbage) + decoder.longest


@EACH
def test_a_frame_cut_anywhere_costs_only_itself(kinds, frame, message):
    """If the end of a frame is lost, the next one is found, wherever the cut was."""
    for cut in range(len(frame)):
        decoder = Decoder(kinds)
        assert decoder.feed(frame[:cut]) == []
        assert decoder.feed(frame) == [message]
        assert decoder.skipped_bytes == cut


@EACH
def test_no_frame_with_a_wrong_bit_is_accepted(kinds, frame, message):
    """With each bit flipped in turn, the frame is dropped and the next one is found."""
    for bit in range(8 * len(frame)):
        damaged = bytearray(frame)
        damaged[bit // 8] ^= 1 << bit % 8
        decoder = Decoder(kinds)
        assert decoder.feed(bytes(damaged)) == []
        assert decoder.feed(frame + bytes(decoder.longest)) == [message]


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize(("side", "name"), [("host", "telemetry"), ("host", "echo"), ("mcu", "command")])
def test_a_number_that_is_not_finite_is_refused_wherever_it_stands(side, name, bad):
    """A non-finite number in any field with a valid CRC is counted as such, and the next frame is found."""
    kinds, frame, message = FRAMES[name]
    first, last = {"telemetry": (12, 60), "echo": (28, 92), "command": (2, 34)}[name]
    places = [*range(first, last, 4), *(range(64, 96, 4) if name == "telemetry" else ())]
    decoder = Decoder(kinds)
    for at in places:
        wrong = wire.sealed(frame[:at] + struct.pack("<f", bad) + frame[at + 4 :])
        assert decoder.feed(wrong + frame) == [message]
    assert decoder.counts["not_finite"] == len(places)
    assert decoder.skipped_bytes == 0


@pytest.mark.parametrize(
    ("change", "count"),
    [
        (lambda f: wire.sealed(f[:2] + b"\x07" + f[3:]), "unknown_type"),
        (lambda f: wire.sealed(f[:3] + b"\x02" + f[4:]), "unknown_type"),
        (lambda f: wire.sealed(f[:4] + b"\x50\x00" + f[6:]), "bad_length"),
        (lambda f: f[:-1] + bytes([f[-1] ^ 1]), "bad_crc"),
    ],
)
def test_what_was_wrong_is_counted(change, count):
    """An unknown type or version, a wrong length and a wrong CRC each have their counter."""
    decoder = Decoder(HOST)
    good = wire.telemetry_bytes(TELEMETRY)
    assert decoder.feed(change(good) + good) == [TELEMETRY32]
    expected = {"bad_crc": 0, "bad_length": 0, "unknown_type": 0, "not_finite": 0, count: 1}
    assert decoder.counts == {"accepted": {"Telemetry": 1}, **expected, "skipped_bytes": len(good)}


def test_frames_for_another_number_of_outputs_are_refused():
    """Frames of a vehicle with six motors are not accepted as those of one with eight, in either direction."""
    for kinds, name in ((HOST, "telemetry"), (HOST, "echo"), (MCU, "command")):
        decoder = Decoder(kinds, outputs=6)
        assert decoder.feed(FRAMES[name][1] + bytes(200)) == []
        assert decoder.counts["bad_length"] >= 1


def test_each_side_hears_only_what_is_meant_for_it():
    """A host ignores commands, a motor controller ignores telemetry."""
    commands = FRAMES["command"][1] + FRAMES["debug configuration"][1]
    telemetry = FRAMES["telemetry"][1] + FRAMES["echo"][1]
    assert Decoder(HOST).feed(commands + bytes(100)) == []
    assert Decoder(MCU).feed(telemetry + bytes(100)) == []


def test_telemetry_without_speeds_says_so():
    """Missing speeds are None, not zeros: the motors of an older firmware may be turning."""
    older = dataclasses.replace(TELEMETRY32, motor_rpm=None)
    assert Decoder().feed(wire.telemetry_bytes(older)) == [older]


def test_any_byte_but_zero_enables():
    """As in C, any non-zero byte is true: a firmware may send 255."""
    frame = FRAMES["command"][1]
    assert Decoder(MCU).feed(wire.sealed(frame[:1] + b"\xff" + frame[2:])) == [COMMAND]


@given(st.lists(GARBAGE, max_size=30))
@settings(max_examples=50)
def test_what_is_kept_is_less_than_a_frame(pieces):
    """For any amount of garbage the buffer contains at most one beginning of a frame."""
    decoder, fed = Decoder(HOST), 0
    for piece in pieces:
        decoder.feed(piece)
        fed += len(piece)
        assert 0 <= fed - decoder.skipped_bytes < decoder.longest
