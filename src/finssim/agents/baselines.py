"""Baselines: classical controllers of tasks, with the same observations and actions as a policy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from finssim.agents.pid import Pid, PidMemory
from finssim.control.guidance import Goal, Measured, Track
from finssim.core.rotations import (
    cross,
    matrix_to_quat,
    quat_conjugate,
    quat_from_euler,
    quat_from_yaw,
    quat_multiply,
    quat_rotate,
)
from finssim.tasks.moving_target import DISTANCE_SCALE as TARGET_DISTANCE_SCALE
from finssim.tasks.moving_target import TARGET_SCALE
from finssim.tasks.station_keeping import DISTANCE_SCALE as STATION_SCALE
from finssim.tasks.trajectory_tracking import DISTANCE_SCALE as TRACKING_SCALE
from finssim.tasks.trajectory_tracking import LOOK_AHEAD
from finssim.tasks.velocity import VELOCITY_SCALE
from finssim.vehicles import Vehicle
from finssim.vehicles.capability import coefficients_of

Array = NDArray[np.float64]
Rows = NDArray[np.float32]
"""Observations or actions, (n, numbers)."""
Mask = NDArray[np.bool_]
Pictures = Mapping[str, NDArray[np.uint8]]
"""Pictures by name, uint8 (n, height, width, channels)."""


PERIOD = 0.1
"""Control step of every task [s]."""
LEVEL = (0.0, 0.0, 0.0, 1.0)
"""No rotation, xyzw."""


class Baseline(Protocol):
    """Controller without internal state: its memory is an argument and a result of every call."""

    @property
    def period(self) -> float:
        """Time between two actions [s]."""

    def reset(self, n: int) -> Any:
        """Return the memory at the start of n episodes: tuples of arrays with n rows, or None."""

    def act(self, memory: Any, observation: NDArray[Any]) -> tuple[Rows, Any]:
        """Return actions (n, size) for observations (n, numbers), in the task's action mode, and the next memory."""


@dataclass(frozen=True)
class WrenchPid:
    """Base of the baselines with the full-wrench PID of `agents.pid`, whose state is derived from the observation."""

    pid: Pid

    @classmethod
    def for_vehicle(cls, vehicle: Vehicle, period: float = PERIOD) -> Any:
        """Return the baseline with gains by pole placement, for a period between actions [s] and observations
        without delay."""
        return cls(Pid.from_vehicle(vehicle, coefficients_of(vehicle), period, least_lag=0.0))

    @property
    def period(self) -> float:
        """Time between two actions [s]."""
        return self.pid.period

    def reset(self, n: int) -> Any:
        """Return zero integrals."""
        return self.pid.reset(n)

    def command(self, memory: PidMemory, measured: Measured, goal: Goal) -> tuple[Rows, PidMemory]:
        """Return actions (n, 6), as fractions of each axis' limit within ±1, and the next memory."""
        tau, memory = self.pid.command(memory, measured, goal)
        return part_of_limits(tau, np.asarray(self.pid.wrench_limits)), memory


def part_of_limits(tau: Array, limits: Array) -> Rows:
    """Return a wrench as a fraction of each axis' limit, (..., 6); 0 where the limit is 0.

    Args:
        tau: Wrench, body frame [N, N m], (..., 6).
        limits: Limit of each axis [N, N m], (6,).
    """
    return np.divide(tau, limits, out=np.zeros_like(tau), where=limits > 0.0).astype(np.float32)


class StationPid(WrenchPid):
    """PID of T1. The goal is level, so z of the goal frame is up, and the vehicle's pose in that frame is
    sufficient."""

    def act(self, memory: PidMemory, observation: Rows) -> tuple[Rows, PidMemory]:
        """Return the actions for observations of T1."""
        measured = seen_from_goal(observation)
        here = Goal(np.zeros_like(measured.position), np.broadcast_to(LEVEL, measured.quaternion.shape))
        return self.command(memory, measured, here)


def seen_from_goal(observation: Rows) -> Track:
    """Return the vehicle's state in the goal frame, from the first 15 numbers of T1's observation."""
    o = np.asarray(observation, float)
    q = turned_from(o)
    return Track(-quat_rotate(q, STATION_SCALE * o[..., :3]), q, o[..., 9:15])


def turned_from(o: Array) -> Array:
    """Return body to goal axes, xyzw, (n, 4), from two columns of the goal's rotation in observations (n,
    numbers)."""
    x, y = o[..., 3:6], o[..., 6:9]
    # The columns of R_b' R* are the goal's axes in the body; with their cross product they form the rotation.
    return quat_conjugate(matrix_to_quat(np.stack([x, y, cross(x, y)], axis=-1)))


