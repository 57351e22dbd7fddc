"""Processor time of writing and reading a frame: `python benchmarks/link.py [--json FILE]`.

Telemetry of 98 bytes and commands of 37 bytes, complete, and telemetry in the fragments of a serial line; beside each
the ratio to unpacking the same bytes with `struct` alone, in the same run. Reported are the best of many rounds of
processor time, which other load disturbs least, and the fraction of one core for 100 telemetry frames and 60 commands
per second.
"""

from __future__ import annotations

import argparse
import json
import struct
import time
from collections.abc import Callable
from pathlib import Path

from finssim.robot.links.clock import ClockMap
from finssim.robot.links.frames import MCU, Decoder, crc16_modbus, encode_command, encode_telemetry
from finssim.robot.messages import Telemetry, ThrusterCommand

ROUNDS, EACH = 40, 1000
TELEMETRY = Telemetry(
    sequence=7,
    mcu_ms=123_456,
    quaternion=(0.0, 0.0, 0.6, 0.8),
    gyro=(0.25, -0.5, 1.0),
    accel=(0.1, 0.2, 9.75),
    depth=0.5,
    pressure=106_000.0,
    flags=0x8112_0000,
    motor_rpm=(0.0, 100.0, -200.0, 300.0, -400.0, 500.0, -600.0, 700.0),
)
COMMAND = ThrusterCommand(True, (0.0, 0.125, -0.25, 0.5, -0.5, 0.75, -1.0, 1.0))


def microseconds(call: Callable[[], object]) -> float:
    """Return the time of one call, the best of the rounds [µs]."""
    best = float("inf")
    for _ in range(ROUNDS):
        began = time.process_time()
        for _ in range(EACH):
            call()
        best = min(best, time.process_time() - began)
    return 1e6 * best / EACH


def measure() -> dict[str, float]:
    """Measure microseconds by operation, ratios to `struct` alone, and the fraction of a core [%]."""
    telemetry, command = encode_telemetry(TELEMETRY), encode_command(COMMAND)
    alone = struct.Struct("<2sBBHHI12fI8fH")
    host, line, mcu, clock = Decoder(), Decoder(), Decoder(MCU), ClockMap()
    ms = iter(range(10**9))

    def in_pieces() -> None:
        for at in range(0, len(telemetry), 32):
            line.feed(telemetry[at : at + 32])

    def stamp() -> None:
        now = next(ms)
        clock.stamp(10 * now % 2**32, 0.01 * now)

    took = {
        "struct_alone": microseconds(lambda: alone.unpack(telemetry)),
        "crc": microseconds(lambda: crc16_modbus(telemetry[2:-2])),
        "decode_telemetry": microseconds(lambda: host.feed(telemetry)),
        "decode_telemetry_in_pieces": microseconds(in_pieces),
        "encode_telemetry": microseconds(lambda: encode_telemetry(TELEMETRY)),
        "decode_command": microseconds(lambda: mcu.feed(command)),
        "encode_command": microseconds(lambda: encode_command(COMMAND)),
        "stamp": microseconds(stamp),
    }
    ratios = {f"{name}_ratio": value / took["struct_alone"] for name, value in took.items() if "code" in name}
    share = 1e-4 * (100.0 * (took["decode_telemetry"] + took["stamp"]) + 60.0 * took["encode_command"])
    return {**took, **ratios, "core_percent": share}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    target = parser.parse_args().json
    figures = measure()
    for name, value in figures.items():
        print(f"{name:>30} {value:8.2f}")
    if target:
        target.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
