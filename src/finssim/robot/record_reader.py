"""Reader of records, complete or truncated: description, messages in time order, and repair.

It implements `finssim record info`, `record repair` and `play`.
"""

from __future__ import annotations

import json
import math
import sys
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np

from finssim.core.files import atomic_write
from finssim.core.mcap_files import MAGIC, intact_mcap, write_intact
from finssim.core.yaml_file import json_value
from finssim.robot.record_messages import METADATA, RecordError, types

__all__ = ["RecordedMessage", "Record", "describe_record", "events_of", "open_record", "repair_record"]


def repair(file: Path, *, out: Path | None = None, as_json: bool = False) -> None:
    """Write a complete record from the readable part of a truncated or damaged one; FILE is not changed.

    Example: finssim record repair run.mcap --out whole.mcap

    Args:
        file (FILE): Record of a run (.mcap).
        out (FILE): File to write; FILE-repaired.mcap if not given.
        as_json: Print one JSON object instead of sentences.
    """
    target = out or file.with_name(f"{file.stem}-repaired.mcap")
    notes = repair_record(file, target)
    if as_json:
        print(json.dumps({"out": str(target), "damage": notes}))
        return
    for note in notes or ["nothing is damaged"]:
        print(note)
    print(f"wrote {target}")


def repair_record(path: Path, out: Path) -> list[str]:
    """Write a complete record with everything that can be read of a truncated or damaged one.

    Args:
        path: The record, which is not changed.
        out: File to write.

    Returns:
        Damage, one sentence each; empty for an intact record.

    Raises:
        RecordError: It is not an MCAP file, or the same as `out`.
        OutputError: `out` cannot be written.
    """
    refuse_foreign(path)
    if out.resolve() == path.resolve():
        raise RecordError(f"{path}: cannot be repaired into itself: give another file with --out")
    notes: list[str] = []
    with atomic_write(out) as temporary:
        write_intact(path, temporary, notes)
    return notes


def refuse_foreign(path: Path) -> None:
    """Refuse a file that is not an MCAP file.

    Raises:
        RecordError: It is not an MCAP file, or cannot be read.
    """
    try:
        with path.open("rb") as file:
            begins = file.read(len(MAGIC))
    except OSError as error:
        raise RecordError(f"{path}: cannot be read: {error.strerror or error}") from None
    if begins != MAGIC:
        raise RecordError(f"{path}: is no MCAP file: expected a record that FinsSim or rosbag2 wrote")


class RecordedMessage(NamedTuple):
    """One message of a record."""

    time: float
    """Time of recording, robot's clock [s]."""
    topic: str
    kind: str
    """Its type, such as `sensor_msgs/msg/Imu`."""
    message: Any
    """Message with the type's fields."""


NO_TYPE = "no type"
"""Type of a topic whose channel has no schema."""


