"""MCAP files read without a library: those cut off by a crash or an empty battery, or damaged; and tables of words."""

from __future__ import annotations

import mmap
import re
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from finssim.core.budget import CHUNK as CHUNK_BYTES
from finssim.core.budget import zstd

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK = 0x01, 0x02, 0x03, 0x04, 0x05, 0x06
ATTACHMENT, METADATA, DATA_END = 0x09, 0x0C, 0x0F
"""Kinds of records (MCAP specification)."""
LAYOUTS = {
    HEADER: "ss", SCHEMA: "2ssm", CHANNEL: "22sst", MESSAGE: "2488", ATTACHMENT: "88ssb4", METADATA: "st", DATA_END: "4"
}  # fmt: skip
"""Kind -> its parts: so many bytes; text (s), bytes (m) or a table (t) after 4 bytes of length, bytes (b) after 8."""
END = struct.pack("<BQI", DATA_END, 4, 0) + struct.pack("<BQQQI", FOOTER, 20, 0, 0, 0) + MAGIC
"""Bytes that close a file without a summary: end of data without a checksum, an empty footer, the magic."""
TAIL = 29 + len(MAGIC)
"""Length of a footer and the magic [bytes]."""
CHUNK_BEGINS = re.compile(rb"\x06.{36}(?:\x00{4}|\x03\x00{3}lz4|\x04\x00{3}zstd)", re.DOTALL)


@contextmanager
def intact_mcap(path: Path, notes: list[str]) -> Iterator[Path]:
    """Yield the file; or, if an MCAP file is cut or damaged, a temporary copy of its intact records.

    Args:
        path: Any bag; only `.mcap` files are looked at.
        notes: Told what is broken, if a copy was made.
    """
    if path.suffix != ".mcap" or not path.is_file() or path.stat().st_size < len(MAGIC):
        yield path
        return
    with TemporaryDirectory() as folder:
        copy = Path(folder) / path.name
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            note = _copied(data, copy) if data[: len(MAGIC)] == MAGIC else None
        if note is not None:
            notes.append(f"{path.name} is {note}")
        yield path if note is None else copy


def _copied(data: mmap.mmap, copy: Path) -> str | None:
    """Copy the intact records of a damaged file, and return what is damaged; copy nothing of an intact file."""
    spans, lost = _intact_records(data)
    summary, ends = _summary(data), data[-len(MAGIC) :] == MAGIC
    if not lost and ends and summary is not None:
        return None
    with copy.open("wb") as target:
        target.write(MAGIC)
        for begin, end in spans[:1]:  # the header; then what a broken chunk may have announced
            target.write(data[begin:end])
        target.write(b"".join(_announced(summary or b"")))
        for begin, end in spans[1:]:
            target.write(data[begin:end])
        rest = data[spans[-1][1] if spans else len(MAGIC) :]
        target.write((b"" if ends else _of_cut_chunk(rest)) + END)
    if lost:
        places = f"{len(lost)} place{'s' if len(lost) > 1 else ''}"
        return f"damaged: {sum(lost)} bytes in {places} cannot be read and are left out"
    return "damaged: its index cannot be read" if ends else "cut off and was read up to the cut"


def _intact_records(data: mmap.mmap) -> tuple[list[tuple[int, int]], list[int]]:
    """Return begin and end of each intact record up to the end of the data, and the lengths of the gaps."""
    spans, lost, at = [], [], len(MAGIC)
    while at < len(data) and data[at] not in (DATA_END, FOOTER):
        if (end := _record_end(data, at)) is None:
            if (end := _resumed(data, at)) is None:
                break
            lost.append(end - at)
        else:
            spans.append((at, end))
        at = end
    return spans, lost


def _resumed(data: mmap.mmap, at: int) -> int | None:
    """Return where the next intact record begins after a damaged one: at its stated end, or else at the next chunk."""
    end = at + 9 + int.from_bytes(data[at + 1 : at + 9], "little")
    if end < len(data) and _record_end(data, end) is not None:
        return end
    begins = (match.start() for match in CHUNK_BEGINS.finditer(data, at + 1))
    return next((begin for begin in begins if _record_end(data, begin) is not None), None)


