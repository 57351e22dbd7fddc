"""A picture as bytes, for UDP and shared memory: a head, the tags, and the image as it is or as JPEG.

magic "FSPC", version u8, format u8, tags u16, time f64, late f64, sequence u32, rows u32, columns u32,
length of the image u32; per tag: id i32, corners 8 x f64; the image. All little endian.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

import numpy as np

from finssim.robot.messages import Picture, TagCorners
from finssim.robot.record_pictures import jpeg, picture_of

__all__ = ["Posted", "decode_picture", "encode_picture"]

_HEAD = struct.Struct("<4sBBHddIIII")
_TAG = struct.Struct("<i8d")
_MAGIC, _VERSION = b"FSPC", 1
NO_IMAGE, RAW, JPEG = 0, 1, 2
MOST_TAGS = 256
LARGEST = 64 * 2**20
"""Pixels; a larger picture is none."""


@dataclass(frozen=True)
class Posted:
    """A picture and what its sender said about the time."""

    picture: Picture
    """`time` is on the sender's clock."""
    late: float
    """How much later than `time` it was sent [s]: what drawing it took beyond the camera's latency."""


def encode_picture(picture: Picture, *, late: float = 0.0, compress: bool = False) -> bytes:
    """A picture as bytes.

    Args:
        picture: Gray, or tags alone.
        late: Time of sending minus `picture.time` [s].
        compress: As JPEG of quality 90, which moves corners by 0.004 px and takes an eighth of the bytes.
    """
    rows, columns = (0, 0) if picture.image is None else picture.image.shape
    kind, data = NO_IMAGE, b""
    if picture.image is not None:
        packed = jpeg(picture.image) if compress else None
        kind, data = (JPEG, packed) if packed else (RAW, np.ascontiguousarray(picture.image).tobytes())
    counts = len(picture.tags), picture.time, late, picture.sequence % 2**32, rows, columns, len(data)
    head = _HEAD.pack(_MAGIC, _VERSION, kind, *counts)
    tags = [_TAG.pack(tag.tag_id, *np.ravel(tag.corners)) for tag in picture.tags]
    return b"".join([head, *tags, data])


def decode_picture(data: bytes) -> Posted | None:
    """The picture; None where the bytes are none. Never raises."""
    if len(data) < _HEAD.size:
        return None
    magic, version, kind, n, time, late, sequence, rows, columns, size = _HEAD.unpack_from(data)
    start = _HEAD.size + n * _TAG.size
    if magic != _MAGIC or version != _VERSION or n > MOST_TAGS or len(data) != start + size:
        return None
    if not (math.isfinite(time) and math.isfinite(late)) or rows * columns > LARGEST:
        return None
    tags = _tags(data, n)
    image = _image(kind, data[start:], rows, columns)
    if tags is None or (image is None) != (kind == NO_IMAGE):
        return None
    return Posted(Picture(time, sequence, image, tags), late)


def _tags(data: bytes, n: int) -> tuple[TagCorners, ...] | None:
    found = []
    for i in range(n):
        tag, *corners = _TAG.unpack_from(data, _HEAD.size + i * _TAG.size)
        if not all(map(math.isfinite, corners)):
            return None
        found.append(TagCorners(tag, np.array(corners).reshape(4, 2)))
    return tuple(found)


def _image(
    kind: int, data: bytes, rows: int, columns: int
) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]] | None:
    """Pixels, None where they are not those that the head announces."""
    if kind == RAW and len(data) == rows * columns > 0:
        return np.frombuffer(data, np.uint8).reshape(rows, columns)
    if kind == JPEG and data[:2] == b"\xff\xd8" and _announced(data) == (rows, columns):
        image = picture_of(data)
        return image if image is not None and image.shape == (rows, columns) else None
    return None


def _announced(data: bytes) -> tuple[int, int] | None:
    """Rows and columns in a JPEG's own frame header, so that no bomb is unpacked."""
    at = 2
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker, size = data[at + 1], int.from_bytes(data[at + 2 : at + 4], "big")
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            return int.from_bytes(data[at + 5 : at + 7], "big"), int.from_bytes(data[at + 7 : at + 9], "big")
        at += 2 + max(size, 2)
    return None
