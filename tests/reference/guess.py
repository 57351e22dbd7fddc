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

from finssim.sim.state import State
from finssim.tasks import ObservationPart, Task
from finssim.tasks.arrays import TaskArrays
from finssim.tasks.terms import End, RewardTerm, Terms, each_step, place_at_rest

BEST = 0.5
"""c."""


@wp.func
def sign(arrays: TaskArrays, w: int, a: int) -> float:
    alone = arrays.agent_reward.shape[1] == 1
    return wp.where(alone, arrays.goal_position[w][0], wp.where(a == 0, 1.0, -1.0))


@wp.func
def guessed(arrays: TaskArrays, p: Any, w: int, a: int) -> float:
    size = arrays.action.shape[1] // arrays.agent_reward.shape[1]
    off = float(0.0)
    for i in range(size):
        d = wp.clamp(arrays.action[w, a * size + i], -1.0, 1.0) - sign(arrays, w, a) * p.best
        off += d * d
    return 1.0 - off / float(size)


@wp.func
def over(w: int) -> bool:
    return True


@wp.func
def draw(state: State, arrays: TaskArrays, key: int, w: int):
    rng = wp.rand_init(key, w)
    arrays.goal_position[w] = wp.vec3(wp.where(wp.randf(rng) < 0.5, -1.0, 1.0), 0.0, 0.0)
    for a in range(arrays.agent_reward.shape[1]):
        place_at_rest(state, w, a, wp.vec3(2.0 * float(a), 0.0, -0.5), 0.0)


@dataclass(frozen=True, kw_only=True)
class Guess(Task):
    """One agent."""

    name: str = "guess"
    observation: tuple[ObservationPart, ...] = (ObservationPart("sign", 1, "1", clip=1.0, term=sign),)
    substeps: int = 1
    time_limit: float = 0.1
    best: float = BEST

    def terms(self) -> Terms:
        return Terms(start=draw, rewards=(RewardTerm("guess", guessed, 1.0),), ends=(End("over", over),))

    def metrics(self, arrays: TaskArrays) -> dict[str, Any]:
        """Success: paid at least 0.9."""
        measured = super().metrics(arrays)
        return {**measured, "success": np.where(measured["return"] >= 0.9, 1.0, 0.0)}


@dataclass(frozen=True, kw_only=True)
class GuessTogether(Guess):
    """Two agents."""

    name: str = "guess_together"
    agents = ("first", "second")


@dataclass(frozen=True, kw_only=True)
class Steady(Guess):
    """Pays 1 in every step, whatever is done; time ends an episode after five steps, and nothing else does."""

    name: str = "steady"
    time_limit: float = 0.5

    def terms(self) -> Terms:
        return Terms(start=draw, rewards=(RewardTerm("one", each_step, 1.0),))


@dataclass(frozen=True, kw_only=True)
class SteadyTogether(Steady):
    """Two agents."""

    name: str = "steady_together"
    agents = ("first", "second")
