"""References over time, inputs of pose controllers, and errors relative to the goal."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from finssim.core.rotations import (
    cross,
    quat_conjugate,
    quat_from_yaw,
    quat_inverse_rotate,
    quat_multiply,
    quat_rotate,
    quat_to_rotvec,
    wrap_angle,
)

# Inputs of every pose controller, its error, and the common interface of controllers.


Array = npt.NDArray[np.float64]


class Measured(Protocol):
    """State of a vehicle as the input of a controller; any object with these attributes is accepted."""

    @property
    def position(self) -> Any:
        """Position of the body origin, world frame [m], (..., 3)."""

    @property
    def quaternion(self) -> Any:
        """Attitude, body to world, xyzw, (..., 4)."""

    @property
    def nu(self) -> Any:
        """Velocity of the body origin and angular velocity, body frame [m/s, rad/s], (..., 6)."""


@dataclass(frozen=True)
class Track:
    """State of one or n moving objects, such as another vehicle; it is a `Measured`."""

    position: Array
    """Position of the origin, world frame [m], (..., 3)."""
    quaternion: Array
    """Attitude, body to world, xyzw, (..., 4)."""
    nu: Array
    """Velocity, body frame [m/s, rad/s], (..., 6)."""
    time: float = math.nan
    """Time of the measurement [s]; NaN if unknown."""


@dataclass(frozen=True)
class Known:
    """Measurements as plain arrays; fields that are not needed may be omitted."""

    observation: Any
    """Observation of the task, in the order and the units of its parts, (..., n)."""
    position: Any = None
    """Position of the body origin, world frame [m], (..., 3)."""
    quaternion: Any = None
    """Attitude, body to world, xyzw, (..., 4)."""
    nu: Any = None
    """Linear [m/s] and angular [rad/s] velocity, body frame, (..., 6)."""
    pictures: Any = None
    """Pictures by name: uint8 (n, height, width, 3)."""


@dataclass(frozen=True)
class Goal:
    """Pose to hold, and its motion."""

    position: Any
    """Position of the body origin, world frame [m], (..., 3)."""
    quaternion: Any
    """Requested attitude, body to world, xyzw, (..., 4)."""
    velocity: Any = (0.0, 0.0, 0.0)
    """Velocity of the goal, world frame [m/s], (..., 3)."""
    acceleration: Any = (0.0, 0.0, 0.0)
    """Acceleration of the goal, world frame [m/s²], (..., 3)."""


class Controller(Protocol):
    """A controller without internal state: its memory is an argument and a result of every call."""

    @property
    def period(self) -> float:
        """Interval between two calls of `command` [s]."""

    def reset(self, n: int | None = None) -> Any:
        """Return the initial memory, for one vehicle or for a batch of n."""

    def command(self, memory: Any, measured: Measured, goal: Goal) -> tuple[Array, Any]:
        """Return the requested wrench about `vehicle.wrench_reference`, body frame [N, N m], (..., 6), and
        the new memory."""


class TrackingError(NamedTuple):
    """Difference between goal and measurement, in the measured body's axes."""

    pose: Array
    """Distances of a body point to its goal along three axes [m], then tilt about x and y and heading [rad],
    (..., 6)."""
    velocity: Array
    """Velocity of the goal, body frame; its angular part is zero [m/s, rad/s], (..., 6)."""


