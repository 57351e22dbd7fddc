"""What a run counts: steps, decisions that came late, and the time from camera to command."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np

__all__ = ["Counters", "Ticks"]

EARLY = 0.002
"""A decision may come this much before its time [s], so that a loop that jitters misses no turn."""
REMEMBERED = 20_000
"""Latencies that are kept: half an hour at ten a second."""


class Ticks:
    """When a periodic thing is due: on the grid of its start, never later because an earlier turn was late."""

    def __init__(self, start: float = 0.0) -> None:
        """
        Args:
            start: First turn [s].
        """
        self._next = start

    def due(self, now: float, period: float) -> tuple[bool, int]:
        """Whether it is time, and how many turns were missed altogether since the last one.

        Args:
            now: [s]
            period: From now on [s].
        """
        early = min(EARLY, 0.1 * period)
        if self._next - now > 2.0 * period:  # the clock was set back, or the period has become shorter
            self._next = now
        late = now + early - self._next
        if late < 0.0:
            return False, 0
        missed = math.floor(late / period)
        self._next += (missed + 1) * period
        return True, missed


@dataclass
class Counters:
    """Totals of a run."""

    steps: int = 0
    telemetry: int = 0
    pictures: int = 0
    fixes: int = 0
    """Pictures that became part of the state."""
    decisions: int = 0
    missed: int = 0
    """Turns of the pilot that passed without a decision because the loop was late."""
    overruns: int = 0
    """Steps that took longer than their period."""
    latencies: deque[float] = field(default_factory=lambda: deque(maxlen=REMEMBERED))
    """From the arrival of the newest picture in the state to the command that is decided on it [s]."""
    events: deque[Any] = field(default_factory=lambda: deque(maxlen=200))
    """The latest events of the bridge."""
    _newest: float = math.nan
    _pending: float = math.nan

    def picture(self, arrival: float, used: bool) -> None:
        """A picture came [s]."""
        self.pictures += 1
        if used:
            self.fixes += 1
            self._newest = arrival

    def decided(self) -> None:
        """A decision was made on what is known now."""
        self._pending, self._newest = self._newest, math.nan

    def sent(self, now: float) -> None:
        """What was decided has gone out [s]."""
        if not math.isnan(self._pending):
            self.latencies.append(now - self._pending)
            self._pending = math.nan

    def summary(self) -> dict[str, Any]:
        """Totals as plain data; percentiles of the latency [s], None where there was none."""
        kept = np.array(self.latencies)
        percentiles = {f"p{p}": float(np.percentile(kept, p)) if kept.size else None for p in (50, 95, 99)}
        names = ("steps", "telemetry", "pictures", "fixes", "decisions", "missed", "overruns")
        return {**{name: getattr(self, name) for name in names}, "latency_s": percentiles}
