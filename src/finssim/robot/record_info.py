"""What a record holds, in figures: topics, rates, gaps, events."""

from __future__ import annotations

import json
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from finssim.robot.record_reader import Record

__all__ = ["TopicInfo", "describe_record", "events_of"]

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
    for time, topic, size in record.sizes():
        topics[topic].times.append(time)
        topics[topic].bytes += size
    times = [time for info in topics.values() for time in (info.times[:1] + info.times[-1:])]
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
            event = json.loads(entry.message.data)
        except ValueError:
            continue
        if isinstance(event, dict) and "kind" in event:
            found.append({"time": entry.time, "kind": str(event["kind"]), "text": str(event.get("text", ""))})
    return found
