"""Every learner learns a known solution, works on every task, resumes bit-identically, and refuses invalid requests."""

import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

import finssim
from finssim.learning.episodes import HeldEvaluation
from finssim.learning.learners import LEARNERS, LearningError, learner_named
from finssim.learning.network import Network, answer_of, first_memory
from finssim.learning.resume import read_state, write_state
from finssim.tasks import numeric_tasks, task_named
from reference.guess import BEST, Guess, GuessTogether

IMITATING = ("bc", "dagger", "distill")
"""Learners that are tested with demonstrations and pictures."""
REINFORCED = [name for name in LEARNERS if name not in IMITATING]
ONE = [name for name in REINFORCED if LEARNERS[name].agents != "several"]
SEVERAL = [name for name in REINFORCED if LEARNERS[name].agents != "one"]
PAIRS = [(name, Guess) for name in ONE] + [(name, GuessTogether) for name in SEVERAL]
TRAINED = [
    *((name, "t1") for name in ONE),
    *((name, "team-pursuit") for name in SEVERAL if name not in ONE),
    *(
        ("ppo" if len(task_named(task).agents) == 1 else "torchrl-ippo", task)
        for task in numeric_tasks()
        if task != "t1"
    ),
]
"""Every pair of learner and task."""


def small(name, task, **changes):
    """Return settings with which an update takes a fraction of a second."""
    kind = learner_named(name)
    few = {"worlds": 8, "rollout": 16, "hidden": (16, 16), "batch": 64, "epochs": 2, **changes}
    return replace(kind.settings(task), **few)


def made(name, task, seed=3, **changes):
    """Return a learner in its own small environment."""
    task = task_named(task) if isinstance(task, str) else task
    settings = small(name, task, **changes)
    ranges = "fossen_learn_to_swim" if task.name in numeric_tasks() else None
    environment = finssim.make(task, worlds=settings.worlds, seed=seed, observe="training", randomize=ranges)
    return learner_named(name)(environment, settings, seed=seed)


def flat(value):
    """Return all numbers of a state, in order."""
    if isinstance(value, dict):
        return [x for key in sorted(value, key=str) for x in flat(value[key])]
    if isinstance(value, list | tuple):
        return [x for item in value for x in flat(item)]
    if isinstance(value, torch.Tensor):
        return [value.detach().cpu().numpy()]
    return [value]


def same(first, second):
    first, second = flat(first), flat(second)
    return len(first) == len(second) and all(
        np.array_equal(a, b, equal_nan=True)
        if isinstance(a, np.ndarray) and a.dtype.kind == "f"
        else np.array_equal(a, b)
        for a, b in zip(first, second, strict=True)
    )


@pytest.mark.slow
@pytest.mark.parametrize(("name", "task"), PAIRS)
def test_it_finds_the_best_action(name, task):
    """In a task of one step, every agent plays c for +1 and -c for -1; the held evaluation reports success."""
    steps, batch = 10_000, 64 * len(task.agents)
    changes = {"worlds": 32, "learning_rate": 1e-2, "steps": steps, "batch": batch, "discount": 0.5}
    learner = made(name, task(), **changes)
    before = learner.update()
    while learner.steps < steps:
        row = learner.update()
    network, seen = learner.network(), np.array([[1.0], [-1.0]], np.float32)
    if not isinstance(network, Network):
        seen = torch.from_numpy(seen)
    with torch.no_grad():
        device = None if isinstance(network, Network) else "cpu"
        action = np.asarray(answer_of(network, seen, first_memory(network, 2, device))[0])
    assert np.abs(action - BEST * np.array([[1.0], [-1.0]])).max() < 0.1
    assert row.keys() == before.keys() and row["held"] > before["held"] and row["mean_return"] > 0.9
    held = HeldEvaluation(finssim.make(task(), worlds=8, seed=77))(network)
    assert held["evaluation_success"] == 1.0 and held["evaluation_return"] > 0.96


@pytest.mark.slow  # importing torchrl starts a process
@pytest.mark.parametrize(("name", "task"), [("torchrl-ppo", "team-pursuit"), ("torchrl-mappo", "t1")])
def test_one_agent_is_not_several(name, task):
    """The refusal names an alternative."""
    with pytest.raises(LearningError, match="has .* and this learner trains .*: use "):
        made(name, task)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "task"), sorted(set(TRAINED)))
def test_it_learns_and_goes_on_bitwise(tmp_path, name, task):
    """After two updates, a state through a file into another learner, and two more, parameters, rows and
    worlds are equal."""
    whole = made(name, task, steps=1000)
    first = whole.state()["learner"]
    for _ in range(2):
        whole.update()
    assert not same(first, whole.state()["learner"]), "nothing was learnt"
    write_state(whole.state(), tmp_path / "state")
    rows = [whole.update() for _ in range(2)]
    other = made(name, task, seed=8, steps=1000)
    other.update()
    other.load(read_state(tmp_path / "state"))
    assert rows == [other.update() for _ in range(2)] and other.steps == whole.steps == 4 * 8 * 16
    assert same(whole.state(), other.state())


