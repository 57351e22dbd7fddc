"""The Gymnasium adapters pass Gymnasium's own checks and separate ends from final observations."""

import subprocess
import sys
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import RecordEpisodeStatistics

from finssim.learning.gymnasium_env import Env, VectorEnv
from finssim.tasks import TASKS, EnvironmentSetupError, StationKeeping, numeric_tasks, task_named

SHORT = StationKeeping(time_limit=0.5)
ALONE = [name for name in numeric_tasks() if len(TASKS[name].agents) == 1]
UNBOUNDED = pytest.mark.filterwarnings("ignore:.*infinity.*")
"""Ignores a warning: offsets have no bound, and the space declares it."""


@UNBOUNDED
@pytest.mark.parametrize(("task", "action"), [("t1", None), ("t1", "thruster8"), ("pursuit", None)])
def test_the_single_environment_passes_the_checker(task, action):
    check_env(Env(task, action=action), skip_render_check=True)


@UNBOUNDED
def test_every_task_of_one_agent_is_registered():
    assert {f"finssim/{TASKS[name].__name__}-v0" for name in ALONE} <= gymnasium.registry.keys()


@UNBOUNDED
@pytest.mark.parametrize("task", ["t1", "pursuit"])
def test_a_task_of_one_agent_can_be_made_by_name(task):
    """`gymnasium.make` and `make_vec` find a task by the name of its class, and pass options on."""
    name, size = f"finssim/{TASKS[task].__name__}-v0", TASKS[task]().observation_size
    # Tasks with other vehicles are commanded by wrench.
    action, wide = ("wrench6", 6) if TASKS[task]().others else ("thruster8", 8)
    env = gymnasium.make(name, action=action)
    assert env.reset(seed=1)[0].shape == (size,) and env.action_space.shape == (wide,)
    assert env.unwrapped.environment.task.name == task
    batch = gymnasium.make_vec(name, num_envs=3, hydrodynamics="simplified")
    assert batch.reset(seed=1)[0].shape == (3, size)


@pytest.mark.slow
def test_nothing_needs_to_be_imported_where_the_name_says_from_where():
    script = """
import gymnasium
name = "finssim.learning.gymnasium_env:finssim/StationKeeping-v0"
print(gymnasium.make(name).reset(seed=1)[0].shape, gymnasium.make_vec(name, num_envs=2).reset(seed=1)[0].shape)
"""
    out = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", script], capture_output=True, text=True, check=True
    )
    assert out.stdout.strip() == "(16,) (2, 16)"


def test_observations_lie_in_their_space():
    env = Env(SHORT)
    env.reset(seed=0)
    env.action_space.seed(0)
    for _ in range(40):
        observation, _, terminated, truncated, info = env.step(env.action_space.sample())
        assert env.observation_space.contains(observation)
        assert info["position_error"] >= 0.0
        if terminated or truncated:
            assert info["episode"]["l"] == 5 and info["episode"]["success"] == 0.0
            env.reset()


def test_the_last_observation_is_returned_with_the_end():
    """A single environment stays at its end, with the observation that the batch keeps as final."""
    env, batch = Env(SHORT), VectorEnv(1, SHORT)
    env.reset(seed=4)
    batch.reset(seed=4)
    for _ in range(5):
        observation, reward, terminated, truncated, _ = env.step(np.full(6, 0.2, np.float32))
        *_, info = batch.step(np.full((1, 6), 0.2, np.float32))
    assert (terminated, truncated) == (False, True)
    np.testing.assert_array_equal(observation, info["final_obs"][0])
    assert isinstance(reward, float)


def test_the_batch_says_how_it_resets_and_gives_final_observations():
    """SAME_STEP: the observation is the next episode's first; final_obs, with its mask, the last of the old one."""
    batch = VectorEnv(6, SHORT)
    assert batch.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    first, info = batch.reset(seed=1)
    assert first.shape == (6, 16) and info == {}
    batch.reset(options={"reset_mask": np.arange(6) < 2})
    batch.environment.simulator.state.steps.assign(np.array([0, 0, 2, 2, 2, 2], np.int32))
    for _ in range(3):
        observation, reward, terminated, truncated, info = batch.step(np.zeros((6, 6), np.float32))
    assert truncated.tolist() == [False, False, True, True, True, True] and not terminated.any()
    assert info["_final_obs"].tolist() == truncated.tolist() and info["final_obs"][0] is None
    assert batch.single_observation_space.contains(info["final_obs"][3])
    assert not np.allclose(info["final_obs"][3], observation[3])
    assert info["final_info"]["episode_length"].tolist() == [0, 0, 5, 5, 5, 5]
    assert info["final_info"]["success"].tolist() == [0.0] * 6 and info["_final_info"][5]
    assert batch.observation_space.contains(observation) and reward.shape == (6,)


