"""Homing, a task for vehicles that steer by moving: into the mouth of a dock, by its bearing and along its axis."""

import math
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.control.guidance import Reference
from finssim.physics.types import vec6
from finssim.sim.state import State
from finssim.tasks.arrays import TaskArrays
from finssim.tasks.path import (
    PathFollowing,
    PathReward,
    beside_leg,
    ground_velocity,
    has_left,
    leg_direction,
    path_direction,
    path_error,
)
from finssim.tasks.task import Task
from finssim.tasks.terms import (
    End,
    ObservationPart,
    RewardTerm,
    Terms,
    Total,
    action_costs,
    tilted,
    turn_rates,
    world_up,
    world_velocity,
)


@wp.func
def bearing(arrays: TaskArrays, p: Any, w: int) -> wp.vec3:
    """Return the direction to the dock, body frame, as measured by a USBL on the vehicle [-]."""
    way = wp.normalize(arrays.path.points[w, 1] - arrays.position[w, 0])
    return wp.quat_rotate_inv(arrays.quaternion[w, 0], way)


@wp.func
def homing_speed(state: State, arrays: TaskArrays, p: Any, w: int) -> float:
    """Return the speed towards the dock as a fraction of cruising speed, at most 1."""
    way = wp.normalize(arrays.path.points[w, 1] - state.position[w, 0])
    return wp.min(wp.dot(world_velocity(state, w, 0), way) / p.fit.speed, 1.0)


@wp.func
def off_axis(state: State, arrays: TaskArrays, e: float, w: int) -> float:
    """Return the angle between the direction to the dock and its axis, from the distance `e` to the axis [m],
    [rad]."""
    return wp.atan2(e, wp.max(beside_leg(arrays.path, w, state.position[w, 0])[3], 0.01))


@wp.func
def turned_away(state: State, arrays: TaskArrays, w: int) -> float:
    """Return the angle between the velocity over ground and the axis of the dock [rad]."""
    v = wp.normalize(world_velocity(state, w, 0))
    return wp.acos(wp.clamp(wp.dot(v, leg_direction(arrays.path, w, 0)), -1.0, 1.0))


@wp.func
def at_mouth(state: State, arrays: TaskArrays, w: int) -> bool:
    """Return True if the plane of the mouth is reached."""
    return beside_leg(arrays.path, w, state.position[w, 0])[3] <= 0.0


@wp.func
def has_docked(at: bool, e: float, angle: float, p: Any) -> bool:
    """Return True if the vehicle is at the mouth, with its distance `e` [m] and `angle` [rad] within the
    tolerances."""
    return at and e <= p.fit.size * p.radius and angle <= p.slant


@wp.func
def has_missed(at: bool, e: float, angle: float, p: Any) -> bool:
    """Return True if the vehicle is at the plane of the mouth, but `e` [m] or `angle` [rad] is too large."""
    return at and (e > p.fit.size * p.radius or angle > p.slant)


@wp.func
def latest(e: float) -> float:
    """Return the current distance to the axis [m]: at the end of an episode, that at the mouth."""
    return e


@wp.func
def start_homing(state: State, arrays: TaskArrays, p: Any, key: int, w: int):
    """Start an episode with a dock of random direction, unless one is given, and a vehicle that roughly heads for
    it."""
    pi = 3.14159265
    rng = wp.rand_init(key, 4 * w)
    size = p.fit.size
    arrays.path.leg[w] = 0
    if arrays.path.given[w] == 0:
        course = wp.randf(rng, -pi, pi)
        mouth = wp.vec3(0.0, 0.0, size * p.depth)
        arrays.path.points[w, 0] = mouth - size * p.line * wp.vec3(wp.cos(course), wp.sin(course), 0.0)
        arrays.path.points[w, 1] = mouth
    mouth = arrays.path.points[w, 1]
    axis = leg_direction(arrays.path, w, 0)
    angle = wp.atan2(axis[1], axis[0]) + wp.randf(rng, -p.aspect, p.aspect)
    away = size * wp.randf(rng, p.far[0], p.far[1])
    height = size * wp.randf(rng, -p.offset, p.offset)
    x = mouth - wp.vec3(away * wp.cos(angle), away * wp.sin(angle), -height)
    q = tilted(0.0, 0.0, angle + wp.randf(rng, -p.yaw, p.yaw))
    v = wp.quat_rotate_inv(q, arrays.current[w]) + wp.vec3(p.fit.speed, 0.0, 0.0)
    state.position[w, 0] = x
    state.quaternion[w, 0] = q
    state.velocity[w, 0] = vec6(v[0], v[1], v[2], 0.0, 0.0, 0.0)
    arrays.goal_position[w] = mouth
    arrays.goal_quaternion[w] = tilted(0.0, 0.0, wp.atan2(axis[1], axis[0]))


