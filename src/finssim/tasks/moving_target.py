"""T3, moving target: stay close to a target that changes its course every few seconds."""

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.sim.state import State
from finssim.tasks.arrays import TargetMotion, TaskArrays, allocated
from finssim.tasks.fitting import PoolTask
from finssim.tasks.terms import (
    End,
    ObservationPart,
    RewardTerm,
    Terms,
    Total,
    action_costs,
    goal_offset,
    offset_length,
    out_of_pool,
    own_velocity,
    position_error,
    start_upright,
    turn_rate,
    uniform3,
)

DISTANCE_SCALE = 3.0
"""Scale of distances in the observation [m]."""
TARGET_SCALE = 0.2
"""Scale of the target's velocity in the observation [m/s]."""


@wp.func
def target_drift(arrays: TaskArrays, w: int) -> wp.vec3:
    """Return the velocity of the target, in the measured body frame [m/s]."""
    return wp.quat_rotate_inv(arrays.quaternion[w, 0], arrays.target.velocity[w])


OBSERVATION = (
    ObservationPart(
        "target offset, body frame", 3, "m", scale=DISTANCE_SCALE, term="offset", errors=(0, 1, 2)
    ),
    ObservationPart("target velocity, body frame", 3, "m/s", scale=TARGET_SCALE, term=target_drift),
    *own_velocity(clip=2.0),
    ObservationPart("distance to the target", 1, "m", scale=DISTANCE_SCALE, clip=1.0, term=offset_length),
)


@dataclass(frozen=True, kw_only=True)
class TargetReward:
    """Weights of the reward; each term has one reason.

    c = exp(-e / near_scale), e the distance to the target, u the speed relative to it

    r = near · c                                 a slope that does not vanish at the target: centimetres count
      - distance · e                             a slope everywhere: a distant target is caught up with
      + match · c · exp(-u / match_scale)        match the target's velocity, but only close to it: approach it first
      - spin · min(|ω|, 2)                       the attitude is free and not observed; continuous turning is not wanted
      - action · mean(a²)                        the cheapest thrusts that suffice
      - change · mean(Δa²)                       commands that a motor can follow, no chatter
      - loss                                     once, on leaving the pool: more than a bad episode costs
    """

    near: float = 1.0
    near_scale: float = 0.10
    distance: float = 1.0
    match: float = 0.5
    match_scale: float = 0.05
    spin: float = 0.2
    action: float = 0.02
    change: float = 0.05
    loss: float = 10.0


@wp.func
def new_course(arrays: TaskArrays, p: Any, w: int, t: float):
    """Draw the target's next velocity and the time at which it ends, from the world's own random stream.

    `t` is the time [s].
    """
    rng = arrays.target.rng[w]
    z = wp.randf(rng, -1.0, 1.0)
    angle = wp.randf(rng, -3.14159265, 3.14159265)
    pace = wp.randf(rng, 0.0, p.fit.pace * p.fastest)
    level = wp.sqrt(1.0 - z * z)
    arrays.target.wanted[w] = pace * wp.vec3(level * wp.cos(angle), level * wp.sin(angle), p.vertical * z)
    arrays.target.until[w] = t + wp.randf(rng, p.retarget[0], p.retarget[1])
    arrays.target.rng[w] = rng


@wp.func
def move_target(arrays: TaskArrays, p: Any, w: int):
    """Move the target over the control step that ends now; outside its box its velocity points back."""
    t = arrays.time[w]
    if t >= arrays.target.until[w]:
        new_course(arrays, p, w, t)
    x = arrays.goal_position[w]
    target_velocity = arrays.target.wanted[w]
    for k in range(3):
        if x[k] > p.fit.size * p.high[k]:
            target_velocity[k] = -wp.abs(target_velocity[k])
        if x[k] < p.fit.size * p.low[k]:
            target_velocity[k] = wp.abs(target_velocity[k])
    arrays.target.wanted[w] = target_velocity
    v = arrays.target.velocity[w]
    change = target_velocity - v
    limit = p.fit.pace * p.acceleration * p.control_step
    v += change * wp.min(1.0, limit / wp.max(wp.length(change), 1.0e-9))
    arrays.target.velocity[w] = v
    arrays.goal_position[w] = x + p.control_step * v


@wp.func
def slip(state: State, arrays: TaskArrays, w: int) -> float:
    """Return u, the speed relative to the target [m/s]."""
    nu = state.velocity[w, 0]
    drift = wp.quat_rotate_inv(state.quaternion[w, 0], arrays.target.velocity[w])
    return wp.length(wp.vec3(nu[0], nu[1], nu[2]) - drift)


@wp.func
def closeness(p: Any, e: float) -> float:
    """Return 1 at the target, 1/e at a distance `e` of `near_scale` [m], scaled to the vehicle."""
    return wp.exp(-e / (p.fit.size * p.reward.near_scale))


@wp.func
def matching(p: Any, close: float, u: float) -> float:
    """Return `near`, times 1/e per `match_scale` of the speed `u` relative to the target [m/s]."""
    return close * wp.exp(-u / (p.fit.pace * p.reward.match_scale))


@wp.func
def spinning(turn: float) -> float:
    """Return the magnitude of the angular velocity, at most 2 [rad/s]."""
    return wp.min(turn, 2.0)


