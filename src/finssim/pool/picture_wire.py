"""The camera's end of the picture wire: over UDP to one robot, or into shared memory."""

from __future__ import annotations

import fcntl
import os
import socket
import struct
import tempfile
import zlib
from pathlib import Path
from typing import Protocol

from finssim.robot.link.frames import LinkError
from finssim.robot.messages import Picture
from finssim.robot.pictures import (
    LONGEST_FRAGMENT,
    MEMORY_HEAD,
    MEMORY_MAGIC,
    MEMORY_SLOT,
    MEMORY_VERSION,
    encode_picture,
    fragments,
    memory_path,
)

__all__ = ["PictureSink", "SharedMemorySender", "UdpSender"]

SLOTS = 8
SLOT_BYTES = 2 * 2**20
"""A raw picture of 1920 x 1080 fits."""


class PictureSink(Protocol):
    """Takes pictures for a robot."""

    def send(self, picture: Picture, now: float) -> None:
        """Hand a picture on; `now` and `picture.time` are on this machine's `time.monotonic` [s]."""

    def close(self) -> None:
        """Let go of the wire."""


class UdpSender:
    """Datagrams to one robot: JPEG of quality 90, or the tags alone in one of them."""

    def __init__(
        self, bind: tuple[str, int], peer: tuple[str, int], *, fragment: int = LONGEST_FRAGMENT
    ) -> None:
        """
        Args:
            bind: Address and port of this end; port 0 takes a free one (see `address`).
            peer: Of the robot.
            fragment: Bytes of a picture in a datagram; 1400 for a network, more only on this machine.

        Raises:
            LinkError: The address cannot be bound.
        """
        self.sent = self.lost = 0
        self._peer, self._fragment = peer, fragment
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4 * 2**20)
        try:
            self._socket.bind(bind)
        except OSError as problem:
            self._socket.close()
            raise LinkError(
                f"cannot bind {bind[0]}:{bind[1]} for pictures ({problem.strerror or problem}): "
                "end the program that has it, or give another port"
            ) from None
        self.address: tuple[str, int] = self._socket.getsockname()

    def send(self, picture: Picture, now: float) -> None:
        """Send a picture; one that cannot leave is counted and forgotten."""
        data = encode_picture(picture, late=max(now - picture.time, 0.0), compress=True)
        try:
            for datagram in fragments(data, self.sent + self.lost, self._fragment):
                self._socket.sendto(datagram, self._peer)
            self.sent += 1
        except OSError:
            self.lost += 1

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class SharedMemorySender:
    """A ring in memory under a name: made anew at every start, taken away at the end.

    Its file is locked for as long as its writer lives: no other camera can take the name meanwhile.
    """

    def __init__(self, name: str, *, slots: int = SLOTS, slot_bytes: int = SLOT_BYTES) -> None:
        """
        Args:
            name: Letters, digits, - and _.
            slots: Pictures that it holds.
            slot_bytes: Longest picture [bytes].

        Raises:
            LinkError: It is not a plain name, another camera has it, or the memory cannot be had.
        """
        self.path = memory_path(name)
        self.sent = self.lost = 0
        self._slots, self._size = slots, slot_bytes
        if _taken(self.path):
            raise LinkError(f"shm:{name} belongs to a camera that is running: end it, or give another name")
        try:
            self._file = _ring(
                self.path,
                MEMORY_HEAD.pack(MEMORY_MAGIC, MEMORY_VERSION, slots, slot_bytes, 0),
                slots * slot_bytes,
            )
        except OSError as problem:
            raise LinkError(f"shared memory {self.path}: {problem.strerror}: free some or use udp") from None

    def send(self, picture: Picture, now: float) -> None:
        """Write a picture into the next slot; one that is too long, or finds no memory, is counted and forgotten."""
        data = encode_picture(picture, late=max(now - picture.time, 0.0))
        if len(data) > self._size - MEMORY_SLOT.size:
            self.lost += 1
            return
        number = self.sent + 1
        at = MEMORY_HEAD.size + (number - 1) % self._slots * self._size
        try:
            os.pwrite(self._file, bytes(MEMORY_SLOT.size), at)
            os.pwrite(self._file, data, at + MEMORY_SLOT.size)
            os.pwrite(self._file, MEMORY_SLOT.pack(number, len(data), zlib.crc32(data)), at)
            os.pwrite(self._file, struct.pack("<Q", number), MEMORY_HEAD.size - 8)
            self.sent = number
        except OSError:
            self.lost += 1

    def close(self) -> None:
        """Take the memory away, unless another camera has taken the name since."""
        try:
            if os.stat(self.path).st_ino == os.fstat(self._file).st_ino:
                os.unlink(self.path)
        except OSError:
            pass
        os.close(self._file)


def _taken(path: Path) -> bool:
    """Whether a camera that lives has the file. A lock ends with its process, however that ends."""
    try:
        file = os.open(path, os.O_RDONLY)
    except OSError:
        return False
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(file)
    return False


def _ring(path: Path, head: bytes, size: int) -> int:
    """A new file under the name, locked and empty but for its head; returns its descriptor."""
    file, temporary = tempfile.mkstemp(prefix=f".{path.name}-", dir=path.parent)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.truncate(file, len(head) + size)
        os.pwrite(file, head, 0)
        os.replace(temporary, path)
    except OSError:
        os.close(file)
        os.unlink(temporary)
        raise
    return file
