"""Baselines of teams: lead pursuit, a formation around the prey, and a consensus formation of a net."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from finssim.agents.baselines import Array
from finssim.agents.drive import DriveBaseline, DriveNumbers
from finssim.extensions.teams.formation import NEAR, Formation
from finssim.extensions.teams.pursuit import DISTANCE_SCALE as CHASE_SCALE
from finssim.extensions.teams.pursuit import PI
from finssim.vehicles import Vehicle


@dataclass(frozen=True, kw_only=True)
class LeadPursuit(DriveBaseline):
    """Controller that points at a predicted position of the prey, turns first while that is far to the side,
    then approaches and matches the prey's speed.

    The predicted position is `lead` seconds ahead of the prey. The target speed is the prey's speed plus
    `approach` times the remaining distance to `stand_off`, so that the relative speed vanishes there.
    """

    lead: float = 0.30
    """Time of the prediction [s]."""
    turn_first: float = math.radians(15.0)
    """Bearing of the prey beyond which the vehicle turns before it drives [rad]."""
    approach: float = 0.5
    """Closing speed per remaining distance [1/s]."""
    stand_off: float = 0.5
    """Distance from the prey that is kept [m]."""

    def wanted(self, o: Array) -> tuple[Array, Array]:
        """See `DriveBaseline`."""
        velocity, gap, relative = o[:, 0:3], CHASE_SCALE * o[:, 6:9], o[:, 9:12]
        aim = gap + self.lead * relative
        distance = np.maximum(np.linalg.norm(gap, axis=1, keepdims=True), 1e-6)
        target = velocity + relative + self.approach * (distance - self.stand_off) * aim / distance
        top = np.array([self.drive.top, *self.drive.terminal[1:3]])
        return np.clip(target, -top, top), np.arctan2(aim[:, 1], aim[:, 0])


# The classical controller of formation keeping: a consensus on the shape, and a state machine for the net's path.


@dataclass(frozen=True, kw_only=True)
class ConsensusFormation(DriveBaseline):
    """Consensus formation: each agent drives its edges to equal length and its height to that of the others,
    and adds a velocity that depends on the state.

    gather: while an edge error is above `loose`, only the shape is controlled. approach: the net's centre
    moves to the target. carry: while the net holds the target, it moves on to the goal, with the target kept
    at its centre. The state follows from the observation only, so all three agents agree without messages if
    they observe the same.
    """

    side: float
    """Side of the net [m]."""
    reach: float
    """Distance from the net within which it holds the target [m]."""
    shape: float = 0.6
    """Speed per error of an edge or of the height [1/s]."""
    go: float = 0.4
    """Speed per distance to the target or goal [1/s]."""
    cruise: float = 0.5
    """Largest speed of the net's centre, as a share of the vehicle's slowest steady speed."""
    loose: float = 0.15
    """Edge error above which only the shape is controlled, as a share of the side [-]."""

    @classmethod
    def for_vehicle(cls, vehicle: Vehicle) -> ConsensusFormation:
        """Return the baseline with the numbers of a vehicle, for the net that three such vehicles carry by default."""
        task = Formation().fitted([vehicle])
        return cls(drive=DriveNumbers.of(vehicle), side=task.side, reach=task.reach)

    def wanted(self, o: Array) -> tuple[Array, Array]:
        """See `DriveBaseline`; of observations (n, 34)."""
        mates = CHASE_SCALE * np.stack([o[:, 14:17], o[:, 20:23]], axis=1)
        return self.shaping(mates) + self.going(o, mates.sum(axis=1) / 3.0), PI * o[:, 13]

    def shaping(self, mates: Array) -> Array:
        """Return the velocity [m/s] towards equal sides and heights, from the team-mates' positions [m], (n, 2, 3)."""
        length = np.maximum(np.linalg.norm(mates, axis=2, keepdims=True), 1e-6)
        pull = np.sum((length - self.side) * mates / length, axis=1)
        pull[:, 2] = mates[:, :, 2].sum(axis=1)
        return np.asarray(self.shape * pull)

    def going(self, o: Array, middle: Array) -> Array:
        """Return the velocity of the net's centre, from the observation and the position of the centre."""
        target, goal = NEAR * o[:, 6:9], NEAR * o[:, 26:29]
        has = (NEAR * o[:, 32] <= self.reach) & (o[:, 33] >= 0.0)
        way = np.where(has[:, None], goal - target + 0.5 * (target - middle), target - middle)
        speed = self.go * np.linalg.norm(way, axis=1, keepdims=True)
        top = self.cruise * min(self.drive.top, *self.drive.terminal[1:3])
        going = self.go * way * np.minimum(1.0, top / np.maximum(speed, 1e-6))
        loose = np.abs(o[:, 29:32]).max(axis=1) > self.loose
        return np.asarray(np.where(loose[:, None], 0.0, going))


