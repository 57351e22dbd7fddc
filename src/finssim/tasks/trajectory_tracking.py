"""T2, trajectory tracking: follow a moving reference, whatever the heading (paper, section IV)."""

import math
from dataclasses import dataclass, field
from typing import Any

import warp as wp

from finssim.engine.state import State
from finssim.tasks.arrays import TaskArrays
from finssim.tasks.episode import action_effort, close_episode, open_episode, report_frozen, uniform3
from finssim.tasks.measurement import MeasurementNoise
from finssim.tasks.reference import (
    reference_position,
    reference_progress,
    reference_table,
    reference_velocity,
)
from finssim.tasks.reference_shapes import SHAPE_NAMES, fill_reference, greatest_rate
from finssim.tasks.task import ObservationPart, Task

DISTANCE_SCALE = 3.0
"""Distances are divided by this in the observation [m]."""
VELOCITY_CLIP = 2.0
"""Velocities are clipped here in the observation [m/s, rad/s]."""
LOOK_AHEAD = 0.1
"""The reference is seen now and one, two and three times this later [s]."""

REST = 1.0e-6
"""A reference slower than this has no tangent: it is taken to lie ahead [m/s]."""

LEVELS = (
    ("line", "circle"),
    ("circle", "lemniscate"),
    ("circle", "lemniscate", "helix"),
    ("line", "circle", "lemniscate", "helix"),
)
"""Shapes of the three published levels of difficulty, and of ours, which has them all at once."""

OBSERVATION = (
    *(
        ObservationPart(
            f"reference offset in {LOOK_AHEAD * i:.1f} s, body frame", 3, "m", scale=DISTANCE_SCALE
        )
        for i in range(4)
    ),
    ObservationPart("reference velocity, body frame", 3, "m/s"),
    ObservationPart("linear velocity, body frame", 3, "m/s", clip=VELOCITY_CLIP),
    ObservationPart("angular velocity, body frame", 3, "rad/s", clip=VELOCITY_CLIP),
    ObservationPart("world up, body frame", 3, "1"),
    ObservationPart("tangent heading in the body, sine and cosine", 2, "1"),
    ObservationPart("progress, sine and cosine of one and two turns", 4, "1"),
)


@wp.struct
class TrackingParameters:
    """Ranges and weights of the task, for the kernels."""

    shape_of: wp.vec4i
    shapes: int
    scale_low: wp.vec3
    scale_high: wp.vec3
    speed_limit: wp.vec3
    slowest: float
    lift: float
    depth: float
    jitter: wp.vec3
    tilt: float
    speed: float
    lost: float
    ceiling: float
    range: float
    tolerance: float
    time_limit: float
    control_step: float
    track_weight: float
    track_scale: float
    distance_weight: float
    posture_weight: float
    tilt_scale: float
    spin_scale: float
    spin_weight: float
    action_weight: float
    change_weight: float
    loss: float


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
def write_tracking(arrays: TaskArrays, w: int, t: float):
    """The 30 numbers of `OBSERVATION` from the measured state of vehicle 0, at a time since the start [s]."""
    q = arrays.quaternion[w, 0]
    x = arrays.position[w, 0]
    for i in range(4):
        place = reference_position(arrays.reference, w, t + LOOK_AHEAD * float(i))
        offset = wp.quat_rotate_inv(q, place - x) / DISTANCE_SCALE
        for k in range(3):
            arrays.observation[w, 3 * i + k] = offset[k]
    drift = wp.quat_rotate_inv(q, reference_velocity(arrays.reference, w, t))
    up = wp.quat_rotate_inv(q, wp.vec3(0.0, 0.0, 1.0))
    nu = arrays.velocity[w, 0]
    for k in range(3):
        arrays.observation[w, 12 + k] = drift[k]
        arrays.observation[w, 21 + k] = up[k]
    for k in range(6):
        arrays.observation[w, 15 + k] = wp.clamp(nu[k], -VELOCITY_CLIP, VELOCITY_CLIP)
    pace = wp.sqrt(drift[0] * drift[0] + drift[1] * drift[1])
    arrays.observation[w, 24] = wp.where(pace > REST, drift[1] / pace, 0.0)
    arrays.observation[w, 25] = wp.where(pace > REST, drift[0] / pace, 1.0)
    turn = 6.2831853 * reference_progress(arrays.reference, w, t)
    arrays.observation[w, 26] = wp.sin(turn)
    arrays.observation[w, 27] = wp.cos(turn)
    arrays.observation[w, 28] = wp.sin(2.0 * turn)
    arrays.observation[w, 29] = wp.cos(2.0 * turn)


