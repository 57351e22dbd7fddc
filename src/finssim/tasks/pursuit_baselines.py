"""Lead pursuit: a baseline of 1-v-1 pursuit that steers to where the prey will be."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finssim.tasks.pursuit_drive import DriveNumbers
from finssim.tasks.pursuit_observation import DISTANCE_SCALE
from finssim.vehicles import Vehicle

__all__ = ["LeadPursuit"]

Array = NDArray[np.float64]

PERIOD = 0.1
"""Control step of every task [s]."""


@dataclass(frozen=True)
class LeadPursuit:
    """Point at where the prey will be, turn first while that is far to the side, then come up and keep its speed.

    The point aimed at lies `lead` seconds ahead of the prey. Closing in, the speed wanted is the prey's plus
    `approach` times the way that is left to `stand_off`, so that the relative speed vanishes there.
    """

    drive: DriveNumbers
    lead: float = 0.30
    """[s]"""
    turn_first: float = math.radians(15.0)
    """A heading error above this is turned away before anything else [rad]."""
    approach: float = 0.5
    """[1/s]"""
    stand_off: float = 0.5
    """Distance that is gone to [m]."""
    period: float = PERIOD

    @classmethod
    def for_vehicle(cls, vehicle: Vehicle) -> LeadPursuit:
        """With the numbers of a vehicle."""
        return cls(DriveNumbers.of(vehicle))

    def reset(self, n: int) -> None:
        """It remembers nothing."""
        return None

    def act(self, memory: None, observation: NDArray[np.float32]) -> tuple[NDArray[np.float32], None]:
        """Actions wrench4 for observations of pursuit, (n, 14)."""
        o = np.asarray(observation, dtype=float)
        own, gap, relative = o[:, 0:3], DISTANCE_SCALE * o[:, 6:9], o[:, 9:12]
        aim = gap + self.lead * relative
        error = np.arctan2(aim[:, 1], aim[:, 0])
        distance = np.maximum(np.linalg.norm(gap, axis=1, keepdims=True), 1e-6)
        wanted = own + relative + self.approach * (distance - self.stand_off) * aim / distance
        top = np.array([self.drive.top, *self.drive.terminal[1:3]])
        wanted = np.clip(wanted, -top, top)
        velocity = np.column_stack([own, o[:, 5]])
        action = self.drive.action(velocity, np.column_stack([wanted, self.drive.turned(error)]))
        action[np.abs(error) > self.turn_first, :2] = 0.0
        return action, None
