"""Tasks with a known best action or a known value.

Guess has one step, and its best action depends on the observation.

An agent observes a sign s, +1 or -1, drawn anew (agents of a world: +1 for the first, -1 for the second), and is paid
r = 1 - mean((a - s c)²) for action a, with c = 0.5 in every component. The best mean action is s c, and pays 1.

Steady pays 1 forever: its value is 1 / (1 - discount) everywhere, if an end by time does not count as an end.
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
"""Best action's magnitude c."""


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
    """Task of one agent."""

    name: str = "guess"
    observation: tuple[ObservationPart, ...] = (ObservationPart("sign", 1, "1", clip=1.0, term=sign),)
    substeps: int = 1
    time_limit: float = 0.1
    best: float = BEST

    def terms(self) -> Terms:
        return Terms(start=draw, rewards=(RewardTerm("guess", guessed, 1.0),), ends=(End("over", over),))

    def metrics(self, arrays: TaskArrays) -> dict[str, Any]:
        """Return success: a reward of at least 0.9."""
        measured = super().metrics(arrays)
        return {**measured, "success": np.where(measured["return"] >= 0.9, 1.0, 0.0)}


@dataclass(frozen=True, kw_only=True)
class GuessTogether(Guess):
    """Task of two agents."""

    name: str = "guess_together"
    agents = ("first", "second")


@dataclass(frozen=True, kw_only=True)
class Steady(Guess):
    """Task that pays 1 in every step for any action; only time ends an episode, after five steps."""

    name: str = "steady"
    time_limit: float = 0.5

    def terms(self) -> Terms:
        return Terms(start=draw, rewards=(RewardTerm("one", each_step, 1.0),))


@dataclass(frozen=True, kw_only=True)
class SteadyTogether(Steady):
    """Task of two agents."""

    name: str = "steady_together"
    agents = ("first", "second")