OBSERVATION = (
    ObservationPart("direction to the dock, body frame", 3, "1", term=bearing, errors=(1, 2)),
    ObservationPart("axis of the dock, inwards, body frame", 3, "1", term=path_direction),
    ObservationPart(
        "velocity over ground by cruising speed, body frame", 3, "1", clip=3.0, term=ground_velocity
    ),
    ObservationPart("angular velocity, body frame", 3, "rad/s", clip=2.0, term=turn_rates),
    ObservationPart("world up, body frame", 3, "1", term=world_up),
)


@dataclass(frozen=True, kw_only=True)
class Homing(PathFollowing):
    """Swim into the mouth of a dock by its bearing, along its axis, by autopilot commands.

    Lengths as for `PathFollowing`. After a miss there is no second attempt.

    r = advance · (speed towards the dock)       integrates to the distance: taking longer gains nothing
      - distance · (angle between its direction and its axis)     approach from the front
      - action · mean(a²) - change · mean(Δa²)   commands that a vehicle can follow, no chatter
      + finish, - loss                           once, in the dock, and on missing or leaving it
    """

    succeeds: ClassVar[str] = "docked"
    title: ClassVar[str] = "swim into a dock by its bearing"
    baselines: ClassVar = {"bearing": "finssim.agents.steering:HomingPilot"}
    name: str = "homing"
    observation: tuple[ObservationPart, ...] = OBSERVATION
    time_limit: float = 60.0
    legs: int = 1
    line: float = 40.0
    """Length of the axis in front of the mouth [m]."""
    radius: float = 0.5
    """Radius of the mouth [m]."""
    slant: float = math.radians(20.0)
    """Largest angle between the velocity over ground and the axis in the mouth [rad]."""
    far: tuple[float, float] = (25.0, 40.0)
    """Range of the starting distance from the mouth [m]."""
    aspect: float = math.radians(50.0)
    """Largest angle between the axis and the direction to the mouth at the start [rad]."""
    offset: float = 2.0
    """Largest height of the start above or below the mouth [m]."""
    yaw: float = math.radians(45.0)
    """Largest angle between the heading and the direction to the mouth at the start [rad]."""
    depth: float = -15.0
    """Height of the mouth [m]."""
    corridor: float = 45.0
    """Distance from the axis beyond which the episode ends [m]."""
    reward: PathReward = field(default_factory=lambda: PathReward(advance=1.0, distance=0.5, finish=50.0))

    def success_rule(self) -> str:
        """Return the rule of success; see `Task`."""
        radius, angle = self.fit.size * self.radius, math.degrees(self.slant)
        return f"through the mouth, within {radius:.3g} m of its middle and {angle:.3g} degrees of its axis"

    def metrics(self, arrays: TaskArrays) -> dict[str, NDArray[np.float64]]:
        """Return the metrics of every task, and the error: distance to the axis at the end [m]."""
        measured = Task.metrics(self, arrays)
        error = measured.pop("miss")
        return {**measured, "error": error}

    def straight(self, here: NDArray[np.float64], goal: Reference) -> NDArray[np.float64]:
        """Return the axis to a goal, whose yaw is that of a docked vehicle, [m], (2, 3)."""
        axis = np.array([math.cos(goal.yaw), math.sin(goal.yaw), 0.0])
        mouth = np.asarray(goal.position, float)
        return np.stack([mouth - self.fit.size * self.line * axis, mouth])

    def terms(self) -> Terms:
        """Return the terms; see the class."""
        r = self.reward
        return Terms(
            start=start_homing,
            shared={"e": path_error, "at": at_mouth, "angle": turned_away},
            rewards=(
                RewardTerm("aspect", off_axis, -r.distance),
                RewardTerm("advance", homing_speed, r.advance),
                *action_costs(r.action, r.change),
            ),
            ends=(
                End("docked", has_docked, r.finish),
                End("missed", has_missed, -r.loss),
                End("left", has_left, -r.loss),
            ),
            totals=(Total("miss", latest),),
        )
