"""Times of frames on the robot's clock: the motor controller's clock is unwrapped and compared with the robot's.

Frames are delayed, by a time that is never negative. In the plane of the controller's time m and the arrival a, every
frame therefore lies on or above the line a = offset + (1 + drift) m, where the offset includes the least delay. The
estimate is the line below all frames of the last minute that is highest in their middle, an edge of their lower convex
hull (Moon, Skelly and Towsley, "Estimation and removal of clock skew from network delay measurements", 1999); only the
frame with the least delay in each second is kept. A stamp is the value of that line: the arrival without its jitter,
but with the least delay.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

_WRAP = 1 << 32
_OVERTAKEN = 5000
"""Greatest age relative to the newest frame at which a frame counts as overtaken [ms]."""
_STEP = 0.25
"""Deviation from the line that indicates a clock step: one frame earlier, or all of a second later by more [s]."""
_SECOND = 1.0
"""Interval of which only the frame with the least delay is kept [s]."""
_BASELINE = 5.0
"""Least time span of the kept frames for an estimate of the drift [s]."""


class ClockMap:
    """Stamps of frames in the robot's time, never later than their arrival.

    Note:
        `reboots` counts restarts of the controller's clock, `jumps` other steps of either clock. A step that only
        delays frames is detected within two seconds, a step back by less than 5 s after that time.
    """

    def __init__(self, window: float = 60.0) -> None:
        """
        Args:
            window: Age beyond which frames are not used for the comparison [s].
        """
        self.window = window
        self.drift = 0.0
        """Rate of the robot's clock relative to the controller's, minus 1 [s/s]."""
        self.reboots, self.jumps = 0, 0
        self._newest: int | None = None
        self._time = 0.0  # unwrapped controller's time of the newest frame [s]
        self._kept: deque[tuple[float, float]] = deque()  # (m, a - m), least delay of each second [s]
        self._second = 0.0  # start of the last of these seconds [s]
        self._offset = 0.0  # least a - (1 + drift) m of the kept frames [s]

    def stamp(self, mcu_ms: int, arrival: float) -> float:
        """Return the creation time of a frame plus the least delay of the link, robot's clock [s].

        Args:
            mcu_ms: Stamp of the frame on the controller's clock, modulo 2³² [ms].
            arrival: Arrival of the frame, robot's clock [s].
        """
        if self._newest is None:
            return self._restart(mcu_ms, 0.001 * mcu_ms, arrival)
        behind = (self._newest - mcu_ms) % _WRAP
        m = self._time + 0.001 * (_WRAP - behind)
        moved = arrival < self._line(m) - _STEP
        if moved and self._began_anew(mcu_ms, arrival):
            self.reboots += 1
            return self._restart(mcu_ms, 0.001 * mcu_ms, arrival)
        if behind <= _OVERTAKEN:
            return min(arrival, self._line(self._time - 0.001 * behind))
        if moved:
            self.jumps += 1
            return self._restart(mcu_ms, 0.001 * mcu_ms, arrival)
        if arrival - self._second >= _SECOND:
            if self._all_late():
                self.jumps += 1
                return self._restart(mcu_ms, m, arrival)
            self._next_second(m, arrival)
        self._newest, self._time = mcu_ms, m
        self._keep(m, arrival)
        return min(arrival, self._line(m))

    def _began_anew(self, mcu_ms: int, arrival: float) -> bool:
        """Return whether the controller can have restarted since the newest frame and counted up to this stamp."""
        since = arrival - self._line(self._time)
        return self._newest is not None and mcu_ms < self._newest and 0.001 * mcu_ms <= since + _STEP

    def _line(self, m: float) -> float:
        """Return the robot's time of a controller's time [s]."""
        return m + self.drift * m + self._offset

    def _restart(self, mcu_ms: int, m: float, arrival: float) -> float:
        """Restart with one frame, but keep the drift, which is a property of the two oscillators."""
        self._newest, self._time, self._second = mcu_ms, m, arrival
        self._kept = deque([(m, arrival - m)])
        self._offset = arrival - m - self.drift * m
        return arrival

    def _keep(self, m: float, arrival: float) -> None:
        """Keep a frame if its delay is the least of its second, and lower the line to it if the frame is below."""
        late = arrival - m
        if late - self.drift * m < self._relative(self._kept[-1]):
            self._kept[-1] = (m, late)
        self._offset = min(self._offset, late - self.drift * m)

    def _relative(self, point: tuple[float, float]) -> float:
        """Return the offset of the line through a kept frame [s]."""
        m, late = point
        return late - self.drift * m

    def _all_late(self) -> bool:
        """Return whether all frames of the last second are far above the line."""
        return self._relative(self._kept[-1]) > self._offset + _STEP

    def _next_second(self, m: float, arrival: float) -> None:
        """Update the line below the completed seconds, and begin a new second with a frame."""
        while self._kept[0][0] < m - self.window and len(self._kept) > 1:
            self._kept.popleft()
        if self._kept[-1][0] - self._kept[0][0] >= _BASELINE:
            self.drift = _edge_below(self._kept)
        self._offset = min(map(self._relative, self._kept))
        self._kept.append((m, arrival - m))
        self._second = arrival


def _edge_below(points: Sequence[tuple[float, float]]) -> float:
    """Return the slope of the edge of the lower convex hull that spans the mean of x; points are sorted by x."""
    hull: list[tuple[float, float]] = []
    for x, y in points:
        while len(hull) > 1 and _turn(hull[-2], hull[-1], (x, y)) <= 0.0:
            hull.pop()
        hull.append((x, y))
    middle = sum(x for x, _ in points) / len(points)
    right = next(i for i, (x, _) in enumerate(hull) if x >= middle and i)
    (x0, y0), (x1, y1) = hull[right - 1], hull[right]
    return (y1 - y0) / (x1 - x0)


def _turn(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> float:
    """Return a positive number if a, b, c turn left."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
