"""Corrupted and forged frames and lines raise and arm at neither end of the wire. A sample of the benchmark."""

import importlib.util
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

PATH = Path(__file__).resolve().parents[2] / "benchmarks" / "fuzz_mavlink.py"
SPEC = importlib.util.spec_from_file_location("fuzz_mavlink", PATH)
fuzz = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(fuzz)


@pytest.mark.slow
@pytest.mark.parametrize(
    "play",
    [lambda: fuzz.fuzz_firmware(20_000), lambda: fuzz.fuzz_link(10_000, 1_000)],
    ids=["autopilot", "robot"],
)
def test_spoiled_and_forged_frames_neither_raise_nor_arm(play):
    """About half have a valid checksum; a valid arming command would arm the vehicle."""
    counts = play()
    assert counts["exceptions"] == counts["armed"] == 0 and min(counts["damaged"], counts["forged"]) > 4000


def test_the_frames_of_the_corpus_arm_as_they_are():
    """The test above is thus able to detect arming."""
    battery = SimpleNamespace(electric=np.array([16.0, 1.0]))
    for message in fuzz.ARMING:
        firmware = fuzz.ArduSub(fuzz.HEAVY, fuzz.SPEC)
        for i in range(110):
            firmware.frames(0.01 * i, fuzz.REST, (), battery, fuzz.Faults())
        firmware.receive(1.2, message.pack(fuzz.GROUND))
        assert firmware.armed
