"""A level rises when enough of the recent episodes that began at it succeeded, and goes on so after a kill."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

import finssim
from finssim.tasks import EnvironmentSetupError, TrajectoryTracking
from finssim.tasks.environment import LevelPlan, climb
from finssim.tasks.task import settings_of
from finssim.tasks.team_pursuit import TeamPursuit

SUCCESSES: list[float] | None = None
"""What the episodes that end come to, one after the other; None where nobody may ask but `climb`."""


@dataclass(frozen=True, kw_only=True)
class Scripted(TrajectoryTracking):
    """T2 in episodes of three steps whose success is written down before."""

    time_limit: float = 0.3

    def metrics(self, arrays):
        measured = super().metrics(arrays)
        if SUCCESSES is None:
            return measured
        return {**measured, "success": np.array([SUCCESSES.pop(0) for _ in measured["length"]])}


def episode(environment, successes):
    """Every world's episode to its end, with these successes; the level before and after the next update begins."""
    global SUCCESSES
    SUCCESSES = list(successes)
    for _ in range(3):
        environment.step(np.zeros((environment.worlds, environment.action_size)))
    SUCCESSES = None
    before = environment.levels.level
    environment.set_progress(0.5)
    return before, environment.levels.level


def test_a_level_rises_with_the_share_of_successes():
    """Not for episodes that began before, not below the bar, not before there are enough; never beyond the last."""
    env = finssim.make(Scripted(level=2), worlds=4)
    levels = climb(env, LevelPlan(level_at=0.75, level_episodes=8))
    assert levels.level == 0 and levels.last == 2
    assert episode(env, []) == (0, 0)  # began before: nobody asks
    assert episode(env, [1, 1, 1, 1]) == (0, 0)  # four of eight
    assert episode(env, [1, 0, 0, 0]) == (0, 0)  # 5/8
    assert episode(env, [1, 1, 0, 0]) == (0, 0)  # the last eight: 3/8
    assert episode(env, [1, 1, 1, 1]) == (0, 1)  # 6/8
    assert levels.share == 0.0 and env.task.level == 1
    assert episode(env, []) == (1, 1)  # began in the step that ended the last of level 0
    assert episode(env, [1, 1, 1, 1]) == (1, 1)
    assert episode(env, [1, 1, 1, 1]) == (1, 2)
    for _ in range(3):
        assert episode(env, [1, 1, 1, 1]) == (2, 2)


def test_worlds_that_end_early_do_not_speak_for_the_others():
    """Where success ends an episode, the first to end are successes: the level waits for the rest."""
    global SUCCESSES
    env = finssim.make(Scripted(level=1), worlds=4)
    climb(env, LevelPlan(level_at=0.75, level_episodes=4))
    assert episode(env, []) == (0, 0)
    levels, late = env.levels, np.array([2, 2, 0, 0], np.int32)
    env.simulator.state.steps.assign(late)  # two worlds are about to end
    SUCCESSES = [1, 1, 1, 1]
    env.step(np.zeros((4, env.action_size)))
    env.simulator.state.steps.assign(late)
    SUCCESSES = [1, 1, 1, 1]
    env.step(np.zeros((4, env.action_size)))
    SUCCESSES = None
    levels.rise()
    assert levels.level == 0 and levels.share == 1.0  # four episodes, all of two worlds


def test_what_the_level_says_is_what_the_worlds_do():
    """The prey's speed and the rules of the capture are those of the level; shapes of references too."""
    env = finssim.make(TeamPursuit(level=3), worlds=2)
    settings = settings_of(env.task)
    fast, touch = settings.speed, settings.rules.mode
    climb(env)
    settings = settings_of(env.task)
    assert settings.speed == pytest.approx(fast * 0.5 / 0.8) and settings.rules.mode != touch
    env.reset(seed=3)
    assert env.task.level == 0 and env.step(np.zeros((2, 3, 4))).observation.shape == (2, 3, 30)


