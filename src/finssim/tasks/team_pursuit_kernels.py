"""The kernels of 3-v-1 pursuit: vehicle 0 herds, 1 and 2 hold a net, 3 is the prey; one world a thread."""

import warp as wp

from finssim.engine.state import State
from finssim.tasks.arrays import TaskArrays
from finssim.tasks.communication import exchange_messages, key_messages, open_messages
from finssim.tasks.episode import close_episode, open_episode, report_frozen
from finssim.tasks.pursuit_kernels import Arena, outside, place_at_rest, prey_start
from finssim.tasks.pursuit_observation import write_chase, write_mate
from finssim.tasks.pursuit_prey import PreyParameters, command_prey, level_direction, nearest_pursuer
from finssim.tasks.team_pursuit_net import net_distance

AGENTS = 3
PREY = 3
ROW = 30
"""Numbers in the observation of an agent."""
CAPTURED, LEFT, CLOSEST, NET, GAP, TO_NET, TO_AGENT = 0, 1, 2, 3, 4, 5, 6
"""Places in `arrays.totals`: caught; an agent left (0 or 1); smallest distances so far from the prey to an agent and to
the net [m]; what is still missing for a capture now [m]; distances to the net and to the nearest agent now [m]."""


@wp.struct
class TeamParameters:
    """Rules, ranges and weights of the task, for the kernels."""

    prey: PreyParameters
    arena: Arena
    mode: int  # of capture
    proximity: float
    reach: float  # of the net
    touch: float
    hold: float
    net_height: float
    net_length: float
    prey_radius: float
    collision: float  # agents nearer to each other than this bump [m]
    step: float
    progress: float
    distance: float
    drive: float
    stray: float
    spread: float
    bump: float
    action: float
    change: float
    stake: float


@wp.func
def to_the_net(state: State, p: TeamParameters, w: int) -> float:
    """Distance from the prey to the net [m]; a net stretched beyond its length does not catch: the excess is added."""
    left = state.position[w, 1]
    right = state.position[w, 2]
    excess = wp.max(wp.length(right - left) - p.net_length, 0.0)
    return net_distance(state.position[w, PREY], left, right, p.net_height) + 2.0 * excess


@wp.func
def missing(p: TeamParameters, net: float, near: float) -> float:
    """How much nearer the prey must come to be captured, by the mode's rule [m]; 0 or less: it is near enough."""
    by_net = net - p.reach
    by_vehicle = near - p.proximity
    gap = by_net
    if p.mode == 1:
        gap = net - p.prey_radius - p.touch
    if p.mode == 2:
        gap = by_vehicle
    if p.mode == 3:
        gap = wp.min(by_net, by_vehicle)
    return gap


@wp.func
def is_captured(arrays: TaskArrays, p: TeamParameters, w: int, net: float, near: float) -> bool:
    """Whether the prey is caught now; the net of modes 0 and 3 must have it for `hold`, without a break."""
    inside = net <= p.reach
    arrays.held[w] = wp.where(inside, arrays.held[w] + p.arena.control_step, 0.0)
    netted = inside and arrays.held[w] >= p.hold - 0.1 * p.arena.control_step
    caught = netted and (p.mode == 0 or p.mode == 3)
    if p.mode == 1:
        caught = net - p.prey_radius <= p.touch
    if p.mode >= 2 and near <= p.proximity:
        caught = True
    return caught


@wp.func
def agent_effort(arrays: TaskArrays, w: int, a: int) -> wp.vec2:
    """Mean squares of one agent's action and of its change; keeps the action for the next change."""
    size = arrays.action.shape[1] // arrays.agent_reward.shape[1]
    effort = wp.vec2()
    for i in range(size):
        k = a * size + i
        u = wp.clamp(arrays.action[w, k], -1.0, 1.0)
        d = u - arrays.previous_action[w, k]
        effort += wp.vec2(u * u, d * d)
        arrays.previous_action[w, k] = u
    return effort / float(size)


@wp.func
def own_reward(state: State, arrays: TaskArrays, p: TeamParameters, w: int, a: int) -> float:
    """What one agent adds to the team's reward; see `TeamReward`."""
    x = state.position[w, a]
    prey = state.position[w, PREY]
    middle = 0.5 * (state.position[w, 1] + state.position[w, 2])
    effort = agent_effort(arrays, w, a)
    r = -p.action * effort[0] - p.change * effort[1]
    for b in range(AGENTS):
        if b != a and wp.length(state.position[w, b] - x) < p.collision:
            r -= p.bump
    if a == 0:
        ahead = wp.normalize(prey - x)
        r += p.drive * wp.dot(ahead, wp.normalize(middle - prey))
        r -= p.stray * wp.min(wp.length(prey - x) / 8.0, 1.0)
    else:
        span = wp.length(state.position[w, 2] - state.position[w, 1])
        r -= p.spread * wp.min(wp.abs(span - 0.7 * p.net_length), p.net_length)
    return r


@wp.func
def share_reward(state: State, arrays: TaskArrays, p: TeamParameters, w: int, team: float):
    """Every agent's reward: the team's and its own; the world's is their mean."""
    total = float(0.0)
    for a in range(AGENTS):
        r = team + own_reward(state, arrays, p, w, a)
        arrays.agent_reward[w, a] = r
        total += r
    mean = total / float(AGENTS)
    arrays.reward[w] = mean
    arrays.episode_return[w] = arrays.episode_return[w] + mean


