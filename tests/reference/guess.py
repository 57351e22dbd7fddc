"""Tasks whose best action, or whose value, is known.

Guess has one step, and its best action depends on what is observed.

An agent sees a sign s, +1 or -1, drawn anew (agents of a world: +1 for the first, -1 for the second), and is paid
r = 1 - mean((a - s c)²) for action a, with c = 0.5 in every component. The best mean action is s c, and pays 1.

Steady pays 1 for ever: its value is 1 / (1 - discount) everywhere, if an end by time is none.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from finssim.engine.state import State
from finssim.tasks import ObservationPart, Task
from finssim.tasks.arrays import TaskArrays
from finssim.tasks.episode import close_episode, open_episode

BEST = 0.5
"""c."""


@wp.struct
class Guessing:
    """The best action where the sign is +1."""

    best: float


@wp.kernel(enable_backward=False)
def score(state: State, arrays: TaskArrays, p: Guessing, world_offset: int):
    w = world_offset + wp.tid()
    agents = arrays.agent_reward.shape[1]
    size = arrays.action.shape[1] // agents
    total = float(0.0)
    for a in range(agents):
        off = float(0.0)
        for i in range(size):
            d = wp.clamp(arrays.action[w, a * size + i], -1.0, 1.0) - arrays.observation[w, a] * p.best
            off += d * d
        arrays.agent_reward[w, a] = 1.0 - off / float(size)
        total += arrays.agent_reward[w, a] / float(agents)
    arrays.reward[w] = total
    arrays.episode_return[w] = total
    arrays.terminated[w] = 1
    arrays.truncated[w] = 0
    arrays.done[w] = 1
    close_episode(state, arrays, w)


@wp.kernel(enable_backward=False)
def draw(
    state: State, arrays: TaskArrays, p: Guessing, seed: int, mask: wp.array(dtype=int), world_offset: int
):
    w = world_offset + wp.tid()
    if mask[w] == 0:
        return
    agents = arrays.agent_reward.shape[1]
    rng = wp.rand_init(seed + 15485863 * state.episode[w], w)
    sign = wp.where(wp.randf(rng) < 0.5, -1.0, 1.0)
    for a in range(agents):
        arrays.observation[w, a] = wp.where(agents == 1, sign, wp.where(a == 0, 1.0, -1.0))
        state.position[w, a] = wp.vec3(2.0 * float(a), 0.0, -0.5)
    open_episode(arrays, w)


@wp.kernel(enable_backward=False)
def show(arrays: TaskArrays, mask: wp.array(dtype=int), world_offset: int):
    pass


@dataclass(frozen=True, kw_only=True)
class Guess(Task):
    """One agent."""

    name: str = "guess"
    observation: tuple[ObservationPart, ...] = (ObservationPart("sign", 1, "1", clip=1.0),)
    substeps: int = 1
    time_limit: float = 0.1
    evaluate = staticmethod(score)
    spawn = staticmethod(draw)
    observe = staticmethod(show)

    def parameters(self) -> Any:
        p = Guessing()
        p.best = BEST
        return p

    def metrics(self, arrays: TaskArrays) -> dict[str, Any]:
        """Success: paid at least 0.9."""
        measured = super().metrics(arrays)
        return {**measured, "success": np.where(measured["return"] >= 0.9, 1.0, 0.0)}


@dataclass(frozen=True, kw_only=True)
class GuessTogether(Guess):
    """Two agents."""

    name: str = "guess_together"
    agents = ("first", "second")


@wp.kernel(enable_backward=False)
def pay(state: State, arrays: TaskArrays, p: Guessing, world_offset: int):
    w = world_offset + wp.tid()
    for a in range(arrays.agent_reward.shape[1]):
        arrays.agent_reward[w, a] = 1.0
    arrays.reward[w] = 1.0
    arrays.episode_return[w] = arrays.episode_return[w] + 1.0
    arrays.terminated[w] = 0
    arrays.truncated[w] = wp.where(state.steps[w] >= 5, 1, 0)
    arrays.done[w] = arrays.truncated[w]
    if arrays.done[w] != 0:
        close_episode(state, arrays, w)


@dataclass(frozen=True, kw_only=True)
class Steady(Guess):
    """Pays 1 in every step, whatever is done; time ends an episode after five steps, and nothing else does."""

    name: str = "steady"
    time_limit: float = 0.5
    evaluate = staticmethod(pay)


@dataclass(frozen=True, kw_only=True)
class SteadyTogether(Steady):
    """Two agents."""

    name: str = "steady_together"
    agents = ("first", "second")
