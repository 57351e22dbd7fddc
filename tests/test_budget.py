"""Input from outside has a size limit, which is checked before anything large is allocated."""

import importlib
import struct
import zlib

import numpy as np
import pytest

from finssim.core import budget
from finssim.core.mcap_files import CHUNK, MAGIC, _record
from finssim.localization import LocalizationError
from finssim.localization.detection.pictures import read_picture, write_picture
from finssim.robot.pictures import picture_of
from finssim.trials.findings import CalibrationError
from finssim.trials.trial_files import read_table


def png_header(width, height):
    """Return a PNG that announces a size and contains a single row."""

    def part(kind, body):
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    body = part(b"IHDR", head) + part(b"IDAT", zlib.compress(b"\0" * 100)) + part(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body


@pytest.mark.parametrize("side", [30_000, 60_000, 2**31 - 1])
def test_a_picture_is_as_large_as_its_header_says(tmp_path, side, monkeypatch):
    """900 million pixels and more are refused in one sentence, from a file and from the network, and never decoded."""
    import cv2

    path = tmp_path / "a.png"
    path.write_bytes(png_header(side, side))
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    with pytest.raises(
        LocalizationError, match=f"a.png: is a picture of {side} x {side} pixels, expected at most 64"
    ):
        read_picture(path)
    assert picture_of(path.read_bytes()) is None


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".tif", ".webp", ".pgm"])
def test_every_format_tells_its_size(tmp_path, suffix):
    """A written picture reads back, and its size is read from its header alone."""
    path = tmp_path / f"a{suffix}"
    write_picture(np.zeros((20, 31), np.uint8) + 200, path)
    assert budget.picture_size(path.read_bytes()) == (31, 20)
    assert read_picture(path).shape == (20, 31)


def test_other_webp_and_tiff_headers_tell_their_size():
    """The size is read from WebP with an extended or a lossy header and from big-endian TIFF, but not from a
    cut header."""
    extended = b"RIFF\0\0\0\0WEBPVP8X" + bytes(8) + (30).to_bytes(3, "little") + (19).to_bytes(3, "little")
    lossy = b"RIFF\0\0\0\0WEBPVP8 " + bytes(10) + struct.pack("<HH", 31, 20)
    tiff = b"MM\0*" + struct.pack(">IHHHIHHHHIHH", 8, 2, 256, 3, 1, 31, 0, 257, 3, 1, 20, 0)
    assert {budget.picture_size(data) for data in (extended, lossy, tiff)} == {(31, 20)}
    assert {budget.picture_size(data[:20]) for data in (extended, lossy, tiff)} == {None}


def test_a_file_is_read_up_to_its_bound(tmp_path):
    """A file of exactly the limit is read; one that is a byte over the limit is refused."""
    path = tmp_path / "a"
    path.write_bytes(b"12345")
    assert budget.read_bytes(path, CalibrationError, limit=5) == b"12345"
    with pytest.raises(CalibrationError, match="a: larger than 0 MiB"):
        budget.read_bytes(path, CalibrationError, limit=4)


def test_a_chunk_is_unpacked_up_to_its_bound():
    """A zstd chunk that unpacks from 10 kB to 100 MB is not a valid record; one of 1 MB is."""
    zstd = pytest.importorskip("backports.zstd")
    for size, sound in ((1 << 20, True), (100 << 20, False)):
        packed = zstd.compress(bytes(size))
        chunk = struct.pack("<QQQII", 0, 0, size, zlib.crc32(bytes(size)), 4) + b"zstd"
        chunk += struct.pack("<Q", len(packed)) + packed
        data = MAGIC + struct.pack("<BQ", CHUNK, len(chunk)) + chunk
        assert (_record(data, len(MAGIC)) is not None) == sound


def test_a_packed_table_says_how_long_it_is(tmp_path):
    """A column of 268 million empty rows in less than 1 MiB of Parquet is refused."""
    pytest.importorskip("pyarrow")
    import pyarrow
    import pyarrow.parquet

    path = tmp_path / "a.parquet"
    pyarrow.parquet.write_table(pyarrow.table({"t": pyarrow.nulls(1 << 28)}), path)
    assert path.stat().st_size < 1 << 20
    with pytest.raises(
        CalibrationError, match="268435456 rows of 1 columns, expected at most 128 million cells"
    ):
        read_table(path)


READS = """
import os

def reads(what):
    if what == "memory":
        return bytes(8 << 30)
    if what == "death":
        os.abort()
    if what == "words":
        raise ValueError("holds nothing")
    if what == "fault":
        raise KeyError("x")
    print("a library prints")
    return {"a": [0, 1, 2]}
"""
"""Source of a reader that runs in a child process."""


@pytest.mark.slow
def test_a_child_reads_within_its_memory(tmp_path, monkeypatch):
    """The child's result is returned; a refusal, excessive memory and a crash each become a sentence."""
    (tmp_path / "child_reads.py").write_text(READS)
    monkeypatch.syspath_prepend(tmp_path)
    reads = importlib.import_module("child_reads").reads
    assert budget.in_child(reads, "", CalibrationError) == {"a": [0, 1, 2]}
    for what, sentence in {
        "memory": "needs more than 3 GiB of memory",
        "death": "breaks the library that reads it",
        "words": "^holds nothing$",
        "fault": "cannot be read, .*'x'",
    }.items():
        with pytest.raises(CalibrationError, match=sentence):
            budget.in_child(reads, what, CalibrationError)


def test_memory_is_limited_for_a_while():
    """Inside the context an array beyond the limit is refused; afterwards the limit is lifted."""
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_AS)
    with budget.limited_memory(1 << 30), pytest.raises(MemoryError):
        np.ones(1 << 28)
    assert resource.getrlimit(resource.RLIMIT_AS) == before