@wp.func
def report_frozen_team(state: State, arrays: TaskArrays, w: int):
    """A frozen world ends and waits for its report, and nobody in it is rewarded."""
    report_frozen(state, arrays, w)
    for a in range(arrays.agent_reward.shape[1]):
        arrays.agent_reward[w, a] = 0.0


@wp.func
def write_team(arrays: TaskArrays, w: int):
    """The 30 numbers of every agent: `CHASE`, then for both team-mates their role, place and motion."""
    for a in range(AGENTS):
        write_chase(arrays, w, a, PREY, a * ROW)
        at = a * ROW + 14
        for b in range(AGENTS):
            if b != a:
                arrays.observation[w, at] = wp.where(b == 0, 1.0, 0.0)
                arrays.observation[w, at + 1] = wp.where(b == 0, 0.0, 1.0)
                write_mate(arrays, w, a, b, at + 2)
                at += 8


@wp.kernel(enable_backward=False)
def evaluate_team(state: State, arrays: TaskArrays, p: TeamParameters, world_offset: int):
    """After a step: messages, capture, rewards, ends and the observations."""
    w = world_offset + wp.tid()
    if state.frozen[w] != 0:
        report_frozen_team(state, arrays, w)
        return
    exchange_messages(state, arrays, w)
    net = to_the_net(state, p, w)
    near = nearest_pursuer(state, AGENTS, w)
    captured = is_captured(arrays, p, w, net, near)
    out = bool(False)
    for a in range(AGENTS):
        if outside(p.arena, state.position[w, a]):
            out = True
    lost = out and not captured
    late = float(state.steps[w]) * p.arena.control_step >= p.arena.time_limit - 0.5 * p.arena.control_step

    gap = wp.max(missing(p, net, near), 0.0)
    # What was missing by the rules of now: a level that rises under a running episode is no way gained or lost.
    before = wp.max(missing(p, arrays.totals[w, TO_NET], arrays.totals[w, TO_AGENT]), 0.0)
    team = p.progress * (before - gap) - p.distance * wp.min(gap / 8.0, 1.0) - p.step
    team += wp.where(captured, p.stake, 0.0) - wp.where(lost, p.stake, 0.0)
    share_reward(state, arrays, p, w, team)
    arrays.totals[w, CAPTURED] = wp.where(captured, 1.0, 0.0)
    arrays.totals[w, LEFT] = wp.where(lost, 1.0, 0.0)
    arrays.totals[w, CLOSEST] = wp.min(arrays.totals[w, CLOSEST], near)
    arrays.totals[w, NET] = wp.min(arrays.totals[w, NET], net)
    arrays.totals[w, GAP] = gap
    arrays.totals[w, TO_NET] = net
    arrays.totals[w, TO_AGENT] = near

    ended = captured or lost
    arrays.terminated[w] = wp.where(ended, 1, 0)
    arrays.truncated[w] = wp.where(late and not ended, 1, 0)
    arrays.done[w] = wp.where(ended or late, 1, 0)
    write_team(arrays, w)
    if ended or late:
        close_episode(state, arrays, w)


@wp.kernel(enable_backward=False)
def spawn_team(
    state: State,
    arrays: TaskArrays,
    p: TeamParameters,
    seed: int,
    mask: wp.array(dtype=int),
    world_offset: int,
):
    """Start an episode where mask is not 0: the team around the origin, the prey some way off."""
    w = world_offset + wp.tid()
    if mask[w] == 0:
        return
    pi = 3.14159265
    rng = wp.rand_init(seed + 15485863 * state.episode[w], 4 * w)
    turn = wp.randf(rng, -pi, pi)
    height = wp.randf(rng, p.arena.low, p.arena.high)
    for a in range(AGENTS):
        angle = turn + (float(a) + wp.randf(rng, -0.2, 0.2)) * 2.0 * pi / 3.0
        away = wp.randf(rng, 0.5, 1.0) * p.arena.spawn
        x = away * level_direction(angle) + wp.vec3(0.0, 0.0, height + wp.randf(rng, -0.3, 0.3))
        place_at_rest(state, w, a, x, wp.randf(rng, -pi, pi))
    heading = wp.randf(rng, -pi, pi)
    place_at_rest(
        state, w, PREY, prey_start(p.arena, wp.rand_init(wp.randi(rng)), wp.vec3(0.0, 0.0, height)), heading
    )
    open_episode(arrays, w)
    key_messages(state, arrays, seed, w)
    net = to_the_net(state, p, w)
    near = nearest_pursuer(state, AGENTS, w)
    arrays.totals[w, CLOSEST] = near
    arrays.totals[w, NET] = net
    arrays.totals[w, GAP] = wp.max(missing(p, net, near), 0.0)
    arrays.totals[w, TO_NET] = net
    arrays.totals[w, TO_AGENT] = near


@wp.kernel(enable_backward=False)
def observe_team(arrays: TaskArrays, mask: wp.array(dtype=int), world_offset: int):
    """First observations of the episodes that start, where mask is not 0."""
    w = world_offset + wp.tid()
    if mask[w] != 0:
        open_messages(arrays, w)
        write_team(arrays, w)


@wp.kernel(enable_backward=False)
def script_team(state: State, arrays: TaskArrays, p: TeamParameters, seed: int, world_offset: int):
    """Before each step: what the prey does."""
    w = world_offset + wp.tid()
    command_prey(state, arrays, p.prey, seed, w)
