"""`check_task` passes every task of ours and the example, and finds the mistakes that it is there for."""

import importlib.util
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import warp as wp

from finssim.engine.state import State
from finssim.tasks import TASKS
from finssim.tasks.arrays import TaskArrays
from finssim.tasks.check import TaskError, check_task
from finssim.tasks.episode import action_effort, close_episode, open_episode

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "own_task.py"
spec = importlib.util.spec_from_file_location("own_task", EXAMPLE)
own = importlib.util.module_from_spec(spec)
spec.loader.exec_module(own)
DepthParameters, KeepDepth = own.DepthParameters, own.KeepDepth


@wp.kernel(enable_backward=False)
def spawn_without_opening(
    state: State,
    arrays: TaskArrays,
    p: DepthParameters,
    seed: int,
    mask: wp.array(dtype=int),
    world_offset: int,
):
    """The last action of the episode before stays, and with it the first change of actions."""
    w = world_offset + wp.tid()
    if mask[w] == 0:
        return
    rng = wp.rand_init(seed + 15485863 * state.episode[w], w)
    arrays.goal_position[w] = wp.vec3(0.0, 0.0, -wp.randf(rng, 0.3, p.deepest))
    state.position[w, 0] = wp.vec3(0.0, 0.0, -0.5)
    state.quaternion[w, 0] = wp.quat_identity()
    nu = state.velocity[w, 0]
    for i in range(6):
        nu[i] = 0.0
    state.velocity[w, 0] = nu
    arrays.episode_return[w] = 0.0


@wp.kernel(enable_backward=False)
def spawn_moving(
    state: State,
    arrays: TaskArrays,
    p: DepthParameters,
    seed: int,
    mask: wp.array(dtype=int),
    world_offset: int,
):
    """The velocity of the episode before stays."""
    w = world_offset + wp.tid()
    if mask[w] != 0:
        state.position[w, 0] = wp.vec3(0.0, 0.0, -0.5)
        state.quaternion[w, 0] = wp.quat_identity()
        open_episode(arrays, w)


@wp.kernel(enable_backward=False)
def evaluate_scaled(state: State, arrays: TaskArrays, p: DepthParameters, world_offset: int):
    """`deepest` scales reward and observation; the change of actions counts; the time limit is p.time_limit."""
    w = world_offset + wp.tid()
    effort = action_effort(arrays, w)
    reward = p.deepest - effort[1]
    late = float(state.steps[w]) * p.control_step >= p.time_limit - 0.5 * p.control_step
    arrays.reward[w] = reward
    arrays.terminated[w] = 0
    arrays.truncated[w] = wp.where(late, 1, 0)
    arrays.done[w] = wp.where(late, 1, 0)
    arrays.episode_return[w] = arrays.episode_return[w] + reward
    arrays.observation[w, 0] = p.deepest * arrays.goal_position[w][2]
    arrays.observation[w, 1] = 3.0 * arrays.velocity[w, 0][2]
    if late:
        close_episode(state, arrays, w)


@dataclass(frozen=True, kw_only=True)
class Leaking(KeepDepth):
    evaluate = staticmethod(evaluate_scaled)
    spawn = staticmethod(spawn_without_opening)


@dataclass(frozen=True, kw_only=True)
class Moving(KeepDepth):
    spawn = staticmethod(spawn_moving)


@dataclass(frozen=True, kw_only=True)
class Unbounded(KeepDepth):
    evaluate = staticmethod(evaluate_scaled)

    def parameters(self):
        p = super().parameters()
        p.deepest = 1000.0
        return p


@dataclass(frozen=True, kw_only=True)
class Dicing(KeepDepth):
    evaluate = staticmethod(evaluate_scaled)

    def parameters(self):
        p = super().parameters()
        p.deepest = int.from_bytes(os.urandom(2), "big") / 2**17
        return p


@dataclass(frozen=True, kw_only=True)
class Endless(KeepDepth):
    def parameters(self):
        p = super().parameters()
        p.time_limit = 1e9
        return p


@dataclass(frozen=True, kw_only=True)
class Miscounting(KeepDepth):
    def metrics(self, arrays):
        measured = super().metrics(arrays)
        return {**measured, "return": 2.0 * measured["return"]}


@dataclass(frozen=True, kw_only=True)
class Misshapen(KeepDepth):
    def metrics(self, arrays):
        return {**super().metrics(arrays), "success": np.zeros(3)}


@pytest.mark.slow
@pytest.mark.parametrize("name", TASKS)
def test_our_own_tasks_pass(name):
    check_task(TASKS[name]())


def test_the_example_passes_and_runs():
    check_task(KeepDepth())
    check_task(KeepDepth(), "bluerov2", action="thruster8")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "sentence"),
    [
        (Leaking, "a reward depends on the episode before"),
        (Moving, "an observation depends on the episode before"),
        (Unbounded, "'way to the depth, upwards' reaches .*: give it a scale or a clip"),
        (Dicing, "equal seeds give other numbers"),
        (Endless, "goes on after its time limit of 10 control steps"),
        (Miscounting, "return and length are not those of the last episode"),
        (Misshapen, r"metric 'success' has shape \(3,\), expected \(8,\)"),
    ],
)
def test_a_mistake_is_named(task, sentence):
    with pytest.raises(TaskError, match=sentence):
        check_task(task())


@pytest.mark.parametrize("name", ["own_task", "own_task_torch"])
def test_the_page_shows_the_example(name):
    """Word for word, so that what is read is what runs."""
    page = (EXAMPLE.parents[1] / "docs" / "own_task.md").read_text(encoding="utf-8")
    assert f"```py\n{(EXAMPLE.parent / f'{name}.py').read_text(encoding='utf-8')}```" in page
