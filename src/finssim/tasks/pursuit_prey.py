"""The scripted prey: a vehicle that wanders, keeps straight on or flees, by its own thrusters, no faster than told."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import warp as wp

from finssim.engine.state import State
from finssim.tasks.arrays import TaskArrays
from finssim.tasks.given import EnvironmentSetupError
from finssim.tasks.pursuit_drive import DriveNumbers, drive, slowest, towards, write_scripted
from finssim.tasks.terms import level_direction
from finssim.vehicles import Vehicle

PREY_MODES = ("random", "straight", "hybrid", "line-of-sight", "mixed")
"""What a prey does:

random: a new direction and speed every few seconds. straight: one direction, drawn for the episode, at full speed.
hybrid: flees from everybody near, askance, and wanders while nobody is. line-of-sight: flees straight away from the
nearest, always. mixed: one of the four, drawn for the episode.
"""

RESERVE = 0.9
"""A prey is never told to go faster than this part of the speed it can hold: the rest is for steering."""


@dataclass(frozen=True, kw_only=True)
class Prey:
    """The prey's behaviour. Its speed is a part of what the slowest pursuer can hold, never a number of its own."""

    mode: str = "mixed"
    """One of `PREY_MODES`."""
    alarm: float = 3.0
    """A hybrid prey flees from pursuers nearer than this [m]."""
    retarget: float = 4.0
    """Time between two draws of a direction, or of the side to flee to [s]."""
    range: float = 9.0
    """Distance from the origin at which it turns along the border [m]."""
    low: float = -5.0
    """It stays above this height ..."""
    high: float = -1.0
    """... and below this one [m]."""

    def __post_init__(self) -> None:
        if self.mode not in PREY_MODES:
            raise EnvironmentSetupError(
                f"unknown prey mode '{self.mode}'; available: {', '.join(PREY_MODES)}"
            )
        if not (self.retarget > 0.0 and self.range > 0.0 and self.low < self.high < 0.0):
            raise EnvironmentSetupError(
                f"prey: retarget is {self.retarget} s, range {self.range} m, heights {self.low} to {self.high} m; "
                "expected times and ranges above 0 and heights below the surface, the lower one first"
            )

    @property
    def kind(self) -> int:
        """Number of the mode."""
        return PREY_MODES.index(self.mode)


def prey_speed(part: float, pursuers: Sequence[Vehicle], prey: Vehicle) -> float:
    """Speed of a prey: `part` of what the slowest pursuer can hold, within what the prey itself can do [m/s]."""
    if not 0.0 <= part <= 1.0:
        raise EnvironmentSetupError(
            f"prey_speed is {part}, expected 0 to 1: a part of the slowest pursuer's speed"
        )
    return min(part * slowest(pursuers), RESERVE * DriveNumbers.of(prey).top)


@wp.func
def most_climb(p: Any) -> float:
    """Up or down [m/s]."""
    return wp.min(0.5 * p.speed, RESERVE * p.prey_drive.terminal[2])


@wp.func
def wander(p: Any, key: int, w: int, draw: int) -> wp.vec3:
    """Velocity of a random walk in its n-th stretch [m/s]."""
    rng = wp.rand_init(wp.randi(wp.rand_init(key, 4 * w + 2)), draw)
    direction = level_direction(wp.randf(rng, -3.14159265, 3.14159265))
    pace = wp.randf(rng, 0.3, 1.0) * p.speed
    return pace * direction + wp.vec3(0.0, 0.0, wp.randf(rng, -1.0, 1.0) * most_climb(p))


@wp.func
def flight(state: State, p: Any, pursuers: int, w: int, reach: float) -> wp.vec3:
    """Away from all pursuers within reach, each weighted by 1/d²; zero where there is none."""
    x = state.position[w, pursuers]
    away = wp.vec3()
    for a in range(pursuers):
        gap = x - state.position[w, a]
        d = wp.max(wp.length(gap), 1.0e-3)
        if d < reach:
            away += gap / (d * d * d)
    return away


@wp.func
def nearest_pursuer(state: State, pursuers: int, w: int) -> float:
    """Distance from the prey to the nearest pursuer [m]."""
    x = state.position[w, pursuers]
    d = wp.length(x - state.position[w, 0])
    for a in range(1, pursuers):
        d = wp.min(d, wp.length(x - state.position[w, a]))
    return d


@wp.func
def kept_inside(p: Any, x: wp.vec3, v: wp.vec3) -> wp.vec3:
    """The velocity without what leads out of the prey's range: it slides along the border, at the same speed."""
    pace = wp.sqrt(v[0] * v[0] + v[1] * v[1])
    r = wp.sqrt(x[0] * x[0] + x[1] * x[1])
    out = wp.vec3(x[0], x[1], 0.0) / wp.max(r, 1.0e-6)
    radial = v[0] * out[0] + v[1] * out[1]
    kept = v
    if r > p.prey.range and radial > 0.0:
        around = wp.vec3(-out[1], out[0], 0.0)
        side = wp.where(wp.dot(around, v) < 0.0, -1.0, 1.0)
        kept = pace * wp.normalize(side * around - 0.2 * out) + wp.vec3(0.0, 0.0, v[2])
    climb = wp.clamp(kept[2], -most_climb(p), most_climb(p))
    climb = wp.where(x[2] > p.prey.high, -0.5 * most_climb(p), climb)
    climb = wp.where(x[2] < p.prey.low, 0.5 * most_climb(p), climb)
    return wp.vec3(kept[0], kept[1], climb)


@wp.func
def prey_velocity(state: State, p: Any, pursuers: int, key: int, w: int) -> wp.vec3:
    """Velocity that the prey wants, world frame; its level part is no faster than `speed` [m/s]."""
    pi = 3.14159265
    rng = wp.rand_init(key, 4 * w + 3)
    heading = wp.randf(rng, -pi, pi)
    mode = wp.where(p.prey.kind == 4, wp.randi(rng, 0, 4), p.prey.kind)
    draw = int(float(state.steps[w]) * p.control_step / p.prey.retarget + 1.0e-4)
    v = wander(p, key, w, draw)
    if mode == 1:
        v = p.speed * level_direction(heading)
    if mode == 3:
        v = flight(state, p, pursuers, w, nearest_pursuer(state, pursuers, w) * 1.0001 + 1.0e-3)
    if mode == 2:
        away = flight(state, p, pursuers, w, p.prey.alarm)
        if wp.length(away) > 0.0:
            turn = wp.where(wp.randf(wp.rand_init(key + draw, 4 * w + 1)) < 0.5, -0.6, 0.6)
            v = wp.quat_rotate(wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), turn), away)
    if mode >= 2 and (mode == 3 or nearest_pursuer(state, pursuers, w) < p.prey.alarm):
        pace = wp.sqrt(v[0] * v[0] + v[1] * v[1])
        v = v * (p.speed / wp.max(pace, 1.0e-6))
    return kept_inside(p, state.position[w, pursuers], v)


@wp.func
def command_prey(state: State, arrays: TaskArrays, p: Any, key: int, w: int):
    """Write the action of the prey, which is the vehicle after the pursuers; it sees the truth."""
    pursuers = arrays.agent_reward.shape[1]
    q = state.quaternion[w, pursuers]
    wanted = towards(q, prey_velocity(state, p, pursuers, key + 7, w))
    write_scripted(arrays, w, drive(p.prey_drive, q, state.velocity[w, pursuers], wanted))
