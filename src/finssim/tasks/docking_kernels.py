"""The kernels of docking: what of it is observed, scored and drawn, one world a thread."""

import warp as wp

from finssim.engine.state import State
from finssim.tasks.arrays import Berth, TaskArrays
from finssim.tasks.episode import action_effort, close_episode, open_episode, report_frozen, uniform3
from finssim.tasks.station_keeping import attitude_error

DISTANCE_SCALE = 3.0
"""Distances are divided by this in the observation [m]."""
VELOCITY_CLIP = 2.0
"""Velocities are clipped here in the observation [m/s, rad/s]."""

SUCCESS = wp.constant(0)
SUCCESS_TIME = wp.constant(1)
CONTACT_IMPULSE = wp.constant(2)
PEAK_FORCE = wp.constant(3)
CRASH = wp.constant(4)
"""Places in `arrays.totals`."""


@wp.struct
class DockingParameters:
    """Geometry, ranges and weights of the task, for the kernels."""

    inside: float  # from where on it counts as inside [m]
    gap: float  # between the envelope's corners and the tube [m]
    slope: float  # growth of that gap towards the mouth, per length
    length: float  # of the vehicle [m]
    dock_low: wp.vec3
    dock_high: wp.vec3
    start_low: wp.vec3  # of the vehicle's nose, dock axes
    start_high: wp.vec3
    turn: float
    tilt: float
    ceiling: float
    range: float
    slow: float
    force_limit: float
    hold: float
    time_limit: float
    control_step: float
    position_weight: float
    position_scale: float
    distance_weight: float
    corridor_weight: float
    heading_weight: float
    heading_scale: float
    turn_weight: float
    contact_weight: float
    action_weight: float
    change_weight: float
    rate_weight: float
    loss: float


@wp.func
def nose_in_dock(arrays: TaskArrays, w: int, x: wp.vec3, q: wp.quat) -> wp.vec3:
    """The nose of a vehicle with its origin at x and attitude q, in the axes of the world's dock [m]."""
    nose = x + wp.quat_rotate(q, wp.vec3(arrays.berth.nose, 0.0, 0.0))
    return wp.quat_rotate_inv(arrays.goal_quaternion[w], nose - arrays.goal_position[w])


@wp.func
def write_docking(arrays: TaskArrays, w: int):
    """The 19 numbers of `OBSERVATION` from the measured state of vehicle 0."""
    q = arrays.quaternion[w, 0]
    nose = nose_in_dock(arrays, w, arrays.position[w, 0], q)
    R = wp.quat_to_matrix(wp.quat_inverse(q) * arrays.goal_quaternion[w])
    offset = R * (wp.vec3(arrays.berth.depth, 0.0, 0.0) - nose)
    nu = arrays.velocity[w, 0]
    for i in range(3):
        arrays.observation[w, i] = offset[i] / DISTANCE_SCALE
        arrays.observation[w, 3 + i] = R[i, 0]
        arrays.observation[w, 6 + i] = R[i, 1]
        arrays.observation[w, 15 + i] = nose[i] / DISTANCE_SCALE
    for i in range(6):
        arrays.observation[w, 9 + i] = wp.clamp(nu[i], -VELOCITY_CLIP, VELOCITY_CLIP)
    arrays.observation[w, 18] = wp.min(wp.length(offset) / DISTANCE_SCALE, 1.0)


@wp.func
def docking_reward(
    p: DockingParameters,
    berth: Berth,
    nose: wp.vec3,
    theta: float,
    push: float,
    omega: wp.vec3,
    effort: wp.vec2,
) -> float:
    """Reward of one step; see `DockingReward`. Nose in dock axes [m], push the contact force [N]."""
    e = wp.length(wp.vec3(berth.depth - nose[0], nose[1], nose[2])) / p.length
    aside = wp.length(wp.vec2(nose[1], nose[2]))
    off = wp.max(aside - p.gap - p.slope * wp.max(-nose[0], 0.0), 0.0) / p.length
    return (
        p.position_weight * wp.exp(-e / p.position_scale)
        - p.distance_weight * e
        - p.corridor_weight * off
        + p.heading_weight * wp.exp(-theta / p.heading_scale)
        - p.turn_weight * theta
        - p.contact_weight * wp.min(push / p.force_limit, 1.0)
        - p.action_weight * effort[0]
        - p.change_weight * effort[1]
        - p.rate_weight * wp.min(wp.dot(omega, omega), 4.0)
    )


