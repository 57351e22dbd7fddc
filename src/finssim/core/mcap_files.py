"""Reading and repairing of MCAP files with the `mcap` library: intact parts of truncated or damaged files."""

from __future__ import annotations

import mmap
import re
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from io import BytesIO
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from finssim.core.budget import CHUNK as CHUNK_BYTES
from finssim.core.budget import zstd

MAGIC = b"\x89MCAP0\r\n"
FOOTER, MESSAGE, CHUNK, ATTACHMENT, DATA_END = 0x02, 0x05, 0x06, 0x09, 0x0F
"""Kinds of records (MCAP specification)."""
END = struct.pack("<BQI", DATA_END, 4, 0) + struct.pack("<BQQQI", FOOTER, 20, 0, 0, 0) + MAGIC
"""Bytes that close a file without a summary: end of data without a checksum, an empty footer, the magic."""
TAIL = 29 + len(MAGIC)
"""Length of a footer and the magic [bytes]."""
CHUNK_BEGINS = re.compile(rb"\x06.{36}(?:\x00{4}|\x03\x00{3}lz4|\x04\x00{3}zstd)", re.DOTALL)


def without_profile(head: bytes) -> bool:
    """Return whether an MCAP file, by its first bytes, has an empty profile, as files of BlueOS' recorder do."""
    return head.startswith(MAGIC + b"\x01") and head[len(MAGIC) + 9 :][:4] == bytes(4)


@contextmanager
def intact_mcap(path: Path, notes: list[str]) -> Iterator[Path]:
    """Yield the file, or a temporary indexed copy if it is an MCAP file that is truncated, damaged or without
    an index.

    Args:
        path: Any file; files of other formats are yielded unchanged.
        notes: List to which a sentence about damage is appended.
    """
    if not path.is_file() or path.stat().st_size <= len(MAGIC):
        yield path
        return
    with TemporaryDirectory() as folder:
        copy = Path(folder) / path.name
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            whole = data[: len(MAGIC)] != MAGIC or _examined(path, data, notes)
            if not whole:
                _copy(data, copy)
        yield path if whole else copy


def write_intact(path: Path, target: Path, notes: list[str]) -> None:
    """Write a complete MCAP file from the intact records of another one.

    Args:
        path: An MCAP file.
        target: File to write.
        notes: List to which a sentence about damage is appended.
    """
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        _examined(path, data, notes)
        _copy(data, target)


def mcap_metadata(path: Path, name: str) -> dict[str, str]:
    """Return a metadata record that precedes the first chunk; empty if there is none or the file is not an MCAP file.

    Args:
        path: A file, complete or truncated.
        name: Name of the metadata record.
    """
    from mcap.records import Chunk, Message, Metadata

    if not path.is_file() or path.stat().st_size <= len(MAGIC):
        return {}
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        for record in _intact_records(data, []) if data[: len(MAGIC)] == MAGIC else ():
            if isinstance(record, Metadata) and record.name == name:
                return record.metadata
            if isinstance(record, (Chunk, Message)):
                break
    return {}


def _examined(path: Path, data: mmap.mmap, notes: list[str]) -> bool:
    """Return True if a file is complete and has an index; otherwise append a note about the damage."""
    lost: list[int] = []
    for _ in _intact_records(data, lost):
        pass
    summary = _summary(data)
    if lost:
        places = f"{len(lost)} place{'s' if len(lost) > 1 else ''}"
        damage = f"damaged: {sum(lost)} bytes in {places} cannot be read and are left out"
    elif data[-len(MAGIC) :] != MAGIC:
        damage = "cut off and was read up to the cut"
    elif summary is None:
        damage = "damaged: its index cannot be read"
    else:
        return bool(summary) and all(
            channel.schema_id in (0, *summary.schemas) for channel in summary.channels.values()
        )
    notes.append(f"{path.name} is {damage}")
    return False


def _summary(data: mmap.mmap) -> Any:
    """Return the summary at the end of a file, False if there is none, None if it is broken."""
    from mcap.reader import SeekingReader

    footer = len(data) - TAIL
    if footer < len(MAGIC) or data[footer : footer + 9] != struct.pack("<BQ", FOOTER, 20):
        return None
    begin, _, crc = struct.unpack("<QQI", data[footer + 9 : -len(MAGIC)])
    if begin and (not len(MAGIC) < begin <= footer or (crc and zlib.crc32(data[begin : footer + 25]) != crc)):
        return None
    data.seek(0)
    stream: Any = data
    try:
        return SeekingReader(stream).get_summary() or False
    except Exception:  # depending on the damage, any layer of the library may raise
        return None


def _copy(data: mmap.mmap, target: Path) -> None:
    """Write the intact records of a file to a file with an index."""
    from mcap import records
    from mcap.writer import CompressionType, Writer

    intact = _intact_records(data, [])
    first = next(intact, None)
    header = first if isinstance(first, records.Header) else records.Header("", "")
    # A damaged chunk may have contained schemas and channels, which the summary repeats.
    summary = _summary(data)
    announced = (*summary.schemas.values(), *summary.channels.values()) if summary else ()
    schemas, channels = {0: 0}, dict[int, int]()  # renumbered
    with target.open("wb") as file:
        writer: Any = Writer(file, compression=CompressionType.LZ4)
        writer.start(header.profile, header.library)
        for outer in chain(announced, (first,), intact):
            for record in _inside(outer.data) if isinstance(outer, records.Chunk) else (outer,):
                match record:
                    case records.Schema() if record.id not in schemas:
                        schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
                    case records.Channel() if record.id not in channels and record.schema_id in schemas:
                        channels[record.id] = writer.register_channel(
                            record.topic, record.message_encoding, schemas[record.schema_id], record.metadata
                        )
                    case records.Message() if record.channel_id in channels:
                        number, times = channels[record.channel_id], (record.log_time, record.publish_time)
                        writer.add_message(number, times[0], record.data, times[1], record.sequence)
                    case records.Metadata():
                        writer.add_metadata(record.name, record.metadata)
                    case records.Attachment():
                        writer.add_attachment(
                            record.create_time, record.log_time, record.name, record.media_type, record.data
                        )
        writer.finish()


