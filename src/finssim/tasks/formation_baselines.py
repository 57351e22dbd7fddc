"""The classical controller of formation keeping: a consensus on the shape, and a state machine for where to go."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finssim.tasks.formation import NEAR, Formation
from finssim.tasks.pursuit_baselines import PERIOD
from finssim.tasks.pursuit_drive import DriveNumbers
from finssim.tasks.pursuit_observation import DISTANCE_SCALE, PI
from finssim.vehicles import Vehicle

__all__ = ["ConsensusFormation"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ConsensusFormation:
    """Each agent pulls its edges to equal sides and its height to the others', and adds what the state asks for.

    gather, while an edge is off by more than `loose`: the shape alone. approach: the net's middle goes to the target.
    carry, while the net has the target: on to the goal, with the target kept in the middle. Which state it is follows
    from the observation alone, so that all three agree without a word, as far as they see the same.
    """

    drive: DriveNumbers
    side: float
    """Of the net [m]."""
    reach: float
    """Distance from the net within which it has the target [m]."""
    shape: float = 0.6
    """Speed per error of an edge or of the height [1/s]."""
    go: float = 0.4
    """Speed per distance [1/s]."""
    cruise: float = 0.5
    """Largest speed of the net's middle, as a part of the vehicle's slowest steady speed."""
    loose: float = 0.15
    """[sides]"""
    period: float = PERIOD

    @classmethod
    def for_vehicle(cls, vehicle: Vehicle) -> ConsensusFormation:
        """With the numbers of a vehicle, for the net that three of them carry by the task's default settings."""
        task = Formation().fitted([vehicle])
        return cls(DriveNumbers.of(vehicle), task.side, task.reach)

    def reset(self, n: int) -> None:
        """It remembers nothing."""
        return None

    def act(self, memory: None, observation: NDArray[np.float32]) -> tuple[NDArray[np.float32], None]:
        """Actions wrench4 for observations of formation, (n, 34)."""
        o = np.asarray(observation, dtype=float)
        own = o[:, 0:3]
        mates = DISTANCE_SCALE * np.stack([o[:, 14:17], o[:, 20:23]], axis=1)
        wanted = self.shaping(mates) + self.going(o, mates.sum(axis=1) / 3.0)
        velocity = np.column_stack([own, o[:, 5]])
        turn = self.drive.turned(PI * o[:, 13])
        return self.drive.action(velocity, np.column_stack([wanted, turn])), None

    def shaping(self, mates: Array) -> Array:
        """Velocity towards equal sides and equal heights, from the team-mates' places, (n, 2, 3)."""
        length = np.maximum(np.linalg.norm(mates, axis=2, keepdims=True), 1e-6)
        pull = np.sum((length - self.side) * mates / length, axis=1)
        pull[:, 2] = mates[:, :, 2].sum(axis=1)
        return np.asarray(self.shape * pull)

    def going(self, o: Array, middle: Array) -> Array:
        """Velocity of the net's middle, from the observation and from where the middle is."""
        target, goal = NEAR * o[:, 6:9], NEAR * o[:, 26:29]
        has = (NEAR * o[:, 32] <= self.reach) & (o[:, 33] >= 0.0)
        way = np.where(has[:, None], goal - target + 0.5 * (target - middle), target - middle)
        speed = self.go * np.linalg.norm(way, axis=1, keepdims=True)
        top = self.cruise * min(self.drive.top, *self.drive.terminal[1:3])
        going = self.go * way * np.minimum(1.0, top / np.maximum(speed, 1e-6))
        loose = np.abs(o[:, 29:32]).max(axis=1) > self.loose
        return np.asarray(np.where(loose[:, None], 0.0, going))
