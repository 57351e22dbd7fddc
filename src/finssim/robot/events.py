"""What a bridge tells its operator and its record: events in order, a repeated one at most once a second."""

from __future__ import annotations

from collections import Counter, deque
from typing import NamedTuple

__all__ = ["Event", "EventLog"]

KEPT = 1000
"""Events that wait for somebody to drain them."""
REPEAT = 1.0
"""Least time between two events of one kind and source [s]."""


class Event(NamedTuple):
    """Something that happened."""

    time: float
    """Robot's clock [s]."""
    kind: str
    """One or two words: state, fault, hold, command, telemetry, echo, clock, refused."""
    text: str
    """One sentence."""


class EventLog:
    """The newest events, and how many there were of each kind."""

    def __init__(self) -> None:
        self.events: deque[Event] = deque(maxlen=KEPT)
        self.counts: Counter[str] = Counter()
        self._last: dict[str, float] = {}

    def add(self, time: float, kind: str, text: str) -> None:
        """Notes an event, always.

        Args:
            time: Robot's clock [s].
            kind: One or two words.
            text: One sentence.
        """
        self.counts[kind] += 1
        self.events.append(Event(time, kind, text))

    def repeat(self, time: float, kind: str, text: str) -> None:
        """Counts an event that may come with every message, and notes it if none of its kind was noted just now.

        Args:
            time: Robot's clock [s].
            kind: One or two words.
            text: One sentence.
        """
        last = self._last.get(kind)
        if last is not None and 0.0 <= time - last < REPEAT:
            self.counts[kind] += 1
            return
        self._last[kind] = time
        self.add(time, kind, text)

    def drain(self) -> list[Event]:
        """All events since the last call, oldest first."""
        drained = list(self.events)
        self.events.clear()
        return drained
