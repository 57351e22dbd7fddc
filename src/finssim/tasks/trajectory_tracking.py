"""T2, trajectory tracking: follow a moving reference, whatever the heading (paper, section IV)."""

import math
from dataclasses import dataclass, field
from typing import Any, ClassVar

import warp as wp

from finssim.engine.state import State
from finssim.tasks.arrays import TaskArrays
from finssim.tasks.fitting import FittedTask
from finssim.tasks.reference import (
    SHAPE_NAMES,
    fill_reference,
    greatest_rate,
    reference_position,
    reference_progress,
    reference_table,
    reference_velocity,
)
from finssim.tasks.terms import (
    End,
    ObservationPart,
    RewardTerm,
    Terms,
    own_velocity,
    start_upright,
    tilt_angle,
    uniform3,
)

LEVELS = (
    ("line", "circle"),
    ("circle", "lemniscate"),
    ("circle", "lemniscate", "helix"),
    ("line", "circle", "lemniscate", "helix"),
)
"""Shapes of the three published levels of difficulty, and of ours, which has them all at once."""

DISTANCE_SCALE = 3.0
"""Distances are divided by this in the observation [m]."""
LOOK_AHEAD = 0.1
"""The reference is seen now and one, two and three times this later [s]."""

REST = 1.0e-6
"""A reference slower than this has no tangent: it is taken to lie ahead [m/s]."""


@wp.func
def reference_offset(arrays: TaskArrays, w: int, k: int) -> wp.vec3:
    """From the vehicle to where the reference is k `LOOK_AHEAD` from now, body frame [m]."""
    place = reference_position(arrays.reference, w, arrays.time[w] + LOOK_AHEAD * float(k))
    return wp.quat_rotate_inv(arrays.quaternion[w, 0], place - arrays.position[w, 0])


@wp.func
def reference_drift(arrays: TaskArrays, w: int) -> wp.vec3:
    """Velocity of the reference, body frame [m/s]."""
    return wp.quat_rotate_inv(
        arrays.quaternion[w, 0], reference_velocity(arrays.reference, w, arrays.time[w])
    )


@wp.func
def tangent(drift: wp.vec3) -> wp.vec2:
    """Sine and cosine of the heading of the reference's velocity, seen from the body."""
    pace = wp.sqrt(drift[0] * drift[0] + drift[1] * drift[1])
    return wp.vec2(wp.where(pace > REST, drift[1] / pace, 0.0), wp.where(pace > REST, drift[0] / pace, 1.0))


@wp.func
def progress(arrays: TaskArrays, w: int) -> wp.vec4:
    """Sine and cosine of the progress, once and twice."""
    turn = 6.2831853 * reference_progress(arrays.reference, w, arrays.time[w])
    return wp.vec4(wp.sin(turn), wp.cos(turn), wp.sin(2.0 * turn), wp.cos(2.0 * turn))


OBSERVATION = (
    *(
        ObservationPart(
            f"reference offset in {LOOK_AHEAD * i:.1f} s, body frame",
            3,
            "m",
            DISTANCE_SCALE,
            term=reference_offset,
            index=i,
            errors=(0, 1, 2) if i == 0 else (),
        )
        for i in range(4)
    ),
    ObservationPart("reference velocity, body frame", 3, "m/s", term="drift"),
    *own_velocity(clip=2.0),
    ObservationPart(
        "world up, body frame",
        3,
        "1",
        term="wp.quat_rotate_inv(arrays.quaternion[w, a], wp.vec3(0.0, 0.0, 1.0))",
    ),
    ObservationPart("tangent heading in the body, sine and cosine", 2, "1", term=tangent),
    ObservationPart("progress, sine and cosine of one and two turns", 4, "1", term=progress),
)


