"""The kernels of 1-v-1 pursuit: vehicle 0 pursues vehicle 1, which a script commands; one world a thread."""

import warp as wp

from finssim.engine.state import State
from finssim.physics.types import vec6
from finssim.tasks.arrays import TaskArrays
from finssim.tasks.episode import action_effort, close_episode, open_episode, report_frozen
from finssim.tasks.pursuit_observation import write_chase
from finssim.tasks.pursuit_prey import PreyParameters, command_prey, level_direction

CAPTURED, LEFT, CLOSEST = 0, 1, 2
"""Places in `arrays.totals`: caught the prey, left the bounds (0 or 1), smallest distance so far [m]."""

DISTANCE_SLOPE = 8.0
"""The distance costs its full weight here and beyond [m]."""


@wp.struct
class Arena:
    """Where episodes start and what ends them; open water without walls."""

    spawn: float  # pursuers start this near to the origin [m]
    nearest: float  # the prey starts this far from there ...
    farthest: float  # ... to this far [m]
    low: float  # everybody starts between these heights [m]
    high: float
    bounds: float  # farther from the origin has left [m]
    ceiling: float  # so has higher than this [m]
    depth: float  # and deeper [m]
    time_limit: float
    control_step: float


@wp.struct
class PursuitParameters:
    """Ranges and weights of the task, for the kernels."""

    prey: PreyParameters
    arena: Arena
    radius: float
    relative_speed: float
    hold: float
    near: float
    step: float
    progress: float
    distance: float
    heading: float
    close: float
    spin: float
    action: float
    change: float
    capture: float
    loss: float


@wp.func
def world_velocity(state: State, w: int, v: int) -> wp.vec3:
    """Velocity of a vehicle, world frame [m/s]."""
    nu = state.velocity[w, v]
    return wp.quat_rotate(state.quaternion[w, v], wp.vec3(nu[0], nu[1], nu[2]))


@wp.func
def outside(a: Arena, x: wp.vec3) -> bool:
    """Whether a place is out of bounds."""
    return x[0] * x[0] + x[1] * x[1] > a.bounds * a.bounds or x[2] > a.ceiling or x[2] < -a.depth


@wp.func
def place_at_rest(state: State, w: int, v: int, x: wp.vec3, yaw: float):
    """Put a vehicle somewhere, level and at rest."""
    state.position[w, v] = x
    state.quaternion[w, v] = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), yaw)
    state.velocity[w, v] = vec6()


@wp.func
def prey_start(a: Arena, rng: wp.uint32, x: wp.vec3) -> wp.vec3:
    """A place for the prey: at a distance from x that is drawn, in any direction, at about the same height."""
    angle = wp.randf(rng, -3.14159265, 3.14159265)
    away = wp.randf(rng, a.nearest, a.farthest)
    height = wp.clamp(x[2] + wp.randf(rng, -0.5, 0.5), a.low, a.high)
    level = x + away * level_direction(angle)
    return wp.vec3(level[0], level[1], height)


@wp.func
def pursuit_reward(state: State, arrays: TaskArrays, p: PursuitParameters, w: int) -> float:
    """Reward of one step but for its ends; see `PursuitReward`. Keeps the action for the next step's change."""
    gap = state.position[w, 1] - state.position[w, 0]
    d = wp.max(wp.length(gap), 1.0e-6)
    closing = -wp.dot(gap, world_velocity(state, w, 1) - world_velocity(state, w, 0)) / d
    ahead = wp.quat_rotate(state.quaternion[w, 0], wp.vec3(1.0, 0.0, 0.0))
    spin = state.velocity[w, 0][5]
    effort = action_effort(arrays, w)
    return (
        p.progress * closing * p.arena.control_step
        - p.distance * wp.min(d / DISTANCE_SLOPE, 1.0)
        + p.heading * wp.dot(ahead, gap) / d
        + wp.where(d < p.near, p.close, 0.0)
        - p.spin * spin * spin
        - p.action * effort[0]
        - p.change * effort[1]
        - p.step
    )


@wp.kernel(enable_backward=False)
def evaluate_pursuit(state: State, arrays: TaskArrays, p: PursuitParameters, world_offset: int):
    """After a step: reward, capture, ends and the observation."""
    w = world_offset + wp.tid()
    if state.frozen[w] != 0:
        report_frozen(state, arrays, w)
        return
    step = p.arena.control_step
    d = wp.length(state.position[w, 1] - state.position[w, 0])
    relative = wp.length(world_velocity(state, w, 1) - world_velocity(state, w, 0))
    inside = d <= p.radius and relative <= p.relative_speed
    arrays.held[w] = wp.where(inside, arrays.held[w] + step, 0.0)
    captured = inside and arrays.held[w] >= p.hold - 0.1 * step
    out = outside(p.arena, state.position[w, 0]) and not captured
    late = float(state.steps[w]) * step >= p.arena.time_limit - 0.5 * step

    reward = pursuit_reward(state, arrays, p, w)
    reward += wp.where(captured, p.capture, 0.0) - wp.where(out, p.loss, 0.0)
    arrays.totals[w, CAPTURED] = wp.where(captured, 1.0, 0.0)
    arrays.totals[w, LEFT] = wp.where(out, 1.0, 0.0)
    arrays.totals[w, CLOSEST] = wp.min(arrays.totals[w, CLOSEST], d)

    ended = captured or out
    arrays.reward[w] = reward
    arrays.terminated[w] = wp.where(ended, 1, 0)
    arrays.truncated[w] = wp.where(late and not ended, 1, 0)
    arrays.done[w] = wp.where(ended or late, 1, 0)
    arrays.episode_return[w] = arrays.episode_return[w] + reward
    write_chase(arrays, w, 0, 1, 0)
    if ended or late:
        close_episode(state, arrays, w)


@wp.kernel(enable_backward=False)
def spawn_pursuit(
    state: State,
    arrays: TaskArrays,
    p: PursuitParameters,
    seed: int,
    mask: wp.array(dtype=int),
    world_offset: int,
):
    """Start an episode where mask is not 0: pursuer near the origin, prey some way off, both at rest."""
    w = world_offset + wp.tid()
    if mask[w] == 0:
        return
    pi = 3.14159265
    rng = wp.rand_init(seed + 15485863 * state.episode[w], 4 * w)
    away = p.arena.spawn * wp.sqrt(wp.randf(rng)) * level_direction(wp.randf(rng, -pi, pi))
    x = wp.vec3(away[0], away[1], wp.randf(rng, p.arena.low, p.arena.high))
    place_at_rest(state, w, 0, x, wp.randf(rng, -pi, pi))
    heading = wp.randf(rng, -pi, pi)
    prey = prey_start(p.arena, wp.rand_init(wp.randi(rng)), x)
    place_at_rest(state, w, 1, prey, heading)
    open_episode(arrays, w)
    arrays.totals[w, CLOSEST] = wp.length(prey - x)


@wp.kernel(enable_backward=False)
def observe_pursuit(arrays: TaskArrays, mask: wp.array(dtype=int), world_offset: int):
    """First observation of the episodes that start, where mask is not 0."""
    w = world_offset + wp.tid()
    if mask[w] != 0:
        write_chase(arrays, w, 0, 1, 0)


@wp.kernel(enable_backward=False)
def script_pursuit(state: State, arrays: TaskArrays, p: PursuitParameters, seed: int, world_offset: int):
    """Before each step: what the prey does."""
    w = world_offset + wp.tid()
    command_prey(state, arrays, p.prey, seed, w)
