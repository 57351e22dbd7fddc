"""ROS 2 bags, sqlite3 or MCAP, and ROS 1 bags, without ROS: topics as streams."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from finssim.calibration.errors import CalibrationError
from finssim.calibration.importers.assemble import in_our_axes
from finssim.calibration.importers.finssim_record import (
    THRUSTERS,
    own_topics,
    spoken_events,
    thruster_columns,
)
from finssim.calibration.importers.message_fields import USUAL, number_at, stamp_of, word_at
from finssim.calibration.importers.source_map import ColumnSource, SourceMap
from finssim.calibration.importers.streams import Stream
from finssim.calibration.importers.tables import spoken, values_of
from finssim.mcap_repair import whole_mcap
from finssim.vehicles.part import did_you_mean

__all__ = ["BAGS", "bag_files", "read_bag"]

BAGS = (".mcap", ".db3", ".bag")

WORDS = "std_msgs/msg/String"


def read_bag(path: Path, topics: Mapping[str, SourceMap]) -> list[Stream]:
    """The topics of a bag as streams.

    Args:
        path: Folder of a ROS 2 bag, `.mcap`, `.db3`, or a ROS 1 `.bag`.
        topics: How topics are read; without any, each of a usual type is.

    Raises:
        CalibrationError: Not a bag, or topics, types or fields that it has not.
        ModuleNotFoundError: rosbags is not installed.
    """
    with _opened(path) as (reader, notes):
        known = {c.topic: c.msgtype for c in reader.connections}
        own = {} if topics else own_topics(known)
        topics = topics or own
        if not topics:
            topics = {topic: SourceMap() for topic, kind in sorted(known.items()) if kind in USUAL}
        if not topics:
            raise CalibrationError(
                f"{path.name}: no topic of a usual type: write a map; its topics are {_listed(known)}"
            )
        sources = {}
        for topic, source in topics.items():
            if topic not in known:
                raise CalibrationError(
                    f"{path.name}: no topic '{topic}'{did_you_mean(topic, list(known))} its topics are {_listed(known)}"
                )
            sources[topic] = _columns(reader, topic, known[topic], source)
        _choose(sources, known, [topic for topic in topics if not topics[topic].columns], notes)
        collected = _collect(reader, sources, topics, notes)
        events = _events(reader) if own else []
    streams = [_stream(topic, sources[topic], topics[topic], *collected[topic]) for topic in topics]
    found = [stream for stream in streams if len(stream.t) >= 2 and (stream.channels or stream.words)]
    if not found:
        raise CalibrationError(f"{path.name}: {', '.join(topics)} hold fewer than two messages each")
    notes += [f"{topic} holds fewer than two messages" for topic in topics if len(collected[topic][0]) < 2]
    found[0] = found[0].noting(*notes)
    return found + events


def bag_files(path: Path) -> list[Path]:
    """A bag itself, or the storage files of a folder that lost its metadata; none if it is no bag."""
    if not path.is_dir():
        return [path] if path.suffix.lower() in BAGS else []
    if (path / "metadata.yaml").is_file():
        return [path]
    return sorted(part for part in path.iterdir() if part.suffix.lower() in (".mcap", ".db3"))


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, list[str]]]:
    from rosbags.highlevel import AnyReader, AnyReaderError
    from rosbags.typesys import Stores, get_typestore

    notes: list[str] = []
    with ExitStack() as stack:
        parts = [stack.enter_context(whole_mcap(part, notes)) for part in bag_files(path) or [path]]
        if parts != [path] and path.is_dir():
            notes.append(
                f"{path.name} has no metadata.yaml, as after a crash: read from {len(parts)} files in it"
            )
        try:
            reader = AnyReader(parts, default_typestore=get_typestore(Stores.LATEST))
            reader.open()
        except (AnyReaderError, AssertionError, OSError) as error:
            raise CalibrationError(
                f"{path}: cannot be opened as a bag: {error or 'damaged'}: for a damaged .db3 try sqlite3's .recover"
            ) from None
        try:
            yield reader, notes
        finally:
            reader.close()


def _columns(reader: Any, topic: str, kind: str, source: SourceMap) -> dict[str, ColumnSource]:
    """Columns of a topic: the map's, or the usual ones of its type."""
    if source.columns or source.phase is not None or source.split is not None:
        return source.columns
    if kind in THRUSTERS:
        return _thruster_columns(reader, topic, kind)
    if kind not in USUAL:
        raise CalibrationError(
            f"{topic} is of type {kind}, for which no columns are usual: give 'columns: {{u: FIELD, ...}}'"
        )
    return {name: ColumnSource(column=path) for name, path in USUAL[kind].items()}


