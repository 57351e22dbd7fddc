"""T3, moving target: stay with something that changes its course every few seconds."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.engine import Pool
from finssim.engine.state import State
from finssim.tasks.arrays import TargetMotion, TaskArrays
from finssim.tasks.fitting import Fit, fit
from finssim.tasks.measurement import MeasurementNoise
from finssim.tasks.task import ObservationPart, Task
from finssim.tasks.terms import (
    End,
    RewardTerm,
    Terms,
    Total,
    action_change,
    action_effort,
    angular_velocity,
    goal_offset,
    length,
    linear_velocity,
    out_of_pool,
    tilted,
    turn_rates,
    uniform3,
)
from finssim.vehicles import Vehicle

DISTANCE_SCALE = 3.0
"""Distances are divided by this in the observation [m]."""
TARGET_SCALE = 0.2
"""The target's velocity is divided by this in the observation [m/s]."""
VELOCITY_CLIP = 2.0
"""Velocities of the vehicle are clipped here in the observation [m/s, rad/s]."""


@wp.func
def target_drift(arrays: TaskArrays, w: int) -> wp.vec3:
    """Velocity of the target, in the measured body frame [m/s]."""
    return wp.quat_rotate_inv(arrays.quaternion[w, 0], arrays.target.velocity[w])


OBSERVATION = (
    ObservationPart(
        "target offset, body frame", 3, "m", scale=DISTANCE_SCALE, term="offset", errors=(0, 1, 2)
    ),
    ObservationPart("target velocity, body frame", 3, "m/s", scale=TARGET_SCALE, term=target_drift),
    ObservationPart("linear velocity, body frame", 3, "m/s", clip=VELOCITY_CLIP, term=linear_velocity),
    ObservationPart("angular velocity, body frame", 3, "rad/s", clip=VELOCITY_CLIP, term=turn_rates),
    ObservationPart("distance to the target", 1, "m", scale=DISTANCE_SCALE, clip=1.0, term=length),
)


@dataclass(frozen=True, kw_only=True)
class TargetReward:
    """Weights of the reward; each term has one reason.

    near = exp(-e / near_scale), e the distance to the target, u the speed relative to it

    r = near_weight · near                       a slope that does not vanish at the target: centimetres count
      - distance · e                             a slope everywhere: a far target is caught up with
      + match · near · exp(-u / match_scale)     go as it goes, but only beside it: elsewhere it is to be reached
      - spin · min(|ω|, 2)                       the attitude is not observed and free; turning all the time is not
      - action · mean(a²)                        the cheapest thrusts that do it
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
    """Draw a velocity that the target is to have, and until when; from the world's own stream."""
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
    """Take the target through the control step that ends now; outside its box it is on its way back."""
    t = arrays.time[w]
    if t >= arrays.target.until[w]:
        new_course(arrays, p, w, t)
    x = arrays.goal_position[w]
    wanted = arrays.target.wanted[w]
    for k in range(3):
        if x[k] > p.fit.size * p.high[k]:
            wanted[k] = -wp.abs(wanted[k])
        if x[k] < p.fit.size * p.low[k]:
            wanted[k] = wp.abs(wanted[k])
    arrays.target.wanted[w] = wanted
    v = arrays.target.velocity[w]
    change = wanted - v
    most = p.fit.pace * p.acceleration * p.control_step
    v += change * wp.min(1.0, most / wp.max(wp.length(change), 1.0e-9))
    arrays.target.velocity[w] = v
    arrays.goal_position[w] = x + p.control_step * v


@wp.func
def target_error(state: State, arrays: TaskArrays, w: int) -> float:
    """e: from the vehicle to the target [m]."""
    return wp.length(arrays.goal_position[w] - state.position[w, 0])


@wp.func
def slip(state: State, arrays: TaskArrays, w: int) -> float:
    """u: speed relative to the target [m/s]."""
    nu = state.velocity[w, 0]
    drift = wp.quat_rotate_inv(state.quaternion[w, 0], arrays.target.velocity[w])
    return wp.length(wp.vec3(nu[0], nu[1], nu[2]) - drift)


