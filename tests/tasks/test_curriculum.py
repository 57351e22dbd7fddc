"""Ranges of randomisation grow with the training, with steps, or with success."""

from __future__ import annotations

import numpy as np
import pytest

from finssim.evaluation.plants import load_plant
from finssim.sim.randomize import Randomization
from finssim.sim.ranges_file import Ranges
from finssim.tasks import Environment, EnvironmentSetupError, StationKeeping
from finssim.tasks.schedule import LOOK

MASS = (0.6, 1.8)
ALWAYS, NEVER = {"episode_return": -1e9}, {"episode_return": 1e9}


def environment(worlds=200, time_limit=1.0, task=None, **parts) -> Environment:
    """Return T1 with short episodes and randomised mass."""
    ranges = Ranges.model_validate({"name": "test", "mass": MASS, **parts})
    task = task or StationKeeping(time_limit=time_limit)
    return Environment(task, worlds=worlds, randomization=Randomization(ranges), threads=1, seed=3)


def masses(env: Environment) -> np.ndarray:
    """Return the drawn mass factor of every world."""
    return env.draws.numpy(["mass"])[:, 0, 0]


def run(env: Environment, steps: int) -> None:
    action = np.zeros((env.worlds, env.action_size), np.float32)
    for _ in range(steps):
        env.step(action)


@pytest.mark.parametrize(("done", "width"), [(0.0, 0.2), (0.1, 0.2), (0.35, 0.6), (0.6, 1.0), (1.0, 1.0)])
def test_ranges_widen_linearly_with_the_share_of_the_training(done, width):
    """width = start + (1 - start) (done - from) / (to - from); the next draws fill exactly this width."""
    env = environment(worlds=1500, curriculum={"start": 0.2, "over": [0.1, 0.6]})
    env.set_progress(done)
    assert env.schedule.width == pytest.approx(width)
    env.reset()
    low, high = 1.0 - width * 0.4, 1.0 + width * 0.8
    x = masses(env)
    assert low - 1e-6 <= x.min() < low + 0.01 and high - 0.01 < x.max() <= high + 1e-6


def test_a_curriculum_starts_with_the_vehicle_of_the_file():
    """At width zero everything that is drawn has its nominal value."""
    env = environment(
        curriculum={}, thrust={"failure": {"uniform": [0.0, 0.0], "probability": 0.5}}, current=(0.1, 0.3)
    )
    values = env.draws
    for name in ("mass", "thrust.failure.0"):
        assert (values.numpy([name]) == 1.0).all()
    np.testing.assert_allclose(values.numpy(["current"]), 0.1, rtol=1e-6)  # the end nearest to still water
    env.set_progress(1.0)
    env.reset()
    assert np.mean(values.numpy(["thrust.failure.0"]) == 0.0) == pytest.approx(0.5, abs=0.12)


def test_ranges_widen_with_the_environments_own_steps():
    """Steps are counted over all worlds, without any call from the training."""
    env = environment(worlds=10, curriculum={"by": "steps", "over": [0, 2000]})
    run(env, LOOK - 1)
    assert env.schedule.width == 0.0
    run(env, 1)
    assert env.schedule.width == pytest.approx(LOOK * 10 / 2000)
    run(env, 3 * LOOK)
    assert env.schedule.width == 1.0


@pytest.mark.parametrize(
    ("success", "start", "width"),
    [(ALWAYS, 0.0, 0.5), (NEVER, 0.9, 0.4), (NEVER, 0.2, 0.0), (ALWAYS, 0.8, 1.0)],
)
def test_ranges_widen_with_success_and_narrow_without(success, start, width):
    """Five evaluations of 50 steps, each with 5 episodes of 10 steps in 20 worlds, give five steps of 0.1,
    within [0, 1]."""
    plan = {"by": "success", "start": start, "episodes": 100, "success": success}
    env = environment(worlds=20, curriculum=plan)
    run(env, 5 * LOOK)
    assert env.schedule.width == pytest.approx(width)


def test_too_few_episodes_are_not_judged():
    env = environment(worlds=20, curriculum={"by": "success", "episodes": 101, "success": ALWAYS})
    run(env, LOOK)
    assert env.schedule.width == 0.0
    run(env, LOOK)
    assert env.schedule.width == pytest.approx(0.1)


def test_success_is_counted_from_what_the_task_holds():
    """Worlds count that held long enough when their episode ended, and no others."""
    env = environment(worlds=6, time_limit=0.1, curriculum={"by": "success", "success": {"held": 2.0}})
    held = np.array([0.0, 1.0, 1.8, 1.95, 2.5, 9.0], np.float32)
    env.arrays.held.assign(held)
    env.step(np.zeros((6, 6)))
    counts = env.schedule.counts
    assert counts.tried.numpy().tolist() == [1] * 6
    inside = env.arrays.final_held.numpy() >= 2.0 - 1e-4
    np.testing.assert_array_equal(counts.succeeded.numpy(), inside.astype(int))


def test_a_seed_starts_the_schedule_over_and_a_reset_does_not():
    env = environment(worlds=20, curriculum={"by": "success", "episodes": 50, "success": ALWAYS})
    run(env, 2 * LOOK)
    env.reset()
    assert env.schedule.width == pytest.approx(0.2)
    env.reset(seed=3)
    assert env.schedule.width == 0.0 and not masses(env).std()


def test_a_saved_environment_goes_on_with_its_schedule():
    """It continues bit for bit, with a schedule, jitter and sensors."""
    parts = {
        "slew": (0.5, 1.5),
        "command_jitter": (0.0, 0.05),
        "sensors": {"position_std": [0.0, 0.02], "dropout": [0.0, 0.3]},
        "curriculum": {"by": "success", "start": 0.5, "episodes": 3, "success": ALWAYS},
    }
    one, other = environment(worlds=20, **parts), environment(worlds=20, **parts)
    run(one, LOOK + 7)
    other.load_state(one.state())
    for env in (one, other):
        run(env, LOOK + 20)
    assert one.schedule.width == other.schedule.width > 0.5
    np.testing.assert_array_equal(one.arrays.observation.numpy(), other.arrays.observation.numpy())
    np.testing.assert_array_equal(masses(one), masses(other))


def test_an_evaluation_draws_from_the_whole_ranges(tmp_path):
    """An evaluation has no training with which the ranges could grow."""
    path = tmp_path / "plant.yaml"
    path.write_text("ranges: {name: test, mass: [0.6, 1.8], curriculum: {}}\n", encoding="utf-8")
    env = Environment(StationKeeping(), worlds=200, **load_plant(path).environment_arguments())
    assert env.schedule is None and masses(env).min() < 0.65 and masses(env).max() > 1.7


@pytest.mark.parametrize(
    ("ranges", "sentence"),
    [
        ({"mass": (1.0, 1.0), "current": (0.0, 0.0), "curriculum": {}}, "nothing that is drawn can widen"),
    ],
)
def test_a_schedule_without_anything_to_widen_is_refused(ranges, sentence):
    with pytest.raises(EnvironmentSetupError, match=sentence):
        environment(**ranges)


def test_a_task_without_hold_needs_to_be_told_what_success_is():
    """This is not needed if success is not used."""
    task = StationKeeping(hold=0.0)
    with pytest.raises(EnvironmentSetupError, match="has no hold time: define success"):
        environment(task=task, curriculum={"by": "success"})
    environment(task=task, curriculum={}).set_progress(0.5)
