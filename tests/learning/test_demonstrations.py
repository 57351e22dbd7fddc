"""Demonstrations: an expert's actions, written as a Minari data set, and read back unchanged."""

import json

import minari
import numpy as np
import pytest

from finssim.agents.agent import AgentError, expert_for
from finssim.cli import boundary
from finssim.cli.commands import app
from finssim.learning.demonstrations import (
    CollectSettings,
    DatasetError,
    about,
    collect,
    load,
    record_episodes,
    save,
)
from finssim.tasks import Environment, make, task_named
from finssim.vehicles import load_vehicle

SHORT = {"time_limit": 1.0}


class Constant:
    """Expert with the same action everywhere."""

    name = "constant"

    def __init__(self, value=0.5):
        self.value = value

    def reset(self, n):
        return np.zeros(n)

    def act(self, memory, readings, goal):
        return np.full((len(readings.observation), 6), self.value, np.float32), memory + 1


def environment(worlds=3, seed=7):
    return make(task_named("t1", **SHORT), worlds=worlds, seed=seed)


def test_episodes_are_what_the_environment_gave():
    """Of seven episodes, three are of the first world, two of each other; observations chain, rewards are the
    world's."""
    found = record_episodes(environment(), Constant(), 7)
    assert len(found) == 7 and all(
        e.observation.shape == (11, 16) and e.action.shape == (10, 6) for e in found
    )
    again, action = environment(), np.full((3, 6), 0.5, np.float32)
    seen, rewards = [again.arrays.observation.numpy().copy()], []
    for _ in range(10):
        step = again.step(action)
        rewards.append(step.reward.copy())
        seen.append(step.observation.copy())
    for w in range(3):
        assert np.array_equal(found[w].observation[:-1], np.array(seen)[:-1, w])
        assert np.array_equal(found[w].observation[-1], step.final_observation[w])
        assert np.array_equal(found[w].reward, np.array(rewards)[:, w])
        assert found[w].metrics["return"] == pytest.approx(float(np.sum(rewards, axis=0)[w]), rel=1e-5)
        assert not found[w].terminated


def test_what_is_disturbed_is_done_and_not_written():
    """The disturbed action changes the path, but each observation is stored with the expert's own action."""
    calm, disturbed = (record_episodes(environment(), Constant(), 3, disturb=d, seed=1) for d in (0.0, 0.3))
    assert all((e.action == 0.5).all() for e in disturbed)
    assert not np.array_equal(calm[0].observation, disturbed[0].observation)
    again = record_episodes(environment(), Constant(), 3, disturb=0.3, seed=1)
    assert np.array_equal(disturbed[0].observation, again[0].observation)


def test_an_episode_of_a_world_that_breaks_is_no_demonstration(monkeypatch, tmp_path):
    """A broken world contributes the complete episode that begins next."""
    monkeypatch.chdir(tmp_path)  # the folder of its last states
    env, step = environment(), Environment.step

    def breaking(self, action):
        if self._steps == 2:
            position = self.simulator.state.position.numpy().copy()
            position[1] = np.nan
            self.simulator.state.position.assign(position)
        return step(self, action)

    monkeypatch.setattr(Environment, "step", breaking)
    found = record_episodes(env, Constant(), 3)
    assert [len(e.action) for e in found] == [10, 10, 10]
    assert all(np.isfinite(e.observation).all() and not e.terminated for e in found)


def test_worlds_that_always_break_are_refused(monkeypatch, tmp_path):
    """Worlds that always break are refused, instead of waiting for a good episode forever."""
    monkeypatch.chdir(tmp_path)
    env, step = environment(), Environment.step

    def breaking(self, action):
        position = self.simulator.state.position.numpy()
        self.simulator.state.position.assign(np.full_like(position, np.nan))
        return step(self, action)

    monkeypatch.setattr(Environment, "step", breaking)
    with pytest.raises(
        DatasetError, match="ended in a number that is not finite, 0 did not: narrow the ranges"
    ):
        record_episodes(env, Constant(), 3)


def test_written_and_read_back(tmp_path):
    """The data are bit-identical, read by us and by Minari itself."""
    episodes = record_episodes(environment(), Constant(), 4)
    described = {"task": "t1", "expert": "constant", "vehicle": {"name": "finsrov", "sha256": "0"}}
    out = save(tmp_path / "set", episodes, described)
    found = load(out)
    assert np.array_equal(found.action, np.concatenate([e.action for e in episodes]))
    assert np.array_equal(found.observation, np.concatenate([e.observation[:-1] for e in episodes]))
    assert np.array_equal(found.following, np.concatenate([e.observation[1:] for e in episodes]))
    assert found.episodes == 4 and found.about["steps"] == 40
    dataset = minari.MinariDataset(out)
    assert dataset.spec.dataset_id == "finssim/t1/constant-v0" and dataset.total_episodes == 4
    assert [bool(e.truncations[-1]) for e in dataset.iterate_episodes()] == [True] * 4


def test_collecting_by_name(tmp_path):
    """Vehicle, expert, action and revision are stored; equal seeds give equal sets; the expert of T1 succeeds."""
    told = [
        collect(
            "pid",
            "t1",
            episodes=2,
            out=tmp_path / f"set{k}",
            settings=CollectSettings(vehicle="bluerov2", seed=seed),
        )
        for k, seed in enumerate((3, 3, 4))
    ]
    kept = about(tmp_path / "set0")
    assert (
        kept["vehicle"]["name"] == "bluerov2"
        and kept["action"]["mode"] == "wrench6"
        and kept["episodes"] == 2
    )
    assert kept["provenance"] and told[0]["metrics"]["length"] == 200.0
    sets = [load(tmp_path / f"set{k}") for k in range(3)]
    assert np.array_equal(sets[0].action, sets[1].action)
    assert not np.array_equal(sets[0].action, sets[2].action)


@pytest.mark.parametrize(("episodes", "disturb"), [(0, 0.0), (1, 1.0), (1, -0.1)])
def test_numbers_that_do_not_fit_are_refused(tmp_path, episodes, disturb):
    with pytest.raises(DatasetError, match="expected 1 or more, and 0 to below 1"):
        settings = CollectSettings(disturb=disturb)
        collect("pid", "t1", episodes=episodes, out=tmp_path / "set", settings=settings)
    assert not (tmp_path / "set").exists()


def test_who_is_no_expert_is_refused():
    with pytest.raises(
        AgentError,
        match="'nobody' is neither a policy directory nor a baseline of task 't1'; baselines: pid",
    ):
        expert_for("nobody", load_vehicle("finsrov"), task_named("t1"), "wrench6")
    with pytest.raises(AgentError, match="uses action mode wrench6, expected thruster8"):
        expert_for("pid", load_vehicle("finsrov"), task_named("t1"), "thruster8")


def test_commands(tmp_path, capsys):
    """Sets are collected, and listed by folder and by name, as a table and as JSON."""
    words = f"collect pid --task t1 --episodes 1 --disturb 0.1 --out {tmp_path / 'a'}".split()
    assert boundary.run(app, [*words, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["disturb"] == 0.1
    assert boundary.run(app, ["datasets", str(tmp_path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)[str(tmp_path / "a")]["steps"] == 200
    assert boundary.run(app, ["datasets", str(tmp_path / "a")]) == 0
    assert "finsrov" in capsys.readouterr().out
    assert boundary.run(app, ["datasets", str(tmp_path / "b")]) == 2


def test_what_is_no_data_set_is_refused(tmp_path):
    with pytest.raises(DatasetError, match="make one with finssim collect"):
        load(tmp_path / "nothing")
