"""Faults of the wire and of the instruments, switched on by experiments: what a robot must survive."""

from __future__ import annotations

import random
import struct
from dataclasses import dataclass, replace

from finssim.robot.link.frames import TELEMETRY, crc16_modbus, encode_telemetry, forms
from finssim.robot.messages import Telemetry

__all__ = ["FaultError", "Faults"]

REORDERED = 0.025
"""How much later a frame that is overtaken arrives [s]: behind the two that follow it at 100 Hz."""

PROBABILITIES = ("drop", "drop_commands", "corrupt", "reorder", "duplicate")
NUMBERS = {f.name: f.values for f in TELEMETRY.payload if f.code == "f"}
"""Telemetry fields that can be NaN, and how many values each has (0: one per motor output)."""
SPOILABLE = {*NUMBERS, *(f"{name}.{i}" for name, values in NUMBERS.items() for i in range(values or 8))}


class FaultError(ValueError):
    """A fault that cannot be: a probability out of range, a field that no frame has."""


@dataclass
class Faults:
    """What is wrong at present; every field may be changed at any time, all draws come from the seed."""

    seed: int = 0
    drop: float = 0.0
    """Chance that a frame from the vehicle is lost."""
    drop_commands: float = 0.0
    """Chance that a frame to the vehicle is lost."""
    corrupt: float = 0.0
    """Chance that a frame has one to eight bits turned over."""
    reorder: float = 0.0
    """Chance that a frame is overtaken by those behind it."""
    duplicate: float = 0.0
    """Chance that a frame comes twice."""
    freeze_sensors: bool = False
    """Instruments stand still; sequence numbers and clock go on."""
    nan_field: str = ""
    """Telemetry field sent as NaN, `depth` or an element of one, `gyro.2`; none if empty."""
    _frozen: Telemetry | None = None

    def __setattr__(self, name: str, value: object) -> None:
        if name in PROBABILITIES and not (isinstance(value, int | float) and 0.0 <= value <= 1.0):
            raise FaultError(f"{name} is {value!r}, expected a probability from 0 to 1")
        if name == "nan_field" and value and str(value) not in SPOILABLE:
            raise FaultError(
                f"telemetry has no number '{value}': give one of {', '.join(NUMBERS)}, or an element as in gyro.2"
            )
        super().__setattr__(name, value)

    def __post_init__(self) -> None:
        self._random = random.Random(f"faults {self.seed}")

    def lost(self, commands: bool = False) -> bool:
        """Whether the next frame is lost."""
        return self._happens(self.drop_commands if commands else self.drop)

    def _happens(self, probability: float) -> bool:
        return probability > 0.0 and self._random.random() < probability

    def encode(self, telemetry: Telemetry) -> bytes:
        """Frame of a snapshot, with instruments frozen and fields spoiled as asked."""
        if not self.freeze_sensors:
            self._frozen = None
        else:
            held = self._frozen = self._frozen or telemetry
            telemetry = replace(
                telemetry,
                quaternion=held.quaternion,
                gyro=held.gyro,
                accel=held.accel,
                depth=held.depth,
                pressure=held.pressure,
                motor_rpm=held.motor_rpm,
            )
        frame = encode_telemetry(telemetry)
        return (
            frame if not self.nan_field else _with_nan(frame, self.nan_field, len(telemetry.motor_rpm or ()))
        )

    def arrivals(self, time: float, frame: bytes) -> list[tuple[float, bytes]]:
        """When [s] and how a frame that should arrive at a time [s] does so: lost, twice, late, with wrong bits."""
        if self.lost():
            return []
        if self._happens(self.corrupt):
            spoiled = bytearray(frame)
            for bit in self._random.sample(range(8 * len(frame)), self._random.randint(1, 8)):
                spoiled[bit // 8] ^= 1 << (bit % 8)
            frame = bytes(spoiled)
        if self._happens(self.reorder):
            time += REORDERED
        copies = 2 if self._happens(self.duplicate) else 1
        return [(time, frame)] * copies


def _with_nan(frame: bytes, name: str, outputs: int) -> bytes:
    """The frame with one field NaN, or one element of it, and a right CRC: no checksum tells a controller's NaN."""
    field, _, element = name.partition(".")
    body = bytearray(frame[len(TELEMETRY.magic) : -2])
    at = 0
    for entry in forms(TELEMETRY, outputs)[0].fields:
        size, values = struct.calcsize("<" + entry.code), entry.values or outputs
        if entry.name == field:
            for i in [int(element)] if element else range(values):
                struct.pack_into("<f", body, at + i * size, float("nan"))
        at += size * values
    return TELEMETRY.magic + bytes(body) + struct.pack("<H", crc16_modbus(bytes(body)))