@wp.func
def tracking_reward(p: TrackingParameters, e: float, tilt: float, spin: float, effort: wp.vec2) -> float:
    """Reward of one step; see `TrackingReward`."""
    pose = wp.exp(-e / p.track_scale)
    tilted = tilt / p.tilt_scale
    spun = spin * spin / (p.spin_scale * p.spin_scale)
    posture = 0.5 / (1.0 + tilted * tilted) + 0.5 / (1.0 + spun * spun)
    return (
        pose * (p.track_weight + p.posture_weight * posture)
        - p.distance_weight * e
        - p.spin_weight * wp.abs(spin)
        - p.action_weight * effort[0]
        - p.change_weight * effort[1]
    )


@wp.kernel(enable_backward=False)
def evaluate_tracking(state: State, arrays: TaskArrays, p: TrackingParameters, world_offset: int):
    """After a step: reward, ends, time within the tolerance and the observation."""
    w = world_offset + wp.tid()
    if state.frozen[w] != 0:
        report_frozen(state, arrays, w)
        return
    t = float(state.steps[w]) * p.control_step
    x = state.position[w, 0]
    goal = reference_position(arrays.reference, w, t)
    arrays.goal_position[w] = goal
    e = wp.length(goal - x)
    tilt = wp.acos(wp.clamp(wp.quat_rotate(state.quaternion[w, 0], wp.vec3(0.0, 0.0, 1.0))[2], -1.0, 1.0))
    effort = action_effort(arrays, w)
    reward = tracking_reward(p, e, tilt, state.velocity[w, 0][5], effort)
    lost = e > p.lost or x[2] > p.ceiling or wp.length(x) > p.range
    reward -= wp.where(lost, p.loss, 0.0)
    late = t >= p.time_limit - 0.5 * p.control_step
    arrays.held[w] = wp.where(e <= p.tolerance, arrays.held[w] + p.control_step, 0.0)

    done = lost or late
    arrays.reward[w] = reward
    arrays.terminated[w] = wp.where(lost, 1, 0)
    arrays.truncated[w] = wp.where(late and not lost, 1, 0)
    arrays.done[w] = wp.where(done, 1, 0)
    arrays.episode_return[w] = arrays.episode_return[w] + reward
    write_tracking(arrays, w, t)
    if done:
        close_episode(state, arrays, w)


@wp.func
def draw_reference(arrays: TaskArrays, p: TrackingParameters, key: int, w: int):
    """A shape, its size, height, phase, direction and speed, drawn for this episode alone."""
    pi = 3.14159265
    rng = wp.rand_init(key, 4 * w)
    kind = p.shape_of[wp.randi(rng, 0, p.shapes)]
    lift = wp.randf(rng, -p.lift, p.lift)
    phase = wp.randf(rng, -pi, pi)
    direction = wp.where(wp.randf(rng) < 0.5, -1.0, 1.0)
    pace = wp.randf(rng, p.slowest, 1.0)
    scale = uniform3(wp.rand_init(key, 4 * w + 1), p.scale_low, p.scale_high)
    origin = wp.vec3(0.0, 0.0, p.depth) + uniform3(wp.rand_init(key, 4 * w + 2), -p.jitter, p.jitter)
    # As published, no more than one turn in an episode and no axis beyond its speed limit.
    fastest = wp.min(2.0 * pi / p.time_limit, greatest_rate(kind, lift, scale, p.speed_limit))
    fill_reference(arrays.reference, w, kind, lift, scale, origin, phase, direction * pace * fastest)