def _intact_records(data: mmap.mmap, lost: list[int]) -> Iterator[Any]:
    """Yield the records up to the end of the data, with chunks unpacked; for a truncated chunk, its intact records.

    Args:
        data: The file.
        lost: List to which the lengths of damaged parts are appended [bytes].
    """
    at = len(MAGIC)
    while at < len(data) and data[at] not in (DATA_END, FOOTER):
        if (found := _record(data, at)) is None:
            if (end := _resumed(data, at)) is None:
                break
            lost.append(end - at)
        else:
            record, end = found
            if record is not None:
                yield record
        at = end
    else:
        return
    if data[-len(MAGIC) :] == MAGIC:
        lost.append(len(data) - at)
    else:
        yield from _inside(_of_cut_chunk(data[at : at + CHUNK_BYTES]))


def _resumed(data: mmap.mmap, at: int) -> int | None:
    """Return the start of the next intact record after a damaged one: its stated end, or else the next chunk."""
    end = at + 9 + int.from_bytes(data[at + 1 : at + 9], "little")
    if end < len(data) and _record(data, end) is not None:
        return end
    begins = (match.start() for match in CHUNK_BEGINS.finditer(data, at + 1))
    return next((begin for begin in begins if _record(data, begin) is not None), None)


@cache
def _readers() -> dict[int, Any]:
    """Return the library's readers of records by kind; records of other kinds are indices, which the copy
    writes again."""
    from mcap import records as r

    return {
        0x01: r.Header.read, 0x03: r.Schema.read, 0x04: r.Channel.read, CHUNK: r.Chunk.read,
        ATTACHMENT: r.Attachment.read, 0x0C: r.Metadata.read,
    }  # fmt: skip


def _record(data: bytes | mmap.mmap, at: int) -> tuple[Any, int] | None:
    """Return the record at an offset (None for an index) and its end; None if it is broken or truncated."""
    from mcap.records import Message

    if at + 9 > len(data):
        return None
    kind, length = struct.unpack("<BQ", data[at : at + 9])
    end: int = at + 9 + length
    if not 0x01 <= kind <= DATA_END or end > len(data):
        return None
    if kind == MESSAGE:
        # The most frequent kind: parsed without the library's stream, which takes three times as long.
        if length < 22:
            return None
        channel, sequence, log_time, publish_time = struct.unpack("<HIQQ", data[at + 9 : at + 31])
        return Message(channel, log_time, data[at + 31 : end], publish_time, sequence), end
    if kind not in _readers():
        return None, end
    body = data[at + 9 : end]
    try:
        record = _readers()[kind](_exact()(BytesIO(body)))
        if kind == CHUNK:
            record = _unpacked_chunk(record)
    except Exception:  # as above; each compression also raises different errors
        return None
    sound = kind != ATTACHMENT or zlib.crc32(body[:-4]) == int.from_bytes(body[-4:], "little")
    return (record, end) if sound else None


@cache
def _exact() -> Any:
    """Return the library's stream class, changed so that it refuses data that are shorter than their stated
    length."""
    from mcap.data_stream import ReadDataStream

    class Exact(ReadDataStream):
        def read(self, length: int) -> bytes:
            part = super().read(length)
            if len(part) != length:
                raise ValueError("shorter than its stated length")
            return part

    return Exact


def _inside(records: bytes) -> Iterator[Any]:
    """Yield the records of an unpacked chunk up to the first broken record."""
    at = 0
    while (found := _record(records, at)) is not None:
        record, at = found
        yield record


def _last_record_end(records: bytes) -> int:
    """Return the end of the last intact record of an unpacked chunk."""
    at = 0
    while (found := _record(records, at)) is not None:
        at = found[1]
    return at


def _unpacked_chunk(chunk: Any) -> Any:
    """Return a chunk without compression; ValueError if it does not match its checksum or, without one, is
    broken."""
    if chunk.uncompressed_size > CHUNK_BYTES:
        raise ValueError("too large")
    records, crc = _unpacked(chunk.compression, chunk.data), chunk.uncompressed_crc
    size = len(records)
    if size != chunk.uncompressed_size or not (
        zlib.crc32(records) == crc if crc else _last_record_end(records) == size
    ):
        raise ValueError("damaged")
    return replace(chunk, compression="", data=records)


def _of_cut_chunk(data: bytes) -> bytes:
    """Return the data that can be decompressed from a truncated chunk."""
    if len(data) < 49 or data[0] != CHUNK:
        return b""
    # Kind, length; first and last time, size, checksum; then the name of the compression and the length of the data.
    length = struct.unpack_from("<I", data, 37)[0]
    try:
        return _unpacked(data[41 : 41 + length].decode("ascii"), data[41 + length + 8 :])
    except Exception:  # as above
        return b""


def _unpacked(compression: str, packed: bytes) -> bytes:
    """Return the decompressed beginning of a chunk, as far as it is intact, up to the limit of its size."""
    if compression == "":
        return packed
    if compression == "zstd":
        return bytes(zstd().ZstdDecompressor().decompress(packed, CHUNK_BYTES))
    if compression == "lz4":
        import lz4.frame

        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(packed, CHUNK_BYTES))
    return b""
