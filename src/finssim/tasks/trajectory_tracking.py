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

# References: a table of knots per world, filled by a kernel with the shapes of T2, or from trajectories.


ENDLESS = 1.0e9
"""Upper limit of a guide's duration in the table [s]."""


def reference_table(worlds: int, knots: int, spacing: float, device: wp.Device) -> ReferenceTable:
    """Return an empty table of `knots` knots at intervals of `spacing` [s]."""
    table: ReferenceTable = allocated(ReferenceTable, worlds, device, position=knots, velocity=knots)
    table.spacing = spacing
    table.duration.fill_(1.0)
    return table


@wp.func
def reference_knot(r: ReferenceTable, w: int, t: float) -> int:
    """Return the knot at or before the time `t` [s]."""
    return wp.clamp(int(wp.floor(t / r.spacing)), 0, r.position.shape[1] - 2)


@wp.func
def held_time(r: ReferenceTable, w: int, t: float) -> float:
    """Return the time, limited to the end of the reference and of its table [s]."""
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
    """Return the velocity of `reference_position`, zero after its end [m/s]."""
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
    """Return the progress along the reference, a fraction from `offset` to `offset + 1`."""
    return r.offset[w] + wp.min(t / r.duration[w], 1.0)


def follow(environment: Environment, guides: Sequence[Guide]) -> np.ndarray:
    """Start an episode in every world at rest at its guide's first pose; world i follows guides[i] from then on.

    Args:
        environment: Environment of a task that follows references, such as `TrajectoryTracking`.
        guides: One per world.

    Returns:
        Observations, (worlds, size).

    Raises:
        EnvironmentSetupError: The number of guides does not fit, or one exceeds the task's `time_limit`.
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
    """Fill the table of world i with the motion of guides[i]; a station has neither an end nor progress.

    Returns:
        Each guide at the times of the knots, constant after its end.
    """
    t = table.spacing * np.arange(table.position.shape[1])
    ends = [np.minimum(t, guide.duration) for guide in guides]
    places = [guide.at(time) for guide, time in zip(guides, ends, strict=True)]
    velocity = np.stack([reference.velocity for reference in places])
    # Beyond its end a motion continues in the table, so that the interval with the end is exact; later ones are unused.
    beyond = (t - np.stack(ends))[..., None] * velocity
    table.position.assign(
        (np.stack([reference.position for reference in places]) + beyond).astype(np.float32)
    )
    table.velocity.assign(velocity.astype(np.float32))
    table.duration.assign(np.array([min(guide.duration, ENDLESS) for guide in guides], np.float32))
    table.offset.zero_()
    table.given.fill_(1)
    return places


# The training shapes of T2, drawn for every episode inside the kernels: line, circle, lemniscate, helix.


SHAPE_NAMES = ("line", "circle", "lemniscate", "helix")
"""Names of the shapes by the number that the kernels use."""

SPEED_SAMPLES = 96
"""Number of phases at which the greatest slope of a shape is searched, as published."""


@wp.func
def shape_point(kind: int, phase: float, lift: float) -> wp.vec3:
    """Return the point of a shape of unit scale at a phase; `lift` is the height of its tilt [1]."""
    s = wp.sin(phase)
    c = wp.cos(phase)
    d = 1.0 + s * s
    if kind == 0:
        return wp.vec3(s, 0.0, lift * s)
    if kind == 1:
        return wp.vec3(c, s, lift * s)
    if kind == 2:  # lemniscate of Bernoulli
        return wp.vec3(c / d, s * c / d, lift * s)
    return wp.vec3(c, s, phase / 6.2831853)


@wp.func
def shape_slope(kind: int, phase: float, lift: float) -> wp.vec3:
    """Return the derivative of `shape_point` by the phase, as a fraction of the half axes; `phase` is in [rad]."""
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
    """Return the phase rate at which the first axis reaches its speed limit [rad/s]."""
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
    """Write the knots of a shape that is traversed at a constant phase rate [rad/s] from `phase` [rad] on."""
    for k in range(r.position.shape[1]):
        angle = rate * r.spacing * float(k)
        if kind == 3:  # its height is relative to the start
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
"""Shapes of the three published levels of difficulty, and of an additional level with all of them."""

DISTANCE_SCALE = 3.0
"""Scale of distances in the observation [m]."""
LOOK_AHEAD = 0.1
"""Preview interval: the reference is observed now and after one, two and three intervals [s]."""

REST = 1.0e-6
"""Speed of a reference below which its tangent is undefined and taken as straight ahead [m/s]."""


@wp.func
def reference_offset(arrays: TaskArrays, w: int, k: int) -> wp.vec3:
    """Return the vector from the vehicle to the reference k `LOOK_AHEAD` from now, body frame [m]."""
    ahead = reference_position(arrays.reference, w, arrays.time[w] + LOOK_AHEAD * float(k))
    return wp.quat_rotate_inv(arrays.quaternion[w, 0], ahead - arrays.position[w, 0])


@wp.func
def reference_drift(arrays: TaskArrays, w: int) -> wp.vec3:
    """Return the velocity of the reference, body frame [m/s]."""
    return wp.quat_rotate_inv(
        arrays.quaternion[w, 0], reference_velocity(arrays.reference, w, arrays.time[w])
    )


@wp.func
def tangent(drift: wp.vec3) -> wp.vec2:
    """Return sine and cosine of the heading of the reference's velocity, relative to the body."""
    pace = wp.sqrt(drift[0] * drift[0] + drift[1] * drift[1])
    return wp.vec2(wp.where(pace > REST, drift[1] / pace, 0.0), wp.where(pace > REST, drift[0] / pace, 1.0))