def tracking_error(measured: Measured, goal: Goal, point: npt.ArrayLike) -> TrackingError:
    """Return the error of a body point's position and of the attitude.

    The rotation to the goal is split into a rotation about the body's z axis (heading error, wrapped) and a
    tilt without rotation about z, so that a large heading error does not affect the levelling.

    Args:
        measured: State of the vehicle.
        goal: Goal of the vehicle.
        point: Body point, body frame [m], (3,).
    """
    q, q_goal = np.asarray(measured.quaternion, float), np.asarray(goal.quaternion, float)
    to_goal = np.asarray(goal.position, float) - np.asarray(measured.position, float)
    to_goal = to_goal + quat_rotate(q_goal, point)
    distance = quat_inverse_rotate(q, to_goal) - np.asarray(point, float)

    relative = quat_multiply(quat_conjugate(q), q_goal)
    heading = wrap_angle(2.0 * np.arctan2(relative[..., 2], relative[..., 3]))
    tilt = quat_to_rotvec(quat_multiply(relative, quat_from_yaw(-heading)))[..., :2]
    drift = quat_inverse_rotate(q, np.asarray(goal.velocity, float))
    return TrackingError(
        np.concatenate([distance, tilt, heading[..., None]], axis=-1),
        np.concatenate([drift, np.zeros_like(drift)], axis=-1),
    )


def velocity_at(nu: npt.ArrayLike, point: npt.ArrayLike) -> Array:
    """Return the twist of the body at a body point: v + omega x r and omega, body frame [m/s, rad/s], (..., 6).

    Args:
        nu: Twist of the body origin, body frame [m/s, rad/s], (..., 6).
        point: r from the body origin, body frame [m], (3,).
    """
    nu = np.asarray(nu, float)
    return np.concatenate([nu[..., :3] + cross(nu[..., 3:], np.asarray(point, float)), nu[..., 3:]], axis=-1)


DIFFERENCE = 0.05
"""Half the interval of the finite difference for an acceleration [s]: a controller's period."""


@dataclass(frozen=True)
class Reference:
    """Requested motion at one time or, with a leading batch dimension, at several."""

    position: Array
    """Position of the body origin, world frame [m], (..., 3)."""
    velocity: Array
    """Velocity, world frame [m/s], (..., 3)."""
    yaw: Array
    """Requested heading [rad], (...)."""
    progress: Array
    """Fraction of the path in [0, 1], (...)."""


class Guide(Protocol):
    """Requested motion; time counts from its start."""

    @property
    def name(self) -> str:
        """Name of the station or trajectory."""

    @property
    def duration(self) -> float:
        """Duration [s]; infinite for a station."""

    def at(self, t: npt.ArrayLike) -> Reference:
        """Return the reference at times since the start [s], (...); it is constant before and after the duration."""


@dataclass(frozen=True)
class Station:
    """Pose to reach and hold."""

    position: tuple[float, float, float]
    """Position in the world frame [m]."""
    yaw: float
    """Heading [rad]."""
    name: str = "station"
    duration: float = math.inf
    """Time to hold the pose [s]."""

    def at(self, t: npt.ArrayLike) -> Reference:
        """Return the same reference at all times. Times `t` are in [s]."""
        shape = np.shape(t)
        position = np.broadcast_to(np.asarray(self.position, float), (*shape, 3))
        return Reference(position, np.zeros((*shape, 3)), np.full(shape, self.yaw), np.zeros(shape))


def goal_at(guide: Guide, t: float) -> Goal:
    """Return the level pose, velocity and acceleration for a pose controller at a time since the start [s]."""
    before, after = _around(guide, t)
    reference = guide.at(np.array([t, before, after]))
    velocity = reference.velocity
    acceleration = (velocity[2] - velocity[1]) / (after - before) if after > before else np.zeros(3)
    return Goal(reference.position[0], quat_from_yaw(reference.yaw[0]), velocity[0], acceleration)


def acceleration_at(guide: Guide, t: float) -> Array:
    """Return the acceleration of a guide, world frame [m/s²], (3,): the change of its velocity over 0.1 s;
    zero beyond its ends."""
    return np.asarray(goal_at(guide, t).acceleration)


def _around(guide: Guide, t: float) -> tuple[float, float]:
    """Return the times of the finite difference for the acceleration [s]; equal beyond the guide's ends."""
    if not 0.0 <= t <= guide.duration:
        return t, t
    return max(t - DIFFERENCE, 0.0), min(t + DIFFERENCE, guide.duration)
