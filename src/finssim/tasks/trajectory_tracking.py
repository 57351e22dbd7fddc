"""T2, trajectory tracking: follow a moving reference, heading free (paper, section IV)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import warp as wp

from finssim.control.guidance import Guide, Reference
from finssim.core.rotations import quat_from_yaw
from finssim.sim.state import State
from finssim.tasks.arrays import ReferenceTable, TaskArrays, allocated
from finssim.tasks.environment import Environment, EnvironmentSetupError
from finssim.tasks.fitting import FittedTask
from finssim.tasks.terms import (
    End,
    ObservationPart,
    RewardTerm,
    Terms,
    action_costs,
    own_velocity,
    position_error,
    start_upright,
    tilt_angle,
    uniform3,
    world_up,
)

# References to follow: a table of knots per world, filled with the shapes of T2 by a kernel, or from trajectories.


ENDLESS = 1.0e9
"""A guide that takes longer takes this long [s]."""


def reference_table(worlds: int, knots: int, spacing: float, device: wp.Device) -> ReferenceTable:
    """Return an empty table of `knots` knots, `spacing` apart [s]."""
    table: ReferenceTable = allocated(ReferenceTable, worlds, device, position=knots, velocity=knots)
    table.spacing = spacing
    table.duration.fill_(1.0)
    return table


@wp.func
def reference_knot(r: ReferenceTable, w: int, t: float) -> int:
    """The knot at or before a time. `t` is the time [s]."""
    return wp.clamp(int(wp.floor(t / r.spacing)), 0, r.position.shape[1] - 2)


@wp.func
def held_time(r: ReferenceTable, w: int, t: float) -> float:
    """The time, held at the end of the reference and of its table [s]."""
    return wp.min(wp.min(t, r.duration[w]), float(r.position.shape[1] - 1) * r.spacing)


@wp.func
def reference_position(r: ReferenceTable, w: int, t: float) -> wp.vec3:
    """Return the reference position of the vehicle at a time since the episode's start, world frame [m]."""
    now = held_time(r, w, t)
    k = reference_knot(r, w, now)
    u = now / r.spacing - float(k)
    way = r.position[w, k + 1] - r.position[w, k]
    a = r.spacing * r.velocity[w, k]
    b = r.spacing * r.velocity[w, k + 1]
    return r.position[w, k] + u * (a + u * (3.0 * way - 2.0 * a - b + u * (a + b - 2.0 * way)))


@wp.func
def reference_velocity(r: ReferenceTable, w: int, t: float) -> wp.vec3:
    """Velocity of `reference_position`, zero where it is held [m/s]."""
    now = held_time(r, w, t)
    if now < t:
        return wp.vec3()
    k = reference_knot(r, w, now)
    u = now / r.spacing - float(k)
    way = r.position[w, k + 1] - r.position[w, k]
    a = r.spacing * r.velocity[w, k]
    b = r.spacing * r.velocity[w, k + 1]
    return (a + u * (6.0 * way - 4.0 * a - 2.0 * b + 3.0 * u * (a + b - 2.0 * way))) / r.spacing


@wp.func
def reference_progress(r: ReferenceTable, w: int, t: float) -> float:
    """Part of the way, from `offset` to `offset + 1`."""
    return r.offset[w] + wp.min(t / r.duration[w], 1.0)


def follow(environment: Environment, guides: Sequence[Guide]) -> np.ndarray:
    """Start an episode in every world at rest on its guide's first pose; world i follows guides[i] from then on.

    Args:
        environment: Of a task that follows references, such as `TrajectoryTracking`.
        guides: One per world.

    Returns:
        Observations, (worlds, size).

    Raises:
        EnvironmentSetupError: Another number of guides, or one that is longer than the task's `time_limit`.
    """
    table = environment.arrays.reference
    if len(guides) != environment.worlds or table.position is None:
        raise EnvironmentSetupError(
            f"{len(guides)} guides for {environment.worlds} worlds of task '{environment.task.name}': "
            "give one for each world of a task that follows references, such as t2"
        )
    longest = max(guide.duration for guide in guides)
    if longest > environment.task.time_limit:
        raise EnvironmentSetupError(
            f"a guide takes {longest:g} s, longer than the task's time_limit of {environment.task.time_limit:g} s: "
            "make the task with a longer one"
        )
    places = fill_table(table, guides)
    position, yaw = (
        np.stack([getattr(reference, name)[0] for reference in places]) for name in ("position", "yaw")
    )
    q = quat_from_yaw(yaw)
    return environment.start(position, q, position, q)


