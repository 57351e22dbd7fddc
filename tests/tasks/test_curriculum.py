"""Ranges that grow: with the training, with steps, with success, and each end by itself."""

from __future__ import annotations

import numpy as np
import pytest

from finssim.engine.randomize import Randomization
from finssim.engine.ranges_file import Ranges
from finssim.experiments.plants import load_plant
from finssim.tasks import Environment, EnvironmentSetupError, StationKeeping
from finssim.tasks.drawing import LOOK

MASS = (0.6, 1.8)
ALWAYS, NEVER = {"episode_return": -1e9}, {"episode_return": 1e9}


def environment(worlds=200, time_limit=1.0, task=None, **parts) -> Environment:
    """T1 with short episodes, whose mass is drawn."""
    ranges = Ranges.model_validate({"name": "test", "mass": MASS, **parts})
    task = task or StationKeeping(time_limit=time_limit)
    return Environment(task, worlds=worlds, randomization=Randomization(ranges), threads=1, seed=3)


def masses(env: Environment) -> np.ndarray:
    """Drawn factor of every world."""
    return env.drawing.draws.numpy(["mass"])[:, 0, 0]


def run(env: Environment, steps: int) -> None:
    action = np.zeros((env.worlds, env.action_size), np.float32)
    for _ in range(steps):
        env.step(action)


@pytest.mark.parametrize(("done", "width"), [(0.0, 0.2), (0.1, 0.2), (0.35, 0.6), (0.6, 1.0), (1.0, 1.0)])
def test_ranges_widen_linearly_with_the_share_of_the_training(done, width):
    """width = start + (1 - start) (done - from) / (to - from); what is drawn next fills just that."""
    env = environment(worlds=1500, curriculum={"start": 0.2, "over": [0.1, 0.6]})
    env.set_progress(done)
    assert env.drawing.schedule.width == pytest.approx(width)
    env.reset()
    low, high = 1.0 - width * 0.4, 1.0 + width * 0.8
    x = masses(env)
    assert low - 1e-6 <= x.min() < low + 0.01 and high - 0.01 < x.max() <= high + 1e-6


def test_a_curriculum_starts_with_the_vehicle_of_the_file():
    """Everything that is drawn is at its nominal number when nothing of the width is."""
    env = environment(
        curriculum={}, thrust={"failure": {"uniform": [0.0, 0.0], "probability": 0.5}}, current=(0.1, 0.3)
    )
    values = env.drawing.draws
    for name in ("mass", "thrust.failure.0"):
        assert (values.numpy([name]) == 1.0).all()
    np.testing.assert_allclose(values.numpy(["current"]), 0.1, rtol=1e-6)  # the end nearest to still water
    env.set_progress(1.0)
    env.reset()
    assert np.mean(values.numpy(["thrust.failure.0"]) == 0.0) == pytest.approx(0.5, abs=0.12)


def test_ranges_widen_with_the_environments_own_steps():
    """Counted over all worlds; nobody has to tell."""
    env = environment(worlds=10, curriculum={"by": "steps", "over": [0, 2000]})
    run(env, LOOK - 1)
    assert env.drawing.schedule.width == 0.0
    run(env, 1)
    assert env.drawing.schedule.width == pytest.approx(LOOK * 10 / 2000)
    run(env, 3 * LOOK)
    assert env.drawing.schedule.width == 1.0


@pytest.mark.parametrize(
    ("success", "start", "width"),
    [(ALWAYS, 0.0, 0.5), (NEVER, 0.9, 0.4), (NEVER, 0.2, 0.0), (ALWAYS, 0.8, 1.0)],
)
def test_ranges_widen_with_success_and_narrow_without(success, start, width):
    """Five looks of 50 steps with 5 episodes of 10 steps in each of 20 worlds: five steps of 0.1, within [0, 1]."""
    plan = {"by": "success", "start": start, "episodes": 100, "success": success}
    env = environment(worlds=20, curriculum=plan)
    run(env, 5 * LOOK)
    assert env.drawing.schedule.width == pytest.approx(width)


def test_too_few_episodes_are_not_judged():
    env = environment(worlds=20, curriculum={"by": "success", "episodes": 101, "success": ALWAYS})
    run(env, LOOK)
    assert env.drawing.schedule.width == 0.0
    run(env, LOOK)
    assert env.drawing.schedule.width == pytest.approx(0.1)