@wp.func
def near(p: Any, e: float) -> float:
    """near = exp(-e / near_scale)."""
    return wp.exp(-e / (p.fit.size * p.reward.near_scale))


@wp.func
def match(p: Any, close: float, u: float) -> float:
    """near · exp(-u / match_scale)."""
    return close * wp.exp(-u / (p.fit.pace * p.reward.match_scale))


@wp.func
def spin(state: State, w: int) -> float:
    """min(|ω|, 2) [rad/s]."""
    return wp.min(wp.length(angular_velocity(state, w)), 2.0)


@wp.func
def with_target(state: State, p: Any, w: int, e: float, u: float) -> bool:
    """Near enough, as fast as the target, and not turning."""
    close = e <= p.fit.size * p.tolerance
    matched = u <= p.fit.pace * p.slip_tolerance
    return close and matched and wp.length(angular_velocity(state, w)) <= p.rate_tolerance


@wp.func
def squared_error(arrays: TaskArrays, p: Any, w: int, e: float, was: float) -> float:
    """Mean of e² after `settle` [m²]."""
    k = wp.floor((arrays.time[w] - p.settle) / p.control_step + 0.5)
    return wp.where(k >= 1.0, was + (e * e - was) / wp.max(k, 1.0), was)


@wp.func
def start(state: State, arrays: TaskArrays, p: Any, key: int, w: int):
    """A target that stands still, and a vehicle somewhere else in the pool."""
    size = p.fit.size
    arrays.goal_position[w] = uniform3(wp.rand_init(key, 4 * w), size * p.low, size * p.high)
    arrays.goal_quaternion[w] = wp.quat_identity()
    arrays.target.velocity[w] = wp.vec3(0.0)
    arrays.target.rng[w] = wp.rand_init(key, 4 * w + 1)
    new_course(arrays, p, w, 0.0)
    state.position[w, 0] = uniform3(wp.rand_init(key, 4 * w + 2), size * p.spawn_low, size * p.spawn_high)
    rng = wp.rand_init(key, 4 * w + 3)
    roll = wp.randf(rng, -p.tilt, p.tilt)
    pitch = wp.randf(rng, -p.tilt, p.tilt)
    state.quaternion[w, 0] = tilted(roll, pitch, wp.randf(rng, -3.14159265, 3.14159265))
    most = p.fit.pace * p.speed
    nu = state.velocity[w, 0]
    for k in range(3):
        nu[k] = wp.randf(rng, -most, most)
        nu[k + 3] = 0.0
    state.velocity[w, 0] = nu