@dataclass(frozen=True, kw_only=True)
class TrackingReward:
    """Weights of the reward; each term has one reason.

    pose = exp(-e / track_scale)

    r = track · pose                             nearness to the reference; published with a scale of 0.6 m, on which
                                                 centimetres are nothing
      - distance · e                             a slope everywhere: a far reference is caught up with
      + posture · pose · (0.5 / (1 + (tilt / tilt_scale)²) + 0.5 / (1 + (r / spin_scale)⁴))
                                                 level, and not spinning: published with scales of one; only near the
                                                 reference, so that it is never worth staying away for
      - spin · |r|                               the heading is free, but turning all the time is not: without a slope
                                                 at every yaw rate r, a steady turn was learnt
      - action · mean(a²)                        the cheapest thrusts that do it
      - change · mean(Δa²)                       commands that a motor can follow, no chatter
      - loss                                     once, on getting lost: more than a bad episode costs
    """

    track: float = 1.0
    track_scale: float = 0.05
    distance: float = 2.0
    posture: float = 0.5
    tilt_scale: float = 0.2
    spin_scale: float = 0.3
    spin: float = 0.5
    action: float = 0.01
    change: float = 0.05
    loss: float = 10.0


@wp.func
def lead_reference(arrays: TaskArrays, w: int):
    """Take the goal to where the reference is now."""
    arrays.goal_position[w] = reference_position(arrays.reference, w, arrays.time[w])


@wp.func
def posture(state: State, p: Any, w: int, pose: float) -> float:
    """pose · (0.5 / (1 + (tilt / tilt_scale)²) + 0.5 / (1 + (r / spin_scale)⁴))."""
    rate = state.velocity[w, 0][5]
    lean = tilt_angle(state, w) / p.reward.tilt_scale
    spun = rate * rate / (p.reward.spin_scale * p.reward.spin_scale)
    return pose * (0.5 / (1.0 + lean * lean) + 0.5 / (1.0 + spun * spun))


@wp.func
def is_lost(state: State, p: Any, w: int, e: float) -> bool:
    """Farther than `lost` from the reference, above `ceiling`, or beyond `range`."""
    x = state.position[w, 0]
    size = p.fit.size
    return e > size * p.lost or x[2] > size * p.ceiling or wp.length(x) > size * p.range


@wp.func
def draw_reference(arrays: TaskArrays, p: Any, key: int, w: int):
    """A shape, its size, height, phase, direction and speed, drawn for this episode alone."""
    pi = 3.14159265
    size = p.fit.size
    jitter = size * p.jitter
    rng = wp.rand_init(key, 4 * w)
    kind = p.shape_of[wp.randi(rng, 0, p.shapes)]
    lift = wp.randf(rng, -p.lift, p.lift)
    phase = wp.randf(rng, -pi, pi)
    direction = wp.where(wp.randf(rng) < 0.5, -1.0, 1.0)
    pace = wp.randf(rng, p.slowest, 1.0)
    scale = uniform3(wp.rand_init(key, 4 * w + 1), size * p.scale_low, size * p.scale_high)
    origin = wp.vec3(0.0, 0.0, size * p.depth) + uniform3(wp.rand_init(key, 4 * w + 2), -jitter, jitter)
    # As published, no more than one turn in an episode and no axis beyond its speed limit.
    fastest = wp.min(2.0 * pi / p.time_limit, greatest_rate(kind, lift, scale, size * p.speed_limit))
    fill_reference(arrays.reference, w, kind, lift, scale, origin, phase, direction * pace * fastest)


@wp.func
def start(state: State, arrays: TaskArrays, p: Any, key: int, w: int):
    """A reference, unless one is given, and a start beside its first point."""
    if arrays.reference.given[w] == 0:
        draw_reference(arrays, p, key, w)
    rng = wp.rand_init(key, 4 * w + 3)
    start = reference_position(arrays.reference, w, 0.0)
    away = wp.vec3(wp.randf(rng, -1.0, 1.0), wp.randf(rng, -1.0, 1.0), wp.randf(rng, -1.0, 1.0))
    state.position[w, 0] = start + wp.cw_mul(away, p.fit.size * p.jitter)
    start_upright(state, w, rng, p.tilt, p.speed)
    arrays.goal_position[w] = start
    arrays.goal_quaternion[w] = wp.quat_identity()