class Record:
    """An open record; see `open_record`."""

    def __init__(self, path: Path, reader: Any, notes: tuple[str, ...]) -> None:
        summary = reader.get_summary()
        self._reader = reader
        self.path = path
        self.notes = notes
        """Damage, one sentence each."""
        self.metadata: dict[str, str] = next(
            (m.metadata for m in reader.iter_metadata() if m.name == METADATA), {}
        )
        """Metadata given to the recorder; empty for a file that FinsSim did not write."""
        self.files: dict[str, str] = {
            a.name: a.data.decode("utf-8", errors="replace") for a in reader.iter_attachments()
        }
        """Name -> text of the attached files."""
        self.topics: dict[str, str] = {
            c.topic: summary.schemas[c.schema_id].name if c.schema_id else NO_TYPE
            for c in summary.channels.values()
        }
        """Topic -> type."""
        self._epoch = round(float(self.metadata.get("epoch", 0.0)) * 1e9)

    @property
    def cut(self) -> bool:
        """True if the file has no proper end, as after a crash or during recording."""
        return bool(self.notes)

    def topic(self, name: str) -> str:
        """Return the topic that ends in `/name`, such as `odom`; the name itself if there is none."""
        return next((topic for topic in sorted(self.topics) if topic.endswith(f"/{name}")), name)

    def sizes(self) -> Iterator[tuple[float, str, int]]:
        """Yield time [s], topic and size [bytes] of each message, without decoding it."""
        for _, channel, message in self._reader.iter_messages():
            yield self._seconds(message.log_time), channel.topic, len(message.data)

    def messages(
        self, topics: Collection[str] | None = None, start: float | None = None
    ) -> Iterator[RecordedMessage]:
        """Yield messages in time order.

        Args:
            topics: Names, or their last parts, such as `odom`; all that have a type if None.
            start: Time before which messages are skipped [s].

        Raises:
            RecordError: There is no such topic, or its type cannot be decoded.
        """
        if topics is None:
            topics = [topic for topic, kind in self.topics.items() if kind != NO_TYPE]
        selected = [self._known(self.topic(topic)) for topic in topics]
        if untyped := [topic for topic in selected if self.topics[topic] == NO_TYPE]:
            raise RecordError(f"{self.path}: {untyped[0]} has no type in the file (schema 0): omit it")
        for schema, channel, message in self._reader.iter_messages(topics=selected):
            time = self._seconds(message.log_time)
            if start is not None and time < start:
                continue
            if schema.name not in types().types:
                raise RecordError(
                    f"{self.path}: {channel.topic} is of the unknown type {schema.name}: omit it"
                )
            try:
                decoded = types().deserialize_cdr(message.data, schema.name)
            except Exception as error:  # rosbags has no exception class for errors in a message's bytes
                raise RecordError(
                    f"{self.path}: a message of {channel.topic} at {time:.3f} s is no {schema.name}: {error}"
                ) from None
            yield RecordedMessage(time, channel.topic, schema.name, decoded)

    def _known(self, topic: str) -> str:
        if topic not in self.topics:
            raise RecordError(f"{self.path}: no topic '{topic}'; it has {', '.join(sorted(self.topics))}")
        return topic

    def _seconds(self, ns: int) -> float:
        return (ns - self._epoch) * 1e-9


@contextmanager
def open_record(path: Path | str) -> Iterator[Record]:
    """Open a record; a truncated one is read up to its damaged part.

    Raises:
        RecordError: It is not an MCAP file, or has no messages.
    """
    from mcap.reader import make_reader

    path = Path(path)
    refuse_foreign(path)
    notes: list[str] = []
    with intact_mcap(path, notes) as complete, complete.open("rb") as file:
        yield Record(path, make_reader(file), tuple(notes))


# Statistics of a record: topics, rates, gaps, events.


GAP = 5.0
"""Ratio to the usual interval of a topic from which a pause is a gap; pauses below `SHORTEST_GAP` are not gaps."""

SHORTEST_GAP = 0.1
"""Shortest gap [s]."""