def test_episodes_that_try_an_end_have_it():
    """A share of the worlds, half of them at each end; the others are drawn from the range."""
    env = environment(worlds=4000, slew=(0.5, 1.5), automatic={"start": 0.5, "probability": 0.4})
    probe, x = env.drawing.draws.probe.numpy(), env.drawing.draws.numpy(["mass", "slew"])[:, 0]
    assert np.mean(probe >= 0) == pytest.approx(0.4, abs=0.03)
    ends = [0.8, 1.4, 0.75, 1.25]
    for end, value in enumerate(ends):
        assert np.mean(probe == end) == pytest.approx(0.1, abs=0.02)
        np.testing.assert_allclose(x[probe == end, end // 2], value, rtol=1e-6)
    inside = x[probe < 0]
    assert (inside > [ends[0], ends[2]]).all() and (inside < [ends[1], ends[3]]).all()


@pytest.mark.slow
@pytest.mark.parametrize(("success", "part"), [(ALWAYS, 1.0), (NEVER, 0.0)])
def test_automatic_widening_goes_to_the_end_that_success_decides(success, part):
    """Every end is tried often enough in 20 looks to reach the whole width, or none of it."""
    env = environment(worlds=200, automatic={"start": 0.5, "episodes": 20, "step": 0.25, "success": success})
    run(env, 20 * LOOK)
    np.testing.assert_array_equal(env.drawing.schedule.parts, part)


def test_each_end_moves_by_its_own_successes():
    """The heavy end of the mass succeeds, the light one fails, those of the slew lie between or are too few."""
    env = environment(worlds=4, slew=(0.5, 1.5), automatic={"start": 0.5, "episodes": 10, "step": 0.2})
    schedule = env.drawing.schedule
    tried, succeeded = (np.zeros((4, 5), np.int32) for _ in range(2))
    tried[:, 1:] = [[4, 4, 4, 1]] * 4
    succeeded[:, 1:] = [[1, 4, 3, 1], [2, 4, 2, 1], [1, 4, 3, 1], [1, 3, 2, 1]]
    tried[:, 0], succeeded[:, 0] = 50, 50  # episodes that tried no end do not count
    schedule.counts.tried.assign(tried)
    schedule.counts.succeeded.assign(succeeded)
    for _ in range(LOOK):
        schedule.after_step()
    assert schedule.names == ["mass", "slew"]
    np.testing.assert_allclose(schedule.parts, [[0.3, 0.5], [0.7, 0.5]])
    left = schedule.counts.tried.numpy()
    assert (left[:, 4] == 1).all() and not left[:, 1:4].any()


def test_success_is_counted_from_what_the_task_holds():
    """Worlds that held long enough when their episode ended, and no others."""
    env = environment(worlds=6, time_limit=0.1, curriculum={"by": "success", "success": {"held": 2.0}})
    held = np.array([0.0, 1.0, 1.8, 1.95, 2.5, 9.0], np.float32)
    env.arrays.held.assign(held)
    env.step(np.zeros((6, 6)))
    counts = env.drawing.schedule.counts
    assert counts.tried.numpy()[:, 0].tolist() == [1] * 6
    inside = env.arrays.final_held.numpy() >= 2.0 - 1e-4
    np.testing.assert_array_equal(counts.succeeded.numpy()[:, 0], inside.astype(int))


def test_a_seed_starts_the_schedule_over_and_a_reset_does_not():
    env = environment(worlds=20, curriculum={"by": "success", "episodes": 50, "success": ALWAYS})
    run(env, 2 * LOOK)
    env.reset()
    assert env.drawing.schedule.width == pytest.approx(0.2)
    env.reset(seed=3)
    assert env.drawing.schedule.width == 0.0 and not masses(env).std()


def test_a_saved_environment_goes_on_with_its_schedule():
    """Bit for bit, with a schedule, jitter and sensors."""
    parts = {
        "slew": (0.5, 1.5),
        "command_jitter": (0.0, 0.05),
        "sensors": {"position_std": [0.0, 0.02], "dropout": [0.0, 0.3]},
        "automatic": {"start": 0.5, "episodes": 3, "success": ALWAYS},
    }
    one, other = environment(worlds=20, **parts), environment(worlds=20, **parts)
    run(one, LOOK + 7)
    other.load_state(one.state())
    for env in (one, other):
        run(env, LOOK + 20)
    np.testing.assert_array_equal(one.drawing.schedule.parts, other.drawing.schedule.parts)
    np.testing.assert_array_equal(one.arrays.observation.numpy(), other.arrays.observation.numpy())
    np.testing.assert_array_equal(masses(one), masses(other))


def test_an_evaluation_draws_from_the_whole_ranges(tmp_path):
    """A plant has no training that its ranges could grow with."""
    path = tmp_path / "plant.yaml"
    path.write_text("ranges: {name: test, mass: [0.6, 1.8], curriculum: {}}\n", encoding="utf-8")
    env = Environment(StationKeeping(), worlds=200, **load_plant(path).environment_arguments())
    assert env.drawing.schedule is None and masses(env).min() < 0.65 and masses(env).max() > 1.7


@pytest.mark.parametrize(
    ("ranges", "sentence"),
    [
        ({"mass": (1.0, 1.0), "current": (0.0, 0.0), "curriculum": {}}, "nothing that is drawn can widen"),
        ({"mass": {"choice": [0.9, 1.1]}, "automatic": {}}, "nothing that is drawn can widen"),
    ],
)
def test_a_schedule_without_anything_to_widen_is_refused(ranges, sentence):
    with pytest.raises(EnvironmentSetupError, match=sentence):
        environment(**ranges)


def test_a_task_without_hold_needs_to_be_told_what_success_is():
    """Unless nothing is judged."""
    task = StationKeeping(hold=0.0)
    with pytest.raises(EnvironmentSetupError, match="has no hold time: say when an episode succeeds"):
        environment(task=task, automatic={})
    environment(task=task, curriculum={}).set_progress(0.5)