@dataclass(frozen=True, kw_only=True)
class TrajectoryTracking(FittedTask):
    """T2. Lengths in metres, angles in radians, world frame with z up and 0 on the water.

    The published generator, except that shapes are as large as the pool (published: half axes up to 2.5 and 1.25 m,
    beyond its walls) and that their speed is drawn, since what is to be followed is slow. A longer vehicle has shapes,
    their speeds and the pool `fit.size` times as large; the tolerance stays.
    """

    succeeds: ClassVar[str] = "held"
    moving: ClassVar[bool] = True
    title: ClassVar[str] = "follow a moving reference, whatever the heading"
    name: str = "t2"
    observation: tuple[ObservationPart, ...] = OBSERVATION
    time_limit: float = 30.0
    level: int = 3
    """Which of `LEVELS` the shapes are drawn from: 0 to 2 as published, 3 all of them."""
    scale_low: tuple[float, float, float] = (0.3, 0.2, 0.04)
    """Half axes of a shape are drawn from here, along, across and up ..."""
    scale_high: tuple[float, float, float] = (1.2, 0.6, 0.12)
    """... to here."""
    speed_limit: tuple[float, float, float] = (0.30, 0.20, 0.10)
    """Greatest speed of a reference along, across and up [m/s]; never more than one turn in `time_limit` either."""
    slowest: float = 0.2
    """Smallest part of the greatest possible speed that is drawn; 1: always the greatest, as published."""
    lift: float = 0.6
    """Greatest part of the upward half axis by which a shape is tilted."""
    depth: float = -0.5
    """Height of the middle of a shape."""
    jitter: tuple[float, float, float] = (0.15, 0.15, 0.15)
    """Largest shift of a shape, and of the start from its first point."""
    speed: float = 0.1
    """Largest starting speed per axis [m/s]."""
    lost: float = 4.0
    """A greater distance to the reference ends the episode."""
    range: float = 12.0
    """So does going this far from the world's origin."""
    tolerance: float = 0.05
    """The time within this distance is counted, without a break."""
    hold: float = 10.0
    """An episode counts as held when it ends with this long within the tolerance [s]."""
    knot_spacing: float = 0.25
    """Time between two knots of the reference's table [s]."""
    reward: TrackingReward = field(default_factory=TrackingReward)

    def __post_init__(self) -> None:
        if not 0 <= self.level < len(LEVELS):
            raise ValueError(f"level is {self.level}, expected 0 to {len(LEVELS) - 1}")

    def allocate(self, arrays: TaskArrays, worlds: int, device: wp.Device) -> None:
        """Room for every world's reference, from the start to what is seen at the end."""
        knots = math.ceil((self.time_limit + 3.0 * LOOK_AHEAD) / self.knot_spacing) + 2
        arrays.reference = reference_table(worlds, knots, self.knot_spacing, device)

    def success_rule(self) -> str:
        """See `Task`."""
        return f"{self.tolerance:g} m from the reference for {self.hold:g} s, at the end"

    @property
    def shape_of(self) -> tuple[int, int, int, int]:
        """Numbers of the shapes to draw from, the first `shapes` of them."""
        kinds = [SHAPE_NAMES.index(name) for name in LEVELS[self.level]]
        return (*kinds, *[0] * (4 - len(kinds)))  # type: ignore[return-value]

    @property
    def shapes(self) -> int:
        """How many shapes there are to draw from."""
        return len(LEVELS[self.level])

    def terms(self) -> Terms:
        """See `TrackingReward`."""
        r = self.reward
        return Terms(
            start=start,
            advance=lead_reference,
            shared={"e": "position_error", "pose": "wp.exp(-e / (p.fit.size * p.reward.track_scale))"},
            seen={"drift": reference_drift},
            meanings={
                "track": f"1 on the reference, 1/e at {self.fit.size * r.track_scale:.3g} m from it.",
                "spin": "Size of the yaw rate [rad/s].",
            },
            rewards=(
                RewardTerm("track", "pose", r.track),
                RewardTerm("posture", posture, r.posture),
                RewardTerm("distance", "e", -r.distance / self.fit.size),
                RewardTerm("spin", "wp.abs(state.velocity[w, 0][5])", -r.spin),
                RewardTerm("action", "action_effort", -r.action),
                RewardTerm("change", "action_change", -r.change),
            ),
            ends=(End("lost", is_lost, -r.loss),),
            inside="e <= p.tolerance",
        )