@pytest.mark.slow
@pytest.mark.parametrize("name", REINFORCED)
def test_equal_seeds_are_equal_learners(name):
    """Learners of equal seeds are equal; another seed gives another one."""
    task = Guess() if name in ONE else GuessTogether()
    ends = []
    for seed in (1, 1, 2):
        learner = made(name, task, seed=seed)
        learner.update()
        learner.update()
        ends.append(learner.state()["learner"])
    assert same(ends[0], ends[1]) and not same(ends[0], ends[2])


def test_unknown_names_are_refused():
    with pytest.raises(LearningError, match="unknown learner 'sb3'; available: ppo, sb3-ppo, rsl-rl"):
        learner_named("sb3")
    kind, task = learner_named("sb3-ppo"), Guess()
    with pytest.raises(LearningError, match="unknown setting 'gamma'; available: worlds, steps, rollout"):
        kind.settings(task, changes={"gamma": 0.9})
    with pytest.raises(LearningError, match="setting epochs is 'many', expected int such as 5"):
        kind.settings(task, changes={"epochs": "many"})
    with pytest.raises(LearningError, match="setting batch is 0.5, expected int"):
        kind.settings(task, changes={"batch": 0.5})


@pytest.mark.parametrize(
    ("name", "value", "sentence"),
    [
        ("steps", "0", "setting steps is '0', expected 1 or more"),
        ("hidden", ["64", "0"], "expected 1 or more"),
        ("learning_rate", "-1", "setting learning_rate is '-1', expected a number of 0 or more"),
        ("discount", "1.5", "setting discount is '1.5', expected a number from 0 to 1"),
        ("hidden", "1000000000000", "expected 1 or more, at most 1000000000"),
        ("learning_rate", "nan", "setting learning_rate is 'nan', expected a finite number"),
    ],
)
def test_settings_that_nothing_can_be_learnt_with_are_refused(name, value, sentence):
    """Settings that would divide by zero, or fail after the first update, are refused; optional ones may be 0."""
    kind = learner_named("sb3-ppo")
    with pytest.raises(LearningError, match=sentence):
        kind.settings(Guess(), changes={name: value})
    assert kind.settings(Guess(), changes={"entropy_weight": 0.0}).entropy_weight == 0.0


@pytest.mark.parametrize(
    ("name", "library", "extras"),
    [("rsl-rl", "rsl_rl.algorithms", "learn,rsl-rl"), ("sb3-ppo", "torch", "learn")],
)
def test_a_library_that_is_missing_is_named(monkeypatch, name, library, extras):
    """The refusal names the extra to install."""
    kind = learner_named(name)
    monkeypatch.setitem(sys.modules, library, None)
    monkeypatch.delitem(sys.modules, f"finssim.learning.learners.{kind.module}", raising=False)
    with pytest.raises(
        LearningError, match=rf"this learner needs {library}: pip install 'finssim\[{extras}\]'$"
    ):
        kind.settings(Guess())


@pytest.mark.slow  # importing torchrl starts a process
def test_settings_are_changed_by_name():
    """Values are numbers or words, converted to the setting's type."""
    changes = {"learning_rate": "1e-3", "hidden": [32, 16], "epochs": 3}
    settings = learner_named("torchrl-ppo").settings(Guess(), worlds=64, steps=5, changes=changes)
    assert (settings.learning_rate, settings.hidden, settings.epochs) == (1e-3, (32, 16), 3)
    assert (settings.worlds, settings.steps, settings.rollout) == (64, 5, 128)
    assert learner_named("rsl-rl").settings(task_named("t2")).discount == 0.9


@pytest.mark.parametrize("asymmetric", [True, False])
def test_a_critic_may_see_what_was_drawn(asymmetric):
    """RSL-RL's critic has an input for each privileged number, its policy none; without `asymmetric` neither has."""
    settings = small("rsl-rl", Guess(), asymmetric=asymmetric)
    ranges = {"randomize": "fossen_learn_to_swim", "privileged": True}
    environment = finssim.make(Guess(), worlds=settings.worlds, seed=3, **ranges)
    learner = learner_named("rsl-rl")(environment, settings, seed=3)
    told = len(environment.privileged_names)
    assert told > 0 and learner.network()[0].in_features == environment.observation_size
    assert learner.ppo.critic.mlp[0].in_features == environment.observation_size + told * asymmetric
    learner.update()