@dataclass(frozen=True, kw_only=True)
class MovingTarget(Task):
    """T3. Lengths in metres, world frame with z up and 0 on the water, as for FinsROV.

    A longer vehicle has everything `fit.size` times as large, and `fit.pace` times as fast. The target's speed, courses
    and tolerances are the published ones; across the pool its box is what the walls leave (published: 2.5 m).
    """

    succeeds: ClassVar[str] = "once"
    moving: ClassVar[bool] = True
    title: ClassVar[str] = "stay with a target that changes its course"
    needs: ClassVar[tuple[str, ...]] = ("surge", "sway", "heave")
    name: str = "t3"
    observation: tuple[ObservationPart, ...] = OBSERVATION
    time_limit: float = 30.0
    fit: Fit = Fit()
    """Factors of the vehicle; the environment sets them."""
    low: tuple[float, float, float] = (-1.25, -0.50, -0.675)
    """The target starts in this box, and turns back where it leaves it; with 0.08 m/s² it needs 0.06 m for that."""
    high: tuple[float, float, float] = (1.25, 0.50, -0.325)
    fastest: float = 0.10
    """Its speed is drawn up to this [m/s] ..."""
    acceleration: float = 0.08
    """... and changes by this at most [m/s²]."""
    vertical: float = 0.4
    """Part of the drawn speed that is left upwards and downwards."""
    retarget: tuple[float, float] = (1.5, 4.0)
    """Another velocity is drawn after a time from this range [s]."""
    spawn_low: tuple[float, float, float] = (-1.4, -0.6, -0.80)
    """The vehicle starts in this box, with any heading."""
    spawn_high: tuple[float, float, float] = (1.4, 0.6, -0.20)
    tilt: float = math.radians(20.0)
    """Largest roll and pitch at the start [rad]."""
    speed: float = 0.1
    """Largest starting speed per axis [m/s]."""
    bounds: tuple[float, float] = (2.5, 1.5)
    """Leaving |x|, |y| beyond these ends the episode."""
    ceiling: float = 0.3
    """So does rising above this height."""
    depth: float = 1.5
    """So does sinking below this depth."""
    tolerance: float = 0.25
    """Success: within this distance, ..."""
    slip_tolerance: float = 0.12
    """... with at most this speed relative to the target [m/s] ..."""
    rate_tolerance: float = 0.3
    """... and at most this turn rate [rad/s], ..."""
    hold: float = 1.0
    """... for this long: 10 steps [s]."""
    settle: float = 10.0
    """The error of an episode is counted from here [s]."""
    reward: TargetReward = field(default_factory=TargetReward)
    training_noise: MeasurementNoise = MeasurementNoise(
        position_std=0.01, yaw_std=math.radians(1.0), velocity_std=0.02, rate_std=0.02
    )

    def fitted(self, vehicles: Sequence[Vehicle]) -> "MovingTarget":
        """As large and fast as suits the vehicle."""
        return replace(self, fit=fit(vehicles[0]))

    def arena(self) -> Pool:
        """See `Fit.pool`."""
        return self.fit.pool()

    def allocate(self, arrays: TaskArrays, worlds: int, device: wp.Device) -> None:
        """Room for every target's motion."""
        motion = TargetMotion()
        motion.velocity = wp.zeros(worlds, dtype=wp.vec3, device=device)
        motion.wanted = wp.zeros(worlds, dtype=wp.vec3, device=device)
        motion.until = wp.zeros(worlds, dtype=wp.float32, device=device)
        motion.rng = wp.zeros(worlds, dtype=wp.uint32, device=device)
        arrays.target = motion

    def success_rule(self) -> str:
        """See `Task`."""
        return (
            f"{self.tolerance:g} m, {self.slip_tolerance:g} m/s and {self.rate_tolerance:g} rad/s from the target for "
            f"{self.hold:g} s"
        )

    def metrics(self, arrays: TaskArrays) -> dict[str, NDArray[np.float64]]:
        """As every task's; success (10 steps in tolerance at any time), its time [s], error after `settle` (RMS) [m].

        `success_time` is not a number where there was none, nor `error` where the episode was shorter.
        """
        measured = super().metrics(arrays)
        squared = measured.pop("squared_error")
        long = measured["length"] * self.control_step > self.settle + 0.5 * self.control_step
        return {**measured, "error": np.where(long, np.sqrt(squared), np.nan)}

    def terms(self) -> Terms:
        """See `TargetReward`."""
        r = self.reward
        return Terms(
            start=start,
            advance=move_target,
            shared={"e": target_error, "u": slip, "close": near},
            seen={"offset": goal_offset},
            rewards=(
                RewardTerm("near", "close", r.near),
                RewardTerm("match", match, r.match),
                RewardTerm("distance", "e", -r.distance / self.fit.size),
                RewardTerm("spin", spin, -r.spin),
                RewardTerm("action", action_effort, -r.action),
                RewardTerm("change", action_change, -r.change),
            ),
            ends=(End("left", out_of_pool, -r.loss),),
            inside=with_target,
            totals=(Total("squared_error", squared_error),),
        )
