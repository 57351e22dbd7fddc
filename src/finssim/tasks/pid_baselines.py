"""The PID as a baseline: the state that it needs is read from the observation, and from nothing else."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from finssim.control.pid import Pid, PidMemory
from finssim.control.tracking import Goal
from finssim.geometry.rotations import (
    cross,
    matrix_to_quat,
    quat_conjugate,
    quat_from_euler,
    quat_from_yaw,
    quat_rotate,
)
from finssim.tasks.fitting import coefficients_of
from finssim.tasks.moving_target import DISTANCE_SCALE as TARGET_DISTANCE_SCALE
from finssim.tasks.moving_target import TARGET_SCALE
from finssim.tasks.station_keeping import DISTANCE_SCALE
from finssim.tasks.trajectory_tracking import DISTANCE_SCALE as TRACKING_SCALE
from finssim.tasks.trajectory_tracking import LOOK_AHEAD
from finssim.vehicles import Vehicle

__all__ = ["Seen", "StationPid", "TargetPid", "TrackingPid", "WrenchPid"]

Array = NDArray[np.float64]

PERIOD = 0.1
"""Control step of every task [s]."""


class Seen(NamedTuple):
    """A vehicle's state as `Pid` takes it, in axes that the observation can tell: z up, the rest as said there."""

    position: Array
    """Body origin [m], (n, 3)."""
    quaternion: Array
    """Body to those axes, xyzw, (n, 4)."""
    nu: Array
    """Body frame [m/s, rad/s], (n, 6)."""


@dataclass(frozen=True)
class WrenchPid:
    """The full-wrench PID of `control.pid`, whose wrench is given as a part of each axis' limit."""

    pid: Pid

    @classmethod
    def for_vehicle(cls, vehicle: Vehicle, period: float = PERIOD) -> WrenchPid:
        """Gains by pole placement for a vehicle and the time between two actions [s]; a batch shows it the present."""
        return cls(Pid.from_vehicle(vehicle, coefficients_of(vehicle), period, least_lag=0.0))

    def command(self, memory: PidMemory, seen: Seen, goal: Goal) -> tuple[NDArray[np.float32], PidMemory]:
        """Actions (n, 6), limited to ±1, and the memory after."""
        tau, memory = self.pid.command(memory, seen, goal)
        limits = self.pid.wrench_limits
        action = np.divide(tau, limits, out=np.zeros_like(tau), where=limits > 0.0)
        return action.astype(np.float32), memory


@dataclass(frozen=True)
class StationPid:
    """PID of T1. The goal is level, so its own axes have z up: the vehicle's pose in them is all that matters."""

    controller: WrenchPid

    @classmethod
    def for_vehicle(cls, vehicle: Vehicle, period: float = PERIOD) -> StationPid:
        """For a vehicle, and the time between two actions [s]."""
        return cls(WrenchPid.for_vehicle(vehicle, period))

    @property
    def period(self) -> float:
        """Time between two actions [s]."""
        return self.controller.pid.period

    def reset(self, n: int) -> PidMemory:
        """Empty integrals."""
        return self.controller.pid.reset(n)

    def act(
        self, memory: PidMemory, observation: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], PidMemory]:
        """Actions for observations of T1."""
        seen = seen_from_goal(observation)
        here = Goal(
            np.zeros_like(seen.position), np.broadcast_to([0.0, 0.0, 0.0, 1.0], seen.quaternion.shape)
        )
        return self.controller.command(memory, seen, here)


def seen_from_goal(observation: NDArray[np.float32]) -> Seen:
    """The vehicle in the axes of its goal, from the first 15 numbers of T1's observation."""
    o = np.asarray(observation, float)
    x, y = o[..., 3:6], o[..., 6:9]
    # The columns of R_b' R*: the goal's axes in the body. Together with their cross product they are the rotation.
    q = quat_conjugate(matrix_to_quat(np.stack([x, y, cross(x, y)], axis=-1)))
    return Seen(-quat_rotate(q, DISTANCE_SCALE * o[..., :3]), q, o[..., 9:15])


class TrackingMemory(NamedTuple):
    """What `TrackingPid` remembers."""

    heading: Array
    """Heading since the start, counted from the yaw rate [rad], (n,)."""
    pid: PidMemory