@wp.func
def with_target(p: Any, e: float, u: float, turn: float) -> bool:
    """Return True if distance, relative speed and turn rate are within their tolerances [m, m/s, rad/s]."""
    return e <= p.fit.size * p.tolerance and u <= p.fit.pace * p.slip_tolerance and turn <= p.rate_tolerance


@wp.func
def squared_error(arrays: TaskArrays, p: Any, w: int, e: float, was: float) -> float:
    """Return the mean of e² after `settle` [m²]."""
    k = wp.floor((arrays.time[w] - p.settle) / p.control_step + 0.5)
    return wp.where(k >= 1.0, was + (e * e - was) / wp.max(k, 1.0), was)


@wp.func
def start(state: State, arrays: TaskArrays, p: Any, key: int, w: int):
    """Start an episode with a target at rest, and a vehicle elsewhere in the pool."""
    size = p.fit.size
    arrays.goal_position[w] = uniform3(wp.rand_init(key, 4 * w), size * p.low, size * p.high)
    arrays.goal_quaternion[w] = wp.quat_identity()
    arrays.target.velocity[w] = wp.vec3(0.0)
    arrays.target.rng[w] = wp.rand_init(key, 4 * w + 1)
    new_course(arrays, p, w, 0.0)
    state.position[w, 0] = uniform3(wp.rand_init(key, 4 * w + 2), size * p.spawn_low, size * p.spawn_high)
    rng = wp.rand_init(key, 4 * w + 3)
    start_upright(state, w, rng, p.tilt, p.fit.pace * p.speed)


@dataclass(frozen=True, kw_only=True)
class MovingTarget(PoolTask):
    """T3. Lengths in metres, world frame with z up and 0 on the water, for FinsROV.

    For other vehicles, lengths are scaled by `fit.size` and speeds by `fit.pace`. The target's speed, courses and
    tolerances are the published ones; across the pool its box is limited by the walls (published: 2.5 m).
    """

    succeeds: ClassVar[str] = "once"
    moving: ClassVar[bool] = True
    title: ClassVar[str] = "stay with a target that changes its course"
    baselines: ClassVar = {"pid": "finssim.agents.baselines:TargetPid"}
    name: str = "t3"
    observation: tuple[ObservationPart, ...] = OBSERVATION
    time_limit: float = 30.0
    low: tuple[float, float, float] = (-1.25, -0.50, -0.675)
    """Corner of the box in which the target starts [m]; it turns back at the box's faces, within 0.06 m at 0.08
    m/s²."""
    high: tuple[float, float, float] = (1.25, 0.50, -0.325)
    fastest: float = 0.10
    """Greatest drawn speed of the target [m/s]."""
    acceleration: float = 0.08
    """Greatest acceleration of the target [m/s²]."""
    vertical: float = 0.4
    """Factor on the vertical component of the drawn velocity."""
    retarget: tuple[float, float] = (1.5, 4.0)
    """Range of the time between two draws of the velocity [s]."""
    speed: float = 0.1
    """Largest starting speed per axis [m/s]."""
    tolerance: float = 0.25
    """Greatest distance for success [m]."""
    slip_tolerance: float = 0.12
    """Greatest speed relative to the target for success [m/s]."""
    rate_tolerance: float = 0.3
    """Greatest turn rate for success [rad/s]."""
    hold: float = 1.0
    """Time within these tolerances for success [s]: 10 steps."""
    settle: float = 10.0
    """Time from which the error of an episode is measured [s]."""
    reward: TargetReward = field(default_factory=TargetReward)

    def allocate(self, arrays: TaskArrays, worlds: int, device: wp.Device) -> None:
        """Allocate the motion of every target."""
        arrays.target = allocated(TargetMotion, worlds, device)

    def success_rule(self) -> str:
        """Return the rule of success; see `Task`."""
        return (
            f"{self.tolerance:g} m, {self.slip_tolerance:g} m/s and {self.rate_tolerance:g} rad/s from the target for "
            f"{self.hold:g} s"
        )

    def metrics(self, arrays: TaskArrays) -> dict[str, NDArray[np.float64]]:
        """Return the metrics of every task, with success (10 steps in tolerance at any time), its time [s] and the RMS
        error after `settle` [m].

        `success_time` is nan without a success, and `error` is nan for a shorter episode.
        """
        measured = super().metrics(arrays)
        squared = measured.pop("squared_error")
        long = measured["length"] * self.control_step > self.settle + 0.5 * self.control_step
        return {**measured, "error": np.where(long, np.sqrt(squared), np.nan)}

    def terms(self) -> Terms:
        """Return the terms; see `TargetReward`."""
        r = self.reward
        return Terms(
            start=start,
            advance=move_target,
            shared={
                "e": position_error,
                "u": slip,
                "close": closeness,
                "turn": turn_rate,
            },
            seen={"offset": goal_offset},
            meanings={
                "near": f"1 at the target, 1/e at {self.fit.size * r.near_scale:.3g} m from it.",
                "match": f"`near`, times 1/e per {self.fit.pace * r.match_scale:.3g} m/s off the target's velocity.",
            },
            rewards=(
                RewardTerm("near", "close", r.near),
                RewardTerm("match", matching, r.match),
                RewardTerm("distance", "e", -r.distance / self.fit.size),
                RewardTerm("spin", spinning, -r.spin),
                *action_costs(r.action, r.change),
            ),
            ends=(End("left", out_of_pool, -r.loss),),
            inside=with_target,
            totals=(Total("squared_error", squared_error),),
        )
