"""The kernels of formation keeping: three vehicles carry a net to something that drifts, and that to a goal."""

import warp as wp

from finssim.engine.state import State
from finssim.tasks.arrays import TaskArrays
from finssim.tasks.communication import (
    exchange_messages,
    key_messages,
    mate_position,
    measured_velocity,
    open_messages,
)
from finssim.tasks.episode import close_episode, open_episode, uniform3
from finssim.tasks.formation_net import sorted_edges, triangle_distance
from finssim.tasks.pursuit_kernels import Arena, outside, place_at_rest, world_velocity
from finssim.tasks.pursuit_observation import PI, write_mate, write_own_velocity, write_scaled
from finssim.tasks.pursuit_prey import level_direction
from finssim.tasks.team_pursuit_kernels import agent_effort, report_frozen_team

AGENTS = 3
ROW = 34
"""Numbers in the observation of an agent."""
NEAR = 3.0
"""Distances to target, goal and net are divided by this in the observation [m]."""
REACH = 4.0
"""Scaled distances are clipped here."""
SETTLE = 0.5
"""How fast what is held slides to the middle of the net [1/s]."""
DEPTH_SCALE = 5.0
"""The depth is divided by this [m]."""
SUCCESS, TORN, LEFT, HELD, SHAPE, TO_NET, TO_GOAL, STRETCHED = 0, 1, 2, 3, 4, 5, 6, 7
"""Places in `arrays.totals`: delivered, torn, left the bounds (0 or 1); time that the target was held [s]; mean error
of an edge, in sides; distances from target to net and to goal now [m]; time that the net has been too long [s]."""


@wp.struct
class FormationParameters:
    """Ranges and weights of the task, for the kernels."""

    arena: Arena
    side: float
    stretch: float
    slack: float
    reach: float
    goal_radius: float
    hold: float
    grace: float
    drift: float
    collision: float
    jitter: float
    net: float
    goal: float
    shape: float
    bump: float
    step: float
    action: float
    change: float
    success: float
    loss: float


@wp.func
def carried_net(state: State, p: FormationParameters, w: int, x: wp.vec3) -> wp.vec4:
    """The net's distance from a point [m], and the lengths of its edges, the shortest first [m]."""
    a = state.position[w, 0]
    b = state.position[w, 1]
    c = state.position[w, 2]
    edges = sorted_edges(a, b, c)
    return wp.vec4(triangle_distance(x, a, b, c), edges[0], edges[1], edges[2])


@wp.func
def is_held(p: FormationParameters, net: wp.vec4) -> bool:
    """Whether the net holds the target: near enough, and neither stretched too far nor slack."""
    return net[0] <= p.reach and net[1] >= p.slack * p.side and net[3] <= p.stretch * p.side


@wp.func
def move_target(state: State, arrays: TaskArrays, p: FormationParameters, w: int, held: bool):
    """Where the target goes in this step: along with the net and into its middle while it is held, else it drifts."""
    v = arrays.net.drift[w]
    if held:
        middle = (state.position[w, 0] + state.position[w, 1] + state.position[w, 2]) / 3.0
        v = (world_velocity(state, w, 0) + world_velocity(state, w, 1) + world_velocity(state, w, 2)) / 3.0
        v += SETTLE * (middle - arrays.net.target[w])
    arrays.net.motion[w] = v
    arrays.net.target[w] = arrays.net.target[w] + p.arena.control_step * v


@wp.func
def count_shape(
    state: State, arrays: TaskArrays, p: FormationParameters, w: int, net: wp.vec4, held: bool
) -> float:
    """Count what the net is like; the mean error of an edge in this step, in sides."""
    step = p.arena.control_step
    n = float(state.steps[w])
    edges = wp.vec3(net[1], net[2], net[3])
    error = float(0.0)
    for i in range(3):
        error += wp.abs(edges[i] - p.side) / (3.0 * p.side)
    far = net[3] > p.stretch * p.side
    arrays.totals[w, STRETCHED] = wp.where(far, arrays.totals[w, STRETCHED] + step, 0.0)
    arrays.totals[w, HELD] = arrays.totals[w, HELD] + wp.where(held, step, 0.0)
    arrays.totals[w, SHAPE] = arrays.totals[w, SHAPE] + (error - arrays.totals[w, SHAPE]) / n
    return error


