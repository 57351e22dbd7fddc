"""When a frame was made, in the robot's time: the motor controller's clock unwrapped, and both clocks compared.

Frames come late by a delay that is never negative, so in the plane of the controller's time m and the arrival a every
frame lies on or above the line a = offset + (1 + drift) m, the least delay within the offset. The line is the one below
all frames of the last minute that is highest in their middle, an edge of their lower convex hull (Moon, Skelly and
Towsley, "Estimation and removal of clock skew from network delay measurements", 1999); only the frame that came soonest
in each second is kept. A stamp is that line's value: the arrival without its jitter, the least delay still in it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

_WRAP = 1 << 32
_OVERTAKEN = 5000
"""[ms] A frame at most this much older than the newest was overtaken by it."""
_STEP = 0.25
"""Frames earlier than the line by more [s], or all later for a second, come from a clock that was moved."""
_SECOND = 1.0
"""[s] Of each such span, the frame with the least delay is kept."""
_BASELINE = 5.0
"""Least span of the kept frames from which a drift is estimated [s]."""


class ClockMap:
    """Stamps of frames in the robot's time, never later than their arrival.

    Note:
        `reboots` counts how often the controller's clock began anew, `jumps` other steps of either clock. A step that
        only makes frames late shows within two seconds, a step back by less than 5 s after that time.
    """

    def __init__(self, window: float = 60.0) -> None:
        """Args:
        window: Frames older than this do not count for the comparison [s].
        """
        self.window = window
        self.drift = 0.0
        """Seconds by which the robot's clock gains on the controller's in a second."""
        self.reboots, self.jumps = 0, 0
        self._newest: int | None = None
        self._time = 0.0  # of the newest frame, unwrapped controller's time [s]
        self._kept: deque[tuple[float, float]] = deque()  # (m, a - m) of the soonest frame of each second [s]
        self._second = 0.0  # when the last of them began [s]
        self._offset = 0.0  # least a - (1 + drift) m of the kept frames [s]

    def stamp(self, mcu_ms: int, arrival: float) -> float:
        """When a frame was made, plus the least delay of the wire, robot's clock [s].

        Args:
            mcu_ms: Its stamp by the controller's clock, modulo 2³² [ms].
            arrival: When it came, robot's clock [s].
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
        """Return whether a controller that made the newest frame can since have started and counted so far."""
        since = arrival - self._line(self._time)
        return self._newest is not None and mcu_ms < self._newest and 0.001 * mcu_ms <= since + _STEP

    def _line(self, m: float) -> float:
        """Robot's time of a controller's time [s]."""
        return m + self.drift * m + self._offset

    def _restart(self, mcu_ms: int, m: float, arrival: float) -> float:
        """Restart with one frame, keeping the drift, which belongs to the two crystals."""
        self._newest, self._time, self._second = mcu_ms, m, arrival
        self._kept = deque([(m, arrival - m)])
        self._offset = arrival - m - self.drift * m
        return arrival

    def _keep(self, m: float, arrival: float) -> None:
        """Take a frame as the soonest of its second if it is, and lower the line to it if it lies below."""
        late = arrival - m
        if late - self.drift * m < self._relative(self._kept[-1]):
            self._kept[-1] = (m, late)
        self._offset = min(self._offset, late - self.drift * m)

    def _relative(self, point: tuple[float, float]) -> float:
        """Offset of the line through a kept frame [s]."""
        m, late = point
        return late - self.drift * m

    def _all_late(self) -> bool:
        """Return whether no frame of the last second came near the line."""
        return self._relative(self._kept[-1]) > self._offset + _STEP

    def _next_second(self, m: float, arrival: float) -> None:
        """Draw the line again below the seconds that are complete, and begin one with a frame."""
        while self._kept[0][0] < m - self.window and len(self._kept) > 1:
            self._kept.popleft()
        if self._kept[-1][0] - self._kept[0][0] >= _BASELINE:
            self.drift = _edge_below(self._kept)
        self._offset = min(map(self._relative, self._kept))
        self._kept.append((m, arrival - m))
        self._second = arrival


def _edge_below(points: Sequence[tuple[float, float]]) -> float:
    """Slope of the edge of the lower convex hull that spans the mean of x; points are in the order of x."""
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
    """Positive if a, b, c turn left."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
