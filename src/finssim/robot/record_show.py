"""Records on a terminal: `finssim record info` and `finssim play`."""

from __future__ import annotations

import json
import math
import sys
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from finssim.robot.record_messages import RecordError
from finssim.robot.record_reader import Entry, Record, open_record
from finssim.yaml_file import json_value

__all__ = [
    "as_line",
    "describe_record",
    "events_of",
    "figures_of",
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


def figures_of(kind: str, times: Sequence[float], size: int) -> dict[str, Any]:
    """One topic in figures.

    Args:
        kind: Its type.
        times: Of its messages [s], (n,).
        size: Of all of them [bytes].
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
    """Duration, vehicle, topics, events and damage, as plain values."""
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