@wp.func
def share_formation_reward(state: State, arrays: TaskArrays, p: FormationParameters, w: int, team: float):
    """Every agent's reward: the team's, and its own effort and bumps; the world's is their mean."""
    total = float(0.0)
    for a in range(AGENTS):
        effort = agent_effort(arrays, w, a)
        r = team - p.action * effort[0] - p.change * effort[1]
        for b in range(AGENTS):
            if b != a and wp.length(state.position[w, b] - state.position[w, a]) < p.collision:
                r -= p.bump
        arrays.agent_reward[w, a] = r
        total += r / float(AGENTS)
    arrays.reward[w] = total
    arrays.episode_return[w] = arrays.episode_return[w] + total


@wp.func
def write_formation(arrays: TaskArrays, w: int):
    """The 34 numbers of every agent; see `OBSERVATION`."""
    side = arrays.net.side
    for a in range(AGENTS):
        at = a * ROW
        b = (a + 1) % AGENTS
        c = (a + 2) % AGENTS
        x = arrays.position[w, a]
        q = arrays.quaternion[w, a]
        left = mate_position(arrays, w, a, b)
        right = mate_position(arrays, w, a, c)
        target = arrays.net.target[w]
        slip = arrays.net.motion[w] - measured_velocity(arrays, w, a)
        outward = wp.quat_rotate_inv(q, 2.0 * x - left - right)
        edges = sorted_edges(x, left, right)
        write_own_velocity(arrays, w, a, at)
        write_scaled(arrays, w, at + 6, wp.quat_rotate_inv(q, target - x), NEAR, REACH)
        write_scaled(arrays, w, at + 9, wp.quat_rotate_inv(q, slip), 1.0, REACH)
        arrays.observation[w, at + 12] = wp.clamp(-x[2] / DEPTH_SCALE, -REACH, REACH)
        arrays.observation[w, at + 13] = wp.atan2(outward[1], outward[0]) / PI
        write_mate(arrays, w, a, b, at + 14)
        write_mate(arrays, w, a, c, at + 20)
        write_scaled(arrays, w, at + 26, wp.quat_rotate_inv(q, arrays.goal_position[w] - x), NEAR, REACH)
        write_scaled(arrays, w, at + 29, edges - wp.vec3(side, side, side), side, REACH)
        surface = triangle_distance(target, x, left, right)
        arrays.observation[w, at + 32] = wp.min(surface / NEAR, REACH)
        arrays.observation[w, at + 33] = wp.clamp(arrays.net.stretch - edges[2] / side, -REACH, REACH)


