"""Messages longer than a datagram: cut into numbered fragments, and put together again with bounded memory.

magic "FSPF", message u32, index u16, count u16, CRC-32 of the whole message u32; then a piece of it.
All little endian; every piece but the last has the same length.
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter, OrderedDict

__all__ = ["LONGEST_FRAGMENT", "Assembler", "fragments"]

_HEAD = struct.Struct("<4sIHHI")
_MAGIC = b"FSPF"
LONGEST_FRAGMENT = 60_000
"""Bytes of the message in a datagram: what loopback takes whole. Elsewhere 1400 keep below a network's MTU."""
MOST_FRAGMENTS = 4096
UNFINISHED = 4
"""Messages that may be under way at once; an older one is given up."""
MOST_BYTES = 32 * 2**20
"""That unfinished messages may hold together."""


def fragments(data: bytes, number: int, size: int = LONGEST_FRAGMENT) -> list[bytes]:
    """Datagrams that carry a message.

    Args:
        data: The message.
        number: Of the message, counting up; the next one's is different.
        size: Bytes of the message in each.
    """
    pieces = [data[i : i + size] for i in range(0, len(data), size)] or [b""]
    crc = zlib.crc32(data)
    return [_HEAD.pack(_MAGIC, number % 2**32, i, len(pieces), crc) + piece for i, piece in enumerate(pieces)]


class Assembler:
    """Takes fragments in any order, some twice and some never; gives whole messages. Never raises."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        """whole, unknown (no fragment), incomplete (given up), corrupt (CRC)."""
        self._parts: OrderedDict[tuple[int, int, int], dict[int, bytes]] = OrderedDict()
        self._held = 0
        self._done: OrderedDict[tuple[int, int, int], None] = OrderedDict()

    def add(self, datagram: bytes) -> bytes | None:
        """The message that this fragment completes, if it does."""
        if len(datagram) < _HEAD.size:
            self.counts["unknown"] += 1
            return None
        magic, number, index, count, crc = _HEAD.unpack_from(datagram)
        if magic != _MAGIC or not index < count <= MOST_FRAGMENTS:
            self.counts["unknown"] += 1
            return None
        key = (number, count, crc)
        if key in self._done:
            return None
        parts = self._parts.setdefault(key, {})
        if index not in parts:
            parts[index] = datagram[_HEAD.size :]
            self._held += len(parts[index])
        if len(parts) < count:
            self._give_up()
            return None
        del self._parts[key]
        self._held -= sum(map(len, parts.values()))
        return self._whole(key, b"".join(parts[i] for i in range(count)))

    def _whole(self, key: tuple[int, int, int], data: bytes) -> bytes | None:
        if zlib.crc32(data) != key[2]:
            self.counts["corrupt"] += 1
            return None
        self.counts["whole"] += 1
        self._done[key] = None
        if len(self._done) > UNFINISHED:
            self._done.popitem(last=False)
        return data

    def _give_up(self) -> None:
        while len(self._parts) > UNFINISHED or self._held > MOST_BYTES:
            _, parts = self._parts.popitem(last=False)
            self._held -= sum(map(len, parts.values()))
            self.counts["incomplete"] += 1
