"""The RSL-RL environment: groups, rows, ages and ends; and RSL-RL's runner trains with it."""

import numpy as np
import pytest
import torch
from rsl_rl.runners import OnPolicyRunner

from finssim.learning.rsl_rl_env import RslRlVecEnv
from finssim.tasks import StationKeeping, make
from reference.learners import rsl_rl_settings
from reference.pair import KINDS, Pair

SHORT = StationKeeping(time_limit=0.5)


@pytest.mark.slow
@KINDS
def test_the_runner_trains(task, tmp_path, capsys):
    """RSL-RL's own runner checks every number, and logs the task's metrics."""
    env = RslRlVecEnv(task, worlds=4)
    runner = OnPolicyRunner(env, rsl_rl_settings(), str(tmp_path))
    runner.learn(2, init_at_random_ep_len=True)
    assert runner.alg.get_policy()(env.get_observations()).shape == (env.num_envs, env.num_actions)


def test_an_end_by_time_is_a_time_out_with_its_observation():
    env, plain = RslRlVecEnv(SHORT, worlds=4, seed=2), make(SHORT, worlds=4, seed=2)
    for k in range(5):
        observation, reward, done, extras = env.step(torch.full((4, 6), 0.1))
        step = plain.step(np.full((4, 6), 0.1, np.float32))
        assert done.tolist() == extras["time_outs"].tolist() == [k == 4] * 4
        np.testing.assert_array_equal(observation["policy"], step.observation)
        np.testing.assert_array_equal(observation["critic"], step.observation)
        np.testing.assert_array_equal(reward, step.reward)
    np.testing.assert_array_equal(extras["final_observations"]["policy"], step.final_observation)
    assert extras["log"]["Episode/length"] == 5.0
    assert extras["log"]["Episode/return"] == pytest.approx(plain.arrays.final_return.numpy().mean())


def test_a_task_that_ends_an_episode_is_no_time_out():
    env = RslRlVecEnv(StationKeeping(bounds=(0.0, 0.0)), worlds=2)
    *_, done, extras = env.step(torch.zeros(2, 6))
    assert done.all() and not extras["time_outs"].any()


def test_what_was_returned_stays():
    env = RslRlVecEnv(SHORT, worlds=2)
    first = env.get_observations()["policy"]
    observation, reward, *_ = env.step(torch.ones(2, 6))
    kept = first.clone(), observation["policy"].clone(), reward.clone()
    env.step(-torch.ones(2, 6))
    for before, after in zip(kept, (first, observation["policy"], reward), strict=True):
        assert torch.equal(before, after)


def test_agents_are_rows():
    """Row 2 w + a is agent a of world w; a world's rows end together and have one age."""
    env = RslRlVecEnv(Pair(time_limit=0.3), worlds=3)
    assert env.num_envs == 6 and env.get_observations()["policy"][:, 6].tolist() == [0.0, 1.0] * 3
    env.episode_length_buf = torch.tensor([0, 0, 1, 1, 2, 2])
    _, reward, done, _ = env.step(torch.zeros(6, 6))
    assert done.tolist() == [False] * 4 + [True] * 2
    assert env.episode_length_buf.tolist() == [1, 1, 2, 2, 0, 0]
    np.testing.assert_array_equal(reward.view(3, 2), env.environment.arrays.agent_reward.numpy())


def test_a_seed_starts_over():
    env = RslRlVecEnv(SHORT, worlds=3, seed=7)
    first = env.get_observations()["policy"].clone()
    env.step(torch.ones(3, 6))
    assert torch.equal(env.reset(seed=7)["policy"], first) and env.max_episode_length == 5


def test_a_critic_may_know_what_was_drawn():
    """The critic's group has the privileged numbers after the observation; the policy's does not."""
    env = RslRlVecEnv(SHORT, worlds=3, randomize="hold_for_position", privileged=True)
    groups, drawn = env.get_observations(), env.environment.arrays.privileged.numpy()
    assert groups["policy"].shape == (3, 16) and drawn.shape[1] == len(env.environment.privileged_names) > 0
    np.testing.assert_array_equal(groups["critic"], np.concatenate([groups["policy"], drawn], axis=1))