def _thruster_columns(reader: Any, topic: str, kind: str) -> dict[str, ColumnSource]:
    """Columns that the first message of a topic names."""
    connections = [c for c in reader.connections if c.topic == topic]
    for connection, _, raw in reader.messages(connections=connections):
        return thruster_columns(kind, reader.deserialize(raw, connection.msgtype))
    return {}


def _events(reader: Any) -> list[Stream]:
    """What the events of our own records say."""
    connections = [c for c in reader.connections if c.topic.endswith("/events") and c.msgtype == WORDS]
    said = (
        (time * 1e-9, reader.deserialize(raw, c.msgtype).data)
        for c, time, raw in reader.messages(connections=connections)
    )
    stream = spoken_events("events", said, reader.start_time * 1e-9) if connections else None
    return [] if stream is None else [stream]


def _choose(
    sources: dict[str, dict[str, ColumnSource]], known: Mapping[str, str], usual: list[str], notes: list[str]
) -> None:
    """Leave a column that several topics of usual types hold to the type that comes first; in place.

    Two topics of one type keep it, and are refused where the streams are put together.
    """
    order = [*THRUSTERS, *USUAL]
    rank = {topic: order.index(known[topic]) for topic in usual if known[topic] in order}
    if any("depth" in columns for columns in sources.values()):
        for topic in rank:
            if sources[topic].pop("pressure", None) is not None:
                notes.append(f"pressure of {topic} left out, for the depth is there")
    for topic in sorted(rank, key=lambda topic: rank[topic], reverse=True):
        better = {
            name: other for other in sources for name in sources[other] if rank.get(other, -1) < rank[topic]
        }
        left = [name for name in sources[topic] if name in better]
        for name in left:
            del sources[topic][name]
        if left:
            notes.append(f"{', '.join(left)} of {topic} left out for those of {better[left[0]]}")


def _collect(
    reader: Any,
    sources: dict[str, dict[str, ColumnSource]],
    topics: Mapping[str, SourceMap],
    notes: list[str],
) -> dict[str, tuple[list[float], dict[str, list[float]], dict[str, list[str]]]]:
    """Per topic: times, numbers by canonical column, and words."""
    collected: dict[str, Any] = {
        topic: (
            [],
            {name: [] for name in columns},
            {name: [] for name in ("phase", "split") if _worded(topics[topic], name)},
        )
        for topic, columns in sources.items()
    }
    connections = [c for c in reader.connections if c.topic in sources]
    try:
        for connection, received, raw in reader.messages(connections=connections):
            message = reader.deserialize(raw, connection.msgtype)
            topic = connection.topic
            times, numbers, words = collected[topic]
            stamp = stamp_of(message) if topics[topic].stamps == "header" else None
            times.append((received if stamp is None else stamp) * 1e-9)
            for name, spec in sources[topic].items():
                if spec.column is not None:
                    numbers[name].append(number_at(message, spec.column, topic))
            for name, said in words.items():
                said.append(word_at(message, _worded(topics[topic], name), topic))
    except CalibrationError:
        raise
    except Exception as error:  # a damaged bag breaks in whatever layer reads it
        if not any(len(times) >= 2 for times, _, _ in collected.values()):
            raise CalibrationError(f"the bag breaks at its first messages: {error}") from None
        notes.append(f"the bag is damaged and was read up to there: {str(error).splitlines()[0][:120]}")
    return collected


def _worded(source: SourceMap, name: str) -> str:
    """The field that holds the words of a topic, "" for none."""
    return (source.phase.column if source.phase else "") if name == "phase" else source.split or ""


def _stream(
    topic: str,
    columns: dict[str, ColumnSource],
    source: SourceMap,
    times: list[float],
    numbers: dict[str, list[float]],
    words: dict[str, list[str]],
) -> Stream:
    t = np.array(times) + source.time_offset
    channels = {}
    for name, spec in columns.items():
        # The last message of a damaged bag may lack its last fields.
        raw = np.full(len(t), np.nan)
        raw[: len(numbers[name])] = numbers[name]
        channels[name] = values_of(raw, name, spec)
    said = {
        name: spoken(list_, source.phase)
        if name == "phase" and source.phase
        else np.array(list_, dtype=np.str_)
        for name, list_ in words.items()
    }
    return in_our_axes(Stream(source=topic, t=t, channels=channels, words=said), source.frame)


def _listed(known: Mapping[str, str]) -> str:
    return ", ".join(f"{topic} ({kind.replace('/msg/', '/')})" for topic, kind in sorted(known.items()))