class TrackingMemory(NamedTuple):
    """Memory of `TrackingPid`."""

    heading: Array
    """Heading relative to the start, integrated from the yaw rate [rad], (n,)."""
    pid: PidMemory


class TrackingPid(WrenchPid):
    """PID of T2, which keeps the initial heading: the observation has no heading, and the task requires none.

    It uses a level frame with the vehicle at the origin and x along the initial heading, known from the integrated
    yaw rate.
    """

    def reset(self, n: int) -> TrackingMemory:
        """Return zero headings and integrals."""
        return TrackingMemory(np.zeros(n), self.pid.reset(n))

    def act(self, memory: TrackingMemory, observation: Rows) -> tuple[Rows, TrackingMemory]:
        """Return the actions for observations of T2."""
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
        action, pid = self.command(memory.pid, Track(np.zeros_like(up), q, nu), goal)
        return action, TrackingMemory(memory.heading + self.period * heading_rate(up, nu), pid)


class TargetPid(TrackingPid):
    """PID of T3 with feed-forward of the target's velocity. The observation has no attitude, so a level one
    is assumed.

    The heading is relative to the start, from the yaw rate; roll and pitch are left to the vehicle's own
    stability and the feedback of their rates.
    """

    def act(self, memory: TrackingMemory, observation: Rows) -> tuple[Rows, TrackingMemory]:
        """Return the actions for observations of T3."""
        o = np.asarray(observation, float)
        q, nu = quat_from_yaw(memory.heading), o[..., 6:12]
        goal = Goal(
            quat_rotate(q, TARGET_DISTANCE_SCALE * o[..., :3]),
            quat_from_yaw(np.zeros(len(o))),
            quat_rotate(q, TARGET_SCALE * o[..., 3:6]),
        )
        action, pid = self.command(memory.pid, Track(np.zeros((len(o), 3)), q, nu), goal)
        return action, TrackingMemory(memory.heading + self.period * nu[..., 5], pid)


class VelocityPid(TrackingPid):
    """PID of `velocity6`: zero position error, and the commanded velocity as the goal's. Frame as in
    `TrackingPid`."""

    def act(self, memory: TrackingMemory, observation: Rows) -> tuple[Rows, TrackingMemory]:
        """Return the actions for observations of `velocity6`."""
        o = np.asarray(observation, float)
        up, nu = o[..., 15:18], o[..., 9:15]
        q = attitude_from(up, memory.heading)
        wanted = quat_rotate(q, VELOCITY_SCALE * o[..., :3] + nu[..., :3])
        goal = Goal(np.zeros_like(up), quat_multiply(q, quat_conjugate(turned_from(o))), wanted)
        action, pid = self.command(memory.pid, Track(np.zeros_like(up), q, nu), goal)
        return action, TrackingMemory(memory.heading + self.period * heading_rate(up, nu), pid)


def attitude_from(up: Array, heading: Array) -> Array:
    """Return body to level axes, xyzw, (n, 4), from the world's up in the body frame, (n, 3), and the heading
    [rad], (n,)."""
    roll = np.arctan2(up[..., 1], up[..., 2])
    pitch = np.arctan2(-up[..., 0], np.hypot(up[..., 1], up[..., 2]))
    return quat_from_euler(roll, pitch, heading)


def heading_rate(up: Array, nu: Array) -> Array:
    """Return (q sin φ + r cos φ) / cos θ, with up = [-sin θ, cos θ sin φ, cos θ cos φ].

    Args:
        up: World's up in the body frame [-], (n, 3).
        nu: Twist, body frame [m/s, rad/s], (n, 6).

    Returns:
        Rate of the heading [rad/s], (n,).
    """
    level = np.maximum(up[..., 1] ** 2 + up[..., 2] ** 2, 1e-6)
    return np.asarray((nu[..., 4] * up[..., 1] + nu[..., 5] * up[..., 2]) / level)


def acceleration_ahead(offsets: list[Array], velocity: Array) -> Array:
    """Return the acceleration of a reference from its current position, those one and two `LOOK_AHEAD` later,
    and its velocity.

    p(k) - p(0) = v k + a k²/2 + j k³/6; the combination of k and 2k eliminates the jerk j.

    Args:
        offsets: Vectors to the reference at the three times, in one frame [m], (n, 3) each.
        velocity: Velocity of the reference, same frame [m/s], (n, 3).

    Returns:
        Acceleration, same frame [m/s²], (n, 3).
    """
    near, far = offsets[1] - offsets[0], offsets[2] - offsets[0]
    return np.asarray((8.0 * near - far - 6.0 * LOOK_AHEAD * velocity) / (2.0 * LOOK_AHEAD**2))
