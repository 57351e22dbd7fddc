"""Limits for all data read from outside: bytes, pixels, nodes, seconds; and a child process for reading
models."""

from __future__ import annotations

import importlib.util
import io
import os
import pickle
import re
import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

FILE = 256 << 20
"""Largest model, mesh, network or picture [bytes]."""
TEXT = 512 << 20
"""Largest table in a text file, such as a log [bytes]."""
CHUNK = 64 << 20
"""Largest chunk of a log after decompression [bytes]."""
UNPACKED = 4 << 30
"""Largest log that is compressed as whole files, after decompression to disk [bytes]."""
CELLS = 1 << 27
"""Largest number of values in a compressed table."""
PIXELS = 1 << 26
"""Largest number of pixels of a picture."""
NODES = 100_000
"""Largest number of elements of a model; an included file counts each time that it is included."""
DEPTH = 50
"""Largest depth of files of a model that include one another."""
MEMORY = 3 << 30
"""Address space of a child process, and additional memory that a network may use in this process [bytes]."""
SECONDS = 60
"""Processor time of a child process [s]; its wall-clock time may be ten times as long."""


def read_bytes(path: Path, refuse: type[Exception], name: str | None = None, limit: int = FILE) -> bytes:
    """Read a file of bounded size.

    Args:
        path: The file.
        refuse: Class of the error, constructed with one sentence.
        name: Name of the file in the sentence; its path if None.
        limit: Largest size [bytes].

    Raises:
        refuse: The file cannot be read, or exceeds the limit.
    """
    try:
        with path.open("rb") as file:
            data = file.read(limit + 1)
    except OSError as error:
        raise refuse(f"{name or path}: cannot be read: {error.strerror or error}") from None
    if len(data) > limit:
        raise refuse(f"{name or path}: larger than {limit >> 20} MiB: give a smaller file")
    return data


# Zstandard: a file need not state its uncompressed size, so it is first decompressed without storing the output.


def zstd() -> Any:
    """Return the module that decompresses Zstandard."""
    try:
        from compression import zstd  # since Python 3.14
    except ImportError:
        from backports import zstd
    return zstd


def packed_with_zstd(file: Path) -> bool:
    """Return whether a file begins with a Zstandard frame or a skippable frame."""
    try:
        with file.open("rb") as stream:
            begins = stream.read(4)
    except OSError:
        return False
    return begins == b"\x28\xb5\x2f\xfd" or (begins[1:] == b"\x2a\x4d\x18" and begins[0] >> 4 == 5)


def check_unpacked(files: Iterable[Path], refuse: type[Exception], name: str, remedy: str) -> None:
    """Refuse files that decompress to more than `UNPACKED` in total; a damaged file counts up to the damage.

    Args:
        files: Files compressed with Zstandard.
        refuse: Class of the error, constructed with one sentence.
        name: Name of the files in the sentence.
        remedy: Remedy that the sentence states.

    Raises:
        refuse: The total is larger.
    """
    module, room = zstd(), UNPACKED
    for file in files:
        with suppress(module.ZstdError, EOFError), module.open(file, "rb") as unpacked:
            while block := unpacked.read(1 << 20):
                room -= len(block)
                if room < 0:
                    raise refuse(f"{name}: unpacks to more than {UNPACKED >> 20} MiB: {remedy}")


# Pictures: their size is in their header, and is checked before anything is decoded.


def picture_size(data: bytes) -> tuple[int, int] | None:
    """Return the width and height in a picture's header [px]; None if the format is not supported.

    Args:
        data: PNG, JPEG, BMP, WebP, TIFF or portable (P2, P3, P5, P6) picture.
    """
    try:
        if data.startswith(b"\x89PNG\r\n\x1a\n"):
            return struct.unpack_from(">II", data, 16)
        if data.startswith(b"\xff\xd8"):
            return _jpeg_size(data)
        if data.startswith(b"BM"):
            width, height = struct.unpack_from("<ii", data, 18)
            return abs(width), abs(height)
        if data.startswith(b"RIFF") and data[8:12] == b"WEBP":
            return _webp_size(data)
        if data[:4] in (b"II*\0", b"MM\0*"):
            return _tiff_size(data)
        if plain := re.match(rb"P[2356](?:\s|#[^\n]*\n)+(\d{1,9})(?:\s|#[^\n]*\n)+(\d{1,9})\s", data):
            return int(plain[1]), int(plain[2])
    except (struct.error, ValueError, IndexError, KeyError):
        pass
    return None


def _jpeg_size(data: bytes) -> tuple[int, int]:
    at = 2
    while True:
        marker, length = struct.unpack_from(">HH", data, at)
        if 0xFFC0 <= marker <= 0xFFCF and marker not in (0xFFC4, 0xFFC8, 0xFFCC):
            height, width = struct.unpack_from(">HH", data, at + 5)
            return width, height
        at += 1 if marker == 0xFFFF else 2 + length


