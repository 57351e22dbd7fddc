"""T1, station keeping: reach a pose in the pool and hold it within 0.10 m per axis and 10° (paper, section IV)."""

import math
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.engine.state import State
from finssim.tasks.arrays import TaskArrays
from finssim.tasks.episode import action_effort, close_episode, open_episode, report_frozen, uniform3
from finssim.tasks.measurement import MeasurementNoise
from finssim.tasks.task import ObservationPart, Task

DISTANCE_SCALE = 3.0
"""Distances are divided by this in the observation [m]."""
VELOCITY_CLIP = 2.0
"""Velocities are clipped here in the observation [m/s, rad/s]."""

OBSERVATION = (
    ObservationPart("goal offset, body frame", 3, "m", scale=DISTANCE_SCALE),
    ObservationPart("goal rotation relative to the body, first two columns", 6, "1"),
    ObservationPart("linear velocity, body frame", 3, "m/s", clip=VELOCITY_CLIP),
    ObservationPart("angular velocity, body frame", 3, "rad/s", clip=VELOCITY_CLIP),
    ObservationPart("distance to the goal", 1, "m", scale=DISTANCE_SCALE, clip=1.0),
)


@wp.struct
class Parameters:
    """Ranges and weights of the task, for the kernels."""

    goal_low: wp.vec3
    goal_high: wp.vec3
    spawn_low: wp.vec3
    spawn_high: wp.vec3
    tilt: float
    speed: float
    rate: float
    bounds: wp.vec3
    ceiling: float
    depth: float
    time_limit: float
    control_step: float
    tolerance: float
    yaw_tolerance: float
    position_weight: float
    position_scale: float
    distance_weight: float
    heading_weight: float
    heading_scale: float
    turn_weight: float
    action_weight: float
    change_weight: float
    rate_weight: float
    loss: float


@dataclass(frozen=True, kw_only=True)
class Reward:
    """Weights of the reward; each term has one reason.

    r = position · exp(-e / position_scale)      a slope that does not vanish at the goal: centimetres count
      - distance · e                             a slope everywhere: far goals are approached. A weight of 0.3 was too
                                                 little: with random buoyancy, lying on the floor was learnt
      + heading · exp(-θ / heading_scale) - turn · θ     the same for the attitude error θ, roll and pitch included
      - action · mean(a²)                        the cheapest thrusts that do it
      - change · mean(Δa²)                       commands that a motor can follow, no chatter
      - rate · min(|ω|², 4)                      no spinning on the way
      - loss                                     once, on leaving the pool: more than a bad episode costs
    """

    position: float = 1.0
    position_scale: float = 0.15
    distance: float = 1.0
    heading: float = 0.6
    heading_scale: float = 0.20
    turn: float = 0.15
    action: float = 0.03
    change: float = 0.05
    rate: float = 0.01
    loss: float = 10.0


@wp.func
def attitude_error(q: wp.quat, goal: wp.quat) -> float:
    """Angle of the rotation from q to goal, in [0, π] [rad]."""
    d = wp.quat_inverse(q) * goal
    return 2.0 * wp.atan2(wp.length(wp.vec3(d[0], d[1], d[2])), wp.abs(d[3]))


@wp.func
def heading(q: wp.quat) -> float:
    """Yaw of the body x axis about world z [rad]."""
    x = wp.quat_rotate(q, wp.vec3(1.0, 0.0, 0.0))
    return wp.atan2(x[1], x[0])


@wp.func
def wrapped(angle: float) -> float:
    """An angle in (-2π, 2π) brought to [-π, π] [rad]."""
    return angle - wp.sign(angle) * wp.where(wp.abs(angle) > 3.14159265, 6.2831853, 0.0)


@wp.func
def write_observation(arrays: TaskArrays, w: int):
    """The 16 numbers of `OBSERVATION` from the measured state of vehicle 0."""
    q = arrays.quaternion[w, 0]
    offset = wp.quat_rotate_inv(q, arrays.goal_position[w] - arrays.position[w, 0])
    R = wp.quat_to_matrix(wp.quat_inverse(q) * arrays.goal_quaternion[w])
    nu = arrays.velocity[w, 0]
    for i in range(3):
        arrays.observation[w, i] = offset[i] / DISTANCE_SCALE
        arrays.observation[w, 3 + i] = R[i, 0]
        arrays.observation[w, 6 + i] = R[i, 1]
    for i in range(6):
        arrays.observation[w, 9 + i] = wp.clamp(nu[i], -VELOCITY_CLIP, VELOCITY_CLIP)
    arrays.observation[w, 15] = wp.min(wp.length(offset) / DISTANCE_SCALE, 1.0)


