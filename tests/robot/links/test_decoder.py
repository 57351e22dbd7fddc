"""Frames out of streams: in pieces, after garbage, cut, damaged; what is found is what was sent, and no more."""

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
"""As its numbers are in single precision."""
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
    """Bytes come as the line delivers them; messages come out whole, in order, once."""
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
    """The same at the other end, for six outputs."""
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
    """False beginnings in it announce at most `longest` bytes, and hide nothing of what follows them."""
    decoder = Decoder(kinds)
    assert decoder.feed(garbage + frame + bytes(decoder.longest)) == [message]
    assert decoder.skipped_bytes == len(garbage) + decoder.longest


@EACH
def test_a_frame_cut_anywhere_costs_only_itself(kinds, frame, message):
    """Its end lost in transit: the next one is found, whichever byte was the last."""
    for cut in range(len(frame)):
        decoder = Decoder(kinds)
        assert decoder.feed(frame[:cut]) == []
        assert decoder.feed(frame) == [message]
        assert decoder.skipped_bytes == cut


@EACH
def test_no_frame_with_a_wrong_bit_is_accepted(kinds, frame, message):
    """Each bit in turn: nothing comes out, and the frame after it does."""
    for bit in range(8 * len(frame)):
        damaged = bytearray(frame)
        damaged[bit // 8] ^= 1 << bit % 8
        decoder = Decoder(kinds)
        assert decoder.feed(bytes(damaged)) == []
        assert decoder.feed(frame + bytes(decoder.longest)) == [message]


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize(("side", "name"), [("host", "telemetry"), ("host", "echo"), ("mcu", "command")])
def test_a_number_that_is_not_finite_is_refused_wherever_it_stands(side, name, bad):
    """In any field with a right CRC: counted as such, and the frame after it is found."""
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
    """A type or a version of the future, another length, a CRC that does not fit."""
    decoder = Decoder(HOST)
    good = wire.telemetry_bytes(TELEMETRY)
    assert decoder.feed(change(good) + good) == [TELEMETRY32]
    expected = {"bad_crc": 0, "bad_length": 0, "unknown_type": 0, "not_finite": 0, count: 1}
    assert decoder.counts == {"accepted": {"Telemetry": 1}, **expected, "skipped_bytes": len(good)}


def test_frames_for_another_number_of_outputs_are_refused():
    """A vehicle with six motors is not heard as one with eight, nor told what eight should do."""
    for kinds, name in ((HOST, "telemetry"), (HOST, "echo"), (MCU, "command")):
        decoder = Decoder(kinds, outputs=6)
        assert decoder.feed(FRAMES[name][1] + bytes(200)) == []
        assert decoder.counts["bad_length"] >= 1


def test_each_side_hears_only_what_is_meant_for_it():
    """Commands are nothing to a host, telemetry nothing to a motor controller."""
    commands = FRAMES["command"][1] + FRAMES["debug configuration"][1]
    telemetry = FRAMES["telemetry"][1] + FRAMES["echo"][1]
    assert Decoder(HOST).feed(commands + bytes(100)) == []
    assert Decoder(MCU).feed(telemetry + bytes(100)) == []


def test_telemetry_without_speeds_says_so():
    """None, not zeros: the motors of an older firmware are not known to stand still."""
    older = dataclasses.replace(TELEMETRY32, motor_rpm=None)
    assert Decoder().feed(wire.telemetry_bytes(older)) == [older]


def test_any_byte_but_zero_enables():
    """As C has it: a firmware may send 255 for true."""
    frame = FRAMES["command"][1]
    assert Decoder(MCU).feed(wire.sealed(frame[:1] + b"\xff" + frame[2:])) == [COMMAND]


@given(st.lists(GARBAGE, max_size=30))
@settings(max_examples=50)
def test_what_is_kept_is_less_than_a_frame(pieces):
    """However much garbage comes: what is neither skipped nor a frame is at most one beginning."""
    decoder, fed = Decoder(HOST), 0
    for piece in pieces:
        decoder.feed(piece)
        fed += len(piece)
        assert 0 <= fed - decoder.skipped_bytes < decoder.longest
