"""A task of two agents and one vehicle of the task's own, for tests: an agent's place is 0.3 m beside a goal.

Reward of agent a: (a + 1) `bonus` - `slope` · distance to its place. No kernel looks at any other task.
"""

from dataclasses import dataclass
from typing import Any, ClassVar

import warp as wp

from finssim.engine.state import State
from finssim.tasks.arrays import TaskArrays
from finssim.tasks.episode import close_episode, open_episode, report_frozen, uniform3
from finssim.tasks.task import ObservationPart, Task

SIZE = 7


@wp.struct
class PairParameters:
    time_limit: float
    control_step: float
    bonus: float
    slope: float
    bound: float


@wp.func
def place(arrays: TaskArrays, w: int, a: int) -> wp.vec3:
    return arrays.goal_position[w] + wp.vec3(0.0, 0.3 - 0.6 * float(a), 0.0)


@wp.func
def write(arrays: TaskArrays, w: int):
    for a in range(2):
        q = arrays.quaternion[w, a]
        offset = wp.quat_rotate_inv(q, place(arrays, w, a) - arrays.position[w, a])
        for k in range(3):
            arrays.observation[w, 7 * a + k] = offset[k]
            arrays.observation[w, 7 * a + 3 + k] = wp.clamp(arrays.velocity[w, a][k], -2.0, 2.0)
        arrays.observation[w, 7 * a + 6] = float(a)


@wp.kernel(enable_backward=False)
def evaluate_pair(state: State, arrays: TaskArrays, p: PairParameters, world_offset: int):
    w = world_offset + wp.tid()
    if state.frozen[w] != 0:
        report_frozen(state, arrays, w)
        return
    total = float(0.0)
    out = bool(False)
    for a in range(2):
        x = state.position[w, a]
        reward = float(a + 1) * p.bonus - p.slope * wp.length(place(arrays, w, a) - x)
        arrays.agent_reward[w, a] = reward
        total += 0.5 * reward
        if wp.abs(x[0]) > p.bound:
            out = True
    late = float(state.steps[w]) * p.control_step >= p.time_limit - 0.5 * p.control_step
    arrays.reward[w] = total
    arrays.terminated[w] = wp.where(out, 1, 0)
    arrays.truncated[w] = wp.where(late and not out, 1, 0)
    arrays.done[w] = wp.where(out or late, 1, 0)
    arrays.episode_return[w] = arrays.episode_return[w] + total
    write(arrays, w)
    if out or late:
        close_episode(state, arrays, w)


@wp.kernel(enable_backward=False)
def spawn_pair(
    state: State,
    arrays: TaskArrays,
    p: PairParameters,
    seed: int,
    mask: wp.array(dtype=int),
    world_offset: int,
):
    w = world_offset + wp.tid()
    if mask[w] == 0:
        return
    key = seed + 15485863 * state.episode[w]
    low, high = wp.vec3(-0.5, -0.2, -0.6), wp.vec3(0.5, 0.2, -0.4)
    arrays.goal_position[w] = uniform3(wp.rand_init(key, 4 * w), low, high)
    for a in range(2):
        away = wp.vec3(0.0, 0.5 - 1.0 * float(a), 0.0)
        state.position[w, a] = away + uniform3(wp.rand_init(key, 4 * w + 1 + a), low, high)
    state.position[w, 2] = wp.vec3(2.0, 0.0, -0.5)
    open_episode(arrays, w)


@wp.kernel(enable_backward=False)
def observe_pair(arrays: TaskArrays, mask: wp.array(dtype=int), world_offset: int):
    w = world_offset + wp.tid()
    if mask[w] != 0:
        write(arrays, w)


@wp.kernel(enable_backward=False)
def script_pair(state: State, arrays: TaskArrays, p: PairParameters, seed: int, world_offset: int):
    w = world_offset + wp.tid()
    for i in range(arrays.scripted.shape[1]):
        arrays.scripted[w, i] = 0.0


@dataclass(frozen=True, kw_only=True)
class Pair(Task):
    """Two agents side by side, and one that stands."""

    agents: ClassVar[tuple[str, ...]] = ("left", "right")
    others: ClassVar[tuple[str, ...]] = ("post",)

    name: str = "pair"
    observation: tuple[ObservationPart, ...] = (
        ObservationPart("offset, body frame", 3, "m"),
        ObservationPart("linear velocity, body frame", 3, "m/s", clip=2.0),
        ObservationPart("number of the agent", 1, "1", clip=1.0),
    )
    time_limit: float = 2.0
    bonus: float = 0.0
    slope: float = 1.0
    bound: float = 3.0

    evaluate = staticmethod(evaluate_pair)
    spawn = staticmethod(spawn_pair)
    observe = staticmethod(observe_pair)
    script = staticmethod(script_pair)

    def parameters(self) -> Any:
        p = PairParameters()
        for name in ("time_limit", "control_step", "bonus", "slope", "bound"):
            setattr(p, name, getattr(self, name))
        return p


def constant(**settings: Any) -> Pair:
    """Every step gives agent a the reward a + 1: after any policy its value is (a + 1) / (1 - γ)."""
    return Pair(bonus=1.0, slope=0.0, bound=1e9, **settings)