@wp.func
def reward_of(arrays: TaskArrays, p: Parameters, w: int, e: float, theta: float, omega: wp.vec3) -> float:
    """Reward of one step; see `Reward`. Keeps the action for the next step's change."""
    effort = action_effort(arrays, w)
    return (
        p.position_weight * wp.exp(-e / p.position_scale)
        - p.distance_weight * e
        + p.heading_weight * wp.exp(-theta / p.heading_scale)
        - p.turn_weight * theta
        - p.action_weight * effort[0]
        - p.change_weight * effort[1]
        - p.rate_weight * wp.min(wp.dot(omega, omega), 4.0)
    )


@wp.kernel(enable_backward=False)
def evaluate(state: State, arrays: TaskArrays, p: Parameters, world_offset: int):
    """After a step: reward, ends, success timer and the observation; a frozen world ends and waits for its report."""
    w = world_offset + wp.tid()
    if state.frozen[w] != 0:
        report_frozen(state, arrays, w)
        return
    x = state.position[w, 0]
    q = state.quaternion[w, 0]
    nu = state.velocity[w, 0]
    error = arrays.goal_position[w] - x
    theta = attitude_error(q, arrays.goal_quaternion[w])
    reward = reward_of(arrays, p, w, wp.length(error), theta, wp.vec3(nu[3], nu[4], nu[5]))
    out = wp.abs(x[0]) > p.bounds[0] or wp.abs(x[1]) > p.bounds[1] or x[2] > p.ceiling or x[2] < -p.depth
    reward -= wp.where(out, p.loss, 0.0)
    late = float(state.steps[w]) * p.control_step >= p.time_limit - 0.5 * p.control_step

    off = wp.max(wp.max(wp.abs(error[0]), wp.abs(error[1])), wp.abs(error[2]))
    turn = wp.abs(wrapped(heading(arrays.goal_quaternion[w]) - heading(q)))
    inside = off <= p.tolerance and turn <= p.yaw_tolerance
    arrays.held[w] = wp.where(inside, arrays.held[w] + p.control_step, 0.0)

    arrays.reward[w] = reward
    arrays.terminated[w] = wp.where(out, 1, 0)
    arrays.truncated[w] = wp.where(late and not out, 1, 0)
    done = out or late
    arrays.done[w] = wp.where(done, 1, 0)
    arrays.episode_return[w] = arrays.episode_return[w] + reward
    write_observation(arrays, w)
    if done:
        close_episode(state, arrays, w)


@wp.kernel(enable_backward=False)
def spawn(
    state: State, arrays: TaskArrays, p: Parameters, seed: int, mask: wp.array(dtype=int), world_offset: int
):
    """Start an episode where mask is not 0: a goal pose, a start pose and velocity, drawn for this episode alone."""
    w = world_offset + wp.tid()
    if mask[w] == 0:
        return
    key = seed + 15485863 * state.episode[w]
    pi = 3.14159265
    arrays.goal_position[w] = uniform3(wp.rand_init(key, 4 * w), p.goal_low, p.goal_high)
    state.position[w, 0] = uniform3(wp.rand_init(key, 4 * w + 1), p.spawn_low, p.spawn_high)
    angles = uniform3(
        wp.rand_init(key, 4 * w + 2), wp.vec3(-p.tilt, -p.tilt, -pi), wp.vec3(p.tilt, p.tilt, pi)
    )
    rng = wp.rand_init(key, 4 * w + 3)
    z = wp.vec3(0.0, 0.0, 1.0)
    arrays.goal_quaternion[w] = wp.quat_from_axis_angle(z, wp.randf(rng, -pi, pi))
    roll = wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), angles[0])
    pitch = wp.quat_from_axis_angle(wp.vec3(0.0, 1.0, 0.0), angles[1])
    state.quaternion[w, 0] = wp.quat_from_axis_angle(z, angles[2]) * pitch * roll
    nu = state.velocity[w, 0]
    for i in range(3):
        nu[i] = wp.randf(rng, -p.speed, p.speed)
    for i in range(3):
        nu[i + 3] = wp.randf(rng, -p.rate, p.rate)
    state.velocity[w, 0] = nu
    open_episode(arrays, w)


