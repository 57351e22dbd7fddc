"""T1, station keeping: reach a pose in the pool and hold it within 0.10 m per axis and 10° (paper, section IV)."""

import math
from dataclasses import dataclass, field
from typing import Any, ClassVar

import warp as wp

from finssim.sim.state import State
from finssim.tasks.arrays import TaskArrays
from finssim.tasks.fitting import PoolTask
from finssim.tasks.measurement import MeasurementNoise
from finssim.tasks.terms import (
    End,
    ObservationPart,
    RewardTerm,
    Terms,
    action_costs,
    attitude_error,
    goal_columns,
    goal_offset,
    heading_match,
    offset_length,
    out_of_pool,
    own_velocity,
    position_error,
    tilt_angle,
    tilted,
    uniform3,
)

DISTANCE_SCALE = 3.0
"""Scale of distances in the observation [m]."""

OBSERVATION = (
    ObservationPart("goal offset, body frame", 3, "m", scale=DISTANCE_SCALE, term="offset", errors=(0, 1, 2)),
    ObservationPart(
        "goal rotation relative to the body, first two columns", 6, "1", term=goal_columns, errors=(1,)
    ),
    *own_velocity(clip=2.0),
    ObservationPart("distance to the goal", 1, "m", scale=DISTANCE_SCALE, clip=1.0, term=offset_length),
)


@dataclass(frozen=True, kw_only=True)
class Reward:
    """Weights of the reward; each term has one reason.

    r = position · exp(-e / position_scale)      a slope that does not vanish at the goal: centimetres count
      - distance · e                             a slope everywhere: distant goals. A weight of 0.3 was too small:
                                                 with random buoyancy, policies learned to lie on the floor
      + heading · exp(-θ / heading_scale) - turn · θ     the same for the attitude error θ, roll and pitch included
      - leaning · clip(2 tilt / max_tilt - 1, 0, 2)   avoid tilts at which a bridge stops. If this ended the episode,
                                                 policies learned to capsize at once, to end the losses
      - action · mean(a²)                        the cheapest thrusts that suffice
      - change · mean(Δa²)                       commands that a motor can follow, no chatter
      - rate · min(|ω|², 4)                      no spinning
      - loss                                     once, on leaving the pool: more than a bad episode costs
    """

    position: float = 1.0
    position_scale: float = 0.15
    distance: float = 1.0
    heading: float = 0.6
    heading_scale: float = 0.20
    turn: float = 0.15
    leaning: float = 1.0
    action: float = 0.03
    change: float = 0.05
    rate: float = 0.01
    loss: float = 10.0


@wp.func
def heading(q: wp.quat) -> float:
    """Return the yaw of the body x axis about world z [rad]."""
    x = wp.quat_rotate(q, wp.vec3(1.0, 0.0, 0.0))
    return wp.atan2(x[1], x[0])


@wp.func
def wrapped(angle: float) -> float:
    """Wrap an angle [rad] in (-2π, 2π) to [-π, π]."""
    return angle - wp.sign(angle) * wp.where(wp.abs(angle) > 3.14159265, 6.2831853, 0.0)


@wp.func
def within_tolerance(state: State, arrays: TaskArrays, p: Any, w: int) -> bool:
    """Return True if every axis is within `tolerance`, and yaw within `yaw_tolerance`."""
    error = arrays.goal_position[w] - state.position[w, 0]
    off = wp.max(wp.max(wp.abs(error[0]), wp.abs(error[1])), wp.abs(error[2]))
    turn = wp.abs(wrapped(heading(arrays.goal_quaternion[w]) - heading(state.quaternion[w, 0])))
    return off <= p.tolerance and turn <= p.yaw_tolerance


@wp.func
def at_goal(p: Any, e: float) -> float:
    """Return 1 at the goal, 1/e at an error `e` of `position_scale` [m], scaled to the vehicle."""
    return wp.exp(-e / (p.fit.size * p.reward.position_scale))


@wp.func
def leaning(state: State, p: Any, w: int) -> float:
    """Return 0 up to half of `max_tilt`, 1 at `max_tilt`, at most 2 [1]; a bridge stops at `max_tilt`."""
    return wp.clamp(2.0 * tilt_angle(state, w) / p.max_tilt - 1.0, 0.0, 2.0)


