"""Records read back, finished or cut: what they are about, their messages in time order; cut ones made whole."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from finssim.files import atomic_write
from finssim.mcap_repair import MAGIC, whole_mcap
from finssim.robot.record_messages import METADATA, RecordError, types

__all__ = ["Entry", "Record", "open_record", "refuse_foreign", "repair_record", "write_whole"]


def repair(
    file: Path,
    *,
    out: Path | None = None,
) -> None:
    """Write a whole record of all that can be read of a cut or damaged one; FILE itself stays as it is.

    Example: finssim record repair run.mcap --out whole.mcap

    Args:
        file (FILE): Record of a run (.mcap).
        out (FILE): File to write; FILE-repaired.mcap if not given.
    """
    target = out or file.with_name(f"{file.stem}-repaired.mcap")
    for note in repair_record(file, target) or ["nothing is damaged"]:
        print(note)
    print(f"wrote {target}")


def repair_record(path: Path, out: Path) -> list[str]:
    """Write a whole record of all that can be read of a cut or damaged one.

    Args:
        path: The record; it stays as it is.
        out: File to write.

    Returns:
        What was found damaged, one sentence each; none of a record that is well.

    Raises:
        RecordError: Not an MCAP file, or the same as `out`.
        OutputError: `out` cannot be written.
    """
    refuse_foreign(path)
    if out.resolve() == path.resolve():
        raise RecordError(f"{path}: cannot be repaired into itself: give another file with --out")
    notes: list[str] = []
    with whole_mcap(path, notes) as whole, atomic_write(out) as temporary:
        write_whole(whole, temporary, notes)
    return notes


def refuse_foreign(path: Path) -> None:
    """Refuse what is no MCAP file.

    Raises:
        RecordError: It is none, or cannot be read.
    """
    try:
        with path.open("rb") as file:
            begins = file.read(len(MAGIC))
    except OSError as error:
        raise RecordError(f"{path}: cannot be read: {error.strerror or error}") from None
    if begins != MAGIC:
        raise RecordError(f"{path}: is no MCAP file: expected a record that FinsSim or rosbag2 wrote")


def write_whole(source: Path, target: Path, notes: list[str]) -> None:
    """Copy every record of a file, as far as it can be read, into one with an index."""
    from mcap import records
    from mcap.stream_reader import StreamReader
    from mcap.writer import CompressionType, Writer

    schemas, channels, started = {0: 0}, dict[int, int](), False  # numbered anew
    with source.open("rb") as given, target.open("wb") as made:
        writer = Writer(made, compression=CompressionType.LZ4)
        try:
            for one in StreamReader(given, validate_crcs=True).records:
                match one:
                    case records.Header():
                        writer.start(one.profile, one.library)
                        started = True
                    case records.Schema() if one.id not in schemas:
                        schemas[one.id] = writer.register_schema(one.name, one.encoding, one.data)
                    case records.Channel() if one.id not in channels:
                        kind, schema = one.message_encoding, schemas[one.schema_id]
                        channels[one.id] = writer.register_channel(one.topic, kind, schema, one.metadata)
                    case records.Message() if one.channel_id in channels:
                        channel = channels[one.channel_id]
                        writer.add_message(channel, one.log_time, one.data, one.publish_time, one.sequence)
                    case records.Metadata():
                        writer.add_metadata(one.name, one.metadata)
                    case records.Attachment():
                        writer.add_attachment(
                            one.create_time, one.log_time, one.name, one.media_type, one.data
                        )
        except Exception as error:  # damage shows in whatever layer meets it
            notes.append(f"{source.name} is damaged and was read up to there: {str(error).splitlines()[0]}")
        if not started:
            writer.start()
        writer.finish()


class Entry(NamedTuple):
    """One message of a record."""

    time: float
    """When it was recorded, robot's clock [s]."""
    topic: str
    kind: str
    """Its type, such as `sensor_msgs/msg/Imu`."""
    message: Any
    """With the type's fields."""