@dataclass(frozen=True)
class TrackingPid:
    """PID of T2. The observation has no heading, and none is asked for: the vehicle keeps the one it starts with.

    The axes are level, with the vehicle at the origin and x where it pointed at the start, as its yaw rate tells.
    """

    controller: WrenchPid

    @classmethod
    def for_vehicle(cls, vehicle: Vehicle, period: float = PERIOD) -> TrackingPid:
        """For a vehicle, and the time between two actions [s]."""
        return cls(WrenchPid.for_vehicle(vehicle, period))

    @property
    def period(self) -> float:
        """Time between two actions [s]."""
        return self.controller.pid.period

    def reset(self, n: int) -> TrackingMemory:
        """Heading zero, empty integrals."""
        return TrackingMemory(np.zeros(n), self.controller.pid.reset(n))

    def act(
        self, memory: TrackingMemory, observation: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], TrackingMemory]:
        """Actions for observations of T2."""
        o = np.asarray(observation, float)
        up, nu = o[..., 21:24], o[..., 15:21]
        q = attitude_from(up, memory.heading)
        offsets = [TRACKING_SCALE * o[..., 3 * i : 3 * i + 3] for i in range(3)]
        goal = Goal(
            quat_rotate(q, offsets[0]),
            quat_from_yaw(np.zeros(len(o))),
            quat_rotate(q, o[..., 12:15]),
            quat_rotate(q, acceleration_ahead(offsets, o[..., 12:15])),
        )
        action, pid = self.controller.command(memory.pid, Seen(np.zeros_like(up), q, nu), goal)
        return action, TrackingMemory(memory.heading + self.period * heading_rate(up, nu), pid)


@dataclass(frozen=True)
class TargetPid:
    """PID of T3 with the target's velocity fed forward. The observation has no attitude: it is taken to be level.

    The heading is the one at the start, as the yaw rate tells; roll and pitch are left to the water and their rates.
    """

    controller: WrenchPid

    @classmethod
    def for_vehicle(cls, vehicle: Vehicle, period: float = PERIOD) -> TargetPid:
        """For a vehicle, and the time between two actions [s]."""
        return cls(WrenchPid.for_vehicle(vehicle, period))

    @property
    def period(self) -> float:
        """Time between two actions [s]."""
        return self.controller.pid.period

    def reset(self, n: int) -> TrackingMemory:
        """Heading zero, empty integrals."""
        return TrackingMemory(np.zeros(n), self.controller.pid.reset(n))

    def act(
        self, memory: TrackingMemory, observation: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], TrackingMemory]:
        """Actions for observations of T3."""
        o = np.asarray(observation, float)
        q, nu = quat_from_yaw(memory.heading), o[..., 6:12]
        goal = Goal(
            quat_rotate(q, TARGET_DISTANCE_SCALE * o[..., :3]),
            quat_from_yaw(np.zeros(len(o))),
            quat_rotate(q, TARGET_SCALE * o[..., 3:6]),
        )
        action, pid = self.controller.command(memory.pid, Seen(np.zeros((len(o), 3)), q, nu), goal)
        return action, TrackingMemory(memory.heading + self.period * nu[..., 5], pid)


def attitude_from(up: Array, heading: Array) -> Array:
    """Body to level axes, xyzw, (n, 4), from the world's up in the body, (n, 3), and a heading [rad], (n,)."""
    roll = np.arctan2(up[..., 1], up[..., 2])
    pitch = np.arctan2(-up[..., 0], np.hypot(up[..., 1], up[..., 2]))
    return quat_from_euler(roll, pitch, heading)


def heading_rate(up: Array, nu: Array) -> Array:
    """(q sin φ + r cos φ) / cos θ, with up = [-sin θ, cos θ sin φ, cos θ cos φ].

    Args:
        up: World's up in the body frame [-], (n, 3).
        nu: Twist, body frame [m/s, rad/s], (n, 6).

    Returns:
        [rad/s], (n,).
    """
    level = np.maximum(up[..., 1] ** 2 + up[..., 2] ** 2, 1e-6)
    return np.asarray((nu[..., 4] * up[..., 1] + nu[..., 5] * up[..., 2]) / level)


def acceleration_ahead(offsets: list[Array], velocity: Array) -> Array:
    """Acceleration of a reference from where it is now, one and two `LOOK_AHEAD` later, and its velocity.

    p(k) - p(0) = v k + a k²/2 + j k³/6; of k and 2k together the jerk j falls out.

    Args:
        offsets: Way to the reference at the three times, in one frame [m], (n, 3) each.
        velocity: Of the reference, same frame [m/s], (n, 3).

    Returns:
        Same frame [m/s²], (n, 3).
    """
    near, far = offsets[1] - offsets[0], offsets[2] - offsets[0]
    return np.asarray((8.0 * near - far - 6.0 * LOOK_AHEAD * velocity) / (2.0 * LOOK_AHEAD**2))
