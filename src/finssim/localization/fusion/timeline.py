"""A short memory of samples in the order of their times, so that one that comes late is put where it belongs."""

from __future__ import annotations

import bisect
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

from finssim.localization.fusion.health import Outcome
from finssim.localization.fusion.streams import DepthSample, Sample

__all__ = ["Surroundings", "Timeline"]

S = TypeVar("S")

_RANK = {"imu": 0, "depth": 1, "vision": 2, "heading": 3, "velocity": 4}
"""Order of samples of one time, so that delivery decides nothing."""
SAME = 1e-7
"""Stamps nearer than this are the same [s]."""


@dataclass(frozen=True)
class Surroundings:
    """What the other sensors said at the time of a picture."""

    roll: float
    """[rad]; NaN where no IMU sample is near."""
    pitch: float
    depth: float
    """Of the pressure port [m]; NaN where no sample is near."""


class Timeline(Generic[S]):
    """Samples of the last `horizon` seconds with the state after each; `S` is any immutable state."""

    def __init__(self, start: S, horizon: float) -> None:
        """
        Args:
            start: State before any sample.
            horizon: How far back a late sample is still taken [s].
        """
        self.horizon = horizon
        self._before = start
        """State before the oldest sample that is kept."""
        self._closed = -math.inf
        """Time up to which samples have been forgotten [s]."""
        self._keys: list[tuple[float, int]] = []
        self._samples: list[Sample] = []
        self._states: list[S] = []
        self._outcomes: list[tuple[Outcome, ...]] = []

    @property
    def head(self) -> float:
        """Time of the newest sample [s]; -inf before the first."""
        return self._keys[-1][0] if self._keys else -math.inf

    @property
    def state(self) -> S:
        """State after the newest sample."""
        return self._states[-1] if self._states else self._before

    def state_at(self, time: float) -> S:
        """State after the last sample not later than `time` [s], of those remembered."""
        k = bisect.bisect_right(self._keys, (time + SAME, len(_RANK)))
        return self._states[k - 1] if k else self._before

    def refusal(self, sample: Sample) -> str | None:
        """`too late` or `duplicate`, or None where the sample has a place."""
        if sample.time < max(self.head - self.horizon, self._closed):
            return "too late"
        k = bisect.bisect_left(self._keys, (sample.time - SAME, 0))
        while k < len(self._keys) and self._keys[k][0] <= sample.time + SAME:
            if self._samples[k].stream == sample.stream:
                return "duplicate"
            k += 1
        return None

    def insert(
        self, sample: Sample, apply: Callable[[S, Sample], tuple[S, tuple[Outcome, ...]]]
    ) -> tuple[list[tuple[Outcome, ...]], list[tuple[Outcome, ...]]]:
        """Put a sample in its place and run everything after it again.

        Args:
            sample: One that `refusal` lets pass.
            apply: State and sample -> state after it and what became of it.

        Returns:
            Outcomes that no longer hold, and those that hold instead.
        """
        key = (sample.time, _RANK[sample.stream])
        k = bisect.bisect_right(self._keys, key)
        self._keys.insert(k, key)
        self._samples.insert(k, sample)
        gone = self._outcomes[k:]
        state = self._states[k - 1] if k else self._before
        states, outcomes = [], []
        for item in self._samples[k:]:
            state, outcome = apply(state, item)
            states.append(state)
            outcomes.append(outcome)
        self._states[k:], self._outcomes[k:] = states, outcomes
        self._forget()
        return gone, outcomes

    def _forget(self) -> None:
        """Drop what is older than the horizon; the state after it stays."""
        k = bisect.bisect_left(self._keys, (self.head - self.horizon, 0))
        if k < 32:  # in batches: a list loses its front at the cost of its length
            return
        self._before, self._closed = self._states[k - 1], self._keys[k - 1][0]
        del self._keys[:k], self._samples[:k], self._states[:k], self._outcomes[:k]

    def depth_at(self, time: float, longest: float) -> float:
        """Depth at a time, in a straight line between two samples or the nearest one within `longest` [m]; or NaN."""
        near = [self._samples[i] for i in self._around(time, "depth")]
        return _between([(s.time, s.depth) for s in near if isinstance(s, DepthSample)], time, longest)

    def tilt_at(
        self, time: float, longest: float, tilt: Callable[[S], tuple[float, float]]
    ) -> tuple[float, float]:
        """Roll and pitch at a time, likewise, from the states after the IMU's samples [rad]."""
        near = [(self._keys[i][0], *tilt(self._states[i])) for i in self._around(time, "imu")]
        return (
            _between([(t, roll) for t, roll, _ in near], time, longest),
            _between([(t, pitch) for t, _, pitch in near], time, longest),
        )

    def _around(self, time: float, stream: str) -> list[int]:
        """Where the last sample of a stream before a time and the first not before it stand, as far as there are."""
        k = bisect.bisect_left(self._keys, (time, -1))
        before = next((i for i in range(k - 1, -1, -1) if self._samples[i].stream == stream), None)
        after = next((i for i in range(k, len(self._keys)) if self._samples[i].stream == stream), None)
        return [i for i in (before, after) if i is not None]


def _between(points: list[tuple[float, float]], time: float, longest: float) -> float:
    """Value at a time of points in the order of their times; NaN where none is within `longest`."""
    k = bisect.bisect_left(points, (time, -math.inf))
    earlier = points[k - 1] if k and time - points[k - 1][0] <= longest else None
    later = points[k] if k < len(points) and points[k][0] - time <= longest else None
    if earlier and later:
        share = (time - earlier[0]) / max(later[0] - earlier[0], 1e-12)
        return earlier[1] + share * (later[1] - earlier[1])
    nearest = earlier or later
    return nearest[1] if nearest else math.nan