def _webp_size(data: bytes) -> tuple[int, int]:
    kind = data[12:16]
    if kind == b"VP8X":
        low, high, low_rows, high_rows = struct.unpack_from("<HBHB", data, 24)
        return 1 + low + (high << 16), 1 + low_rows + (high_rows << 16)
    if kind == b"VP8L":
        bits = struct.unpack_from("<I", data, 21)[0]
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    width, height = struct.unpack_from("<HH", data, 26)
    return width & 0x3FFF, height & 0x3FFF


def _tiff_size(data: bytes) -> tuple[int, int]:
    order = "<" if data.startswith(b"II") else ">"
    (at,) = struct.unpack_from(f"{order}I", data, 4)
    (count,) = struct.unpack_from(f"{order}H", data, at)
    tags = {}
    for i in range(count):
        tag, kind = struct.unpack_from(f"{order}HH", data, at + 2 + 12 * i)
        if tag in (256, 257):
            (tags[tag],) = struct.unpack_from(order + ("H" if kind == 3 else "I"), data, at + 10 + 12 * i)
    return tags[256], tags[257]


def decoded_picture(data: bytes, flags: int) -> NDArray[np.uint8] | str:
    """Decode a picture of bounded size.

    Args:
        data: The file.
        flags: Flags of OpenCV's `imdecode`.

    Returns:
        The picture as OpenCV returns it, or the reason why it cannot be decoded, as the end of a sentence.
    """
    import cv2

    size = picture_size(data)
    if size is None:
        return "is no picture that can be read"
    if size[0] * size[1] > PIXELS:
        return f"is a picture of {size[0]} x {size[1]} pixels, expected at most {PIXELS >> 20} million: make it smaller"
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        image = None
    return "is no picture that can be read" if image is None else np.asarray(image, np.uint8)


# Models are read by third-party libraries in a process whose memory and time are limited.


def in_child(function: Callable[[Any], Any], argument: Any, refuse: type[Exception]) -> Any:
    """Call a function in a process of bounded memory and time.

    Args:
        function: Function of a module that imports quickly: the module is loaded from its file, without its
            package.
        argument: Plain data.
        refuse: Class of the error, constructed with a sentence without a subject.

    Returns:
        What the function returns: plain data and arrays.

    Raises:
        refuse: The function raised an error (its message is used), or it exceeded `MEMORY` or `SECONDS`.
    """
    code = function.__code__
    given = pickle.dumps((sys.path, function.__module__, code.co_filename, code.co_name, argument))
    with tempfile.TemporaryDirectory() as folder:
        process = subprocess.Popen(
            [sys.executable, "-c", f"exec(open({__file__!r}, encoding='utf-8').read()); _serve()"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, cwd=folder,
            env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
        )  # fmt: skip
        try:
            answer, _ = process.communicate(given, timeout=10.0 * SECONDS)
        except subprocess.TimeoutExpired:
            answer = b""
        finally:
            process.kill()
            process.wait()
    try:
        well, result = pickle.loads(answer)
    except (pickle.UnpicklingError, EOFError):
        raise refuse(f"needs more than {SECONDS} s, or breaks the library that reads it") from None
    if not well:
        raise refuse(result)
    return result


def _serve() -> None:
    """Execute one call of `in_child`, in the child process."""
    answer = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # libraries print
    paths, module, file, name, argument = pickle.load(sys.stdin.buffer)
    sys.path[:] = paths
    with suppress(ImportError, ValueError, OSError):  # not on Windows
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))
    spec = importlib.util.spec_from_file_location(module, file)
    assert spec is not None and spec.loader is not None
    sys.modules[module] = loaded = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)
    result = io.BytesIO()
    try:
        pickle.dump((True, getattr(loaded, name)(argument)), result)
    except MemoryError:
        result = io.BytesIO(pickle.dumps((False, f"needs more than {MEMORY >> 30} GiB of memory")))
    except Exception as error:
        words = " ".join(str(error).split())[:200] or type(error).__name__
        if not isinstance(error, ValueError):
            words = f"cannot be read, perhaps for want of memory beyond {MEMORY >> 30} GiB: {words}"
        result = io.BytesIO(pickle.dumps((False, words)))
    answer.write(result.getvalue())
    answer.flush()


@contextmanager
def limited_memory(extra: int = MEMORY) -> Iterator[None]:
    """Allow this process that much additional memory within the block [bytes], where the system can limit
    memory."""
    try:
        import resource

        used = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * resource.getpagesize()
        before = resource.getrlimit(resource.RLIMIT_AS)
        limit = used + extra if before[0] == resource.RLIM_INFINITY else min(before[0], used + extra)
        resource.setrlimit(resource.RLIMIT_AS, (limit, before[1]))
    except (ImportError, ValueError, OSError):
        yield
        return
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)
