"""Records on a terminal: `finssim record info` and `finssim play`."""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from finssim.robot.record_messages import RecordError
from finssim.robot.record_reader import Entry, Record, open_record
from finssim.yaml_file import json_value

__all__ = [
    "TopicInfo",
    "as_line",
    "describe_record",
    "events_of",
    "info",
    "json_line",
    "plain",
    "play",
    "play_record",
]


# What a record holds, in figures: topics, rates, gaps, events.


GAP = 5.0
"""A pause longer than so many usual intervals of a topic is a gap; pauses below `SHORTEST_GAP` are none."""

SHORTEST_GAP = 0.1
"""[s]"""


@dataclass
class TopicInfo:
    """One topic in figures."""

    kind: str
    times: list[float]
    """[s]"""
    bytes: int = 0

    @property
    def rate(self) -> float:
        """Messages a second; 0 of fewer than two."""
        span = self.times[-1] - self.times[0] if self.times else 0.0
        return (len(self.times) - 1) / span if span > 0.0 else 0.0

    @property
    def gaps(self) -> list[tuple[float, float]]:
        """Beginning and length of the pauses that are far longer than the usual one [s]."""
        steps = [(a, b - a) for a, b in pairwise(self.times)]
        if len(steps) < GAP:
            return []
        usual = sorted(step for _, step in steps)[len(steps) // 2]
        return [(at, step) for at, step in steps if step > max(GAP * usual, SHORTEST_GAP)]

    def as_dict(self) -> dict[str, Any]:
        """Plain values."""
        longest = max((step for _, step in self.gaps), default=0.0)
        return {
            "type": self.kind,
            "messages": len(self.times),
            "rate_hz": round(self.rate, 3),
            "bytes": self.bytes,
            "gaps": len(self.gaps),
            "longest_gap_s": round(longest, 3),
        }


def describe_record(record: Record) -> dict[str, Any]:
    """Duration, vehicle, topics, events and damage, as plain values."""
    topics = {topic: TopicInfo(kind, []) for topic, kind in sorted(record.topics.items())}
    for at, topic, size in record.sizes():
        topics[topic].times.append(at)
        topics[topic].bytes += size
    times = [at for info in topics.values() for at in (info.times[:1] + info.times[-1:])]
    start, end = min(times, default=0.0), max(times, default=0.0)
    return {
        "file": str(record.path),
        "cut": record.cut,
        "notes": list(record.notes),
        "start_s": start,
        "duration_s": end - start,
        "messages": sum(len(info.times) for info in topics.values()),
        "metadata": record.metadata,
        "files": sorted(record.files),
        "topics": {topic: info.as_dict() for topic, info in topics.items()},
        "events": events_of(record),
    }


def events_of(record: Record) -> list[dict[str, Any]]:
    """Events in their order: time [s], kind, text; words that are no event of ours are passed over."""
    topic = record.topic("events")
    found = []
    for entry in record.messages([topic]) if topic in record.topics else ():
        try:
            event = json_value(entry.message.data, RecordError, "event")
        except ValueError:
            continue
        if isinstance(event, dict) and "kind" in event:
            found.append({"time": entry.time, "kind": str(event["kind"]), "text": str(event.get("text", ""))})
    return found


# Records played: their messages one after the other, in the time in which they were recorded.


SHOWN = 16
"""Elements of a longer array are counted, not shown, in lines; JSON has all but pictures."""


def play(
    record: Record,
    *,
    speed: float,
    clock: Callable[[], float],
    wait: Callable[[float], None],
    topics: Collection[str] | None = None,
    start: float | None = None,
) -> Iterator[Entry]:
    """Messages, each when its time has come.

    Args:
        record: An open one.
        speed: Times as fast as recorded [-]; infinite: at once.
        clock: [s], monotonic.
        wait: Waits so long [s].
        topics: Only these.
        start: From this time of the record on [s].

    Raises:
        RecordError: A speed that is not above zero, or no such topic.
    """
    if not speed > 0.0:
        raise RecordError(f"speed is {speed:g}, expected a number above 0")
    began: tuple[float, float] | None = None
    for entry in record.messages(topics, start):
        if began is None:
            began = clock(), entry.time
        if math.isfinite(speed):
            pause = began[0] + (entry.time - began[1]) / speed - clock()
            if pause > 0.0:
                wait(pause)
        yield entry


def plain(value: Any) -> Any:
    """A message as dictionaries, lists and numbers; pictures by their size."""
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


def json_line(entry: Entry) -> str:
    """One line of JSON."""
    line = {"time": entry.time, "topic": entry.topic, "type": entry.kind, "message": plain(entry.message)}
    return json.dumps(line)


def as_line(entry: Entry) -> str:
    """One line to read: time, topic and the numbers and words in it, without the header."""
    return f"{entry.time:10.3f}  {entry.topic}  " + " ".join(_line_words(plain(entry.message)))


def _line_words(value: Any, name: str = "") -> Iterator[str]:
    if isinstance(value, dict):
        for key, inner in value.items():
            if key not in ("header", "covariance") and not key.endswith("_covariance"):
                yield from _line_words(inner, f"{name}.{key}" if name else key)
    elif isinstance(value, list) and value and isinstance(value[0], dict):
        for inner in value:
            yield from _line_words(inner, name)
    elif isinstance(value, list):
        numbers = " ".join(_word(x) for x in value[:SHOWN])
        yield f"{name}=[{numbers}{' ...' if len(value) > SHOWN else ''}]"
    else:
        yield f"{name}={_word(value)}"


def _word(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else "nan" if value is None else str(value)


EVENTS_SHOWN = 20


def info(
    path: Path,
    *,
    as_json: bool = False,
) -> None:
    """Tell what a record holds: vehicle, duration [s], topics with rates [Hz] and gaps [s], events, damage.

    Example: finssim record info run.mcap

    Args:
        path (FILE): Record of a run (.mcap).
        as_json: Print one JSON object instead of tables.

    Raises:
        RecordError: Not a record.
    """
    with open_record(path) as record:
        found = describe_record(record)
    if as_json:
        print(json.dumps(found, indent=2))
        return
    for line in _lines(found):
        print(line)


def play_record(
    path: Path,
    *,
    speed: float = 1.0,
    fast: bool = False,
    topics: Annotated[Sequence[str] | None, ","] = None,
    start: Annotated[float, (0.0, None)] = 0.0,
    as_json: bool = False,
) -> None:
    """Print the messages of a record as they came, a line each [s, SI units]; pictures by their size.

    Example: finssim play run.mcap --topics odom,events --speed 4

    Args:
        path (FILE): Record of a run (.mcap).
        speed (FACTOR): Times as fast as it was recorded [-].
        fast: Without waiting.
        topics (NAMES): Only these, with commas between: odom,thruster_cmd.
        start: Begin so long after the start of the record [s].
        as_json: Print one JSON object a line instead of text.

    Raises:
        RecordError: Not a record, no such topic, or a speed that is not above zero.
    """
    with open_record(path) as record:
        for note in record.notes:
            print(note, file=sys.stderr)
        first = next((at for at, _, _ in record.sizes()), 0.0) + start if start else None
        pace = math.inf if fast else speed
        played = play(record, speed=pace, clock=time.monotonic, wait=time.sleep, topics=topics, start=first)
        for entry in played:
            print(json_line(entry) if as_json else as_line(entry), flush=True)


def _lines(found: dict[str, Any]) -> list[str]:
    about = found["metadata"]
    lines = [
        f"{found['file']}: {found['duration_s']:.2f} s, {found['messages']} messages"
        + (f", vehicle {about['vehicle']} ({about['vehicle_sha256'][:12]})" if "vehicle" in about else "")
    ]
    lines += [f"  {note}" for note in found["notes"]]
    told = {k: v for k, v in about.items() if k not in ("vehicle", "vehicle_sha256", "provenance")}
    lines += [f"  {key}: {value if len(value) <= 90 else value[:90] + ' ...'}" for key, value in told.items()]
    lines += [f"  keeps {', '.join(found['files'])}"] if found["files"] else []
    lines.append(f"{'topic':36}{'messages':>9}{'rate [Hz]':>11}{'gaps':>6}{'longest [s]':>13}  type")
    for topic, told_of in found["topics"].items():
        lines.append(
            f"{topic:36}{told_of['messages']:9}{told_of['rate_hz']:11.2f}{told_of['gaps']:6}"
            f"{told_of['longest_gap_s']:13.2f}  {told_of['type']}"
        )
    events = found["events"]
    start = found["start_s"]
    lines += [f"{e['time'] - start:10.3f} s  {e['kind']}: {e['text']}" for e in events[:EVENTS_SHOWN]]
    if len(events) > EVENTS_SHOWN:
        lines.append(
            f"and {len(events) - EVENTS_SHOWN} more events: finssim play FILE --topics events --fast"
        )
    return lines
