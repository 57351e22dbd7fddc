"""Settings by task: what outranks what, and every line of the tables is of something that there is."""

import sys

import pytest

from finssim.learning.learners import LEARNERS, base, learner_named
from finssim.learning.learners.base import ON_POLICY, RANDOMIZED, SETTINGS, task_settings
from finssim.tasks import TASKS, numeric_tasks, task_named
from reference.guess import Guess


def test_the_tasks_own_lines_outrank_the_others(monkeypatch):
    """Every task, then the task; `on-policy`, then the learner; plain, then randomised."""
    plain = {"*": {"on-policy": {"a": 1, "b": 1}}, "t1": {"on-policy": {"b": 2, "c": 2}, "rsl-rl": {"c": 3}}}
    drawn = {"*": {"on-policy": {"a": 4, "b": 4}}, "t1": {"on-policy": {"d": 5}}}
    monkeypatch.setattr(base, "SETTINGS", plain)
    monkeypatch.setattr(base, "RANDOMIZED", drawn)
    assert task_settings("other", "bc", True) == {}
    assert task_settings("other", "sb3-ppo", False) == {"a": 1, "b": 1}
    assert task_settings("other", "sb3-ppo", True) == {"a": 4, "b": 4}
    assert task_settings("t1", "sb3-ppo", False) == {"a": 1, "b": 2, "c": 2}
    assert task_settings("t1", "rsl-rl", True) == {"a": 4, "b": 2, "c": 3, "d": 5}


@pytest.mark.parametrize("randomized", [False, True])
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow if "torchrl" in kind.module + kind.extra else ())
        for name, kind in LEARNERS.items()
    ],
)  # importing torchrl starts a process
def test_a_training_begins_with_its_tasks_settings(name, randomized):
    """And what the command says outranks them."""
    kind = learner_named(name)
    for task in numeric_tasks():
        settings = kind.settings(task_named(task), randomized=randomized)
        for setting, value in task_settings(task, name, randomized).items():
            assert setting == "rollout" or getattr(settings, setting) == value
        given = kind.settings(task_named(task), randomized=randomized, steps=7, worlds=3)
        assert (given.steps, given.worlds) == (7, 3)


def test_every_line_is_of_something_that_exists():
    assert set(ON_POLICY) <= set(LEARNERS)
    for table in (SETTINGS, RANDOMIZED):
        assert set(table) <= {"*", *TASKS}
        assert {learner for rows in table.values() for learner in rows} <= {"on-policy", *LEARNERS}


def test_a_task_of_ones_own_has_the_defaults():
    """Its name is in no table."""
    kind = learner_named("sb3-ppo")
    module = sys.modules[type(kind.settings(Guess())).__module__]
    assert kind.settings(Guess(), worlds=256) == module.OnPolicySettings()
