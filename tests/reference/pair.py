"""A task of two agents and one vehicle of the task's own, for tests: an agent's target is 0.3 m beside a goal.

Reward of agent a: (a + 1) `bonus` - `slope` · distance to its target. No other task has these terms.
"""

from dataclasses import dataclass
from typing import Any, ClassVar

import pytest
import warp as wp

from finssim.sim.state import State
from finssim.tasks import ObservationPart, Task
from finssim.tasks.arrays import TaskArrays
from finssim.tasks.terms import End, RewardTerm, Terms, place_at_rest, uniform3


@wp.func
def place(arrays: TaskArrays, w: int, a: int) -> wp.vec3:
    return arrays.goal_position[w] + wp.vec3(0.0, 0.3 - 0.6 * float(a), 0.0)


@wp.func
def offset(arrays: TaskArrays, w: int, a: int) -> wp.vec3:
    return wp.quat_rotate_inv(arrays.quaternion[w, a], place(arrays, w, a) - arrays.position[w, a])


@wp.func
def velocity(arrays: TaskArrays, w: int, a: int) -> wp.vec3:
    nu = arrays.velocity[w, a]
    return wp.vec3(nu[0], nu[1], nu[2])


@wp.func
def number(a: int) -> float:
    return float(a)


@wp.func
def bonus(a: int) -> float:
    return float(a + 1)


@wp.func
def away(state: State, arrays: TaskArrays, w: int, a: int) -> float:
    return wp.length(place(arrays, w, a) - state.position[w, a])


@wp.func
def out(state: State, p: Any, w: int) -> bool:
    return wp.abs(state.position[w, 0][0]) > p.bound or wp.abs(state.position[w, 1][0]) > p.bound


@wp.func
def begin_pair(state: State, arrays: TaskArrays, key: int, w: int):
    low, high = wp.vec3(-0.5, -0.2, -0.6), wp.vec3(0.5, 0.2, -0.4)
    arrays.goal_position[w] = uniform3(wp.rand_init(key, 4 * w), low, high)
    for a in range(2):
        beside = wp.vec3(0.0, 0.5 - 1.0 * float(a), 0.0)
        x = beside + uniform3(wp.rand_init(key, 4 * w + 1 + a), low, high)
        place_at_rest(state, w, a, x, 0.0)
    place_at_rest(state, w, 2, wp.vec3(2.0, 0.0, -0.5), 0.0)


@wp.func
def stand(arrays: TaskArrays, w: int):
    for i in range(arrays.scripted.shape[1]):
        arrays.scripted[w, i] = 0.0


@dataclass(frozen=True, kw_only=True)
class Pair(Task):
    """Two agents side by side, and one vehicle at rest."""

    agents: ClassVar[tuple[str, ...]] = ("left", "right")
    others: ClassVar[tuple[str, ...]] = ("post",)

    name: str = "pair"
    observation: tuple[ObservationPart, ...] = (
        ObservationPart("offset, body frame", 3, "m", term=offset),
        ObservationPart("linear velocity, body frame", 3, "m/s", clip=2.0, term=velocity),
        ObservationPart("number of the agent", 1, "1", clip=1.0, term=number),
    )
    time_limit: float = 2.0
    bonus: float = 0.0
    slope: float = 1.0
    bound: float = 3.0

    def terms(self) -> Terms:
        return Terms(
            start=begin_pair,
            command=stand,
            rewards=(RewardTerm("bonus", bonus, self.bonus), RewardTerm("away", away, -self.slope)),
            ends=(End("out", out),),
        )


def constant(**settings: Any) -> Pair:
    """Return a task with reward a + 1 for agent a in every step: the value of any policy is (a + 1) / (1 -
    γ)."""
    return Pair(bonus=1.0, slope=0.0, bound=1e9, **settings)


KINDS = pytest.mark.parametrize("task", ["t1", "team-pursuit", Pair()], ids=["t1", "team-pursuit", "pair"])
"""Tasks for adapters: a vehicle alone, a team and a prey that the task drives, and a pair."""
