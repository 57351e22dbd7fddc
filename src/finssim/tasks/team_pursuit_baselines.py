"""The formation baseline of 3-v-1 pursuit: netters abreast of the prey, herder behind it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finssim.tasks.pursuit_baselines import PERIOD
from finssim.tasks.pursuit_drive import DriveNumbers
from finssim.tasks.pursuit_observation import DISTANCE_SCALE
from finssim.vehicles import Vehicle

__all__ = ["FormationPursuit"]

Array = NDArray[np.float64]


def level_unit(x: Array) -> Array:
    """Level directions of vectors (n, 3); zero where there is none."""
    level = x * np.array([1.0, 1.0, 0.0])
    length = np.linalg.norm(level, axis=1, keepdims=True)
    return level / np.maximum(length, 1e-6)


@dataclass(frozen=True)
class FormationPursuit:
    """Each agent goes to its place relative to the prey, from its own observation and with the prey's velocity added.

    The way ahead leads from the herder through the prey. Netters stand `forward` ahead of the prey and half of
    `spacing` to either side of the way, so that the net lies across it; the herder stays `behind`. Published with 6, 2
    and 3 m for vehicles twelve times as fast; here 0.4 times that.
    """

    drive: DriveNumbers
    spacing: float = 2.4
    forward: float = 0.8
    behind: float = 1.2
    gain: float = 0.6
    """Speed per distance to one's place [1/s]."""
    period: float = PERIOD

    @classmethod
    def for_vehicle(cls, vehicle: Vehicle) -> FormationPursuit:
        """With the numbers of a vehicle."""
        return cls(DriveNumbers.of(vehicle))

    def reset(self, n: int) -> None:
        """It remembers nothing."""
        return None

    def places(self, observation: Array) -> Array:
        """Where each agent should be, from itself, body frame [m], (n, 3); one row per agent."""
        prey = DISTANCE_SCALE * observation[:, 6:9]
        mates = DISTANCE_SCALE * np.stack([observation[:, 16:19], observation[:, 24:27]], axis=1)
        herds = observation[:, [14, 22]]
        herder = herds.max(axis=1) < 0.5
        ahead = level_unit(prey - np.einsum("nm,nmk->nk", herds, mates))
        across = np.column_stack([-ahead[:, 1], ahead[:, 0], np.zeros(len(ahead))])
        other = np.einsum("nm,nmk->nk", 1.0 - herds, mates)
        # Of two netters the one farther to the left of the way takes the left place.
        side = np.where(np.sum(other * across, axis=1) < 0.0, 1.0, -1.0)[:, None]
        netter = prey + self.forward * ahead + 0.5 * self.spacing * side * across
        drives = level_unit(0.5 * mates.sum(axis=1) - prey)
        return np.asarray(np.where(herder[:, None], prey - self.behind * drives, netter))

    def act(self, memory: None, observation: NDArray[np.float32]) -> tuple[NDArray[np.float32], None]:
        """Actions wrench4 for observations of team pursuit, (n, 30)."""
        o = np.asarray(observation, dtype=float)
        own, relative = o[:, 0:3], o[:, 9:12]
        place = self.places(o)
        wanted = own + relative + self.gain * place
        # Faster than the vehicle goes is the same direction as fast as it goes.
        level = np.maximum(np.linalg.norm(wanted[:, :2], axis=1, keepdims=True) / self.drive.top, 1.0)
        wanted[:, :2] /= level
        wanted[:, 2] = np.clip(wanted[:, 2], -self.drive.terminal[2], self.drive.terminal[2])
        error = np.where(
            np.linalg.norm(wanted[:, :2], axis=1) > 0.05, np.arctan2(wanted[:, 1], wanted[:, 0]), 0.0
        )
        velocity = np.column_stack([own, o[:, 5]])
        return self.drive.action(velocity, np.column_stack([wanted, self.drive.turned(error)])), None
