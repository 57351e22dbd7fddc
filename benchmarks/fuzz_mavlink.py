"""Fuzz both ends of the robot's link with corrupted MAVLink frames and Doppler log lines.

    python benchmarks/fuzz_mavlink.py [--frames 1000000] [--lines 100000] [--seed 1]

Half of the frames are corrupted on the line (bits flipped, bytes lost or inserted, the checksum unchanged), half have
other payloads and the right checksum. The emulated autopilot receives frames of ground stations, among them corrupted
arming commands; the robot's link receives frames of an autopilot and lines of a log, while arming is not requested.

Exceptions and armings are counted, and the exit status is 0 only if there are none; armings of the link are commands
that it sends to arm, to change the mode, or axes.
"""

from __future__ import annotations

import argparse
import random
import re
import sys
import time
from collections import Counter
from types import SimpleNamespace

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from finssim.pool import draw_plant
from finssim.pool.ardusub import ArduSub
from finssim.pool.firmware import FirmwareSample
from finssim.pool.virtual_pool import Faults
from finssim.robot.links.mavlink import MavlinkLink
from finssim.robot.links.water_linked import encode_velocity
from finssim.robot.messages import ThrusterCommand
from finssim.vehicles import load_vehicle
from finssim.vehicles.defaults import vehicle_at

HEAVY = load_vehicle("bluerov2_heavy")
SPEC = draw_plant(HEAVY, 1, "nominal")
REST = FirmwareSample((0.0, 0.0, 0.0), (0.0, 0.0, 9.81), 0.6, 107000.0)
ZEROS = (0.0,) * 5
ARMING = (
    mavlink.MAVLink_command_long_message(1, 1, 400, 0, 1.0, 0.0, *ZEROS),
    mavlink.MAVLink_command_long_message(1, 1, 400, 0, 1.0, 21196.0, *ZEROS),
    mavlink.MAVLink_command_int_message(1, 1, 0, 400, 0, 0, 1.0, 21196.0, 0.0, 0.0, 0, 0, 0.0),
    mavlink.MAVLink_manual_control_message(1, 0, 0, 500, 0, 1 << 6),
)
"""Unmodified frames that arm a vehicle."""
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
TELEMETRY = (
    *[mavlink.MAVLink_heartbeat_message(12, 3, base, mode, state, 3)
      for base, mode, state in ((81, 19, 3), (209, 19, 4), (209, 2, 5))],
    mavlink.MAVLink_attitude_message(10, 0.1, 0.2, -0.3, 0.01, 0.02, 0.03),
    mavlink.MAVLink_raw_imu_message(10, 1, 2, -1000, 3, 4, 5, 6, 7, 8),
    mavlink.MAVLink_scaled_pressure2_message(10, 1070.0, 0.1, 2000),
    mavlink.MAVLink_rc_channels_message(10, 18, *[1500] * 18, 255),
    mavlink.MAVLink_local_position_ned_message(10, 1.0, 2.0, 3.0, 0.4, 0.1, 0.2),
    mavlink.MAVLink_ekf_status_report_message(831, 0.1, 0.1, 0.1, 0.1, 0.1),
    *[mavlink.MAVLink_param_value_message(name, value, 9, 100, 1)
      for name, value in ((b"JS_GAIN_DEFAULT", 0.5), (b"JS_THR_GAIN", 1.0), (b"BARO2_GND_PRESS", 101325.0))],
    mavlink.MAVLink_named_value_float_message(10, b"PilotGain", 0.5),
    mavlink.MAVLink_autopilot_version_message(8202, 0x040500FF, 0, 0, 0, [1] * 8, [1] * 8, [1] * 8, 1, 1, 1),
    *[mavlink.MAVLink_command_ack_message(command, result) for command in (400, 176, 511) for result in (0, 4)],
    mavlink.MAVLink_statustext_message(4, b"words of an autopilot"),
    mavlink.MAVLink_servo_output_raw_message(10, 0, *[1600] * 16),
    mavlink.MAVLink_sys_status_message(1, 1, 1, 100, 15000, 100, 90, 0, 0, 0, 0, 0, 0),
)  # fmt: skip
"""Frames that an autopilot sends."""
AUTOPILOT = mavlink.MAVLink(None, 1, 1)


def damaged(message, rng, sender=GROUND):
    """Return a frame that was corrupted on the line: bits flipped, bytes lost or inserted, the checksum
    unchanged."""
    frame = bytearray(message.pack(sender))
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