@wp.func
def count_docking(arrays: TaskArrays, p: DockingParameters, w: int, t: float, inside: bool, crashed: bool):
    """Keep the time docked and the totals."""
    arrays.held[w] = wp.where(inside, arrays.held[w] + p.control_step, 0.0)
    if arrays.held[w] >= p.hold - 0.5 * p.control_step and arrays.totals[w, SUCCESS] == 0.0:
        arrays.totals[w, SUCCESS] = 1.0
        arrays.totals[w, SUCCESS_TIME] = t
    arrays.totals[w, CONTACT_IMPULSE] = arrays.totals[w, CONTACT_IMPULSE] + arrays.funnel.impulse[w, 0]
    arrays.totals[w, PEAK_FORCE] = wp.max(arrays.totals[w, PEAK_FORCE], arrays.funnel.force[w, 0])
    if crashed:
        arrays.totals[w, CRASH] = 1.0


@wp.kernel(enable_backward=False)
def evaluate_docking(state: State, arrays: TaskArrays, p: DockingParameters, world_offset: int):
    """After a step: reward, ends, time docked and the observation."""
    w = world_offset + wp.tid()
    if state.frozen[w] != 0:
        report_frozen(state, arrays, w)
        return
    x = state.position[w, 0]
    q = state.quaternion[w, 0]
    nu = state.velocity[w, 0]
    omega = wp.vec3(nu[3], nu[4], nu[5])
    push = arrays.funnel.force[w, 0]
    nose = nose_in_dock(arrays, w, x, q)
    theta = attitude_error(q, arrays.goal_quaternion[w])
    reward = docking_reward(p, arrays.berth, nose, theta, push, omega, action_effort(arrays, w))
    crashed = push > p.force_limit
    lost = crashed or x[2] > p.ceiling or wp.length(x - arrays.goal_position[w]) > p.range
    reward -= wp.where(lost, p.loss, 0.0)
    t = float(state.steps[w]) * p.control_step
    late = t >= p.time_limit - 0.5 * p.control_step
    aside = wp.length(wp.vec2(nose[1], nose[2]))
    still = wp.length(wp.vec3(nu[0], nu[1], nu[2])) <= p.slow
    count_docking(
        arrays, p, w, t, nose[0] >= p.inside and aside <= 2.0 * p.gap and still and not crashed, crashed
    )
    done = lost or late
    arrays.reward[w] = reward
    arrays.terminated[w] = wp.where(lost, 1, 0)
    arrays.truncated[w] = wp.where(late and not lost, 1, 0)
    arrays.done[w] = wp.where(done, 1, 0)
    arrays.episode_return[w] = arrays.episode_return[w] + reward
    write_docking(arrays, w)
    if done:
        close_episode(state, arrays, w)


@wp.kernel(enable_backward=False)
def spawn_docking(
    state: State,
    arrays: TaskArrays,
    p: DockingParameters,
    seed: int,
    mask: wp.array(dtype=int),
    world_offset: int,
):
    """Start an episode where mask is not 0: a dock somewhere, and a vehicle at rest before its mouth."""
    w = world_offset + wp.tid()
    if mask[w] == 0:
        return
    key = seed + 15485863 * state.episode[w]
    z = wp.vec3(0.0, 0.0, 1.0)
    pi = 3.14159265
    rng = wp.rand_init(key, 4 * w + 3)
    q_d = wp.quat_from_axis_angle(z, wp.randf(rng, -pi, pi))
    arrays.goal_position[w] = uniform3(wp.rand_init(key, 4 * w), p.dock_low, p.dock_high)
    arrays.goal_quaternion[w] = q_d
    arrays.funnel.force[w, 0] = 0.0
    arrays.funnel.impulse[w, 0] = 0.0
    roll = wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), wp.randf(rng, -p.tilt, p.tilt))
    pitch = wp.quat_from_axis_angle(wp.vec3(0.0, 1.0, 0.0), wp.randf(rng, -p.tilt, p.tilt))
    q = q_d * wp.quat_from_axis_angle(z, wp.randf(rng, -p.turn, p.turn)) * pitch * roll
    nose = uniform3(wp.rand_init(key, 4 * w + 1), p.start_low, p.start_high)
    state.position[w, 0] = (
        arrays.goal_position[w]
        + wp.quat_rotate(q_d, nose)
        - wp.quat_rotate(q, wp.vec3(arrays.berth.nose, 0.0, 0.0))
    )
    state.quaternion[w, 0] = q
    nu = state.velocity[w, 0]
    for k in range(6):
        nu[k] = 0.0
    state.velocity[w, 0] = nu
    open_episode(arrays, w)


@wp.kernel(enable_backward=False)
def observe_docking(arrays: TaskArrays, mask: wp.array(dtype=int), world_offset: int):
    """First observation of the episodes that start, where mask is not 0."""
    w = world_offset + wp.tid()
    if mask[w] != 0:
        write_docking(arrays, w)
