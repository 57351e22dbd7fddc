"""A short fuzzing run; `fuzz_link.py` does longer ones."""

import pytest

from finssim.robot.links import frames
from finssim.robot.links.frames import crc16_modbus
from robot.links.fuzz_link import Fuzzer


def test_no_mutated_frame_upsets_a_decoder():
    """Of ten thousand mutated frames exactly the valid ones come out, and nothing is raised."""
    fuzzer = Fuzzer(seed=1)
    while fuzzer.frames < 10_000:
        fuzzer.step()
    assert fuzzer.accepted > 1000


def test_the_fuzzer_would_notice_an_accepted_wrong_crc(monkeypatch):
    """A decoder that accepts every CRC is caught within a few frames."""
    monkeypatch.setattr(frames, "crc16_modbus", AlwaysRight)
    fuzzer = Fuzzer(seed=1)
    with pytest.raises(AssertionError, match="found"):
        while fuzzer.frames < 100:
            fuzzer.step()


class AlwaysRight(int):
    """A CRC that equals any other."""

    def __new__(cls, data):
        return super().__new__(cls, crc16_modbus(data))

    def __eq__(self, other):
        return True

    __hash__ = int.__hash__