def test_the_next_episode_may_begin_in_the_next_step():
    """NEXT_STEP: the last observation comes with the end, the first of the next episode a step later, with reward 0.

    A world in mid-episode is not affected by worlds that reset: it is bit-identical to SAME_STEP.
    """
    batch, same = VectorEnv(3, SHORT, autoreset_mode="NextStep"), VectorEnv(3, SHORT)
    assert batch.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    action = np.full((3, 6), 0.2, np.float32)
    for env in (batch, same):
        env.reset(seed=4)
        env.environment.simulator.state.steps.assign(np.array([2, 2, 0], np.int32))
    for _ in range(3):
        observation, reward, _terminated, truncated, info = batch.step(action)
        *_, final = same.step(action)
    assert truncated.tolist() == [True, True, False] and info["_episode_length"].tolist() == [
        True,
        True,
        False,
    ]
    assert info["episode_length"].tolist() == [5, 5, 0]
    np.testing.assert_array_equal(observation[0], final["final_obs"][0])
    last = observation.copy()
    observation, reward, terminated, truncated, info = batch.step(action)
    other, *_ = same.step(action)
    assert reward[:2].tolist() == [0.0, 0.0] and not (terminated | truncated).any() and info == {}
    assert (
        not np.allclose(observation[:2], last[:2]) and batch.environment.simulator.state.steps.numpy()[0] == 0
    )
    np.testing.assert_array_equal(observation[2], other[2])
    *_, truncated, _ = batch.step(action)
    assert truncated.tolist() == [False, False, True]


def test_gymnasiums_statistics_are_the_tasks():
    """Gymnasium's wrapper, which supports only NEXT_STEP, counts returns and lengths as the task does."""
    batch = RecordEpisodeStatistics(VectorEnv(2, SHORT, autoreset_mode=AutoresetMode.NEXT_STEP))
    batch.reset(seed=2)
    for _ in range(11):
        *_, info = batch.step(np.zeros((2, 6), np.float32))
    assert info["episode"]["l"].tolist() == [5, 5] == info["episode_length"].tolist()
    np.testing.assert_allclose(info["episode"]["r"], info["episode_return"], rtol=1e-5)


def test_another_way_to_begin_is_refused():
    with pytest.raises(
        EnvironmentSetupError, match="autoreset_mode is Disabled, expected SameStep or NextStep"
    ):
        VectorEnv(1, SHORT, autoreset_mode="Disabled")


def test_what_was_returned_stays():
    """Results are copies, which the next step does not change."""
    batch = VectorEnv(2)
    first, _ = batch.reset(seed=3)
    kept = first.copy()
    observation, reward, *_ = batch.step(np.ones((2, 6), np.float32))
    after = observation.copy(), reward.copy()
    batch.step(-np.ones((2, 6), np.float32))
    np.testing.assert_array_equal(first, kept)
    np.testing.assert_array_equal(observation, after[0])
    np.testing.assert_array_equal(reward, after[1])


def test_seeds_repeat():
    for make in (lambda: Env(), lambda: VectorEnv(4)):
        first, second = make().reset(seed=5)[0], make().reset(seed=5)[0]
        np.testing.assert_array_equal(first, second)
        assert not np.array_equal(first, make().reset(seed=6)[0])


def test_an_unknown_task_is_refused():
    with pytest.raises(EnvironmentSetupError, match="unknown task 't9'; available: t1"):
        Env("t9")
    with pytest.raises(EnvironmentSetupError, match="worlds is 2, expected 1: several are a VectorEnv"):
        Env("t1", worlds=2)


def test_a_task_with_other_settings_is_taken():
    assert Env(replace(SHORT, time_limit=0.2)).environment.task.time_limit == 0.2


def test_after_its_end_an_episode_goes_on_until_reset():
    """Further steps move the same vehicle; each is reported as truncated."""
    env = Env(SHORT)
    env.reset(seed=1)
    ends = [env.step(np.ones(6, np.float32))[3] for _ in range(8)]
    assert ends == [False] * 4 + [True] * 4
    assert env.environment.simulator.state.steps.numpy().tolist() == [8]


def test_a_world_that_breaks_has_started_over_when_step_returns(tmp_path):
    """The step returns the last finite observation, reward 0, terminated; the next step is the new episode's first."""
    env = Env("t1", crash_directory=tmp_path)
    env.reset(seed=1)
    still = np.zeros(6, np.float32)
    last = env.step(still)[0]
    velocity = env.environment.simulator.state.velocity
    broken = velocity.numpy()
    broken[0, 0, 0] = np.nan
    velocity.assign(broken)
    observation, reward, terminated, truncated, info = env.step(still)
    np.testing.assert_array_equal(observation, last)
    assert (reward, terminated, truncated, info["episode"]["l"]) == (0.0, True, False, 2)
    assert env.environment.simulator.state.steps.numpy().tolist() == [0]
    assert env.step(still)[2] is False


@pytest.mark.slow
@UNBOUNDED
def test_a_task_that_sees_has_a_dictionary_of_observations():
    pytest.importorskip("newton")
    env = gymnasium.make("finssim/CameraDocking-v0")
    check_env(env.unwrapped, skip_render_check=True)
    assert env.observation_space["front_camera"].shape == (27, 48, 3)
    net = gymnasium.make("finssim/Net-v0")
    assert net.observation_space["sonar"].shape == (128, 48, 1)
    assert net.reset(seed=1)[0] in net.observation_space
    for mode in (AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP):
        batch = VectorEnv(2, task_named("camera-docking", time_limit=0.2), autoreset_mode=mode)
        first, _ = batch.reset(seed=3)
        second = batch.step(np.zeros((2, 6)))[0]
        third, _, _, ended, info = batch.step(np.zeros((2, 6)))
        assert ended.all() and all(one in batch.observation_space for one in (first, second, third))
        if mode is AutoresetMode.SAME_STEP:
            assert info["final_obs"][0] in batch.single_observation_space
            assert np.any(info["final_obs"][0]["front_camera"] != third["front_camera"][0])