@wp.kernel(enable_backward=False)
def observe(arrays: TaskArrays, mask: wp.array(dtype=int), world_offset: int):
    """First observation of the episodes that start, where mask is not 0."""
    w = world_offset + wp.tid()
    if mask[w] != 0:
        write_observation(arrays, w)


@dataclass(frozen=True, kw_only=True)
class StationKeeping(Task):
    """T1. Lengths in metres, angles in radians, world frame with z up and 0 on the water."""

    title: ClassVar[str] = "reach a pose in the pool and hold it"
    name: str = "t1"
    observation: tuple[ObservationPart, ...] = OBSERVATION
    goal_low: tuple[float, float, float] = (-1.2, -0.5, -0.82)
    """Goals are uniform in this box; yaw is uniform over the circle, roll and pitch are level."""
    goal_high: tuple[float, float, float] = (1.2, 0.5, -0.28)
    spawn_low: tuple[float, float, float] = (-1.4, -0.6, -0.80)
    spawn_high: tuple[float, float, float] = (1.4, 0.6, -0.20)
    tilt: float = math.radians(20.0)
    """Largest roll and pitch at the start."""
    speed: float = 0.30
    """Largest starting speed per axis [m/s]."""
    rate: float = 0.35
    """Largest starting turn rate per axis [rad/s]."""
    bounds: tuple[float, float] = (2.5, 1.5)
    """Leaving |x|, |y| beyond these ends the episode."""
    ceiling: float = 0.3
    """So does rising above this height."""
    depth: float = 1.5
    """So does sinking below this depth."""
    tolerance: float = 0.10
    """Success: every axis within this ..."""
    yaw_tolerance: float = math.radians(10.0)
    """... and yaw within this ..."""
    hold: float = 10.0
    """... for this long [s]."""
    reward: Reward = field(default_factory=Reward)
    training_noise: MeasurementNoise = MeasurementNoise(
        position_std=0.01, yaw_std=math.radians(1.0), velocity_std=0.02, rate_std=0.02, delay=0.1
    )
    """About what an estimate is off by, and how late it comes: with exact states, gains are learnt that chatter."""

    evaluate = staticmethod(evaluate)
    spawn = staticmethod(spawn)
    observe = staticmethod(observe)

    def success_rule(self) -> str:
        """See `Task`."""
        turn = math.degrees(self.yaw_tolerance)
        return f"{self.tolerance:g} m per axis and {turn:g}° in yaw for {self.hold:g} s, at the end"

    def metrics(self, arrays: TaskArrays) -> dict[str, NDArray[np.float64]]:
        """As every task's, and success: held for `hold` seconds when the episode ended."""
        measured = super().metrics(arrays)
        enough = measured["held"] >= self.hold - 0.5 * self.control_step
        return {**measured, "success": np.where(enough, 1.0, 0.0)}

    def parameters(self) -> Any:
        """The struct that the kernels take."""
        p, r = Parameters(), self.reward
        for name in ("goal_low", "goal_high", "spawn_low", "spawn_high"):
            setattr(p, name, wp.vec3(*getattr(self, name)))
        for name in (
            "tilt",
            "speed",
            "rate",
            "ceiling",
            "depth",
            "time_limit",
            "control_step",
            "tolerance",
            "yaw_tolerance",
        ):
            setattr(p, name, getattr(self, name))
        p.bounds = wp.vec3(*self.bounds, 0.0)
        p.position_weight, p.position_scale, p.distance_weight = r.position, r.position_scale, r.distance
        p.heading_weight, p.heading_scale, p.turn_weight = r.heading, r.heading_scale, r.turn
        p.action_weight, p.change_weight, p.rate_weight, p.loss = r.action, r.change, r.rate, r.loss
        return p
