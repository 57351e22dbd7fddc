"""Time that the recorder takes in the control loop: `python benchmarks/recorder.py [--json FILE]`.

Processor time of the calling thread for each message, the best of several rounds, while the writing thread stores them
on disk; beside it the time of an Imu through the writer of the `mcap` package in the same thread, and their ratio,
which depends little on the machine.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from io import BytesIO
from pathlib import Path

import numpy as np

from finssim.robot.messages import Picture, Telemetry
from finssim.robot.reading import Reading
from finssim.robot.record_messages import TOPICS, Messages, definition
from finssim.robot.recorder import Recorder
from finssim.vehicles import load_vehicle

ROUNDS, CALLS = 10, 300
TELEMETRY = Telemetry(
    1, 2, (0.0, 0.0, 0.0, 1.0), (0.1, 0.2, 0.3), (0.0, 0.0, 9.81), 0.5, 1e5, 0, (100.0,) * 8
)
READING = Reading(0.0, np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(6), True, std=np.full(7, 0.01))


def microseconds(call: Callable[[int], None], messages: int = 1) -> float:
    """Return the processor time of this thread per message [µs], the best round."""
    best = float("inf")
    for turn in range(ROUNDS):
        start = time.thread_time()
        for i in range(CALLS):
            call(turn * CALLS + i)
        best = min(best, time.thread_time() - start)
        time.sleep(0.2)  # let the writing thread catch up
    return 1e6 * best / (CALLS * messages)


def measure(folder: Path) -> dict[str, float]:
    """Measure microseconds per message, by kind."""
    vehicle = load_vehicle("finsrov")
    make, picture = Messages(vehicle), np.zeros((480, 640), np.uint8)
    imu, odometry = TOPICS["imu"].type, TOPICS["odometry"].type
    figures = {
        "imu_encode_us": microseconds(lambda i: make.cdr(make.imu(i, TELEMETRY), imu)),
        "odometry_encode_us": microseconds(lambda i: make.cdr(make.odometry(i, READING), odometry)),
        "mcap_writer_imu_us": _library(make, imu),
    }
    with Recorder(folder / "run.mcap", vehicle) as recorder:
        figures["telemetry_us"] = microseconds(lambda i: recorder.telemetry(0.01 * i, TELEMETRY), 4)
        figures["reading_us"] = microseconds(lambda i: recorder.reading(0.01 * i, READING), 3)
        figures["command_us"] = microseconds(lambda i: recorder.command(0.01 * i, np.zeros(8), "pid"))
        figures["picture_us"] = microseconds(lambda i: recorder.picture(0.01 * i, Picture(0.0, i, picture)))
    figures["telemetry_to_library"] = figures["telemetry_us"] / figures["mcap_writer_imu_us"]
    return {name: round(value, 2) for name, value in figures.items()}


def _library(make: Messages, kind: str) -> float:
    """Measure the same Imu through the writer of the `mcap` package [µs]."""
    from mcap.writer import CompressionType, Writer

    writer = Writer(BytesIO(), compression=CompressionType.LZ4)
    writer.start("ros2")
    schema = writer.register_schema(kind, "ros2msg", definition(kind).encode())
    channel = writer.register_channel("/imu", "cdr", schema)
    return microseconds(lambda i: writer.add_message(channel, i, make.cdr(make.imu(i, TELEMETRY), kind), i))


def main() -> None:
    """Print the figures; with --json write them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path)
    out = parser.parse_args().json
    with tempfile.TemporaryDirectory() as folder:
        figures = measure(Path(folder))
    for name, value in figures.items():
        print(f"{name:24}{value:9.2f}")
    if out is not None:
        out.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