def fill_table(table: ReferenceTable, guides: Sequence[Guide]) -> list[Reference]:
    """Give world i the motion of guides[i]; a station has no end, and no progress.

    Returns:
        Each guide at the times of the knots, held at its end.
    """
    t = table.spacing * np.arange(table.position.shape[1])
    ends = [np.minimum(t, guide.duration) for guide in guides]
    places = [guide.at(time) for guide, time in zip(guides, ends, strict=True)]
    velocity = np.stack([reference.velocity for reference in places])
    # Beyond its end a motion continues in the table, so that the piece with the end is followed; none reads further.
    beyond = (t - np.stack(ends))[..., None] * velocity
    table.position.assign(
        (np.stack([reference.position for reference in places]) + beyond).astype(np.float32)
    )
    table.velocity.assign(velocity.astype(np.float32))
    table.duration.assign(np.array([min(guide.duration, ENDLESS) for guide in guides], np.float32))
    table.offset.zero_()
    table.given.fill_(1)
    return places


# The shapes that T2 trains on, drawn for every episode inside the kernels: line, circle, lemniscate, helix.


SHAPE_NAMES = ("line", "circle", "lemniscate", "helix")
"""Names of the shapes by the number that the kernels use."""

SPEED_SAMPLES = 96
"""Phases at which the greatest slope of a shape is looked for, as published."""


@wp.func
def shape_point(kind: int, phase: float, lift: float) -> wp.vec3:
    """Point of a shape of unit scale at a phase; `lift` is the height of its tilt [1]."""
    s = wp.sin(phase)
    c = wp.cos(phase)
    d = 1.0 + s * s
    if kind == 0:
        return wp.vec3(s, 0.0, lift * s)
    if kind == 1:
        return wp.vec3(c, s, lift * s)
    if kind == 2:  # Bernoulli's
        return wp.vec3(c / d, s * c / d, lift * s)
    return wp.vec3(c, s, phase / 6.2831853)


@wp.func
def shape_slope(kind: int, phase: float, lift: float) -> wp.vec3:
    """Derivative of `shape_point` by the phase. It is in shares of the half axes; `phase` is in [rad]."""
    s = wp.sin(phase)
    c = wp.cos(phase)
    d = 1.0 + s * s
    if kind == 0:
        return wp.vec3(c, 0.0, lift * c)
    if kind == 1:
        return wp.vec3(-s, c, lift * c)
    if kind == 2:
        return wp.vec3(-s * (3.0 - s * s) / (d * d), (1.0 - 3.0 * s * s) / (d * d), lift * c)
    return wp.vec3(-s, c, 1.0 / 6.2831853)


@wp.func
def greatest_rate(kind: int, lift: float, scale: wp.vec3, limit: wp.vec3) -> float:
    """Phase rate at which the first axis reaches its speed limit [rad/s]."""
    steepest = wp.vec3()
    for i in range(SPEED_SAMPLES):
        slope = shape_slope(kind, 6.2831853 * float(i) / float(SPEED_SAMPLES), lift)
        steepest = wp.max(
            steepest, wp.cw_mul(scale, wp.vec3(wp.abs(slope[0]), wp.abs(slope[1]), wp.abs(slope[2])))
        )
    rate = float(1.0e6)
    for axis in range(3):
        if steepest[axis] > 0.0:
            rate = wp.min(rate, limit[axis] / steepest[axis])
    return rate


@wp.func
def fill_reference(
    r: ReferenceTable,
    w: int,
    kind: int,
    lift: float,
    scale: wp.vec3,
    origin: wp.vec3,
    phase: float,
    rate: float,
):
    """Write the knots of a shape that is run through at a constant phase rate [rad/s] from `phase` [rad] on."""
    for k in range(r.position.shape[1]):
        angle = rate * r.spacing * float(k)
        if kind == 3:  # its height counts from the start
            lifted = shape_point(kind, phase + angle, lift)
            lifted[2] = angle / 6.2831853
            r.position[w, k] = origin + wp.cw_mul(scale, lifted)
        else:
            r.position[w, k] = origin + wp.cw_mul(scale, shape_point(kind, phase + angle, lift))
        r.velocity[w, k] = rate * wp.cw_mul(scale, shape_slope(kind, phase + angle, lift))
    r.duration[w] = 6.2831853 / wp.abs(rate)
    r.offset[w] = phase / 6.2831853
    r.given[w] = 0


# The task.


LEVELS = (
    ("line", "circle"),
    ("circle", "lemniscate"),
    ("circle", "lemniscate", "helix"),
    ("line", "circle", "lemniscate", "helix"),
)
"""Shapes of the three published levels of difficulty, and of ours, which has all of them."""

