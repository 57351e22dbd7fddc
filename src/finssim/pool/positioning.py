"""Position fixes on a link, from motion capture or acoustic positioning, with rate, latency, losses and outliers."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from finssim.core.rotations import quat_yaw
from finssim.robot.links.frames import encode_navigation
from finssim.robot.messages import POSE, POSITION, NavigationAid

__all__ = ["Exposure", "POSITIONING", "PoseAt", "Positioning", "PositioningSettings", "Shutter"]


# Exposure of the overhead camera and arrival of its pictures: a shutter that advances with the simulation time.


Array = npt.NDArray[np.float64]

PoseAt = Callable[[float], tuple[Array, Array]]
"""Time [s] -> position of the body origin [m], (3,), and quaternion body to world, xyzw, (4,), world frame."""
WIDEST = 3.0
"""Limit of the jitter, in standard deviations."""


@dataclass(frozen=True)
class Exposure:
    """One picture before it is rendered: the motion of the vehicle while the shutter was open."""

    sequence: int
    middle: float
    """Middle of the exposure [s]."""
    arrival: float
    """Time of arrival at the robot's computer [s]."""
    start: tuple[Array, Array]
    """Pose when the shutter opened, see `PoseAt`."""
    end: tuple[Array, Array]
    """Position [m], (3,), and quaternion, (4,), when it closed."""
    source: str = ""
    """Name of the vehicle's sensor; the overhead camera if empty."""


class Shutter:
    """Shutter with a fixed rate; some pictures are lost, the others arrive with latency and jitter."""

    def __init__(
        self, *, rate: float, exposure: float, latency: float, jitter: float, dropout: float, seed: int
    ) -> None:
        """
        Args:
            rate: Picture rate [Hz].
            exposure: [s].
            latency: Mean time from the middle of the exposure to arrival [s].
            jitter: Standard deviation of the latency [s]; pictures arrive in order.
            dropout: Probability that a picture is lost.
            seed: Seed of jitter and losses.
        """
        self._rate, self._exposure, self._dropout = rate, exposure, dropout
        self._latency, self._jitter = latency, jitter
        self._random = np.random.default_rng([seed, 0xCA])
        self._sequence = 0
        self._opened: tuple[Array, Array] | None = None
        self._last_arrival = -math.inf

    def advance(self, t0: float, t1: float, pose_at: PoseAt) -> list[Exposure]:
        """Return the exposures that ended in (t0, t1], without lost ones; `pose_at` is only called for times in this
        interval.

        Times are in [s].
        """
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


class ArrivalQueue:
    """Queue of pictures before their arrival, in the order of arrival."""

    def __init__(self) -> None:
        self._waiting: deque[Exposure] = deque()

    def post(self, exposures: list[Exposure]) -> None:
        """Add pictures to the queue."""
        self._waiting.extend(exposures)

    def arrived(self, t: float) -> list[Exposure]:
        """Return the pictures that have arrived at a time [s], each once."""
        there = []
        while self._waiting and self._waiting[0].arrival <= t:
            there.append(self._waiting.popleft())
        return there


@dataclass(frozen=True, kw_only=True)
class PositioningSettings:
    """Settings of one positioning system."""

    rate: float
    """Rate of the fixes [Hz]."""
    std: float
    """Standard deviation of the position per axis [m]."""
    yaw_std: float = 0.0
    """Standard deviation of the heading [rad]; 0 means that fixes have no heading."""
    latency: float = 0.0
    """Mean time from the measurement to arrival [s]."""
    jitter: float = 0.0
    """Standard deviation of the latency [s]."""
    dropout: float = 0.0
    """Probability that a fix is lost."""
    outliers: float = 0.0
    """Probability that a fix is wrong by up to `outlier_size`."""
    outlier_size: float = 10.0
    """Largest offset of a wrong fix, per axis [m]."""


POSITIONING: Mapping[str, PositioningSettings] = {
    "motion-capture": PositioningSettings(
        rate=50.0, std=0.002, yaw_std=math.radians(0.3), latency=0.02, jitter=0.003, dropout=0.01
    ),
    "usbl": PositioningSettings(
        rate=0.5, std=0.5, latency=0.4, jitter=0.1, dropout=0.1, outliers=0.05, outlier_size=15.0
    ),
}
"""Positioning systems by name: motion capture, and an ultra-short baseline at a range of some ten metres."""


class Positioning:
    """Positioning system that measures the position of the vehicle and reports it with latency."""

    def __init__(self, settings: PositioningSettings, seed: int) -> None:
        """
        Args:
            settings: Settings of the system.
            seed: Seed of noise, outliers, jitter and losses.
        """
        s = settings
        self.settings = s
        self._shutter = Shutter(
            rate=s.rate, exposure=0.0, latency=s.latency, jitter=s.jitter, dropout=s.dropout, seed=seed
        )
        self._arrivals, self._random = ArrivalQueue(), np.random.default_rng([seed, 0xF1])

    def advance(self, t0: float, t1: float, pose_at: PoseAt) -> list[tuple[float, bytes]]:
        """Return the frames that arrive in (t0, t1], each with its arrival [s], oldest first; `pose_at` as for a
        camera."""
        self._arrivals.post(self._shutter.advance(t0, t1, pose_at))
        frames = []
        for fix in self._arrivals.arrived(t1):
            s, (position, quaternion) = self.settings, fix.start
            x = position + s.std * self._random.standard_normal(3)
            wrong, turned = self._random.random() < s.outliers, s.yaw_std * self._random.standard_normal()
            offset = self._random.uniform(-s.outlier_size, s.outlier_size, 3)
            x = x + offset if wrong else x
            yaw = float(quat_yaw(quaternion)) + turned
            kind, third = (POSE, yaw) if s.yaw_std else (POSITION, float(x[2]))
            aid = NavigationAid(
                fix.sequence & 0xFFFF,
                kind,
                fix.arrival - fix.middle,
                (float(x[0]), float(x[1]), third),
                (s.std, s.yaw_std),
            )
            frames.append((fix.arrival, encode_navigation(aid)))
        return frames
