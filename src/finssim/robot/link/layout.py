"""What a frame is made of: fields in the order of the wire, and the one description that writes and reads them."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

__all__ = ["Field", "Form", "Layout", "LinkError", "crc16_modbus", "forms"]


class LinkError(ValueError):
    """An address or a message is refused; the text says what, where and what to do."""


class Field(NamedTuple):
    """One entry of a frame; all are little endian."""

    name: str
    """Attribute of the message, or of the frame alone where it has a `constant`."""
    code: str
    """As `struct` has it: ? B H I f."""
    meaning: str
    """With its unit, for the table of the documentation."""
    values: int = 1
    """How many values; 0: one per motor output."""
    constant: int | None = None
    """Value that is always sent; None: the message's."""
    order: tuple[int, ...] = ()
    """Index in the message of each value on the wire; empty: as they are."""


@dataclass(frozen=True)
class Layout:
    """One kind of frame: magic, header, payload, CRC16 of header and payload, tail."""

    title: str
    message: type
    """What it is decoded to."""
    magic: bytes
    header: tuple[Field, ...]
    """A field `length` counts the bytes of the payload."""
    payload: tuple[Field, ...]
    tail: bytes = b""
    optional: str = ""
    """Name of the last field if a frame may end before it; None is then decoded."""


class Form:
    """A layout for one number of motor outputs, with or without its optional field: bytes of known length."""

    def __init__(self, layout: Layout, outputs: int, *, complete: bool = True) -> None:
        """Args:
        layout: The kind of frame.
        outputs: Motor outputs of the vehicle.
        complete: False: without the optional field.
        """
        payload = layout.payload if complete else layout.payload[:-1]
        length = struct.calcsize("<" + _codes(payload, outputs))
        header = tuple(f._replace(constant=length) if f.name == "length" else f for f in layout.header)
        self.layout, self.fields, self.outputs = layout, (*header, *payload), outputs
        self.absent = {} if complete else {layout.optional: None}
        self._body = struct.Struct("<" + _codes(self.fields, outputs))
        self.crc_at = len(layout.magic) + self._body.size
        self.size = self.crc_at + 2 + len(layout.tail)

    @cached_property
    def prefix(self) -> bytes:
        """Bytes with which every such frame begins: the magic and the constants right after it."""
        body = b""
        for field in self.fields:
            if field.constant is None:
                break
            body += struct.pack("<" + field.code, field.constant)
        return self.layout.magic + body

    @cached_property
    def _places(self) -> tuple[tuple[str, int, int, tuple[int, ...]], ...]:
        """Name, first value, one past the last (0: a single value) and order of what a message holds."""
        places, at = [], 0
        for field in self.fields:
            count = field.values or self.outputs
            if field.constant is None:
                alone = field.values == 1
                order = tuple(field.order.index(i) for i in range(count)) if field.order else ()
                places.append((field.name, at, 0 if alone else at + count, order))
            at += count
        return tuple(places)

    def encode(self, message: Any) -> bytes:
        """Bytes of a message; raises LinkError for a number the wire has no room for, or that is not finite."""
        numbers = self._numbers(message)
        try:
            if not math.isfinite(sum(numbers)):
                self._refuse_not_finite(message)
            body = self._body.pack(*numbers)
        except (struct.error, OverflowError, TypeError) as problem:
            raise LinkError(
                f"{self.layout.title}: {message} does not fit the frame ({problem}): send numbers within its fields"
            ) from None
        return self.layout.magic + body + struct.pack("<H", crc16_modbus(body)) + self.layout.tail

    def _numbers(self, message: Any) -> list[Any]:
        """Values of all fields in the order of the wire."""
        numbers: list[Any] = []
        for name, _, _, count, constant, order in self.fields:
            if constant is not None:
                numbers.append(constant)
                continue
            given = getattr(message, name)
            if count == 1:
                numbers.append(given)
                continue
            if len(given) != (count or self.outputs):
                raise LinkError(
                    f"{self.layout.title}: {name} has {len(given)} values, expected {count or self.outputs}"
                )
            numbers.extend([given[i] for i in order] if order else given)
        return numbers

    def _refuse_not_finite(self, message: Any) -> None:
        """Raise LinkError for the first field with a number that is not finite, if there is one."""
        for field in self.fields:
            if field.code != "f":
                continue
            given = getattr(message, field.name)
            if not all(map(math.isfinite, (given,) if field.values == 1 else given)):
                raise LinkError(
                    f"{self.layout.title}: {field.name} is {given}, expected finite numbers: "
                    "stop the motors instead of sending it"
                )

    def decode(self, frame: bytes, at: int = 0) -> Any | None:
        """Message of the frame that begins at `at`, its CRC already found right; None if a number is not finite."""
        values = self._body.unpack_from(frame, at + len(self.layout.magic))
        # Single precision cannot overflow the sum, so it is finite where all of them are.
        if not math.isfinite(sum(values)):
            return None
        found: dict[str, Any] = dict(self.absent)
        for name, first, end, order in self._places:
            part = values[first:end] if end else values[first]
            found[name] = tuple([part[i] for i in order]) if order else part
        return self.layout.message(**found)


@lru_cache(maxsize=64)
def forms(layout: Layout, outputs: int) -> tuple[Form, ...]:
    """Every form a layout has for a number of motor outputs, the complete one first."""
    complete = Form(layout, outputs)
    return (complete, Form(layout, outputs, complete=False)) if layout.optional else (complete,)


def _codes(fields: tuple[Field, ...], outputs: int) -> str:
    return "".join(f"{f.values or outputs}{f.code}" for f in fields)


@lru_cache(maxsize=64)
def _crc_terms(length: int) -> tuple[npt.NDArray[np.uint16], npt.NDArray[np.int64], int]:
    """What each byte of a message of that length adds to its CRC: 256 numbers per place in a row, where each place
    begins in them, and the CRC of zeros alone. The CRC is linear: all that is added is added by exclusive or."""
    one = np.arange(256, dtype=np.uint16)
    for _ in range(8):
        one = np.where(one & 1, (one >> 1) ^ 0xA001, one >> 1).astype(np.uint16)
    terms, crc = np.empty((length, 256), np.uint16), 0xFFFF
    for place in range(length - 1, -1, -1):
        behind = one if place == length - 1 else (terms[place + 1] >> 8) ^ one[terms[place + 1] & 0xFF]
        terms[place] = behind
        crc = (crc >> 8) ^ int(one[crc & 0xFF])
    return terms.ravel(), 256 * np.arange(length), crc


def crc16_modbus(data: bytes) -> int:
    """CRC16-MODBUS: polynomial x¹⁶ + x¹⁵ + x² + 1 reflected (0xA001), initial value 0xFFFF; 0x4B37 of "123456789"."""
    terms, place, of_zeros = _crc_terms(len(data))
    return of_zeros ^ int(np.bitwise_xor.reduce(terms[place + np.frombuffer(data, np.uint8)]))
