"""When the overhead camera exposes and when the pictures arrive: a shutter that is told the time in ticks."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

__all__ = ["Exposure", "PoseAt", "Shutter"]

Array = npt.NDArray[np.float64]

PoseAt = Callable[[float], tuple[Array, Array]]
"""Time [s] -> position of the body origin [m], (3,), and body to world, xyzw, (4,), world frame."""
WIDEST = 3.0
"""Standard deviations of jitter beyond which there is none."""


@dataclass(frozen=True)
class Exposure:
    """One picture before it is developed: how the vehicle moved while the shutter was open."""

    sequence: int
    middle: float
    """[s]"""
    arrival: float
    """At the robot's computer [s]."""
    start: tuple[Array, Array]
    """Pose when the shutter opened, as of `PoseAt`."""
    end: tuple[Array, Array]
    """Pose when it closed."""


class Shutter:
    """Opens at a fixed rate; some pictures are lost on the way, the others arrive late by latency and jitter."""

    def __init__(
        self, *, rate: float, exposure: float, latency: float, jitter: float, dropout: float, seed: int
    ) -> None:
        """
        Args:
            rate: Pictures a second [Hz].
            exposure: [s].
            latency: From the middle of the exposure to arrival, on average [s].
            jitter: Standard deviation of the latency [s]; no picture overtakes another.
            dropout: Chance that a picture is lost.
            seed: Of jitter and losses.
        """
        self._rate, self._exposure, self._dropout = rate, exposure, dropout
        self._latency, self._jitter = latency, jitter
        self._random = np.random.default_rng([seed, 0xCA])
        self._sequence = 0
        self._opened: tuple[Array, Array] | None = None
        self._last_arrival = -math.inf

    def advance(self, t0: float, t1: float, pose_at: PoseAt) -> list[Exposure]:
        """Exposures that ended in (t0, t1], without those that are lost; `pose_at` is asked for times in it alone."""
        done: list[Exposure] = []
        while True:
            middle = (self._sequence + 1) / self._rate
            opens, closes = middle - 0.5 * self._exposure, middle + 0.5 * self._exposure
            if self._opened is None and opens <= t1:
                self._opened = pose_at(max(opens, t0))
            if self._opened is None or closes > t1:
                return done
            late = max(-WIDEST, min(float(self._random.normal()), WIDEST)) * self._jitter
            lost = float(self._random.random()) < self._dropout
            arrival = max(middle + self._latency + late, closes, self._last_arrival)
            if not lost:
                self._last_arrival = arrival
                done.append(Exposure(self._sequence, middle, arrival, self._opened, pose_at(max(closes, t0))))
            self._sequence, self._opened = self._sequence + 1, None


class Mail:
    """Pictures on their way, in the order of their arrival."""

    def __init__(self) -> None:
        self._waiting: deque[Exposure] = deque()

    def post(self, exposures: list[Exposure]) -> None:
        """Send some on their way."""
        self._waiting.extend(exposures)

    def arrived(self, t: float) -> list[Exposure]:
        """Those that are there at a time [s], each once."""
        there = []
        while self._waiting and self._waiting[0].arrival <= t:
            there.append(self._waiting.popleft())
        return there
