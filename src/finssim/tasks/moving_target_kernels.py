"""The kernels of the moving target: how it moves, and what of it is observed, scored and drawn, one world a thread."""

import warp as wp

from finssim.engine.state import State
from finssim.tasks.arrays import TaskArrays
from finssim.tasks.episode import action_effort, close_episode, open_episode, report_frozen, uniform3

DISTANCE_SCALE = 3.0
"""Distances are divided by this in the observation [m]."""
TARGET_SCALE = 0.2
"""The target's velocity is divided by this in the observation [m/s]."""
VELOCITY_CLIP = 2.0
"""Velocities of the vehicle are clipped here in the observation [m/s, rad/s]."""


@wp.struct
class TargetParameters:
    """Ranges and weights of the task, for the kernels."""

    low: wp.vec3
    high: wp.vec3
    fastest: float
    acceleration: float
    vertical: float
    soonest: float
    latest: float
    spawn_low: wp.vec3
    spawn_high: wp.vec3
    tilt: float
    speed: float
    bounds: wp.vec3
    ceiling: float
    depth: float
    time_limit: float
    control_step: float
    tolerance: float
    slip_tolerance: float
    rate_tolerance: float
    hold: float
    settle: float
    near_weight: float
    near_scale: float
    distance_weight: float
    match_weight: float
    match_scale: float
    spin_weight: float
    action_weight: float
    change_weight: float
    loss: float


@wp.func
def new_course(arrays: TaskArrays, p: TargetParameters, w: int, t: float):
    """Draw a velocity that the target is to have, and until when; from the world's own stream."""
    rng = arrays.target.rng[w]
    z = wp.randf(rng, -1.0, 1.0)
    angle = wp.randf(rng, -3.14159265, 3.14159265)
    pace = wp.randf(rng, 0.0, p.fastest)
    level = wp.sqrt(1.0 - z * z)
    arrays.target.wanted[w] = pace * wp.vec3(level * wp.cos(angle), level * wp.sin(angle), p.vertical * z)
    arrays.target.until[w] = t + wp.randf(rng, p.soonest, p.latest)
    arrays.target.rng[w] = rng


@wp.func
def move_target(arrays: TaskArrays, p: TargetParameters, w: int, t: float):
    """Take the target through the control step that ends at t; outside its box it is on its way back."""
    if t >= arrays.target.until[w]:
        new_course(arrays, p, w, t)
    x = arrays.goal_position[w]
    wanted = arrays.target.wanted[w]
    for k in range(3):
        if x[k] > p.high[k]:
            wanted[k] = -wp.abs(wanted[k])
        if x[k] < p.low[k]:
            wanted[k] = wp.abs(wanted[k])
    arrays.target.wanted[w] = wanted
    v = arrays.target.velocity[w]
    change = wanted - v
    most = p.acceleration * p.control_step
    v += change * wp.min(1.0, most / wp.max(wp.length(change), 1.0e-9))
    arrays.target.velocity[w] = v
    arrays.goal_position[w] = x + p.control_step * v


@wp.func
def write_target(arrays: TaskArrays, w: int):
    """The 13 numbers of `OBSERVATION` from the measured state of vehicle 0."""
    q = arrays.quaternion[w, 0]
    offset = wp.quat_rotate_inv(q, arrays.goal_position[w] - arrays.position[w, 0])
    drift = wp.quat_rotate_inv(q, arrays.target.velocity[w])
    nu = arrays.velocity[w, 0]
    for k in range(3):
        arrays.observation[w, k] = offset[k] / DISTANCE_SCALE
        arrays.observation[w, 3 + k] = drift[k] / TARGET_SCALE
    for k in range(6):
        arrays.observation[w, 6 + k] = wp.clamp(nu[k], -VELOCITY_CLIP, VELOCITY_CLIP)
    arrays.observation[w, 12] = wp.min(wp.length(offset) / DISTANCE_SCALE, 1.0)


@wp.func
def target_reward(p: TargetParameters, e: float, slip: float, spin: float, effort: wp.vec2) -> float:
    """Reward of one step; see `TargetReward`."""
    near = wp.exp(-e / p.near_scale)
    return (
        near * (p.near_weight + p.match_weight * wp.exp(-slip / p.match_scale))
        - p.distance_weight * e
        - p.spin_weight * wp.min(spin, 2.0)
        - p.action_weight * effort[0]
        - p.change_weight * effort[1]
    )


