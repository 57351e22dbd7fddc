"""The SB3 adapter: terminal observations, truncation apart from termination, values bootstrapped where right."""

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env

from finssim.engine import Pool
from finssim.learning.gymnasium_env import Env
from finssim.learning.sb3 import Sb3VecEnv
from finssim.tasks import Environment, StationKeeping

SHORT = StationKeeping(time_limit=0.5)


def adapter(worlds=4, task=SHORT, stagger=False, **options):
    return Sb3VecEnv(Environment(task, worlds=worlds, **options), stagger=stagger)


@pytest.mark.filterwarnings("ignore:.*infinity.*")
def test_the_single_environment_passes_sb3s_checker():
    check_env(Env("t1"))


def test_an_end_by_time_is_a_truncation_with_its_observation():
    """info has terminal_observation, TimeLimit.truncated and the episode's totals, in the worlds that ended."""
    venv, plain = adapter(seed=2), Environment(SHORT, worlds=4, seed=2)
    venv.reset()
    plain.reset()
    for _ in range(5):
        observation, reward, done, infos = venv.step(np.zeros((4, 6), np.float32))
        step = plain.step(np.zeros((4, 6)))
    assert done.all() and all(info["TimeLimit.truncated"] for info in infos)
    np.testing.assert_array_equal([info["terminal_observation"] for info in infos], step.final_observation)
    np.testing.assert_array_equal(observation, step.observation)
    assert [info["episode"]["l"] for info in infos] == [5] * 4
    np.testing.assert_allclose([info["episode"]["r"] for info in infos], plain.arrays.final_return.numpy())


def test_leaving_the_pool_is_no_truncation():
    venv = adapter(1, pool=Pool(length=20.0, width=20.0))
    venv.reset()
    venv.environment.start((2.6, 0.0, -0.5), (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, -0.5), (0.0, 0.0, 0.0, 1.0))
    _, _, done, infos = venv.step(np.zeros((1, 6), np.float32))
    assert done[0] and infos[0]["TimeLimit.truncated"] is False


def test_infos_are_empty_while_episodes_go_on():
    venv = adapter()
    venv.reset()
    assert venv.step(np.zeros((4, 6), np.float32))[3] == [{}, {}, {}, {}]


def test_sb3_adds_the_value_of_the_terminal_observation_at_a_truncation_only():
    """Rewards in SB3's buffer are ours, plus γ V(terminal observation) where time ended an episode."""
    venv = adapter(seed=3)
    rewards, finals = [], []
    step = venv.environment.step

    def recorded(action):
        out = step(action)
        rewards.append(out.reward.copy())
        finals.append((out.truncated.copy(), out.final_observation.copy()))
        return out

    venv.environment.step = recorded
    model = PPO(
        "MlpPolicy",
        venv,
        n_steps=8,
        batch_size=32,
        n_epochs=1,
        learning_rate=0.0,
        gamma=0.9,
        seed=0,
        device="cpu",
    )
    model.learn(32)
    got = model.rollout_buffer.rewards
    for k, (reward, (truncated, final)) in enumerate(zip(rewards, finals, strict=True)):
        with torch.no_grad():
            value = model.policy.predict_values(torch.as_tensor(final)).numpy()[:, 0]
        np.testing.assert_allclose(got[k], reward + 0.9 * value * truncated, rtol=1e-5, atol=1e-6)
    assert sum(truncated.any() for truncated, _ in finals) == 1


def test_staggered_episodes_end_at_different_times():
    """First episodes start at random ages, and a shortened one is not counted."""
    venv = adapter(200, StationKeeping(time_limit=2.0), stagger=True, seed=1)
    venv.reset()
    ended, counted = np.zeros(200, int), 0
    for _ in range(20):
        _, _, done, infos = venv.step(np.zeros((200, 6), np.float32))
        ended += done
        counted += sum("episode" in info for info in infos)
        assert 0 < done.sum() < 60
    assert (ended >= 1).all() and counted == 0
    for _ in range(20):
        *_, infos = venv.step(np.zeros((200, 6), np.float32))
        assert all(info["episode"]["l"] == 20 for info in infos if info)


def test_a_seed_given_to_sb3_is_the_environments():
    venv = adapter()
    venv.seed(11)
    np.testing.assert_array_equal(
        venv.reset(), Environment(SHORT, worlds=4, seed=11).arrays.observation.numpy()
    )


def test_an_environment_that_does_not_reset_itself_is_refused():
    with pytest.raises(ValueError, match="auto_reset=True"):
        Sb3VecEnv(Environment(SHORT, auto_reset=False))