@wp.func
def start(state: State, arrays: TaskArrays, p: Any, key: int, w: int):
    """Start an episode with a random goal pose, start pose and velocity."""
    pi = 3.14159265
    size = p.fit.size
    arrays.goal_position[w] = uniform3(wp.rand_init(key, 4 * w), size * p.goal_low, size * p.goal_high)
    state.position[w, 0] = uniform3(wp.rand_init(key, 4 * w + 1), size * p.spawn_low, size * p.spawn_high)
    bound = wp.vec3(p.tilt, p.tilt, pi)
    angles = uniform3(wp.rand_init(key, 4 * w + 2), -bound, bound)
    rng = wp.rand_init(key, 4 * w + 3)
    arrays.goal_quaternion[w] = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), wp.randf(rng, -pi, pi))
    state.quaternion[w, 0] = tilted(angles[0], angles[1], angles[2])
    nu = state.velocity[w, 0]
    for i in range(3):
        nu[i] = wp.randf(rng, -p.speed, p.speed)
    for i in range(3):
        nu[i + 3] = wp.randf(rng, -p.rate, p.rate)
    state.velocity[w, 0] = nu


@dataclass(frozen=True, kw_only=True)
class StationKeeping(PoolTask):
    """T1. Lengths in metres, angles in radians, world frame with z up and 0 on the water.

    For a longer vehicle, goals, starts and pool are scaled by `fit.size`; the tolerance is not. Success here means
    holding the goal at the end of an episode; `finssim.evaluation.metrics` judges a trial of `finssim evaluate`, as in
    the paper.
    """

    succeeds: ClassVar[str] = "held"
    title: ClassVar[str] = "reach a pose in the pool and hold it"
    needs: ClassVar[tuple[str, ...]] = ("surge", "sway", "heave", "yaw")
    baselines: ClassVar = {"pid": "finssim.agents.baselines:StationPid"}
    name: str = "t1"
    observation: tuple[ObservationPart, ...] = OBSERVATION
    goal_low: tuple[float, float, float] = (-1.2, -0.5, -0.82)
    """Lower corner of the box of the goals [m]; yaw is uniform over the circle, roll and pitch are 0."""
    goal_high: tuple[float, float, float] = (1.2, 0.5, -0.28)
    max_tilt: float = math.radians(45.0)
    """Tilt that the vehicle should stay well below [rad]: the default `safety.max_tilt`, at which a bridge stops
    it."""
    speed: float = 0.30
    """Largest starting speed per axis [m/s]."""
    rate: float = 0.35
    """Largest starting turn rate per axis [rad/s]."""
    approach: ClassVar[float] = 1.2
    """Greatest observed distance to the goal on a robot [m]; a farther goal is moved to this distance in its direction,
    because distant goals are rare in training, and policies then tilt beyond the limits of the sensors."""
    tolerance: float = 0.10
    """Greatest error per axis for success [m]."""
    yaw_tolerance: float = math.radians(10.0)
    """Greatest yaw error for success [rad]."""
    hold: float = 10.0
    """Time within these tolerances for success [s]."""
    reward: Reward = field(default_factory=Reward)
    training_noise: MeasurementNoise = MeasurementNoise(
        position_std=0.01, yaw_std=math.radians(1.0), velocity_std=0.02, rate_std=0.02, delay=0.1, graded=True
    )
    """Delay and noise, larger than an estimate's, increasing from none in the first world to all in the last: with
    exact states alone, policies learn gains that oscillate; with noise alone, they hold vehicles with little rotational
    damping only under noise."""

    def success_rule(self) -> str:
        """Return the rule of success; see `Task`."""
        turn = math.degrees(self.yaw_tolerance)
        return f"{self.tolerance:g} m per axis and {turn:g}° in yaw for {self.hold:g} s, at the end"

    def terms(self) -> Terms:
        """Return the terms; see `Reward`."""
        r = self.reward
        return Terms(
            start=start,
            shared={"e": position_error, "theta": attitude_error},
            meanings={
                "position": f"1 at the goal, 1/e at {self.fit.size * r.position_scale:.3g} m from it.",
                "heading": f"1 in the goal's attitude, 1/e at {r.heading_scale:.3g} rad from it.",
            },
            seen={"offset": goal_offset},
            rewards=(
                RewardTerm("position", at_goal, r.position),
                RewardTerm("distance", "e", -r.distance / self.fit.size),
                RewardTerm("heading", heading_match, r.heading),
                RewardTerm("turn", "theta", -r.turn),
                RewardTerm("leaning", leaning, -r.leaning),
                *action_costs(r.action, r.change, r.rate),
            ),
            ends=(End("left", out_of_pool, -r.loss),),
            inside=within_tolerance,
        )
