"""Behaviour cloning and DAgger: they match the expert, resume bit-identically, and refuse unsuitable data."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from finssim.agents.agent import NOWHERE
from finssim.control.guidance import Known
from finssim.learning.demonstrations import CollectSettings, Episode, collect, save
from finssim.learning.learners import LearningError, learner_named
from finssim.learning.resume import read_state, write_state
from finssim.tasks import make, task_named
from finssim.vehicles import load_vehicle

FINSROV = load_vehicle("finsrov")
SMALL = {
    "bc": {"worlds": 4, "steps": 4000, "rollout": 1000, "batch": 50},
    "dagger": {"worlds": 4, "steps": 4000, "rollout": 20, "batch": 50, "expert_rounds": 1},
}


def environment(seed=3, **options):
    return make(task_named("t1", time_limit=2.0), worlds=4, seed=seed, observe="training", **options)


def made(name, seed=3, **changes):
    settings = replace(learner_named(name).settings(task_named("t1")), **{**SMALL[name], **changes})
    return learner_named(name)(environment(seed), settings, seed=seed)


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """Four whole episodes of the PID on T1."""
    out = tmp_path_factory.mktemp("shown") / "pid"
    collect("pid", "t1", episodes=4, out=out, settings=CollectSettings(seed=2))
    return str(out)


def linear(folder, rows=4000):
    """Write a set with known truth: the action is a linear function of the observation, inside the limits."""
    rng = np.random.default_rng(0)
    observation = rng.normal(size=(rows + 1, 16)).astype(np.float32)
    W = rng.uniform(-0.1, 0.1, (16, 6)).astype(np.float32)
    action = np.clip(observation[:-1] @ W, -1.0, 1.0)
    episode = Episode(observation, action, np.zeros(rows, np.float32), False, {"return": 0.0})
    about = {
        "task": "t1",
        "expert": "linear",
        "vehicle": {"name": "finsrov", "sha256": FINSROV.sha256},
        "action": {"mode": "wrench6"},
    }
    return str(save(folder, [episode], about)), observation[:-1], action


@pytest.mark.slow
def test_cloning_finds_the_function_that_was_shown(tmp_path):
    """The error is a tenth of the action's spread after forty passes, and decreases with more steps."""
    place, observation, action = linear(tmp_path / "set")
    learner = made("bc", demonstrations=place, steps=160_000, rollout=16_000, learning_rate=3e-3)
    losses = []
    while learner.steps < learner.settings.steps:
        losses.append(learner.update()["imitation_loss"])
    with torch.no_grad():
        error = learner.network()(torch.from_numpy(observation)).numpy() - action
    assert np.sqrt(np.mean(error**2)) < 0.1 * np.std(action)
    assert losses[-1] < 0.1 * losses[0] and learner.steps == 160_000


def test_dagger_keeps_what_the_expert_says_of_where_the_learner_came(shown):
    """Every kept observation has the PID's action, with its memory along the learner's own path."""
    learner = made("dagger", expert_rounds=0)
    learner.update()
    rows, told = learner._observation.numpy(), learner._action.numpy()
    assert rows.shape == (20 * 4, 16) and told.shape == (20 * 4, 6)
    memory = learner._expert.reset(4)
    for k in range(20):  # 2 s episodes: none ends before the first is over, but shortened ones do
        wanted, memory = learner._expert.act(memory, Known(rows[4 * k : 4 * k + 4]), NOWHERE)
        if k == 0:
            assert np.allclose(told[:4], np.clip(wanted, -1.0, 1.0), atol=1e-6)
    assert np.abs(told).max() <= 1.0


def test_dagger_begins_with_the_expert_at_the_helm():
    """In the first round the expert's actions are executed; afterwards they are not."""
    learner = made("dagger", expert_rounds=1)
    actions = []
    step = learner._worlds.step
    learner._worlds.step = lambda action: (actions.append(action.flatten(0, -2).clone()), step(action))[1]
    learner.update()
    assert torch.equal(torch.cat(actions), learner._action)
    actions.clear()
    learner.update()
    assert not torch.allclose(torch.cat(actions), learner._action[-80:], atol=1e-3)


def test_dagger_takes_demonstrations_to_begin_with(shown):
    learner = made("dagger", demonstrations=shown)
    assert len(learner._observation) == 800  # four episodes of 200 steps
    learner.update()
    assert len(learner._observation) == 880
    few = made("dagger", demonstrations=shown, kept=100)
    assert len(few._observation) == 100


@pytest.mark.slow
@pytest.mark.parametrize("name", SMALL)
def test_a_training_goes_on_bitwise(name, shown, tmp_path):
    """Two updates, a state on disk, and two more in another learner give the same numbers."""
    changes = {} if name == "dagger" else {"demonstrations": shown}
    whole = made(name, **changes)
    for _ in range(2):
        whole.update()
    write_state({"learner": whole.state()}, tmp_path / "state")
    expected = [whole.update() for _ in range(2)]
    other = made(name, **changes)
    other.load(read_state(tmp_path / "state")["learner"])
    assert [other.update() for _ in range(2)] == expected
    for a, b in zip(whole.network().parameters(), other.network().parameters(), strict=True):
        assert torch.equal(a, b)


def test_what_does_not_fit_is_refused(shown):
    """A missing set, and another task, vehicle or mode are refused."""
    with pytest.raises(LearningError, match="no demonstrations are named: collect some with finssim collect"):
        made("bc")
    kind = learner_named("bc")
    for other, sentence in (
        (make("t2", worlds=4), "is of task t1, expected t2"),
        (make("t1", worlds=4, vehicle="bluerov2_heavy"), "is of vehicle"),
        (make("t1", worlds=4, action="wrench4"), "is of action mode wrench6, expected wrench4"),
    ):
        settings = replace(kind.settings(other.task), **SMALL["bc"], demonstrations=shown)
        with pytest.raises(LearningError, match=sentence):
            kind(other, settings, seed=1)