def forged(message, rng, sender=GROUND):
    """Return a frame with other content and the right checksum that does not request arming."""
    frame = bytearray(message.pack(sender))
    kind, start, end = type(message), 10, len(frame) - 2
    if rng.random() < 0.2:
        frame[start:end] = rng.randbytes(end - start)
    for _ in range(rng.randint(1, 8)):
        frame[rng.randrange(start, end)] = rng.choice((0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256)))
    if kind is mavlink.MAVLink_manual_control_message:
        frame[18:20] = b"\0\0"  # buttons
    if kind in (mavlink.MAVLink_command_long_message, mavlink.MAVLink_command_int_message):
        frame[38:40] = frame[38:40] if frame[38:40] != (400).to_bytes(2, "little") else b"\0\0"
    crc = mavlink.x25crc(frame[1:-2])
    crc.accumulate(bytes([kind.crc_extra]))
    return bytes(frame[:-2]) + crc.crc.to_bytes(2, "little")


def fuzz_firmware(count, seed=1):
    """Return the numbers of frames by kind, of exceptions and of armings."""
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
        counts[make.__name__] += 1
        if firmware.armed:
            counts["armed"] += 1
            print("armed by", make.__name__, message)
            firmware.armed = False
    return counts


REPORT = encode_velocity([0.4, -0.2, 0.1], altitude=1.5, measured=1.0, sent=1.2, interval=0.1)
NUMBERS = (b"NaN", b"-1e999", b"1e308", b"null", b"[[]]", b'"1"', b"true", b"-0", b"9" * 400, b'{"vx": 1}')


def damaged_line(rng):
    """Return a line of a log with changed bytes or invalid numbers."""
    line = bytearray(REPORT)
    if rng.random() < 0.5:
        line = bytearray(
            re.sub(rb"-?\d[\d.e+-]*", lambda m: rng.choice(NUMBERS) if rng.random() < 0.1 else m[0], REPORT)
        )
    else:
        for _ in range(rng.randint(1, 5)):
            line[rng.randrange(1, len(line))] = rng.randrange(256)
        if rng.random() < 0.2:
            del line[rng.randrange(1, len(line)) :]
    return bytes(line)


def fuzz_link(frames, lines, seed=1):
    """Return the numbers of frames and lines by kind, of exceptions, and of commands and axes that were sent
    without request."""
    rng, counts, now = random.Random(seed), Counter(exceptions=0, armed=0), 0.0
    link, outside = MavlinkLink(vehicle_at("tank", HEAVY, navigation=True)), mavlink.MAVLink(None)
    link.feed(0.0, TELEMETRY[0].pack(AUTOPILOT))
    off, left = ThrusterCommand(False, (0.0,) * len(HEAVY.thrusters)), lines
    for i in range(frames + lines):
        now += 0.002
        if left and rng.random() < left / (frames + lines - i):
            made, data, left = "lines", damaged_line(rng), left - 1
        else:
            make = damaged if rng.random() < 0.5 else forged
            made, data = make.__name__, make(rng.choice(TELEMETRY), rng, AUTOPILOT)
        counts[made] += 1
        try:
            counts["messages"] += len(link.feed(now, data))
            sent = link.encode(now, off, "fault" if i % 1000 < 100 else "disarmed")
        except Exception as problem:
            counts["exceptions"] += 1
            print(made, data, repr(problem))
            continue
        for message in (m for frame in sent for m in outside.parse_buffer(frame) or ()):
            kind, command = message.get_type(), getattr(message, "command", 0)
            counts["armed"] += kind in ("MANUAL_CONTROL", "RC_CHANNELS_OVERRIDE") or command in (176, 400)
    counts["understood"] = link.counts.total() - link.counts["bad"]
    return counts


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=1_000_000)
    parser.add_argument("--lines", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=1)
    words = parser.parse_args()
    bad = 0
    for name, play in (
        ("robot's link", lambda: fuzz_link(words.frames, words.lines, words.seed)),
        ("emulated autopilot", lambda: fuzz_firmware(words.frames, words.seed)),
    ):
        began = time.process_time()
        counts = play()
        print(f"{name}: {dict(counts)}; {time.process_time() - began:.0f} s of processor time", flush=True)
        bad += counts["exceptions"] + counts["armed"]
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