@wp.kernel(enable_backward=False)
def evaluate_formation(state: State, arrays: TaskArrays, p: FormationParameters, world_offset: int):
    """After a step: messages, the target's way, rewards, ends and the observations."""
    w = world_offset + wp.tid()
    if state.frozen[w] != 0:
        report_frozen_team(state, arrays, w)
        return
    step = p.arena.control_step
    exchange_messages(state, arrays, w)
    move_target(state, arrays, p, w, is_held(p, carried_net(state, p, w, arrays.net.target[w])))
    target = arrays.net.target[w]
    net = carried_net(state, p, w, target)
    held = is_held(p, net)
    to_goal = wp.length(arrays.goal_position[w] - target)
    shape = count_shape(state, arrays, p, w, net, held)
    there = held and to_goal <= p.goal_radius
    arrays.held[w] = wp.where(there, arrays.held[w] + step, 0.0)
    delivered = arrays.held[w] >= p.hold - 0.1 * step
    torn = arrays.totals[w, STRETCHED] > p.grace + 0.1 * step
    left = outside(p.arena, state.position[w, 0])
    left = left or outside(p.arena, state.position[w, 1]) or outside(p.arena, state.position[w, 2])
    failed = (torn or left) and not delivered
    late = float(state.steps[w]) * step >= p.arena.time_limit - 0.5 * step

    team = p.net * (arrays.totals[w, TO_NET] - net[0]) + p.goal * (arrays.totals[w, TO_GOAL] - to_goal)
    team += wp.where(delivered, p.success, 0.0) - wp.where(failed, p.loss, 0.0) - p.shape * shape - p.step
    share_formation_reward(state, arrays, p, w, team)
    arrays.totals[w, SUCCESS] = wp.where(delivered, 1.0, 0.0)
    arrays.totals[w, TORN] = wp.where(torn and failed, 1.0, 0.0)
    arrays.totals[w, LEFT] = wp.where(left and failed, 1.0, 0.0)
    arrays.totals[w, TO_NET] = net[0]
    arrays.totals[w, TO_GOAL] = to_goal

    ended = delivered or failed
    arrays.terminated[w] = wp.where(ended, 1, 0)
    arrays.truncated[w] = wp.where(late and not ended, 1, 0)
    arrays.done[w] = wp.where(ended or late, 1, 0)
    write_formation(arrays, w)
    if ended or late:
        close_episode(state, arrays, w)


@wp.func
def away_from(rng: wp.uint32, a: Arena, x: wp.vec3) -> wp.vec3:
    """A place at a level distance from x that is drawn, up to 0.5 m higher or lower."""
    level = x + wp.randf(rng, a.nearest, a.farthest) * level_direction(wp.randf(rng, -PI, PI))
    return wp.vec3(level[0], level[1], wp.clamp(x[2] + wp.randf(rng, -0.5, 0.5), a.low, a.high))


@wp.kernel(enable_backward=False)
def spawn_formation(
    state: State,
    arrays: TaskArrays,
    p: FormationParameters,
    seed: int,
    mask: wp.array(dtype=int),
    world_offset: int,
):
    """Start an episode where mask is not 0: the team in its triangle, the target some way off, the goal beyond."""
    w = world_offset + wp.tid()
    if mask[w] == 0:
        return
    rng = wp.rand_init(seed + 15485863 * state.episode[w], 4 * w)
    turn = wp.randf(rng, -PI, PI)
    away = p.arena.spawn * wp.sqrt(wp.randf(rng)) * level_direction(wp.randf(rng, -PI, PI))
    middle = wp.vec3(away[0], away[1], wp.randf(rng, p.arena.low, p.arena.high))
    most = wp.vec3(p.jitter, p.jitter, p.jitter)
    for a in range(AGENTS):
        angle = turn + float(a) * 2.0 * PI / 3.0
        shift = uniform3(wp.rand_init(wp.randi(rng)), -most, most)
        x = middle + p.side / wp.sqrt(3.0) * level_direction(angle) + shift
        place_at_rest(state, w, a, x, angle + wp.randf(rng, -0.5, 0.5))
    target = away_from(wp.rand_init(wp.randi(rng)), p.arena, middle)
    arrays.goal_position[w] = away_from(wp.rand_init(wp.randi(rng)), p.arena, target)
    arrays.net.target[w] = target
    arrays.net.drift[w] = p.drift * level_direction(wp.randf(rng, -PI, PI))
    arrays.net.motion[w] = arrays.net.drift[w]
    open_episode(arrays, w)
    key_messages(state, arrays, seed, w)
    net = carried_net(state, p, w, target)
    arrays.totals[w, TO_NET] = net[0]
    arrays.totals[w, TO_GOAL] = wp.length(arrays.goal_position[w] - target)


@wp.kernel(enable_backward=False)
def observe_formation(arrays: TaskArrays, mask: wp.array(dtype=int), world_offset: int):
    """First observations of the episodes that start, where mask is not 0."""
    w = world_offset + wp.tid()
    if mask[w] != 0:
        open_messages(arrays, w)
        write_formation(arrays, w)
