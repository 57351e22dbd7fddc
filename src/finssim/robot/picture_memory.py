"""Pictures through shared memory: a ring of slots in a file that lives in memory, written by one and read by many.

The file begins with "FSPM", version u32, slots u32, bytes of a slot u32, and the number of the newest picture u64,
counted from 1; 0 while there is none. Picture n lies in slot (n - 1) mod slots: n u64, length u32, CRC-32 u32, bytes.
A slot is numbered 0 while it is being written, and its reader looks at the number before and after: what was
overwritten meanwhile is left out. Nobody waits for anybody, so either side may die and start again at any time.
"""

from __future__ import annotations

import os
import re
import struct
import tempfile
import zlib
from dataclasses import replace
from pathlib import Path

from finssim.robot.link.layout import LinkError
from finssim.robot.messages import Picture
from finssim.robot.picture_codec import decode_picture

__all__ = ["HEAD", "MAGIC", "SLOT", "VERSION", "SharedMemoryPictures", "memory_path"]

MAGIC, VERSION = b"FSPM", 1
HEAD = struct.Struct("<4sIIIQ")
SLOT = struct.Struct("<QII")
_MOST_AT_ONCE = 4
"""A reader that is further behind goes on with the newest ones."""
_SAME_CLOCK = 10.0
"""Times further from now are of another clock [s]."""


def memory_path(name: str) -> Path:
    """The file behind a name.

    Raises:
        LinkError: It is not a plain name.
    """
    if not re.fullmatch(r"[A-Za-z0-9_-]{1,64}", name):
        raise LinkError(f"shm:{name}: expected a name of up to 64 letters, digits, - and _, such as shm:pool")
    memory = Path("/dev/shm")
    folder = memory if memory.is_dir() and os.access(memory, os.W_OK) else Path(tempfile.gettempdir())
    return folder / f"finssim-pictures-{name}"


class SharedMemoryPictures:
    """Reads what a camera on this machine writes; before there is one, and after it, nothing comes."""

    def __init__(self, name: str) -> None:
        """
        Args:
            name: As given to the camera.

        Raises:
            LinkError: It is not a plain name.
        """
        self.path = memory_path(name)
        self.received = self.missed = self.not_understood = 0
        self._file: int | None = None
        self._inode = 0
        self._last = 0

    def receive(self, now: float) -> list[Picture]:
        """Pictures since the last call, oldest first. Both sides' clock is this machine's `time.monotonic`."""
        self._follow()
        if self._file is None:
            return []
        head = os.pread(self._file, HEAD.size, 0)
        if len(head) < HEAD.size:
            return []
        magic, version, slots, size, newest = HEAD.unpack(head)
        if magic != MAGIC or version != VERSION or not (2 <= slots <= 1024 and SLOT.size < size <= 2**30):
            return []
        if newest < self._last:  # begun anew in the same file, or spoilt
            self._last = 0
        first = max(self._last + 1, newest - min(_MOST_AT_ONCE, slots - 1) + 1)
        self.missed += max(first - self._last - 1, 0) if self._last else 0
        found = [self._read(n, HEAD.size + (n - 1) % slots * size, size) for n in range(first, newest + 1)]
        self._last = newest
        return [self._on_clock(picture, now) for picture in found if picture is not None]

    def close(self) -> None:
        """Let go of the file; it is its writer's."""
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def describe(self) -> str:
        """Which memory, and how it fares."""
        text = f"shared memory {self.path.name}, {self.received} pictures"
        return text + (
            f", {self.missed + self.not_understood} missed" if self.missed + self.not_understood else ""
        )

    def _follow(self) -> None:
        """Open the file that has the name now: a camera that starts again makes a new one."""
        try:
            inode = os.stat(self.path).st_ino
        except OSError:
            return  # what is open already may still hold a last picture
        if self._file is not None and inode == self._inode:
            return
        self.close()
        try:
            self._file = os.open(self.path, os.O_RDONLY)
            self._inode, self._last = os.fstat(self._file).st_ino, 0
        except OSError:
            self._file = None

    def _read(self, number: int, at: int, size: int) -> Picture | None:
        assert self._file is not None
        head = os.pread(self._file, SLOT.size, at)
        if len(head) == SLOT.size and SLOT.unpack(head)[0] == number:
            _, length, crc = SLOT.unpack(head)
            data = os.pread(self._file, min(length, size - SLOT.size), at + SLOT.size)
            again = os.pread(self._file, SLOT.size, at)
            posted = decode_picture(data) if again == head and zlib.crc32(data) == crc else None
            if posted is not None:
                self.received += 1
                return posted.picture
        self.not_understood += 1
        return None

    @staticmethod
    def _on_clock(picture: Picture, now: float) -> Picture:
        return picture if 0.0 <= now - picture.time < _SAME_CLOCK else replace(picture, time=now)
