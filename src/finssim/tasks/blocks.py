"""Evaluation of a task for several worlds at once on a CPU: see `finssim.physics.lanes`."""

from typing import Any

import warp as wp

from finssim.physics.lanes import LANES, LaneError, LaneRow, Trace, WorldStruct, lane_function, world_source
from finssim.sim.state import State
from finssim.sim.step import MODULE_OPTIONS
from finssim.tasks.arrays import TaskArrays
from finssim.tasks.terms import close_episode, report_frozen

_made: dict[tuple[Any, str], wp.Kernel] = {}


def evaluate_in_blocks(score: Any, inputs: list[Any]) -> wp.Kernel | None:
    """Return the kernel `evaluate` of a task for blocks of worlds; None if a term cannot be traced.

    Args:
        score: Function that evaluates one step of a world, to be traced.
        inputs: Inputs of the kernel `evaluate`.
    """
    state, arrays, p, weights = inputs
    trace = Trace()
    structs = [
        WorldStruct(trace, name, actual, {"time_limit": 1e3, "frozen": 0})
        for name, actual in (("state", state), ("arrays", arrays), ("p", p))
    ]
    row = [trace.symbol("F", f"all(weights[{i}])", 1.0) for i in range(len(weights))]
    try:
        trace.require(structs[0].frozen[0] == 0)
        with trace.exploration():
            over = lane_function(score)(*structs, LaneRow((len(row),), row), 0)
    except (LaneError, AttributeError, TypeError, ValueError, LookupError, ArithmeticError):
        return None
    source = world_source(trace, over)
    if (score, source) not in _made:
        _made[score, source] = _kernel(score, source, p._cls, type(weights))
    return _made[score, source]


def _kernel(score: Any, source: str, P: Any, W: Any) -> wp.Kernel:
    @wp.func_native(source)
    def blocks(state: State, arrays: TaskArrays, p: P, weights: W, w: int, count: int) -> int: ...

    @wp.kernel(enable_backward=False, module="unique", module_options=MODULE_OPTIONS)
    def evaluate(state: State, arrays: TaskArrays, p: P, weights: W, worlds: int, world_offset: int):
        i = wp.static(LANES) * wp.tid()
        first = world_offset + i
        count = wp.min(wp.static(LANES), worlds - i)
        done = blocks(state, arrays, p, weights, first, count)
        for k in range(count):
            w = first + k
            if state.frozen[w] != 0:
                report_frozen(state, arrays, w)
            else:
                over = ((done >> (wp.static(LANES) + k)) & 1) != 0
                if ((done >> k) & 1) == 0:
                    over = score(state, arrays, p, weights, w)
                if over:
                    close_episode(state, arrays, w)

    return evaluate
