"""Settings by task: precedence, and every line of the tables names something that exists."""

import sys
from dataclasses import replace

import pytest

from finssim.learning.learners import LEARNERS, base, learner_named
from finssim.learning.learners.base import ON_POLICY, RANDOMIZED, SETTINGS, task_settings
from finssim.learning.train import TrainingSettings, _values
from finssim.tasks import TASKS, numeric_tasks, task_named
from reference.guess import Guess


def test_the_tasks_own_lines_outrank_the_others(monkeypatch):
    """The precedence is: every task, then the task; `on-policy`, then the learner; plain, then randomised."""
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
    """A training has the settings of its task, over which options of the command take precedence."""
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
    """A user's task is in no table and has the default settings."""
    kind = learner_named("sb3-ppo")
    module = sys.modules[type(kind.settings(Guess())).__module__]
    assert kind.settings(Guess(), worlds=256) == module.OnPolicySettings()


def test_a_gpu_takes_as_many_gradient_steps_of_more_samples():
    """Worlds, samples per step and steps grow alike, or with the requested worlds; an explicit setting is kept."""
    kind, task = learner_named("ppo"), task_named("t1")
    cpu, gpu = kind.settings(task), kind.settings(task, device="cuda")
    assert (gpu.worlds, gpu.batch, gpu.steps) == (64 * cpu.worlds, 64 * cpu.batch, 64 * cpu.steps)
    assert (gpu.epochs, gpu.rollout, gpu.learning_rate) == (cpu.epochs, cpu.rollout, cpu.learning_rate)
    asked = kind.settings(task, worlds=2048, steps=5_000_000, changes={"batch": 1000}, device="cuda")
    assert (asked.worlds, asked.batch, asked.steps) == (2048, 1000, 5_000_000)
    assert kind.settings(task, worlds=2048, device="cuda").batch == 8 * cpu.batch
    assert kind.settings(task, worlds=2048).batch == cpu.batch
    taught = task_named("formation")  # the teacher acts on the host
    assert kind.settings(taught, device="cuda") == kind.settings(taught)


def test_a_training_that_imitates_first_keeps_its_size_on_a_gpu():
    """A training with imitation is not enlarged, since its teacher acts on the host, in every world."""
    kind, task = learner_named("ppo"), task_named("t1")
    plain = _values(TrainingSettings(device="cuda"), kind, "ppo", task)
    taught = _values(TrainingSettings(device="cuda", init="pid"), kind, "ppo", task)
    assert plain.worlds == 64 * taught.worlds and taught == replace(kind.settings(task), teacher="pid")