DISTANCE_SCALE = 3.0
"""Distances are divided by this in the observation [m]."""
LOOK_AHEAD = 0.1
"""The reference is seen now and one, two and three times this later [s]."""

REST = 1.0e-6
"""A reference slower than this has no tangent: it is taken to lie ahead [m/s]."""


@wp.func
def reference_offset(arrays: TaskArrays, w: int, k: int) -> wp.vec3:
    """Return the way from the vehicle to the reference in k `LOOK_AHEAD` from now, body frame [m]."""
    ahead = reference_position(arrays.reference, w, arrays.time[w] + LOOK_AHEAD * float(k))
    return wp.quat_rotate_inv(arrays.quaternion[w, 0], ahead - arrays.position[w, 0])


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
        term=world_up,
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
def on_reference(p: Any, e: float) -> float:
    """Return 1 on the reference, 1/e at an error `e` of `track_scale` [m] in proportion to the vehicle."""
    return wp.exp(-e / (p.fit.size * p.reward.track_scale))


@wp.func
def yaw_speed(state: State, w: int) -> float:
    """Return the size of the yaw rate [rad/s]."""
    return wp.abs(state.velocity[w, 0][5])


@wp.func
def within_tolerance(p: Any, e: float) -> bool:
    """Return whether the error `e` [m] is within `tolerance`."""
    return e <= p.tolerance


@wp.func
def posture(state: State, p: Any, w: int, pose: float) -> float:
    """Return the reward pose · (0.5 / (1 + (tilt / tilt_scale)²) + 0.5 / (1 + (r / spin_scale)⁴))."""
    rate = state.velocity[w, 0][5]
    lean = tilt_angle(state, w) / p.reward.tilt_scale
    spun = rate * rate / (p.reward.spin_scale * p.reward.spin_scale)
    return pose * (0.5 / (1.0 + lean * lean) + 0.5 / (1.0 + spun * spun))


@wp.func
def is_lost(state: State, p: Any, w: int, e: float) -> bool:
    """Farther than `lost` from the reference, above `ceiling`, or beyond `range`. The error `e` is in [m]."""
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
    title: ClassVar[str] = "follow a moving reference, heading free"
    baselines: ClassVar = {"pid": "finssim.agents.baselines:TrackingPid"}
    name: str = "t2"
    observation: tuple[ObservationPart, ...] = OBSERVATION
    time_limit: float = 30.0
    level: int = 3
    """Index of the `LEVELS` that the shapes are drawn from: 0 to 2 as published, 3 all of them."""
    scale_low: tuple[float, float, float] = (0.3, 0.2, 0.04)
    """Half axes of a shape are drawn from here [m], along, across and up ..."""
    scale_high: tuple[float, float, float] = (1.2, 0.6, 0.12)
    """... to here [m]."""
    speed_limit: tuple[float, float, float] = (0.30, 0.20, 0.10)
    """Greatest speed of a reference along, across and up [m/s]; never more than one turn in `time_limit` either."""
    slowest: float = 0.2
    """Smallest part of the greatest possible speed that is drawn; 1: always the greatest, as published."""
    lift: float = 0.6
    """Greatest part of the upward half axis by which a shape is tilted."""
    depth: float = -0.5
    """Height of the middle of a shape [m]."""
    jitter: tuple[float, float, float] = (0.15, 0.15, 0.15)
    """Largest shift of a shape, and of the start from its first point [m]."""
    speed: float = 0.1
    """Largest starting speed per axis [m/s]."""
    lost: float = 4.0
    """A greater distance to the reference ends the episode [m]."""
    range: float = 12.0
    """So does going this far from the world's origin [m]."""
    tolerance: float = 0.05
    """The time within this distance [m] is counted, without a break."""
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
        """Return the number of shapes to draw from."""
        return len(LEVELS[self.level])

    def terms(self) -> Terms:
        """See `TrackingReward`."""
        r = self.reward
        return Terms(
            start=start,
            advance=lead_reference,
            shared={"e": position_error, "pose": on_reference},
            seen={"drift": reference_drift},
            meanings={
                "track": f"1 on the reference, 1/e at {self.fit.size * r.track_scale:.3g} m from it.",
            },
            rewards=(
                RewardTerm("track", "pose", r.track),
                RewardTerm("posture", posture, r.posture),
                RewardTerm("distance", "e", -r.distance / self.fit.size),
                RewardTerm("spin", yaw_speed, -r.spin),
                *action_costs(r.action, r.change),
            ),
            ends=(End("lost", is_lost, -r.loss),),
            inside=within_tolerance,
        )
