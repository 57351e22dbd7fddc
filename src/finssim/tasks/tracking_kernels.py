"""The kernels of trajectory tracking: what of it is observed, scored and drawn, one world a thread."""

import warp as wp

from finssim.engine.state import State
from finssim.tasks.arrays import TaskArrays
from finssim.tasks.episode import action_effort, close_episode, open_episode, report_frozen, uniform3
from finssim.tasks.reference import reference_position, reference_progress, reference_velocity
from finssim.tasks.reference_shapes import fill_reference, greatest_rate

DISTANCE_SCALE = 3.0
"""Distances are divided by this in the observation [m]."""
VELOCITY_CLIP = 2.0
"""Velocities are clipped here in the observation [m/s, rad/s]."""
LOOK_AHEAD = 0.1
"""The reference is seen now and one, two and three times this later [s]."""

REST = 1.0e-6
"""A reference slower than this has no tangent: it is taken to lie ahead [m/s]."""


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


@wp.func
def write_tracking(arrays: TaskArrays, w: int):
    """The 30 numbers of `OBSERVATION` from the measured state of vehicle 0, at the time in the episode."""
    t = arrays.time[w]
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
    arrays.time[w] = t
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
    write_tracking(arrays, w)
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
        write_tracking(arrays, w)
