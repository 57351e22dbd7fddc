"""MCAP files whose chunks close when their writer says so, so that little is lost when the process dies."""

from __future__ import annotations

import struct
import zlib
from collections import Counter, defaultdict
from collections.abc import Mapping
from typing import Any, Protocol

from finssim.mcap_repair import MAGIC

__all__ = ["McapWriter", "RawFile"]

MESSAGE = struct.Struct("<BQHIQQ")
"""Kind 5, length of what follows, channel, sequence, log time and publish time [ns]."""

COMPRESSION = "lz4"


class RawFile(Protocol):
    """What is written to: a file opened without a buffer."""

    def write(self, data: memoryview, /) -> int | None:
        """Take some of the bytes; returns how many."""


class McapWriter:
    """One file: metadata and attachments at once, messages in chunks that `close_chunk` ends (MCAP specification 0).

    The writer of the `mcap` package closes a chunk by its size alone; here time has to. Its records are used for
    everything that is rare.
    """

    def __init__(self, file: RawFile, *, profile: str = "ros2", library: str = "finssim") -> None:
        from mcap.records import Header

        self._file = file
        self._at = 0
        self._schemas: dict[str, Any] = {}
        self._channels: dict[int, Any] = {}
        self._counts: Counter[int] = Counter()
        self._spans: list[tuple[int, int]] = []
        self._indexes: dict[str, list[Any]] = {"chunk": [], "attachment": [], "metadata": []}
        self._open_chunk()
        self._put(MAGIC + _bytes(Header(profile=profile, library=library)))

    @property
    def pending(self) -> int:
        """Bytes in the open chunk."""
        return len(self._chunk)

    @property
    def written(self) -> int:
        """Bytes of the whole records in the file."""
        return self._at

    @property
    def messages(self) -> int:
        """Messages in the file and in the open chunk."""
        return sum(self._counts.values())

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write a table of words."""
        from mcap.records import Metadata, MetadataIndex

        at = self._at
        self._put(_bytes(Metadata(name=name, metadata=dict(values))))
        self._indexes["metadata"].append(MetadataIndex(offset=at, length=self._at - at, name=name))

    def attachment(self, name: str, media_type: str, data: bytes, time: int = 0) -> None:
        """Write a file into the file; `time` in ns."""
        from mcap.records import Attachment, AttachmentIndex

        at, told = self._at, {"log_time": time, "create_time": time, "name": name, "media_type": media_type}
        self._put(_bytes(Attachment(data=data, **told)))
        self._indexes["attachment"].append(
            AttachmentIndex(offset=at, length=self._at - at, data_size=len(data), **told)
        )

    def channel(self, topic: str, kind: str, definition: str, qos: str) -> int:
        """Announce a topic of ROS 2 messages in CDR; returns its number.

        Args:
            topic: Name of the topic.
            kind: Type, such as `sensor_msgs/msg/Imu`.
            definition: Text of the type and of all that it uses, as in a rosbag.
            qos: Offered profiles as rosbag2 keeps them (`record_topics.offered_qos`).
        """
        from mcap.records import Channel, Schema

        if kind not in self._schemas:
            number = len(self._schemas) + 1
            self._schemas[kind] = Schema(id=number, name=kind, encoding="ros2msg", data=definition.encode())
            self._chunk += _bytes(self._schemas[kind])
        number = len(self._channels) + 1
        self._channels[number] = Channel(
            id=number,
            schema_id=self._schemas[kind].id,
            topic=topic,
            message_encoding="cdr",
            metadata={"offered_qos_profiles": qos},
        )
        self._chunk += _bytes(self._channels[number])
        return number

    def message(self, channel: int, time: int, data: bytes) -> None:
        """Add a message to the open chunk; `time` in ns."""
        self._places[channel].append((time, len(self._chunk)))
        self._chunk += MESSAGE.pack(
            5, 22 + len(data), channel, self._counts[channel] & 0xFFFFFFFF, time, time
        )
        self._chunk += data
        self._counts[channel] += 1

    def close_chunk(self) -> None:
        """Write the open chunk and its index; nothing if it is empty."""
        import lz4.frame
        from mcap.records import Chunk, ChunkIndex, MessageIndex

        if not self._chunk:
            return
        times = [time for places in self._places.values() for time, _ in places]
        first, last = (min(times), max(times)) if times else (0, 0)
        packed = lz4.frame.compress(bytes(self._chunk))
        told = {"message_start_time": first, "message_end_time": last, "compression": COMPRESSION}
        told["uncompressed_size"] = len(self._chunk)
        chunk = _bytes(Chunk(data=packed, uncompressed_crc=zlib.crc32(self._chunk), **told))
        at, offsets, indexes = self._at, {}, b""
        for channel, places in self._places.items():
            offsets[channel] = at + len(chunk) + len(indexes)
            indexes += _bytes(MessageIndex(channel_id=channel, records=places))
        self._put(chunk + indexes)
        self._indexes["chunk"].append(
            ChunkIndex(
                chunk_start_offset=at,
                chunk_length=len(chunk),
                message_index_offsets=offsets,
                message_index_length=len(indexes),
                compressed_size=len(packed),
                **told,
            )
        )
        self._spans += [(first, last)] if times else []
        self._open_chunk()

    def finish(self) -> None:
        """Close the last chunk and write the summary by which readers find their way."""
        from mcap.records import DataEnd, Footer, SummaryOffset

        self.close_chunk()
        self._put(_bytes(DataEnd(data_section_crc=0)))
        start, summary, offsets = self._at, b"", b""
        for kind, records in self._summary().items():
            group = b"".join(map(_bytes, records))
            place = SummaryOffset(
                group_opcode=kind, group_start=start + len(summary), group_length=len(group)
            )
            offsets += _bytes(place) if group else b""
            summary += group
        listed = start + len(summary)
        summary += offsets
        crc = zlib.crc32(struct.pack("<BQQQ", 2, 20, start, listed), zlib.crc32(summary))
        footer = Footer(summary_start=start, summary_offset_start=listed, summary_crc=crc)
        self._put(summary + _bytes(footer) + MAGIC)

    def _summary(self) -> dict[Any, list[Any]]:
        """Records of the summary by their kind."""
        from mcap.opcode import Opcode
        from mcap.records import Statistics

        statistics = Statistics(
            message_count=self.messages,
            schema_count=len(self._schemas),
            channel_count=len(self._channels),
            attachment_count=len(self._indexes["attachment"]),
            metadata_count=len(self._indexes["metadata"]),
            chunk_count=len(self._indexes["chunk"]),
            message_start_time=min((first for first, _ in self._spans), default=0),
            message_end_time=max((last for _, last in self._spans), default=0),
            channel_message_counts=dict(self._counts),
        )
        return {
            Opcode.SCHEMA: list(self._schemas.values()),
            Opcode.CHANNEL: list(self._channels.values()),
            Opcode.STATISTICS: [statistics],
            Opcode.CHUNK_INDEX: self._indexes["chunk"],
            Opcode.ATTACHMENT_INDEX: self._indexes["attachment"],
            Opcode.METADATA_INDEX: self._indexes["metadata"],
        }

    def _open_chunk(self) -> None:
        self._chunk = bytearray()
        self._places: dict[int, list[tuple[int, int]]] = defaultdict(list)

    def _put(self, data: bytes) -> None:
        """Write all of it; counted only when the system has taken it whole."""
        view = memoryview(data)
        while view:
            view = view[self._file.write(view) or 0 :]
        self._at += len(data)


def _bytes(record: Any) -> bytes:
    from mcap.data_stream import RecordBuilder

    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())
