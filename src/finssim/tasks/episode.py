"""What the kernels of every task do at the start, in each step and at the end of an episode."""

import warp as wp

from finssim.engine.state import State
from finssim.tasks.arrays import TaskArrays


@wp.func
def uniform3(rng: wp.uint32, low: wp.vec3, high: wp.vec3) -> wp.vec3:
    """A point drawn uniformly from a box; the caller passes a stream of its own."""
    a = wp.randf(rng)
    b = wp.randf(rng)
    c = wp.randf(rng)
    return low + wp.cw_mul(wp.vec3(a, b, c), high - low)


@wp.func
def open_episode(arrays: TaskArrays, w: int):
    """Start the totals of an episode over."""
    arrays.time[w] = 0.0
    arrays.held[w] = 0.0
    arrays.episode_return[w] = 0.0
    for i in range(arrays.totals.shape[1]):
        arrays.totals[w, i] = 0.0
    for i in range(arrays.action.shape[1]):
        arrays.previous_action[w, i] = 0.0


@wp.func
def action_effort(arrays: TaskArrays, w: int) -> wp.vec2:
    """Mean squares of the action and of its change since the last step; keeps the action for the next change."""
    size = arrays.action.shape[1]
    effort = float(0.0)
    change = float(0.0)
    for i in range(size):
        a = wp.clamp(arrays.action[w, i], -1.0, 1.0)
        d = a - arrays.previous_action[w, i]
        effort += a * a
        change += d * d
        arrays.previous_action[w, i] = a
    n = float(size)
    return wp.vec2(effort / n, change / n)


@wp.func
def close_episode(state: State, arrays: TaskArrays, w: int):
    """Keep the last observation and the totals of an episode that ends."""
    for i in range(arrays.observation.shape[1]):
        arrays.final_observation[w, i] = arrays.observation[w, i]
    arrays.final_return[w] = arrays.episode_return[w]
    arrays.final_length[w] = state.steps[w]
    arrays.final_held[w] = arrays.held[w]
    for i in range(arrays.totals.shape[1]):
        arrays.final_totals[w, i] = arrays.totals[w, i]


@wp.func
def report_frozen(state: State, arrays: TaskArrays, w: int):
    """A frozen world ends and waits for its report."""
    arrays.reward[w] = 0.0
    arrays.terminated[w] = 1
    arrays.truncated[w] = 0
    arrays.done[w] = 0
    close_episode(state, arrays, w)