def _record_end(data: bytes | mmap.mmap, at: int) -> int | None:
    """The end of the record that begins there; None if it is broken or cut."""
    if at + 9 > len(data):
        return None
    kind, length = struct.unpack("<BQ", data[at : at + 9])
    end: int = at + 9 + length
    if not HEADER <= kind <= DATA_END or end > len(data):
        return None
    if kind == CHUNK:
        return end if _sound_chunk(data[at + 9 : end]) else None
    if kind not in LAYOUTS:
        return end
    body = data[at + 9 : end]
    sound = kind != ATTACHMENT or zlib.crc32(body[:-4]) == int.from_bytes(body[-4:], "little")
    return end if sound and _fits(body, LAYOUTS[kind]) else None


def _fits(body: bytes, layout: str) -> bool:
    """Return whether the parts of a record lie within it, and its texts are valid."""
    at = 0
    for part in layout:
        if part.isdigit():
            at += int(part)
            continue
        width = 8 if part == "b" else 4
        begin = at + width
        at = begin + int.from_bytes(body[at:begin], "little")
        if at > len(body):
            return False
        try:
            if part == "s":
                body[begin:at].decode()
        except UnicodeDecodeError:
            return False
        while part == "t" and begin < at:
            if not _fits(body[begin:at], "ss"):
                return False
            for _ in "ss":
                begin += 4 + int.from_bytes(body[begin : begin + 4], "little")
    return at <= len(body)


def _sound_chunk(body: bytes) -> bool:
    """Return whether a chunk can be unpacked to match its checksum, or to intact records if it has none."""
    if len(body) < 40:
        return False
    size, crc, length = struct.unpack_from("<QII", body, 16)
    compression, begin = body[32 : 32 + length], 40 + length
    if size > CHUNK_BYTES or len(body) != begin + int.from_bytes(body[32 + length : begin], "little"):
        return False
    try:
        records = _unpacked(compression.decode("ascii"), body[begin:])
    except Exception:  # each compression raises different errors
        return False
    sound = zlib.crc32(records) == crc if crc else _last_record_end(records) == size
    return len(records) == size and bool(sound)


def _summary(data: mmap.mmap) -> bytes | None:
    """The summary at the end of a file, empty where it has none; None where it is broken."""
    if len(data) < len(MAGIC) + TAIL or data[-TAIL : 9 - TAIL] != struct.pack("<BQ", FOOTER, 20):
        return None
    begin, _, crc = struct.unpack("<QQI", data[9 - TAIL : -len(MAGIC)])
    footer = len(data) - TAIL
    if begin and (not len(MAGIC) < begin <= footer or (crc and zlib.crc32(data[begin : footer + 25]) != crc)):
        return None
    return data[begin:footer] if begin else b""


def _announced(summary: bytes) -> Iterator[bytes]:
    """The schemas and channels of a summary."""
    at = 0
    while (end := _record_end(summary, at)) is not None:
        if summary[at] in (SCHEMA, CHANNEL):
            yield summary[at:end]
        at = end


def _last_record_end(records: bytes) -> int:
    """Return where the last intact record ends."""
    at = 0
    while (end := _record_end(records, at)) is not None:
        at = end
    return at


def _of_cut_chunk(data: bytes) -> bytes:
    """Return the intact records inside a chunk that is cut; records may also occur outside of a chunk."""
    if len(data) < 49 or data[0] != CHUNK:
        return b""
    # Kind, length; first and last time, size, checksum; then the compression's name and the length of what follows.
    length = struct.unpack_from("<I", data, 37)[0]
    compression = data[41 : 41 + length].decode("ascii", errors="replace")
    try:
        records = _unpacked(compression, data[41 + length + 8 :])
    except Exception:  # as above
        return b""
    return records[: _last_record_end(records)]


def _unpacked(compression: str, packed: bytes) -> bytes:
    """Return as much as can be unpacked of the beginning of a chunk."""
    if compression == "":
        return packed
    if compression == "zstd":
        return bytes(zstd().ZstdDecompressor().decompress(packed, CHUNK_BYTES))
    if compression == "lz4":
        import lz4.frame

        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(packed, CHUNK_BYTES))
    return b""


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
            strings = _strings(file.read(length))
            if len(strings) % 2 and strings[0] == name:
                return dict(zip(strings[1::2], strings[2::2], strict=True))
    return {}


def _strings(data: bytes) -> list[str]:
    """The name, and keys and values by turns; as many as the data hold."""
    strings, at = [], 0
    while at + 4 <= len(data):
        (length,) = struct.unpack_from("<I", data, at)
        at += 4
        strings.append(data[at : at + length].decode("utf-8", errors="replace"))
        at += length
        if len(strings) == 1:
            at += 4  # the length of the complete table
    return strings
