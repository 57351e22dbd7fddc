"""The thread that puts a record on disk: the control loop never waits for it, and a full disk never stops it."""

from __future__ import annotations

import logging
import os
import threading
from collections import deque
from collections.abc import Callable
from pathlib import Path

from finssim.files import OutputError, atomic_write, refuse_unwritable
from finssim.mcap_repair import END
from finssim.robot.mcap_writer import McapWriter

__all__ = ["RecordSink"]

Payload = bytes | Callable[[], "bytes | None"]

LOG = logging.getLogger(__name__)

LARGEST_CHUNK = 1 << 20
"""A chunk is closed when it has grown to so many bytes."""

DISORDER = 1_000_000_000
"""A message that is late by less is recorded at the time of the one before; later ones mean a clock set back [ns]."""

POLLS = 5
"""The queue is looked at so many times a chunk."""


class RecordSink:
    """A file that messages are put into from one thread and written by another.

    A chunk is written and flushed to disk when its messages span `chunk_seconds`, or lie in it that long: a process
    that is killed loses no more than that and a fifth of it. Where the system refuses to write, the file is closed
    after its last whole chunk, `problem` says why in a sentence, and what comes later is dropped and counted.
    """

    def __init__(
        self,
        path: Path,
        announce: Callable[[McapWriter, str], int],
        *,
        chunk_seconds: float = 0.5,
        longest_queue: int = 64 << 20,
    ) -> None:
        """Args:
            path: File to make; an existing one is refused.
            announce: Makes the channel of a key when its first message is written, and returns its number.
            chunk_seconds: [s]
            longest_queue: Bytes that may wait for the disk; more are dropped.

        Raises:
            OutputError: The file exists or cannot be made.
        """
        if os.path.lexists(path):
            raise OutputError(
                f"cannot write {path}: it exists, and records are never replaced: give a new name"
            )
        refuse_unwritable(atomic_write(path))
        path.parent.mkdir(parents=True, exist_ok=True)
        self.path = path
        self.problem = ""
        """Why recording stopped; empty while it goes on."""
        self.dropped = 0
        """Messages that were not recorded."""
        self._file = open(path, "xb", buffering=0)
        self.writer = McapWriter(self._file)
        """For metadata and attachments, before `start`."""
        self._announce = announce
        self._channels: dict[str, int] = {}
        self._chunk_seconds, self._longest_queue = chunk_seconds, longest_queue
        self._queue: deque[tuple[str, int, Payload, int]] = deque()
        self._put_bytes = self._taken_bytes = 0  # each written by one thread only
        self._newest = 0
        self._opened: int | None = None
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"recorder {path.name}", daemon=True)

    def start(self) -> None:
        """Begin to write."""
        os.fsync(self._file.fileno())
        self._thread.start()

    def put(self, key: str, time: int, payload: Payload, size: int) -> None:
        """Queue a message.

        Args:
            key: Of its channel.
            time: [ns]
            payload: Its bytes, or what makes them, called on the writing thread; None where it cannot.
            size: About how many bytes wait.
        """
        if self.problem or self._put_bytes - self._taken_bytes > self._longest_queue:
            self.dropped += 1
            return
        # Readers of a file without an index want its messages in order; their own stamps keep when things were.
        if 0 < self._newest - time < DISORDER:
            time = self._newest
        self._newest = time
        self._put_bytes += size
        self._queue.append((key, time, payload, size))

    def close(self) -> None:
        """Write what waits, and the summary; returns when it is on disk."""
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        try:
            idle = 0
            while not self._closing.wait(self._chunk_seconds / POLLS):
                self._drain()
                idle = idle + 1 if self.writer.pending else 0
                if idle >= POLLS:
                    self._close_chunk()
                    idle = 0
            self._drain()
            self.writer.finish()
            os.fsync(self._file.fileno())
        except Exception as error:  # whatever it is, it must be told, and must not stop the vehicle's control
            self._stop(error)
        finally:
            self._file.close()

    def _drain(self) -> None:
        while self._queue:
            key, time, payload, size = self._queue.popleft()
            self._taken_bytes += size
            data = payload() if callable(payload) else payload
            if data is None:
                self.dropped += 1
                continue
            if key not in self._channels:
                self._channels[key] = self._announce(self.writer, key)
            self._opened = time if self._opened is None else self._opened
            self.writer.message(self._channels[key], time, data)
            if time - self._opened >= self._chunk_seconds * 1e9 or self.writer.pending >= LARGEST_CHUNK:
                self._close_chunk()

    def _close_chunk(self) -> None:
        self.writer.close_chunk()
        self._opened = None
        os.fsync(self._file.fileno())

    def _stop(self, error: Exception) -> None:
        """Give up: the file ends after its last whole record, if the system lets it."""
        reason = os.strerror(error.errno) if isinstance(error, OSError) and error.errno else str(error)
        self.problem = (
            f"{self.path}: recording stopped: {reason}: what was recorded until then is kept; "
            "free some space or record elsewhere"
        )
        self.dropped += len(self._queue)
        self._queue.clear()
        LOG.warning(self.problem)
        try:
            self._file.truncate(self.writer.written)
            self._file.seek(0, os.SEEK_END)
            self._file.write(END)
        except OSError:
            # No room even for that: readers find the last whole record themselves.
            LOG.warning("%s: ends without a summary: `finssim record repair` writes one", self.path)
