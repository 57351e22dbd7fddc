"""Frames that nobody meant to send: the autopilot neither raises nor arms. As a script: 10^6 of them, counted."""

import random
from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from finssim.pool import draw_plant
from finssim.pool.ardusub import ArduSub
from finssim.pool.firmware import Sample
from finssim.pool.virtual_pool import Faults
from finssim.vehicles import load_vehicle

HEAVY = load_vehicle("bluerov2_heavy")
SPEC = draw_plant(HEAVY, 1, "nominal")
REST = Sample((0.0, 0.0, 0.0), (0.0, 0.0, 9.81), 0.6, 107000.0)
ZEROS = (0.0,) * 5
ARMING = (
    mavlink.MAVLink_command_long_message(1, 1, 400, 0, 1.0, 0.0, *ZEROS),
    mavlink.MAVLink_command_long_message(1, 1, 400, 0, 1.0, 21196.0, *ZEROS),
    mavlink.MAVLink_command_int_message(1, 1, 0, 400, 0, 0, 1.0, 21196.0, 0.0, 0.0, 0, 0, 0.0),
    mavlink.MAVLink_manual_control_message(1, 0, 0, 500, 0, 1 << 6),
)
"""Frames that arm a vehicle as they are."""
HARMLESS = (
    mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3),
    mavlink.MAVLink_manual_control_message(1, 1000, -1000, 500, 300, 0, s=100, t=-100),
    mavlink.MAVLink_rc_channels_override_message(1, 1, *[1600] * 8, *[1700] * 10),
    *[
        mavlink.MAVLink_command_long_message(1, 1, c, 0, a, b, *ZEROS)
        for c, a, b in ((176, 1.0, 2.0), (511, 30.0, 1e5), (510, 30.0, 0.0), (512, 148.0, 0.0), (241, 1.0, 0.0),
                        (183, 9.0, 1500.0), (209, 1.0, 0.0), (246, 1.0, 0.0), (520, 1.0, 0.0), (31000, 1.0, 1.0))
    ],
    mavlink.MAVLink_command_int_message(1, 1, 0, 176, 0, 0, 1.0, 19.0, 0.0, 0.0, 5, 6, 7.0),
    mavlink.MAVLink_set_mode_message(1, 1, 19),
    mavlink.MAVLink_param_request_list_message(1, 1),
    mavlink.MAVLink_param_request_read_message(1, 1, b"JS_GAIN_DEFAULT", -1),
    *[
        mavlink.MAVLink_param_set_message(1, 1, name, value, 9)
        for name, value in ((b"JS_GAIN_DEFAULT", 0.5), (b"BARO_SPEC_GRAV", 1.0), (b"ANGLE_MAX", 4500.0),
                            (b"SR0_EXTRA1", 50.0), (b"JS_THR_GAIN", 1.0), (b"SURFACE_DEPTH", -10.0),
                            (b"ATC_RAT_RLL_P", 0.135), (b"BARO1_GND_PRESS", 101325.0))
    ],
    mavlink.MAVLink_request_data_stream_message(1, 1, 0, 10, 1),
    mavlink.MAVLink_mission_request_list_message(1, 1, 0),
    mavlink.MAVLink_mission_clear_all_message(1, 1, 0),
    mavlink.MAVLink_mission_count_message(1, 1, 3, 0),
    mavlink.MAVLink_log_request_list_message(1, 1, 0, 9),
    mavlink.MAVLink_timesync_message(0, 77),
    mavlink.MAVLink_ping_message(1, 2, 0, 0),
    mavlink.MAVLink_set_gps_global_origin_message(1, 338103130, -1183938670, 0),
    mavlink.MAVLink_vision_position_delta_message(0, 100000, [0.0] * 3, [0.1, 0.0, 0.0], 90.0),
)  # fmt: skip
GROUND = mavlink.MAVLink(None, 255, 190)


def damaged(message, rng):
    """A frame that the line has spoiled: bits turned over, bytes lost or put in, the checksum as it was."""
    frame = bytearray(message.pack(GROUND))
    how = rng.random()
    if how < 0.7:
        for bit in rng.sample(range(8 * len(frame)), rng.randint(1, 12)):
            frame[bit // 8] ^= 1 << (bit % 8)
    elif how < 0.85:
        first = rng.randrange(len(frame))
        del frame[first : first + rng.randint(1, 8)]
    else:
        at = rng.randint(1, len(frame) - 1)
        frame[at:at] = rng.randbytes(rng.randint(1, 8))
    return bytes(frame)


def forged(message, rng):
    """A frame with other content and the right checksum, that does not mean to arm."""
    frame = bytearray(message.pack(GROUND))
    kind, start, end = type(message), 10, len(frame) - 2
    for _ in range(rng.randint(1, 8)):
        frame[rng.randrange(start, end)] = rng.choice((0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256)))
    if kind is mavlink.MAVLink_manual_control_message:
        frame[18:20] = b"\0\0"  # buttons
    if kind in (mavlink.MAVLink_command_long_message, mavlink.MAVLink_command_int_message):
        frame[38:40] = frame[38:40] if frame[38:40] != (400).to_bytes(2, "little") else b"\0\0"
    crc = mavlink.x25crc(frame[1:-2])
    crc.accumulate(bytes([kind.crc_extra]))
    return bytes(frame[:-2]) + crc.crc.to_bytes(2, "little")


def fuzz(count, seed=1):
    """Frames sent, by how they were made, exceptions and armings."""
    rng, counts, now = random.Random(seed), Counter(exceptions=0, armed=0), 0.0
    firmware_spec = SPEC.firmware.model_copy(update={"reboot_time": 0.0})
    firmware = ArduSub(HEAVY, SPEC.model_copy(update={"firmware": firmware_spec}))
    battery = SimpleNamespace(electric=np.array([16.0, 1.0]))
    for i in range(count):
        make = damaged if rng.random() < 0.5 else forged
        message = rng.choice(HARMLESS + ARMING if make is damaged else HARMLESS)
        now += 0.002
        try:
            counts["answers"] += len(firmware.receive(now, make(message, rng)))
            firmware.watch(now)
            if i % 10 == 0:
                firmware.frames(now, REST, (), battery, Faults())
        except Exception as problem:
            counts["exceptions"] += 1
            print(make.__name__, message, repr(problem))
            raise
        counts[make.__name__] += 1
        if firmware.armed:
            counts["armed"] += 1
            print("armed by", make.__name__, message)
            firmware.armed = False
    return counts


@pytest.mark.slow
def test_spoiled_and_forged_frames_neither_raise_nor_arm():
    """20 000 of them, about half with a right checksum; the vehicle behind would take a good arming command."""
    counts = fuzz(20_000)
    assert counts["exceptions"] == counts["armed"] == 0 and min(counts["damaged"], counts["forged"]) > 9000


def test_the_frames_of_the_corpus_arm_as_they_are():
    """So the test above would see it."""
    for message in ARMING:
        firmware = ArduSub(HEAVY, SPEC)
        for i in range(110):
            firmware.frames(0.01 * i, REST, (), SimpleNamespace(electric=np.array([16.0, 1.0])), Faults())
        firmware.receive(1.2, message.pack(GROUND))
        assert firmware.armed


if __name__ == "__main__":
    print(dict(fuzz(1_000_000)))
