"""1-v-1 pursuit: come up to a prey that flees with a vehicle like one's own, and stay with it."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import warp as wp

from finssim.engine.state import State
from finssim.tasks.pursuit_drive import DriveNumbers
from finssim.tasks.pursuit_observation import CHASE, prey_gap
from finssim.tasks.pursuit_prey import Prey, command_prey, prey_speed
from finssim.tasks.task import ObservationPart, Task
from finssim.tasks.terms import (
    End,
    RewardTerm,
    Terms,
    Total,
    action_change,
    action_effort,
    level_direction,
    one,
    place_at_rest,
    world_velocity,
)
from finssim.vehicles import Vehicle

DISTANCE_SLOPE = 8.0
"""The distance costs its full weight here and beyond [m]."""


@dataclass(frozen=True, kw_only=True)
class PursuitReward:
    """Weights of the reward; each term has one reason.

    r = progress · (closing speed) · dt          nearer is better; over an episode it adds up to the way gained [m]
      - distance · min(d / 8 m, 1)               a slope everywhere, also behind a prey that keeps its distance
      + heading · cos(angle to the prey)         the bow, where thrust and camera are best, points at the prey
      + near, within near_radius                 staying with it is worth something before it counts as captured
      - spin · r²                                no turning on the spot
      - action · mean(a²) - change · mean(Δa²)   the cheapest thrusts that do it; commands that a motor can follow
      - step                                     sooner is better
      + capture                                  once; more than all the rest of an episode (published: 50)
      - loss                                     once, on leaving the bounds (published: 1, cheaper than going on)

    Time running out costs nothing (published: 5): the time is not observed, so that nothing could be learnt from it.
    """

    progress: float = 0.9
    distance: float = 0.08
    heading: float = 0.01
    near: float = 0.03
    near_radius: float = 1.2
    spin: float = 0.002
    action: float = 0.001
    change: float = 0.0015
    step: float = 0.0005
    capture: float = 20.0
    loss: float = 20.0


@dataclass(frozen=True, kw_only=True)
class OpenWater(Task):
    """Base of the tasks in open water: where episodes start and end. Lengths in metres, world frame with z up."""

    action: ClassVar[str] = "wrench4"
    pool: ClassVar[None] = None

    spawn_radius: float = 2.5
    """Agents start this near to the origin."""
    low: float = -4.0
    """Everybody starts between this height ..."""
    high: float = -2.0
    """... and this one."""
    bounds: float = 12.0
    """Going farther from the origin than this ends the episode."""
    ceiling: float = 0.3
    """So does rising above this height."""
    depth: float = 8.0
    """And sinking below this depth."""


@wp.func
def outside(state: State, p: Any, w: int, v: int) -> bool:
    """Whether a vehicle is out of bounds."""
    x = state.position[w, v]
    return x[0] * x[0] + x[1] * x[1] > p.bounds * p.bounds or x[2] > p.ceiling or x[2] < -p.depth


@wp.func
def prey_start(p: Any, rng: wp.uint32, x: wp.vec3) -> wp.vec3:
    """A place for the prey: at a distance from x that is drawn, in any direction, at about the same height."""
    angle = wp.randf(rng, -3.14159265, 3.14159265)
    away = wp.randf(rng, p.nearest, p.farthest)
    height = wp.clamp(x[2] + wp.randf(rng, -0.5, 0.5), p.low, p.high)
    level = x + away * level_direction(angle)
    return wp.vec3(level[0], level[1], height)


@wp.func
def gap(state: State, w: int) -> wp.vec3:
    """From the pursuer to the prey, world frame [m]."""
    return state.position[w, 1] - state.position[w, 0]


@wp.func
def distance(way: wp.vec3) -> float:
    """d, from the pursuer to the prey [m]."""
    return wp.max(wp.length(way), 1.0e-6)


@wp.func
def relative_motion(state: State, w: int) -> wp.vec3:
    """The prey's velocity less the pursuer's, world frame [m/s]."""
    return world_velocity(state, w, 1) - world_velocity(state, w, 0)


@wp.func
def gained(p: Any, way: wp.vec3, d: float, motion: wp.vec3) -> float:
    """Closing speed times the control step [m]."""
    return -wp.dot(way, motion) / d * p.control_step


@wp.func
def far(d: float) -> float:
    """min(d / 8 m, 1)."""
    return wp.min(d / DISTANCE_SLOPE, 1.0)


@wp.func
def facing(state: State, w: int, way: wp.vec3, d: float) -> float:
    """Cosine of the angle from the bow to the prey."""
    ahead = wp.quat_rotate(state.quaternion[w, 0], wp.vec3(1.0, 0.0, 0.0))
    return wp.dot(ahead, way) / d


@wp.func
def close_by(p: Any, d: float) -> float:
    """1 within `near_radius`."""
    return wp.where(d < p.reward.near_radius, 1.0, 0.0)


@wp.func
def yawing(state: State, w: int) -> float:
    """r², the yaw rate squared [rad²/s²]."""
    r = state.velocity[w, 0][5]
    return r * r


@wp.func
def with_prey(p: Any, d: float, motion: wp.vec3) -> bool:
    """Within `radius`, at no more than `relative_speed`."""
    return d <= p.radius and wp.length(motion) <= p.relative_speed


@wp.func
def is_captured(p: Any, held: float) -> bool:
    """With the prey for `hold` seconds."""
    return held > 0.0 and held >= p.hold - 0.1 * p.control_step


@wp.func
def is_outside(state: State, p: Any, w: int) -> bool:
    """The pursuer is out of bounds."""
    return outside(state, p, w, 0)


@wp.func
def closest(d: float, was: float) -> float:
    """Smallest distance so far [m]."""
    return wp.min(was, d)


@wp.func
def start(state: State, p: Any, key: int, w: int):
    """Pursuer near the origin, prey some way off, both at rest."""
    pi = 3.14159265
    rng = wp.rand_init(key, 4 * w)
    away = p.spawn_radius * wp.sqrt(wp.randf(rng)) * level_direction(wp.randf(rng, -pi, pi))
    x = wp.vec3(away[0], away[1], wp.randf(rng, p.low, p.high))
    place_at_rest(state, w, 0, x, wp.randf(rng, -pi, pi))
    heading = wp.randf(rng, -pi, pi)
    place_at_rest(state, w, 1, prey_start(p, wp.rand_init(wp.randi(rng)), x), heading)


@dataclass(frozen=True, kw_only=True)
class Pursuit(OpenWater):
    """1-v-1 pursuit. Captured: within `radius` at a relative speed of at most `relative_speed`, for `hold` seconds."""

    agents: ClassVar[tuple[str, ...]] = ("pursuer",)
    others: ClassVar[tuple[str, ...]] = ("prey",)
    succeeds: ClassVar[str] = "captured"
    moving: ClassVar[bool] = True
    title: ClassVar[str] = "catch a prey, one against one"
    needs: ClassVar[tuple[str, ...]] = ("surge", "sway", "heave", "yaw")
    name: str = "pursuit"
    observation: tuple[ObservationPart, ...] = field(default=CHASE, repr=False)
    time_limit: float = 60.0
    prey: Prey = field(default_factory=Prey)
    """What the prey does."""
    prey_speed: float = 0.6
    """Its speed, as a part of what the pursuer can hold (published: 2 m/s, four times that speed)."""
    nearest: float = 2.0
    """The prey starts this far from the pursuer ..."""
    farthest: float = 5.0
    """... to this far."""
    radius: float = 0.8
    relative_speed: float = 0.35
    """[m/s]"""
    hold: float = 0.5
    """[s]"""
    reward: PursuitReward = field(default_factory=PursuitReward)
    speed: float = 0.0
    """Speed of the prey [m/s]: follows from the vehicles."""
    prey_drive: DriveNumbers | None = field(default=None, repr=False)
    """What the prey's thrusters do: follows from its vehicle."""

    def fitted(self, vehicles: Sequence[Vehicle]) -> "Pursuit":
        """The prey's speed and thrust from the vehicles: pursuer, prey."""
        speed = prey_speed(self.prey_speed, vehicles[:1], vehicles[1])
        return replace(self, speed=speed, prey_drive=DriveNumbers.of(vehicles[1]))

    def success_rule(self) -> str:
        """See `Task`."""
        return f"within {self.radius:g} m at no more than {self.relative_speed:g} m/s for {self.hold:g} s"

    def terms(self) -> Terms:
        """See `PursuitReward`."""
        r = self.reward
        return Terms(
            start=start,
            command=command_prey,
            shared={"way": gap, "d": distance, "motion": relative_motion},
            seen={"gap": prey_gap},
            rewards=(
                RewardTerm("progress", gained, r.progress),
                RewardTerm("distance", far, -r.distance),
                RewardTerm("heading", facing, r.heading),
                RewardTerm("near", close_by, r.near),
                RewardTerm("spin", yawing, -r.spin),
                RewardTerm("action", action_effort, -r.action),
                RewardTerm("change", action_change, -r.change),
                RewardTerm("step", one, -r.step),
            ),
            ends=(End("captured", is_captured, r.capture), End("left", is_outside, -r.loss)),
            inside=with_prey,
            totals=(Total("closest", closest, first="d"),),
        )