def test_it_goes_on_from_a_saved_state():
    """Level, what was counted, and the worlds."""
    made = [finssim.make(Scripted(), worlds=4, seed=2) for _ in range(2)]
    for env in made:
        climb(env, LevelPlan(level_at=0.5, level_episodes=8))
    whole, other = made
    for successes in ([], [1, 1, 1, 1], [1, 1, 1, 1], [], [1, 0, 1, 1]):
        episode(whole, successes)
    other.load_state(whole.state())
    assert other.levels.level == whole.levels.level == 1 and other.levels.share == 0.75
    ends = [episode(env, [0, 0, 1, 0]) for env in made]
    assert ends == [(1, 2), (1, 2)]
    before, after = whole.state(), other.state()
    assert all(np.array_equal(before[name], after[name], equal_nan=True) for name in before)


def test_a_seed_begins_at_the_first_level_again():
    """As if the environment had just been made."""
    env = finssim.make(Scripted(level=1), worlds=4)
    climb(env, LevelPlan(level_at=0.75, level_episodes=4))
    episode(env, [])
    assert episode(env, [1, 1, 1, 1]) == (0, 1)
    env.reset(seed=3)
    assert env.levels.level == 0 and env.task.level == 0


def test_a_state_without_levels_does_not_fit():
    """Nor one with levels where there are none; a sentence says so."""
    plain, climbing = (finssim.make(Scripted(level=1), worlds=4) for _ in range(2))
    climb(climbing)
    for environment, state in ((plain, climbing.state()), (climbing, plain.state())):
        with pytest.raises(EnvironmentSetupError, match="saved state does not fit: the environment has"):
            environment.load_state(state)


@dataclass(frozen=True, kw_only=True)
class Unjudged(TrajectoryTracking):
    """T2 that does not tell success."""

    def metrics(self, arrays):
        return {name: values for name, values in super().metrics(arrays).items() if name != "success"}


@pytest.mark.parametrize(
    ("task", "plan", "sentence"),
    [
        ("t1", {}, "task 't1' has no levels"),
        (replace(TrajectoryTracking(), level=1), {"level_from": 2}, "at most the task's own level, 1"),
        ("t2", {"level_at": 1.5}, "level_at 1.5"),
        (Unjudged(level=1), {}, "no metric 'success'"),
    ],
)
def test_what_cannot_be_is_refused(task, plan, sentence):
    with pytest.raises(EnvironmentSetupError, match=sentence):
        climb(finssim.make(task), LevelPlan(**plan))


@pytest.mark.slow
def test_a_training_tells_the_level_and_goes_on_with_it(tmp_path, monkeypatch):
    """A column of the curve; the plan in policy.yaml; after a kill the same network."""
    import yaml

    from finssim.learning.train import train
    from finssim.learning.training_loop import Loop

    task = replace(TrajectoryTracking(), time_limit=1.0, hold=0.1, tolerance=5.0)  # everybody succeeds
    options = {
        "seed": 1, "worlds": 8, "steps": 2048,
        "settings": {"level_at": "0.9", "level_episodes": "16", "rollout": 64, "batch": 128, "epochs": 1},
    }  # fmt: skip
    whole = train(task, out=tmp_path / "whole", **options)
    rows = (whole / "curves.csv").read_text().splitlines()
    column = [row.split(",")[rows[0].split(",").index("level")] for row in rows[1:]]
    assert [int(float(x)) for x in column] == [0, 1, 2, 3]
    told = yaml.safe_load((whole / "policy.yaml").read_text())["training"]
    assert told["levels"] == {"level_from": 0, "level_at": 0.9, "level_episodes": 16}
    assert told["task"]["level"] == 3

    update = Loop._update
    monkeypatch.setattr(
        Loop,
        "_update",
        lambda self, total: exec("raise RuntimeError") if len(self.curves) == 3 else update(self, total),
    )
    with pytest.raises(RuntimeError):
        train(task, out=tmp_path / "cut", **options)
    monkeypatch.setattr(Loop, "_update", update)
    again = train(task, out=tmp_path / "cut", resume=True, **options)
    assert (again / "policy.onnx").read_bytes() == (whole / "policy.onnx").read_bytes()
