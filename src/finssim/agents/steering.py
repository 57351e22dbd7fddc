"""Baselines of tasks for vehicles that need speed to steer: classical guidance by references to the autopilot."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finssim.agents.baselines import PERIOD, Rows
from finssim.control.course import STEEPEST, WIDEST
from finssim.control.path_following import LineOfSight, PathErrors, SeabedFollower
from finssim.core.rotations import cross
from finssim.tasks.path import ERROR_SCALE, Cruise
from finssim.tasks.terrain import Beam, TerrainFollowing
from finssim.vehicles import Vehicle

Array = NDArray[np.float64]

LOOK_AHEAD_TIME = 1.5
"""Look-ahead distance on the path, as a time at cruising speed [s]."""


@dataclass(frozen=True, kw_only=True)
class PathPilot:
    """Line of sight with integral action along a path, from the observation."""

    cruise: Cruise
    guide: LineOfSight
    period: float = PERIOD
    """Time between two actions [s]."""

    @classmethod
    def for_vehicle(cls, vehicle: Vehicle) -> PathPilot:
        """Return the baseline for the speed of a vehicle."""
        cruise = Cruise.of(vehicle)
        return cls(
            cruise=cruise, guide=LineOfSight(LOOK_AHEAD_TIME * cruise.speed, gain=0.1, steepest=STEEPEST)
        )

    def reset(self, n: int) -> Array:
        """Return empty integrals [m s], (n, 2)."""
        return self.guide.reset(n)

    def act(self, memory: Array, observation: Rows) -> tuple[Rows, Array]:
        """Return the actions for observations, (n, numbers): cruising speed, course and pitch."""
        o = np.asarray(observation, float)
        up, velocity, ahead = o[:, 17:20], o[:, 11:14], o[:, 5:8]
        across, above = (ERROR_SCALE * self.cruise.size * o[:, i] for i in (0, 1))
        slope = -np.arcsin(np.clip((ahead * up).sum(axis=1), -1.0, 1.0))
        nothing = np.zeros(len(o))
        errors = PathErrors(level_angle(velocity, ahead, up), slope, nothing, across, above, nothing)
        (turn, pitch), after = self.guide.aim(memory, errors, self.period)
        action = np.column_stack([nothing, turn / WIDEST, pitch / STEEPEST])
        return np.clip(action, -1.0, 1.0).astype(np.float32), after


def level_angle(start: Array, end: Array, up: Array) -> Array:
    """Return the angle about the vertical from one direction to another, counter-clockwise from above [rad], (n,).

    Args:
        start: First direction, body frame [-], (n, 3).
        end: Second direction, body frame [-], (n, 3).
        up: World's up, body frame [-], (n, 3).
    """
    across = (cross(start, end) * up).sum(axis=1)
    along = (start * end).sum(axis=1) - (start * up).sum(axis=1) * (end * up).sum(axis=1)
    return np.asarray(np.arctan2(across, along))


@dataclass(frozen=True, kw_only=True)
class TerrainPilot:
    """Constant altitude, from the beams' estimate of the seabed, and line of sight along the survey line."""

    cruise: Cruise
    guide: LineOfSight
    follower: SeabedFollower
    beam: Beam
    """Beam of the altimeter."""
    period: float = PERIOD
    """Time between two actions [s]."""

    @classmethod
    def for_vehicle(cls, vehicle: Vehicle) -> TerrainPilot:
        """Return the baseline for the speed of a vehicle."""
        cruise = Cruise.of(vehicle)
        guide = LineOfSight(LOOK_AHEAD_TIME * cruise.speed, gain=0.1, steepest=STEEPEST)
        follower = SeabedFollower(TerrainFollowing().altitude * cruise.size, time_constant=0.5, ahead=1.0)
        beam = TerrainFollowing().fitted([vehicle]).below
        return cls(cruise=cruise, guide=guide, follower=follower, beam=beam)

    def reset(self, n: int) -> tuple[Array, Array]:
        """Return empty integrals [m s], (n, 2), and an unknown seabed [m, m/s], (n, 2)."""
        return self.guide.reset(n), self.follower.reset(n)

    def act(self, memory: tuple[Array, Array], observation: Rows) -> tuple[Rows, tuple[Array, Array]]:
        """Return the actions for observations, (n, numbers): cruising speed, course and pitch."""
        o = np.asarray(observation, float)
        size = self.cruise.size
        line, velocity, up = o[:, 4:7], o[:, 7:10], o[:, 13:16]
        depth = 10.0 * size * o[:, 2]
        # Height over a level seabed; the echo angle of a wide beam is nearer to the vertical than its axis.
        beta = np.arccos(np.clip(-(up * self.beam.direction).sum(axis=1), -1.0, 1.0))
        below = 5.0 * size * o[:, 0] * np.cos(self.beam.echo_angle(beta))
        altitude = below - (up * self.beam.position).sum(axis=1)
        wanted, rate, seabed = self.follower.depth(memory[1], depth, altitude, self.period)
        slope = np.arcsin(np.clip(rate / self.cruise.speed, -1.0, 1.0))
        nothing = np.zeros(len(o))
        across = ERROR_SCALE * size * o[:, 3]
        errors = PathErrors(level_angle(velocity, line, up), slope, nothing, across, wanted - depth, nothing)
        (turn, pitch), integrals = self.guide.aim(memory[0], errors, self.period)
        action = np.column_stack([nothing, turn / WIDEST, pitch / STEEPEST])
        return np.clip(action, -1.0, 1.0).astype(np.float32), (integrals, seabed)


@dataclass(frozen=True, kw_only=True)
class HomingPilot:
    """Course towards the dock plus an angle proportional to the bearing's angle to the axis, so that the path
    joins the axis."""

    lead: float = 1.0
    """Fraction of the angle from the axis to the bearing that is added to the bearing [-]."""
    period: float = PERIOD
    """Time between two actions [s]."""

    @classmethod
    def for_vehicle(cls, vehicle: Vehicle) -> HomingPilot:
        """Return the baseline, which is the same for every vehicle."""
        return cls()

    def reset(self, n: int) -> Array:
        """Return an empty memory [-], (n, 0)."""
        return np.zeros((n, 0))

    def act(self, memory: Array, observation: Rows) -> tuple[Rows, Array]:
        """Return the actions for observations, (n, numbers): cruising speed, course and pitch."""
        o = np.asarray(observation, float)
        dock, axis, velocity, up = o[:, 0:3], o[:, 3:6], o[:, 6:9], o[:, 12:15]
        turn = level_angle(velocity, dock, up) + self.lead * level_angle(axis, dock, up)
        slopes = [-np.arcsin(np.clip((way * up).sum(axis=1), -1.0, 1.0)) for way in (dock, axis)]
        pitch = slopes[0] + self.lead * (slopes[0] - slopes[1])
        action = np.column_stack([np.zeros(len(o)), turn / WIDEST, pitch / STEEPEST])
        return np.clip(action, -1.0, 1.0).astype(np.float32), memory
