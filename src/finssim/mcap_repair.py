"""MCAP files that were cut off, as by a crash or an empty battery: readable up to the cut."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import BinaryIO

__all__ = ["END", "MAGIC", "whole_mcap"]

MAGIC = b"\x89MCAP0\r\n"
DATA_END, FOOTER, CHUNK = 0x0F, 0x02, 0x06
"""Kinds of records (MCAP specification)."""

COPIED_AT_ONCE = 1 << 20

END = struct.pack("<BQI", DATA_END, 4, 0) + struct.pack("<BQQQI", FOOTER, 20, 0, 0, 0) + MAGIC
"""What closes a file without a summary: end of data without a checksum, an empty footer, the magic."""


@contextmanager
def whole_mcap(path: Path, notes: list[str]) -> Iterator[Path]:
    """The file itself; or, for an MCAP without its end, a temporary copy that ends after its last whole record.

    Args:
        path: Any bag; only `.mcap` files are looked at.
        notes: Told when a copy was made.
    """
    if path.suffix != ".mcap" or not path.is_file() or _ends_well(path):
        yield path
        return
    with TemporaryDirectory() as folder:
        copy = Path(folder) / path.name
        with path.open("rb") as source, copy.open("wb") as target:
            end = _last_whole_record(source, len(MAGIC))
            source.seek(0)
            _copy(source, target, end)
            target.write(_of_cut_chunk(source.read()) + END)
        notes.append(f"{path.name} is cut off and was read up to the cut")
        yield copy


def _ends_well(path: Path) -> bool:
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            return True  # no MCAP at all: the reader says so
        file.seek(-len(MAGIC), 2)
        return file.tell() > 0 and file.read() == MAGIC


def _last_whole_record(file: BinaryIO, at: int) -> int:
    """Where the last whole data record ends, from a place where one begins."""
    size = file.seek(0, 2)
    while at + 9 <= size:
        file.seek(at)
        kind, length = struct.unpack("<BQ", file.read(9))
        if kind in (DATA_END, FOOTER, 0) or at + 9 + length > size:
            break
        at += 9 + length
    return at


def _copy(source: BinaryIO, target: BinaryIO, count: int) -> None:
    """The next bytes of one file at the end of another."""
    while count > 0 and (part := source.read(min(count, COPIED_AT_ONCE))):
        target.write(part)
        count -= len(part)


def _of_cut_chunk(data: bytes) -> bytes:
    """The whole records inside a chunk that is cut; they may also stand outside of one."""
    if len(data) < 49 or data[0] != CHUNK:
        return b""
    # Kind, length; first and last time, size, checksum; then the compression's name and the length of what follows.
    length = struct.unpack_from("<I", data, 37)[0]
    compression = data[41 : 41 + length].decode("ascii", errors="replace")
    packed = data[41 + length + 8 :]
    records = _unpacked(compression, packed)
    return records[: _last_whole_record(BytesIO(records), 0)]


def _unpacked(compression: str, packed: bytes) -> bytes:
    """As much as can be unpacked of the beginning of a chunk."""
    if compression == "":
        return packed
    if compression == "zstd":
        try:
            from compression import zstd  # since Python 3.14
        except ImportError:
            from backports import zstd
        return bytes(zstd.ZstdDecompressor().decompress(packed))
    if compression == "lz4":
        import lz4.frame

        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(packed))
    return b""
