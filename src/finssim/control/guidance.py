"""References over time, the readings that a controller receives, and errors to the goal."""

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

# What every pose controller is given and how far it is from its goal; the interface controllers share.


Array = npt.NDArray[np.float64]


class Measured(Protocol):
    """A vehicle's state as a controller reads it; any object with these attributes will do."""

    @property
    def position(self) -> Any:
        """Body origin, world frame [m], (..., 3)."""

    @property
    def quaternion(self) -> Any:
        """Body to world, xyzw, (..., 4)."""

    @property
    def nu(self) -> Any:
        """Velocity of the body origin and angular velocity, body frame [m/s, rad/s], (..., 6)."""


@dataclass(frozen=True)
class Track:
    """The state of something that moves, or of n of them, such as another vehicle; it is a `Measured`."""

    position: Array
    """Its origin, world frame [m], (..., 3)."""
    quaternion: Array
    """Body to world, xyzw, (..., 4)."""
    nu: Array
    """Body frame [m/s, rad/s], (..., 6)."""
    time: float = math.nan
    """Time of the measurement [s]; NaN if it is not known."""


@dataclass(frozen=True)
class Known:
    """Readings as plain arrays; fields that are not needed may be left out."""

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
    """The pose to hold, and how it moves."""

    position: Any
    """Position of the body origin, world frame [m], (..., 3)."""
    quaternion: Any
    """Attitude the body should have, body to world, xyzw, (..., 4)."""
    velocity: Any = (0.0, 0.0, 0.0)
    """Velocity of the goal, world frame [m/s], (..., 3)."""
    acceleration: Any = (0.0, 0.0, 0.0)
    """Acceleration of the goal, world frame [m/s²], (..., 3)."""


class Controller(Protocol):
    """A controller without internal state: its memory is an argument and a result of every call."""

    @property
    def period(self) -> float:
        """Time between two calls of `command` [s]."""

    def reset(self, n: int | None = None) -> Any:
        """Memory at the start, for one vehicle or for a batch of n."""

    def command(self, memory: Any, measured: Measured, goal: Goal) -> tuple[Array, Any]:
        """Wanted wrench about `vehicle.wrench_reference`, body frame [N, N m], (..., 6), and the memory after."""


class TrackingError(NamedTuple):
    """Goal minus measured, in the measured body's axes."""

    pose: Array
    """Three distances of a body point to its goal [m], then tilt about x and y and heading [rad], (..., 6)."""
    velocity: Array
    """Velocity of the goal, body frame; its angular part is zero [m/s, rad/s], (..., 6)."""


def tracking_error(measured: Measured, goal: Goal, point: npt.ArrayLike) -> TrackingError:
    """Error of a body point's position and of the attitude.

    The rotation to the goal is split into a turn about the body's z (heading error, wrapped) and a tilt without any
    turn about z, so that half a turn to make does not disturb the levelling.

    Args:
        measured: Where the vehicle is.
        goal: Where it should be.
        point: The body point, body frame [m], (3,).
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
    """Twist of the body at a body point: v + omega x r and omega, body frame [m/s, rad/s], (..., 6).

    Args:
        nu: Twist of the body origin, body frame [m/s, rad/s], (..., 6).
        point: r from the body origin, body frame [m], (3,).
    """
    nu = np.asarray(nu, float)
    return np.concatenate([nu[..., :3] + cross(nu[..., 3:], np.asarray(point, float)), nu[..., 3:]], axis=-1)


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
        """Name of the station or trajectory."""

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
    """Time to hold the pose [s]."""

    def at(self, t: npt.ArrayLike) -> Reference:
        """Return the same reference at all times. Times `t` are in [s]."""
        shape = np.shape(t)
        position = np.broadcast_to(np.asarray(self.position, float), (*shape, 3))
        return Reference(position, np.zeros((*shape, 3)), np.full(shape, self.yaw), np.zeros(shape))


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