class Record:
    """An open record; see `open_record`."""

    def __init__(self, path: Path, reader: Any, notes: tuple[str, ...]) -> None:
        summary = reader.get_summary()
        self._reader = reader
        self.path = path
        self.notes = notes
        """What was found damaged, one sentence each."""
        self.metadata: dict[str, str] = next(
            (m.metadata for m in reader.iter_metadata() if m.name == METADATA), {}
        )
        """What the recorder was told; empty of a file that FinsSim did not write."""
        self.files: dict[str, str] = {
            a.name: a.data.decode("utf-8", errors="replace") for a in reader.iter_attachments()
        }
        """Name -> text of the files kept in it."""
        self.topics: dict[str, str] = {
            c.topic: summary.schemas[c.schema_id].name for c in summary.channels.values()
        }
        """Topic -> type."""
        self._epoch = round(float(self.metadata.get("epoch", 0.0)) * 1e9)

    @property
    def cut(self) -> bool:
        """Whether it has no proper end, as after a crash or while it is being written."""
        return bool(self.notes)

    def topic(self, name: str) -> str:
        """The topic that ends in `/name`, such as `odom`; the name itself if there is none."""
        return next((topic for topic in sorted(self.topics) if topic.endswith(f"/{name}")), name)

    def sizes(self) -> Iterator[tuple[float, str, int]]:
        """Time [s], topic and size [bytes] of each message, none of them decoded."""
        for _, channel, message in self._reader.iter_messages():
            yield self._seconds(message.log_time), channel.topic, len(message.data)

    def messages(self, topics: Collection[str] | None = None, start: float | None = None) -> Iterator[Entry]:
        """Messages in time order.

        Args:
            topics: Names, or their last parts, such as `odom`; all topics if None.
            start: Earlier ones are passed over [s].

        Raises:
            RecordError: There is no such topic, or one of a type that cannot be decoded.
        """
        wanted = None if topics is None else [self._known(self.topic(topic)) for topic in topics]
        for schema, channel, message in self._reader.iter_messages(topics=wanted):
            time = self._seconds(message.log_time)
            if start is not None and time < start:
                continue
            if schema.name not in types().types:
                raise RecordError(
                    f"{self.path}: {channel.topic} is of the unknown type {schema.name}: leave it out"
                )
            try:
                decoded = types().deserialize_cdr(message.data, schema.name)
            except Exception as error:  # rosbags has no class of its own for what a message's bytes break
                raise RecordError(
                    f"{self.path}: a message of {channel.topic} at {time:.3f} s is no {schema.name}: {error}"
                ) from None
            yield Entry(time, channel.topic, schema.name, decoded)

    def _known(self, topic: str) -> str:
        if topic not in self.topics:
            raise RecordError(f"{self.path}: no topic '{topic}'; it has {', '.join(sorted(self.topics))}")
        return topic

    def _seconds(self, ns: int) -> float:
        return (ns - self._epoch) * 1e-9


@contextmanager
def open_record(path: Path | str) -> Iterator[Record]:
    """Open a record; one that was cut is read up to the cut.

    Raises:
        RecordError: Not an MCAP file, or one without messages.
    """
    from mcap.reader import make_reader

    path = Path(path)
    refuse_foreign(path)
    notes: list[str] = []
    with ExitStack() as stack:
        whole = stack.enter_context(whole_mcap(path, notes))
        file = stack.enter_context(whole.open("rb"))
        if not _indexed(file):
            copy = Path(stack.enter_context(TemporaryDirectory())) / path.name
            write_whole(whole, copy, notes)
            file = stack.enter_context(copy.open("rb"))
        yield Record(path, make_reader(file), tuple(notes))


def _indexed(file: Any) -> bool:
    """Whether the file has a summary that can be read."""
    from mcap.reader import make_reader

    try:
        return make_reader(file).get_summary() is not None
    except Exception:  # a damaged summary breaks in whatever layer reads it; the data are read without it
        return False
