"""Values over time, of a record or collected from a live source."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from finssim.core.rotations import quat_yaw
from finssim.extensions.viewer.frame import BodyPose, PlotLine, nowhere

__all__ = ["Errors", "HEADING", "POSITION", "PoseSeries", "TimeSeries", "errors_between"]


Array = npt.NDArray[np.float64]

POSITION, HEADING = "position error [m]", "heading error [deg]"
"""Titles of the plots."""

TRAIL = 30.0
"""Duration of the displayed trail [s]."""
TRAIL_POINTS = 150
KEPT = 1200
"""Largest number of points of a live curve."""
SAMPLE = 0.1
"""Time between the points of a live curve [s]."""


class TimeSeries:
    """Values of any unit in the order of their times [s], (n,)."""

    def __init__(self, time: npt.ArrayLike = (), values: Sequence[Any] | Array = ()) -> None:
        self.time = np.asarray(time, float)
        self.values = values

    def at(self, time: float) -> Any:
        """Return the last value that is not later than a time [s]; None before the first."""
        i = int(np.searchsorted(self.time, time, side="right")) - 1
        return None if i < 0 else self.values[i]


class PoseSeries:
    """Recorded motion: times [s], (n,), positions [m], (n, 3), and quaternions, (n, 4), world frame."""

    def __init__(self, time: npt.ArrayLike, position: npt.ArrayLike, quaternion: npt.ArrayLike) -> None:
        self.time = np.asarray(time, float)
        self.position = np.asarray(position, float).reshape(-1, 3)
        self.quaternion = np.asarray(quaternion, float).reshape(-1, 4)

    def __len__(self) -> int:
        return len(self.time)

    def at(self, time: float) -> BodyPose | None:
        """Return the last pose that is not later than a time [s]; None before the first."""
        i = int(np.searchsorted(self.time, time, side="right")) - 1
        return None if i < 0 else BodyPose(self.position[i], self.quaternion[i])

    def trail(self, time: float) -> Array:
        """Return the positions in the 30 s before a time [s], world frame [m], (k, 3)."""
        first, last = np.searchsorted(self.time, (time - TRAIL, time))
        return self.position[first:last][:: max(1, (last - first) // TRAIL_POINTS)] if last else nowhere()

    def on(self, time: Array) -> tuple[Array, Array]:
        """Return positions (k, 3) and unwrapped headings (k,) [rad], interpolated at times; NaN outside the
        record's times."""
        if not len(self):
            return np.full((len(time), 3), np.nan), np.full(len(time), np.nan)
        columns = [*self.position.T, np.unwrap(quat_yaw(self.quaternion))]
        interpolated = [np.interp(time, self.time, column, np.nan, np.nan) for column in columns]
        return np.stack(interpolated[:3], axis=1), interpolated[3]


def errors_between(a: tuple[Array, Array], b: tuple[Array, Array]) -> tuple[Array, Array]:
    """Return distances [m] and heading differences [deg], (k,), between positions and headings (k, 3), (k,)."""
    turn = np.degrees(np.abs((a[1] - b[1] + math.pi) % (2.0 * math.pi) - math.pi))
    return np.linalg.norm(a[0] - b[0], axis=1), turn


class Errors:
    """Errors and recent positions of a vehicle in a live source."""

    def __init__(self) -> None:
        self._rows: deque[tuple[float, ...]] = deque(maxlen=KEPT)
        self._trail: deque[Array] = deque(maxlen=round(TRAIL / SAMPLE))

    def add(
        self, time: float, true: BodyPose | None, estimate: BodyPose | None, goal: BodyPose | None
    ) -> None:
        """Store the errors of a time [s], if the last stored one is at least `SAMPLE` before."""
        if self._rows and time < self._rows[-1][0] + SAMPLE - 1e-9:
            return
        pose = true or estimate
        if pose is not None:
            self._trail.append(np.array(pose.position, float))
        self._rows.append((time, *_error(pose, goal), *_error(estimate, true)))

    @property
    def trail(self) -> Array:
        """Return the recent positions, (k, 3) [m]."""
        return np.array(self._trail).reshape(-1, 3)

    @property
    def latest(self) -> tuple[float, ...]:
        """Return errors to the goal [m, deg] and of the estimate [m, deg]; NaN if unknown."""
        return self._rows[-1][1:] if self._rows else (math.nan,) * 4

    @property
    def to_goal(self) -> str:
        """Return distance and heading difference to the goal as text."""
        distance, turn, *_ = self.latest
        return "-" if math.isnan(distance) else f"{100.0 * distance:.1f} cm, {turn:.1f}°"

    @property
    def of_estimate(self) -> str:
        """Return the distance of the estimate from the truth as text."""
        return "-" if math.isnan(self.latest[2]) else f"{100.0 * self.latest[2]:.1f} cm"

    def curves(self) -> list[PlotLine]:
        """Return the curves of the errors that have values."""
        rows = np.array(self._rows).reshape(-1, 5)
        time = rows[:, 0]
        curves = [
            PlotLine(POSITION, "to the goal", time, rows[:, 1]),
            PlotLine(POSITION, "of the estimate", time, rows[:, 3]),
            PlotLine(HEADING, "to the goal", time, rows[:, 2]),
            PlotLine(HEADING, "of the estimate", time, rows[:, 4]),
        ]
        return [curve for curve in curves if np.isfinite(curve.value).any()]


def _error(a: BodyPose | None, b: BodyPose | None) -> tuple[float, float]:
    if a is None or b is None:
        return math.nan, math.nan
    of_a, of_b = ((p.position[None], np.atleast_1d(quat_yaw(p.quaternion))) for p in (a, b))
    distance, turn = errors_between(of_a, of_b)
    return float(distance[0]), float(turn[0])