# The formation baseline of 3-v-1 pursuit: netters on both sides ahead of the prey, herder behind it.


def level_unit(x: Array) -> Array:
    """Return the horizontal unit directions of vectors (n, 3); zero for vertical ones."""
    level = x * np.array([1.0, 1.0, 0.0])
    length = np.linalg.norm(level, axis=1, keepdims=True)
    return level / np.maximum(length, 1e-6)


@dataclass(frozen=True, kw_only=True)
class FormationPursuit(DriveBaseline):
    """Controller that moves each agent to its position relative to the prey, from its own observation and
    with the prey's velocity added.

    The drive direction leads from the herder through the prey. Netters keep `forward` ahead of the prey and
    half of `spacing` to either side of that line, so that the net is perpendicular to it; the herder keeps
    `behind`. The published values are 6, 2 and 3 m for vehicles twelve times as fast; these are 0.4 times
    those.
    """

    spacing: float = 2.4
    forward: float = 0.8
    behind: float = 1.2
    gain: float = 0.6
    """Speed per distance to the agent's target position [1/s]."""

    def places(self, observation: Array) -> Array:
        """Return the target position of each agent relative to itself, body frame [m], (n, 3); one row per agent."""
        prey = CHASE_SCALE * observation[:, 6:9]
        mates = CHASE_SCALE * np.stack([observation[:, 16:19], observation[:, 24:27]], axis=1)
        herds = observation[:, [14, 22]]
        herder = herds.max(axis=1) < 0.5
        ahead = level_unit(prey - np.einsum("nm,nmk->nk", herds, mates))
        across = np.column_stack([-ahead[:, 1], ahead[:, 0], np.zeros(len(ahead))])
        other = np.einsum("nm,nmk->nk", 1.0 - herds, mates)
        # Of two netters the one farther to the left takes the left position.
        side = np.where(np.sum(other * across, axis=1) < 0.0, 1.0, -1.0)[:, None]
        netter = prey + self.forward * ahead + 0.5 * self.spacing * side * across
        drives = level_unit(0.5 * mates.sum(axis=1) - prey)
        return np.asarray(np.where(herder[:, None], prey - self.behind * drives, netter))

    def wanted(self, o: Array) -> tuple[Array, Array]:
        """See `DriveBaseline`; of observations (n, 30)."""
        target = o[:, 0:3] + o[:, 9:12] + self.gain * self.places(o)
        # A target speed above the vehicle's top speed is reduced without a change of direction.
        level = np.maximum(np.linalg.norm(target[:, :2], axis=1, keepdims=True) / self.drive.top, 1.0)
        target[:, :2] /= level
        target[:, 2] = np.clip(target[:, 2], -self.drive.terminal[2], self.drive.terminal[2])
        moving = np.linalg.norm(target[:, :2], axis=1) > 0.05
        return target, np.where(moving, np.arctan2(target[:, 1], target[:, 0]), 0.0)
