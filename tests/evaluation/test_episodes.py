"""Episodes of any task: measured by the task, the first of each world to its end, means with intervals."""

import json

import numpy as np
import pytest

from finssim.agents.agent import agent_for
from finssim.agents.catalogue import baselines_of
from finssim.cli import boundary
from finssim.cli.commands import app
from finssim.control.modes import MODES
from finssim.evaluation.plants import load_plant
from finssim.evaluation.trials import EpisodeError, TrialSettings, run_episodes, summarize_episodes
from finssim.tasks import Environment, numeric_tasks, task_named
from finssim.vehicles import load_vehicle

NUMERIC = numeric_tasks()

FINSROV, NOMINAL = load_vehicle("finsrov"), load_plant("nominal")


class Still:
    """Agent that does nothing, for any task."""

    wrench_scale = 1.0

    def __init__(self, task, period=None):
        self.task, self.action, self.period = task, task.action, period or task.control_step

    def reset(self, n):
        pass

    def act(self, memory, readings, goal):
        return np.zeros(
            (len(readings.observation), len(MODES[self.action].labels(FINSROV))), np.float32
        ), None

    def describe(self):
        return {"name": "still", "kind": "still"}


@pytest.mark.parametrize("name", NUMERIC)
def test_every_task_can_be_played_to_its_end(name):
    """With a controller that does nothing, each of three short episodes has all measures of the task."""
    task = task_named(name, time_limit=1.0)
    found = run_episodes(Still(task), task, FINSROV, NOMINAL, TrialSettings(trials=3))
    assert [row["trial"] for row in found] == [0, 1, 2]
    assert all(row["return"] is not None for row in found)  # a time that is never reached is None
    assert all(row["length"] <= 10.0 + 1e-6 for row in found)


def test_each_world_counts_its_first_episode():
    """In 1 s episodes of T1, the return is the sum of the ten rewards that the environment gives."""
    task = task_named("t1", time_limit=1.0)
    found = run_episodes(Still(task), task, FINSROV, NOMINAL, TrialSettings(trials=2, seed=5))
    from finssim.tasks import make

    alone = make(task, worlds=2, seed=5)
    total = sum(alone.step(np.zeros((2, 6))).reward.copy() for _ in range(10))
    assert [row["return"] for row in found] == pytest.approx(total.tolist(), rel=1e-5)


def test_a_world_that_breaks_has_no_measures(monkeypatch, tmp_path):
    """A broken world's last return and that of its next episode are not counted; the other worlds continue."""
    step = Environment.step

    def breaking(self, action):
        if self._steps == 2:
            position = self.simulator.state.position.numpy().copy()
            position[1] = np.nan
            self.simulator.state.position.assign(position)
        return step(self, action)

    monkeypatch.setattr(Environment, "step", breaking)
    task = task_named("t1", time_limit=1.0)
    found = run_episodes(
        Still(task), task, FINSROV, NOMINAL, TrialSettings(trials=3, crash_directory=tmp_path)
    )
    assert [row["return"] is not None for row in found] == [True, False, True]
    assert summarize_episodes(found)["valid"] == 2


def test_equal_seeds_are_equal_episodes():
    task = task_named("t3", time_limit=1.0)
    runs = [
        run_episodes(Still(task), task, FINSROV, NOMINAL, TrialSettings(trials=4, seed=seed))
        for seed in (1, 1, 2)
    ]
    returns = [[row["return"] for row in run] for run in runs]
    assert returns[0] == returns[1] != returns[2]


def test_another_rate_is_refused():
    task = task_named("t3")
    with pytest.raises(EpisodeError, match="acts every 0.05 s, expected 0.1 s"):
        run_episodes(Still(task, period=0.05), task, FINSROV, NOMINAL, TrialSettings(trials=1))


def test_means_have_intervals_and_what_is_missing_is_counted():
    trials = [{"trial": i, "return": float(i), "time": None if i == 3 else 1.0} for i in range(4)]
    trials.append({"trial": 4, "return": None, "time": None})
    row = summarize_episodes(trials)
    low, high = row["metrics"]["return"]["ci95"]
    assert row["metrics"]["return"]["value"] == 1.5 and 0.0 <= low < 1.5 < high <= 3.0
    assert row["metrics"]["time"] == {"value": 1.0, "ci95": [1.0, 1.0], "count": 3}
    assert (row["trials"], row["valid"]) == (5, 4)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["t3", "team-pursuit"])
def test_baselines_are_evaluated_by_name(name, tmp_path, capsys):
    """A baseline given by name yields a table, JSON and a figure, with a row for each plant where there are two."""
    who = next(iter(baselines_of(name)))
    assert agent_for(who, FINSROV, task_named(name)).describe()["kind"] == "baseline"
    words = ["evaluate", who, "--task", name, "--plant", "nominal", "--plant", "noise", "--trials", "2"]
    assert boundary.run(app, [*words, "--out", str(tmp_path / "out")]) == 0
    document = json.loads((tmp_path / "out" / "evaluation.json").read_text(encoding="utf-8"))
    assert [plant["plant"]["name"] for plant in document["plants"]] == ["nominal", "noise"]
    assert document["plants"][0]["metrics"]["return"]["value"] is not None
    assert "return" in capsys.readouterr().out
