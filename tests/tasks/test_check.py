"""`check_task` accepts all built-in tasks and the example, and finds the mistakes that it is meant to find."""

import importlib.util
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp

from finssim.sim.state import State
from finssim.tasks import TASKS, Environment, EnvironmentSetupError, ObservationPart, numeric_tasks
from finssim.tasks.arrays import TaskArrays
from finssim.tasks.check import TaskError, check_task
from finssim.tasks.terms import RewardTerm

NUMERIC = numeric_tasks()

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "own_task.py"
spec = importlib.util.spec_from_file_location("own_task", EXAMPLE)
own = importlib.util.module_from_spec(spec)
spec.loader.exec_module(own)
KeepDepth = own.KeepDepth


@wp.func
def start_moving(state: State, arrays: TaskArrays, p: Any, key: int, w: int):
    """Keep the velocity of the previous episode."""
    arrays.goal_position[w] = wp.vec3(0.0, 0.0, -wp.randf(wp.rand_init(key, w), 0.3, p.deepest))
    state.position[w, 0] = wp.vec3(0.0, 0.0, -0.5)
    state.quaternion[w, 0] = wp.quat_identity()


@wp.func
def remember(arrays: TaskArrays, w: int):
    """Keep a memory that no start resets."""
    q = arrays.goal_quaternion[w]
    q[0] = q[0] + arrays.action[w, 0]
    arrays.goal_quaternion[w] = q


@wp.func
def remembered(arrays: TaskArrays, w: int) -> float:
    return arrays.goal_quaternion[w][0]


@wp.func
def scaled(arrays: TaskArrays, p: Any, w: int) -> float:
    return p.factor * arrays.goal_position[w][2]


@dataclass(frozen=True, kw_only=True)
class Leaking(KeepDepth):
    def terms(self):
        rewards = (RewardTerm("remembered", remembered, 1.0),)
        return replace(super().terms(), advance=remember, rewards=rewards)


@dataclass(frozen=True, kw_only=True)
class Moving(KeepDepth):
    def terms(self):
        return replace(super().terms(), start=start_moving)


@dataclass(frozen=True, kw_only=True)
class Unbounded(KeepDepth):
    observation: tuple[ObservationPart, ...] = (
        ObservationPart("way to the depth, upwards", 1, "m", term=scaled),
    )

    @property
    def factor(self) -> float:
        return 1000.0


@dataclass(frozen=True, kw_only=True)
class Dicing(Unbounded):
    @property
    def factor(self) -> float:
        return int.from_bytes(os.urandom(2), "big") / 2**17


@dataclass(frozen=True, kw_only=True)
class Endless(KeepDepth):
    def add_evaluate(self, pipeline, batch):
        pass


@dataclass(frozen=True, kw_only=True)
class Wrong(KeepDepth):
    """A task with a term that takes an argument that does not exist."""

    def terms(self):
        return replace(super().terms(), inside=look_up)


@wp.func
def look_up(state: State, sky: int) -> bool:
    return True


def test_a_term_that_takes_what_there_is_not_is_named():
    with pytest.raises(
        EnvironmentSetupError, match=r"inside \(.*look_up\) has the argument 'sky', expected of: arrays, p"
    ):
        Environment(Wrong())


@dataclass(frozen=True, kw_only=True)
class Written(KeepDepth):
    """A task with a term given as text of code."""

    def terms(self):
        return replace(super().terms(), inside="state.position[w, 0][2] < p.tolerance")


def test_code_as_text_is_no_term():
    with pytest.raises(
        EnvironmentSetupError,
        match=r"task 'keep-depth': inside is 'state.position.* expected a function with @wp.func, or the name of",
    ):
        Environment(Written())


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
@pytest.mark.parametrize("name", NUMERIC)
def test_our_own_tasks_pass(name):
    check_task(TASKS[name]())


def test_the_example_passes_and_runs():
    check_task(KeepDepth())
    check_task(KeepDepth(), "bluerov2", action="thruster8")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "sentence"),
    [
        (Leaking, "a reward depends on the previous episode"),
        (Moving, "an observation depends on the episode before"),
        (Unbounded, "'way to the depth, upwards' reaches .*: give it a scale or a clip"),
        (Dicing, "equal seeds give other numbers"),
        (Endless, "continues after its time limit of 10 control steps"),
        (Miscounting, "return and length are not those of the last episode"),
        (Misshapen, r"metric 'success' has shape \(3,\), expected \(8,\)"),
    ],
)
def test_a_mistake_is_named(task, sentence):
    with pytest.raises(TaskError, match=sentence):
        check_task(task())


@pytest.mark.parametrize(
    ("name", "page"), [("own_task", "reference/task_in_warp.md"), ("own/task/keep_depth", "own_task.md")]
)
def test_the_page_shows_the_example(name, page):
    """The page contains the code word for word, so readers see the code that runs."""
    page = (EXAMPLE.parents[1] / "docs" / page).read_text(encoding="utf-8")
    assert f"```py\n{(EXAMPLE.parent / f'{name}.py').read_text(encoding='utf-8')}```" in page
