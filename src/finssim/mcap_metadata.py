"""Tables of words in an MCAP file, read without a library; they stand before its messages."""

from __future__ import annotations

import struct
from pathlib import Path

from finssim.mcap_repair import MAGIC

METADATA, CHUNK, DATA_END = 0x0C, 0x06, 0x0F
"""Kinds of records (MCAP specification)."""


def mcap_metadata(path: Path, name: str) -> dict[str, str]:
    """The metadata record of that name before the first chunk; empty if there is none, or the file is no MCAP.

    Args:
        path: A file, finished or cut.
        name: Of the metadata record.
    """
    if not path.is_file():
        return {}
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            return {}
        while len(head := file.read(9)) == 9:
            kind, length = struct.unpack("<BQ", head)
            if kind in (CHUNK, DATA_END, 0):
                break
            if kind != METADATA:
                file.seek(length, 1)
                continue
            words = _words(file.read(length))
            if len(words) % 2 and words[0] == name:
                return dict(zip(words[1::2], words[2::2], strict=True))
    return {}


def _words(data: bytes) -> list[str]:
    """The name, and keys and values by turns; as many as the data hold."""
    found, at = [], 0
    while at + 4 <= len(data):
        (length,) = struct.unpack_from("<I", data, at)
        at += 4
        found.append(data[at : at + length].decode("utf-8", errors="replace"))
        at += length
        if len(found) == 1:
            at += 4  # the length of the whole table
    return found
