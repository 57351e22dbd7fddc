"""Where a vehicle should be, as a function of time: a station, or a trajectory (`control.trajectories`)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from finssim.control.tracking import Goal
from finssim.geometry.rotations import quat_from_yaw

__all__ = ["Guide", "Reference", "Station", "acceleration_at", "goal_at"]

Array = npt.NDArray[np.float64]

DIFFERENCE = 0.05
"""Half the time across which an acceleration is taken [s]: a controller's period."""


@dataclass(frozen=True)
class Reference:
    """The wanted motion at one time or, with a leading batch, at several."""

    position: Array
    """Body origin, world frame [m], (..., 3)."""
    velocity: Array
    """World frame [m/s], (..., 3)."""
    yaw: Array
    """Wanted heading [rad], (...)."""
    progress: Array
    """Part of the way in [0, 1], (...)."""


class Guide(Protocol):
    """A wanted motion; time counts from its start."""

    @property
    def name(self) -> str:
        """Of the station or trajectory."""

    @property
    def duration(self) -> float:
        """[s]; infinite for a station."""

    def at(self, t: npt.ArrayLike) -> Reference:
        """The reference at times since the start [s], (...); held at the ends beyond them."""


@dataclass(frozen=True)
class Station:
    """One pose to reach and hold."""

    position: tuple[float, float, float]
    """World frame [m]."""
    yaw: float
    """[rad]"""
    name: str = "station"
    duration: float = math.inf

    def at(self, t: npt.ArrayLike) -> Reference:
        """The same at all times."""
        shape = np.shape(t)
        place = np.broadcast_to(np.asarray(self.position, float), (*shape, 3))
        return Reference(place, np.zeros((*shape, 3)), np.full(shape, self.yaw), np.zeros(shape))


def goal_at(guide: Guide, t: float) -> Goal:
    """The level pose, velocity and acceleration that a pose controller is given at a time since the start [s]."""
    before, after = _around(guide, t)
    reference = guide.at(np.array([t, before, after]))
    velocity = reference.velocity
    acceleration = (velocity[2] - velocity[1]) / (after - before) if after > before else np.zeros(3)
    return Goal(reference.position[0], quat_from_yaw(reference.yaw[0]), velocity[0], acceleration)


def acceleration_at(guide: Guide, t: float) -> Array:
    """Acceleration of a guide, world frame [m/s²], (3,): the change of its velocity over 0.1 s; zero past its ends."""
    return np.asarray(goal_at(guide, t).acceleration)


def _around(guide: Guide, t: float) -> tuple[float, float]:
    """Times between which the acceleration is taken [s]; equal past the guide's ends."""
    if not 0.0 <= t <= guide.duration:
        return t, t
    return max(t - DIFFERENCE, 0.0), min(t + DIFFERENCE, guide.duration)