def figures_of(kind: str, times: Sequence[float], size: int) -> dict[str, Any]:
    """Return the statistics of one topic.

    Args:
        kind: Its type.
        times: Times of its messages [s], (n,).
        size: Total size of its messages [bytes].
    """
    steps = np.diff(times)
    usual = np.sort(steps)[len(steps) // 2] if len(steps) >= GAP else math.inf
    gaps = steps[steps > max(GAP * usual, SHORTEST_GAP)]
    span = times[-1] - times[0] if times else 0.0
    return {
        "type": kind,
        "messages": len(times),
        "rate_hz": round((len(times) - 1) / span, 3) if span > 0.0 else 0.0,
        "bytes": size,
        "gaps": len(gaps),
        "longest_gap_s": round(float(gaps.max(initial=0.0)), 3),
    }


def describe_record(record: Record) -> dict[str, Any]:
    """Return duration, vehicle, topics, events and damage, as plain values."""
    times: dict[str, list[float]] = {topic: [] for topic in sorted(record.topics)}
    sizes = Counter[str]()
    for at, topic, size in record.sizes():
        times[topic].append(at)
        sizes[topic] += size
    ends = [at for of_topic in times.values() for at in (of_topic[:1] + of_topic[-1:])]
    start, end = min(ends, default=0.0), max(ends, default=0.0)
    return {
        "file": str(record.path),
        "cut": record.cut,
        "notes": list(record.notes),
        "start_s": start,
        "duration_s": end - start,
        "messages": sum(map(len, times.values())),
        "metadata": record.metadata,
        "files": sorted(record.files),
        "topics": {topic: figures_of(record.topics[topic], x, sizes[topic]) for topic, x in times.items()},
        "events": events_of(record),
    }


def events_of(record: Record) -> list[dict[str, Any]]:
    """Return the events in order: time [s], kind, text; texts that are not events of FinsSim are skipped."""
    topic = record.topic("events")
    events = []
    for entry in record.messages([topic]) if topic in record.topics else ():
        try:
            event = json_value(entry.message.data, RecordError, "event")
        except ValueError:
            continue
        if isinstance(event, dict) and "kind" in event:
            events.append(
                {"time": entry.time, "kind": str(event["kind"]), "text": str(event.get("text", ""))}
            )
    return events


def plain(value: Any) -> Any:
    """Return a message as dictionaries, lists and numbers; pictures as their size."""
    if hasattr(value, "__dataclass_fields__"):
        names = [name for name in value.__dataclass_fields__ if not name.startswith("_")]
        return {name: plain(getattr(value, name)) for name in names}
    if isinstance(value, np.ndarray):
        return f"{value.size} bytes" if value.dtype == np.uint8 else [plain(x) for x in value.tolist()]
    if isinstance(value, (list, tuple)):
        return [plain(x) for x in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None  # JSON has no such numbers
    return value


def json_line(entry: RecordedMessage) -> str:
    """Return a message as one line of JSON."""
    line = {"time": entry.time, "topic": entry.topic, "type": entry.kind, "message": plain(entry.message)}
    return json.dumps(line)


EVENTS_SHOWN = 20


def info(path: Path, *, as_json: bool = False) -> None:
    """Describe a record: vehicle, duration [s], topics with rates [Hz] and gaps [s], events, damage.

    Example: finssim record info run.mcap

    Args:
        path (FILE): Record of a run (.mcap).
        as_json: Print one JSON object instead of tables.

    Raises:
        RecordError: Not a record.
    """
    with open_record(path) as record:
        description = describe_record(record)
    if as_json:
        print(json.dumps(description, indent=2))
        return
    for line in _lines(description):
        print(line)


def play_record(
    path: Path,
    *,
    topics: Annotated[Sequence[str] | None, ","] = None,
    start: Annotated[float, (0.0, None)] = 0.0,
) -> None:
    """Print the messages of a record in order, one JSON object per line [s, SI units]; pictures as their size.

    Args:
        path (FILE): Record of a run (.mcap).
        topics (NAMES): Topics to print, separated by commas: odom,thruster_cmd.
        start: Offset from the start of the record [s].

    Raises:
        RecordError: It is not a record, or there is no such topic.
    """
    with open_record(path) as record:
        for note in record.notes:
            print(note, file=sys.stderr)
        for topic, kind in record.topics.items():
            if kind == NO_TYPE and topics is None:
                print(f"{topic} has no type in the file (schema 0) and is left out", file=sys.stderr)
        first = next((at for at, _, _ in record.sizes()), 0.0) + start if start else None
        for entry in record.messages(topics, first):
            print(json_line(entry), flush=True)


def _lines(description: dict[str, Any]) -> list[str]:
    about = description["metadata"]
    lines = [
        f"{description['file']}: {description['duration_s']:.2f} s, {description['messages']} messages"
        + (f", vehicle {about['vehicle']} ({about['vehicle_sha256'][:12]})" if "vehicle" in about else "")
    ]
    lines += [f"  {note}" for note in description["notes"]]
    remaining = {k: v for k, v in about.items() if k not in ("vehicle", "vehicle_sha256", "provenance")}
    lines += [
        f"  {key}: {value if len(value) <= 90 else value[:90] + ' ...'}" for key, value in remaining.items()
    ]
    lines += [f"  keeps {', '.join(description['files'])}"] if description["files"] else []
    lines.append(f"{'topic':36}{'messages':>9}{'rate [Hz]':>11}{'gaps':>6}{'longest [s]':>13}  type")
    for topic, topic_info in description["topics"].items():
        lines.append(
            f"{topic:36}{topic_info['messages']:9}{topic_info['rate_hz']:11.2f}{topic_info['gaps']:6}"
            f"{topic_info['longest_gap_s']:13.2f}  {topic_info['type']}"
        )
    events = description["events"]
    start = description["start_s"]
    lines += [f"{e['time'] - start:10.3f} s  {e['kind']}: {e['text']}" for e in events[:EVENTS_SHOWN]]
    if len(events) > EVENTS_SHOWN:
        lines.append(f"and {len(events) - EVENTS_SHOWN} more events: finssim play FILE --topics events")
    return lines
