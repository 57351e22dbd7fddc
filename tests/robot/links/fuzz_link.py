"""Fuzz the decoders of both ends: `PYTHONPATH=tests python -m robot.links.fuzz_link [--frames 1000000] [--seed 0]`.

A stream of mutated frames, cut in pieces, passes through a decoder. The result must equal an independent search that
tries every byte as the beginning of a frame with its own CRC (`wire.frames_in`), so no frame with a wrong CRC is
accepted and no valid one is lost. `fuzz_link_guided.py` chooses mutations by coverage.
"""

from __future__ import annotations

import argparse
import random
import struct
import time

from finssim.robot.links.frames import HOST, MCU, DebugConfig, Decoder
from robot.links import wire
from robot.links.test_frames import COMMAND, ECHO, TELEMETRY

SIDES = ("host", "mcu")
ZEROS = bytes(128)
"""Zeros longer than a frame, and not the beginning of one: they flush what a decoder keeps back."""


class Fuzzer:
    """Mutator of frames and judge of decoders."""

    def __init__(self, seed: int = 0) -> None:
        self.random = random.Random(seed)
        self.frames = self.accepted = 0
        self.seeds = {"host": _host_frames(), "mcu": _mcu_frames()}
        self.mutations = (
            self.flip,
            self.put,
            self.remove,
            self.insert,
            self.cut,
            self.swap,
            self.number,
            self.length,
        )

    def stream(self, side: str) -> bytes:
        """Return one to four frames, each unchanged or mutated one to three times, half of the mutated ones
        with a valid CRC."""
        found = b""
        for _ in range(self.random.randint(1, 4)):
            frame = self.random.choice(self.seeds[side])
            self.frames += 1
            if self.random.random() < 0.1:
                found += frame
                continue
            for _ in range(self.random.randint(1, 3)):
                frame = self.random.choice(self.mutations)(frame, side)
            found += wire.sealed(frame) if self.random.random() < 0.5 else frame
        return found

    def flip(self, data: bytes, side: str) -> bytes:
        """Turn one bit."""
        return self._changed(data, lambda byte: byte ^ 1 << self.random.randrange(8))

    def put(self, data: bytes, side: str) -> bytes:
        """Set one byte to a meaningful value."""
        return self._changed(data, lambda _: self.random.choice(b"\xa5\x5a\xaa\xbb\xac\xca\x00\x01\x02\xff"))

    def remove(self, data: bytes, side: str) -> bytes:
        """Remove some bytes."""
        at = self.random.randrange(len(data) + 1)
        return data[:at] + data[at + self.random.randint(1, 6) :]

    def insert(self, data: bytes, side: str) -> bytes:
        """Insert some bytes or the beginning of another frame."""
        at = self.random.randrange(len(data) + 1)
        other = self.random.choice(self.seeds[side])[: self.random.randint(1, 20)]
        more = self.random.choice((other, self.random.randbytes(self.random.randint(1, 6))))
        return data[:at] + more + data[at:]

    def cut(self, data: bytes, side: str) -> bytes:
        """Cut off the end or the beginning."""
        at = self.random.randrange(len(data) + 1)
        return self.random.choice((data[:at], data[at:]))

    def swap(self, data: bytes, side: str) -> bytes:
        """Continue with the rest of another frame."""
        at = self.random.randrange(len(data) + 1)
        return data[:at] + self.random.choice(self.seeds[side])[at:]

    def number(self, data: bytes, side: str) -> bytes:
        """Write a number that is not finite or at an extreme of the range."""
        value = self.random.choice((float("nan"), float("inf"), -float("inf"), 3.4e38, -0.0, 1e-45))
        at = self.random.randrange(0, max(len(data) - 4, 1), 2) + self.random.randrange(2)
        return data[:at] + struct.pack("<f", value) + data[at + 4 :]

    def length(self, data: bytes, side: str) -> bytes:
        """Announce a different length."""
        value = self.random.choice((0, 8, 52, 84, 86, 256, 65535, self.random.randrange(120)))
        return data[:4] + struct.pack("<H", value) + data[6:]

    def _changed(self, data: bytes, change) -> bytes:
        if not data:
            return data
        at = self.random.randrange(len(data))
        return data[:at] + bytes([change(data[at])]) + data[at + 1 :]

    def step(self) -> None:
        """Judge one stream for one side, in up to four pieces."""
        side = self.random.choice(SIDES)
        stream = self.stream(side)
        self.accepted += judge(stream, side, [self.random.randrange(len(stream) + 1) for _ in range(3)])


def judge(stream: bytes, side: str, cuts=()) -> int:
    """Return the number of messages that a decoder finds in a stream cut in pieces; raise if they are not the
    true ones."""
    decoder = Decoder({"host": HOST, "mcu": MCU}[side])
    found, begin = [], 0
    for end in (*sorted(cuts), len(stream)):
        found += decoder.feed(stream[begin:end])
        begin = end
        counted = decoder.skipped_bytes
        assert counted <= end, f"{counted} bytes skipped of {end}: {stream.hex()}"
    found += decoder.feed(ZEROS)
    expected = wire.frames_in(stream + ZEROS, side)
    assert found == expected, f"{side}: found {found}, expected {expected}: {stream.hex()}"
    assert sum(decoder.accepted.values()) == len(found)
    return len(found)


def _host_frames() -> list[bytes]:
    frame = wire.telemetry_bytes(TELEMETRY)
    older = wire.sealed(frame[:4] + b"\x34\x00" + frame[6:64] + b"\x00\x00")
    return [frame, older, wire.echo_bytes(ECHO)]


def _mcu_frames() -> list[bytes]:
    return [wire.command_bytes(COMMAND), wire.debug_config_bytes(DebugConfig(1, 1, 10))]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=1_000_000, help="mutated frames")
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    fuzzer, began = Fuzzer(chosen.seed), time.perf_counter()
    while fuzzer.frames < chosen.frames:
        fuzzer.step()
    took = time.perf_counter() - began
    print(f"{fuzzer.frames} mutated frames, {fuzzer.accepted} messages accepted, none wrong, {took:.0f} s")


if __name__ == "__main__":
    main()