@wp.func
def count_target(arrays: TaskArrays, p: TargetParameters, w: int, t: float, e: float, inside: bool):
    """Keep the time in tolerance and the totals: success, its time, mean squared distance after `settle`."""
    arrays.held[w] = wp.where(inside, arrays.held[w] + p.control_step, 0.0)
    if arrays.held[w] >= p.hold - 0.5 * p.control_step and arrays.totals[w, 0] == 0.0:
        arrays.totals[w, 0] = 1.0
        arrays.totals[w, 1] = t
    k = wp.floor((t - p.settle) / p.control_step + 0.5)
    if k >= 1.0:
        mean = arrays.totals[w, 2]
        arrays.totals[w, 2] = mean + (e * e - mean) / k


@wp.kernel(enable_backward=False)
def evaluate_target(state: State, arrays: TaskArrays, p: TargetParameters, world_offset: int):
    """After a step: the target moves on; reward, ends, time in tolerance and the observation."""
    w = world_offset + wp.tid()
    if state.frozen[w] != 0:
        report_frozen(state, arrays, w)
        return
    t = float(state.steps[w]) * p.control_step
    move_target(arrays, p, w, t)
    x = state.position[w, 0]
    nu = state.velocity[w, 0]
    e = wp.length(arrays.goal_position[w] - x)
    drift = wp.quat_rotate_inv(state.quaternion[w, 0], arrays.target.velocity[w])
    slip = wp.length(wp.vec3(nu[0], nu[1], nu[2]) - drift)
    spin = wp.length(wp.vec3(nu[3], nu[4], nu[5]))
    reward = target_reward(p, e, slip, spin, action_effort(arrays, w))
    out = wp.abs(x[0]) > p.bounds[0] or wp.abs(x[1]) > p.bounds[1] or x[2] > p.ceiling or x[2] < -p.depth
    reward -= wp.where(out, p.loss, 0.0)
    late = t >= p.time_limit - 0.5 * p.control_step
    count_target(
        arrays, p, w, t, e, e <= p.tolerance and slip <= p.slip_tolerance and spin <= p.rate_tolerance
    )
    done = out or late
    arrays.reward[w] = reward
    arrays.terminated[w] = wp.where(out, 1, 0)
    arrays.truncated[w] = wp.where(late and not out, 1, 0)
    arrays.done[w] = wp.where(done, 1, 0)
    arrays.episode_return[w] = arrays.episode_return[w] + reward
    write_target(arrays, w)
    if done:
        close_episode(state, arrays, w)


@wp.kernel(enable_backward=False)
def spawn_target(
    state: State,
    arrays: TaskArrays,
    p: TargetParameters,
    seed: int,
    mask: wp.array(dtype=int),
    world_offset: int,
):
    """Start an episode where mask is not 0: a target that stands still, and a vehicle somewhere else in the pool."""
    w = world_offset + wp.tid()
    if mask[w] == 0:
        return
    key = seed + 15485863 * state.episode[w]
    pi = 3.14159265
    arrays.goal_position[w] = uniform3(wp.rand_init(key, 4 * w), p.low, p.high)
    arrays.goal_quaternion[w] = wp.quat_identity()
    arrays.target.velocity[w] = wp.vec3(0.0)
    arrays.target.rng[w] = wp.rand_init(key, 4 * w + 1)
    new_course(arrays, p, w, 0.0)
    state.position[w, 0] = uniform3(wp.rand_init(key, 4 * w + 2), p.spawn_low, p.spawn_high)
    rng = wp.rand_init(key, 4 * w + 3)
    roll = wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), wp.randf(rng, -p.tilt, p.tilt))
    pitch = wp.quat_from_axis_angle(wp.vec3(0.0, 1.0, 0.0), wp.randf(rng, -p.tilt, p.tilt))
    yaw = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), wp.randf(rng, -pi, pi))
    state.quaternion[w, 0] = yaw * pitch * roll
    nu = state.velocity[w, 0]
    for k in range(3):
        nu[k] = wp.randf(rng, -p.speed, p.speed)
        nu[k + 3] = 0.0
    state.velocity[w, 0] = nu
    open_episode(arrays, w)


@wp.kernel(enable_backward=False)
def observe_target(arrays: TaskArrays, mask: wp.array(dtype=int), world_offset: int):
    """First observation of the episodes that start, where mask is not 0."""
    w = world_offset + wp.tid()
    if mask[w] != 0:
        write_target(arrays, w)