@wp.kernel(enable_backward=False)
def spawn_tracking(
    state: State,
    arrays: TaskArrays,
    p: TrackingParameters,
    seed: int,
    mask: wp.array(dtype=int),
    world_offset: int,
):
    """Start an episode where mask is not 0: a reference, unless one is given, and a start beside its first point."""
    w = world_offset + wp.tid()
    if mask[w] == 0:
        return
    key = seed + 15485863 * state.episode[w]
    if arrays.reference.given[w] == 0:
        draw_reference(arrays, p, key, w)
    rng = wp.rand_init(key, 4 * w + 3)
    start = reference_position(arrays.reference, w, 0.0)
    away = wp.vec3(wp.randf(rng, -1.0, 1.0), wp.randf(rng, -1.0, 1.0), wp.randf(rng, -1.0, 1.0))
    state.position[w, 0] = start + wp.cw_mul(away, p.jitter)
    roll = wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), wp.randf(rng, -p.tilt, p.tilt))
    pitch = wp.quat_from_axis_angle(wp.vec3(0.0, 1.0, 0.0), wp.randf(rng, -p.tilt, p.tilt))
    yaw = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), wp.randf(rng, -3.14159265, 3.14159265))
    state.quaternion[w, 0] = yaw * pitch * roll
    nu = state.velocity[w, 0]
    for i in range(3):
        nu[i] = wp.randf(rng, -p.speed, p.speed)
    for i in range(3):
        nu[i + 3] = 0.0
    state.velocity[w, 0] = nu
    arrays.goal_position[w] = start
    arrays.goal_quaternion[w] = wp.quat_identity()
    open_episode(arrays, w)


@wp.kernel(enable_backward=False)
def observe_tracking(arrays: TaskArrays, mask: wp.array(dtype=int), world_offset: int):
    """First observation of the episodes that start, where mask is not 0."""
    w = world_offset + wp.tid()
    if mask[w] != 0:
        write_tracking(arrays, w, 0.0)


@dataclass(frozen=True, kw_only=True)
class TrajectoryTracking(Task):
    """T2. Lengths in metres, angles in radians, world frame with z up and 0 on the water.

    The published generator, except that shapes are as large as the pool (published: half axes up to 2.5 and 1.25 m,
    beyond its walls) and that their speed is drawn, since what is to be followed is slow.
    """

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
    tilt: float = math.radians(20.0)
    """Largest roll and pitch at the start; the heading is any."""
    speed: float = 0.1
    """Largest starting speed per axis [m/s]."""
    lost: float = 4.0
    """A greater distance to the reference ends the episode."""
    ceiling: float = 0.3
    """So does rising above this height."""
    range: float = 12.0
    """So does going this far from the world's origin."""
    tolerance: float = 0.05
    """The time within this distance is counted, without a break."""
    hold: float = 10.0
    """An episode counts as held when it ends with this long within the tolerance [s]."""
    knot_spacing: float = 0.25
    """Time between two knots of the reference's table [s]."""
    reward: TrackingReward = field(default_factory=TrackingReward)
    training_noise: MeasurementNoise = MeasurementNoise(
        position_std=0.01, yaw_std=math.radians(1.0), velocity_std=0.02, rate_std=0.02
    )
    """About what an estimate is off by: with exact states, gains are learnt that chatter on measured ones."""

    evaluate = staticmethod(evaluate_tracking)
    spawn = staticmethod(spawn_tracking)
    observe = staticmethod(observe_tracking)

    def __post_init__(self) -> None:
        if not 0 <= self.level < len(LEVELS):
            raise ValueError(f"level is {self.level}, expected 0 to {len(LEVELS) - 1}")

    def allocate(self, arrays: TaskArrays, worlds: int, device: wp.Device) -> None:
        """Room for every world's reference, from the start to what is seen at the end."""
        knots = math.ceil((self.time_limit + 3.0 * LOOK_AHEAD) / self.knot_spacing) + 2
        arrays.reference = reference_table(worlds, knots, self.knot_spacing, device)

    def parameters(self) -> Any:
        """The struct that the kernels take."""
        p, r = TrackingParameters(), self.reward
        kinds = [SHAPE_NAMES.index(name) for name in LEVELS[self.level]]
        p.shape_of, p.shapes = wp.vec4i(*kinds, *[0] * (4 - len(kinds))), len(kinds)
        for name in ("scale_low", "scale_high", "speed_limit", "jitter"):
            setattr(p, name, wp.vec3(*getattr(self, name)))
        for name in (
            *("slowest", "lift", "depth", "tilt", "speed", "lost", "ceiling", "range", "tolerance"),
            *("time_limit", "control_step"),
        ):
            setattr(p, name, getattr(self, name))
        p.track_weight, p.track_scale, p.distance_weight = r.track, r.track_scale, r.distance
        p.posture_weight, p.tilt_scale, p.spin_scale = r.posture, r.tilt_scale, r.spin_scale
        p.spin_weight = r.spin
        p.action_weight, p.change_weight, p.loss = r.action, r.change, r.loss
        return p