@wp.func
def progress(arrays: TaskArrays, w: int) -> wp.vec4:
    """Return sine and cosine of one and two turns of the progress."""
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

    r = track · pose                             nearness to the reference; published with a scale of 0.6 m, at which
                                                 centimetres have no effect
      - distance · e                             a slope everywhere: a distant reference is caught up with
      + posture · pose · (0.5 / (1 + (tilt / tilt_scale)²) + 0.5 / (1 + (r / spin_scale)⁴))
                                                 level, and not spinning: published with scales of one; only near the
                                                 reference, so that staying away from it never pays
      - spin · |r|                               the heading is free, but not continuous turning: without a slope
                                                 at every yaw rate r, policies learned a steady turn
      - action · mean(a²)                        the cheapest thrusts that suffice
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
    """Set the goal to the current reference."""
    arrays.goal_position[w] = reference_position(arrays.reference, w, arrays.time[w])


@wp.func
def on_reference(p: Any, e: float) -> float:
    """Return 1 on the reference, 1/e at an error `e` of `track_scale` [m], scaled to the vehicle."""
    return wp.exp(-e / (p.fit.size * p.reward.track_scale))


@wp.func
def yaw_speed(state: State, w: int) -> float:
    """Return the magnitude of the yaw rate [rad/s]."""
    return wp.abs(state.velocity[w, 0][5])


@wp.func
def within_tolerance(p: Any, e: float) -> bool:
    """Return True if the error `e` [m] is within `tolerance`."""
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
    """Return True if the error `e` [m] exceeds `lost`, or the vehicle is above `ceiling` or beyond `range`."""
    x = state.position[w, 0]
    size = p.fit.size
    return e > size * p.lost or x[2] > size * p.ceiling or wp.length(x) > size * p.range


@wp.func
def draw_reference(arrays: TaskArrays, p: Any, key: int, w: int):
    """Draw a shape, its size, height, phase, direction and speed for this episode."""
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
    """Start an episode beside the first point of a random reference, unless a reference is given."""
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

    The published generator, except that shapes fit in the pool (published: half axes up to 2.5 and 1.25 m, beyond its
    walls) and that their speed is drawn, so that slow references occur as well. For a longer vehicle, shapes, their
    speeds and the pool are scaled by `fit.size`; the tolerance is not.
    """

    succeeds: ClassVar[str] = "held"
    moving: ClassVar[bool] = True
    title: ClassVar[str] = "follow a moving reference, heading free"
    baselines: ClassVar = {"pid": "finssim.agents.baselines:TrackingPid"}
    name: str = "t2"
    observation: tuple[ObservationPart, ...] = OBSERVATION
    time_limit: float = 30.0
    level: int = 3
    """Index into `LEVELS`, the shapes to draw from: 0 to 2 as published, 3 all of them."""
    scale_low: tuple[float, float, float] = (0.3, 0.2, 0.04)
    """Least half axes of a shape [m], along, across and up."""
    scale_high: tuple[float, float, float] = (1.2, 0.6, 0.12)
    """Greatest half axes of a shape [m]."""
    speed_limit: tuple[float, float, float] = (0.30, 0.20, 0.10)
    """Greatest speed of a reference along, across and up [m/s]; it is also limited to one turn in `time_limit`."""
    slowest: float = 0.2
    """Least drawn fraction of the greatest possible speed; 1: always the greatest, as published."""
    lift: float = 0.6
    """Greatest tilt of a shape, as a fraction of its upward half axis."""
    depth: float = -0.5
    """Height of the middle of a shape [m]."""
    jitter: tuple[float, float, float] = (0.15, 0.15, 0.15)
    """Largest shift of a shape, and of the start from its first point [m]."""
    speed: float = 0.1
    """Largest starting speed per axis [m/s]."""
    lost: float = 4.0
    """Distance to the reference above which the episode ends [m]."""
    range: float = 12.0
    """Distance from the world's origin beyond which the episode ends [m]."""
    tolerance: float = 0.05
    """Distance within which the uninterrupted time is counted [m]."""
    hold: float = 10.0
    """Time within the tolerance at the end of an episode, for success [s]."""
    knot_spacing: float = 0.25
    """Time between two knots of the reference's table [s]."""
    reward: TrackingReward = field(default_factory=TrackingReward)

    def __post_init__(self) -> None:
        if not 0 <= self.level < len(LEVELS):
            raise ValueError(f"level is {self.level}, expected 0 to {len(LEVELS) - 1}")

    def allocate(self, arrays: TaskArrays, worlds: int, device: wp.Device) -> None:
        """Allocate the reference of every world, up to the last preview time."""
        knots = math.ceil((self.time_limit + 3.0 * LOOK_AHEAD) / self.knot_spacing) + 2
        arrays.reference = reference_table(worlds, knots, self.knot_spacing, device)

    def success_rule(self) -> str:
        """Return the rule of success; see `Task`."""
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
        """Return the terms; see `TrackingReward`."""
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
