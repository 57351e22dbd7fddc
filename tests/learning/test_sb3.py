"""The SB3 adapter: terminal observations, truncation separate from termination, and correct bootstrapping."""

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.vec_env import VecCheckNan

from finssim.learning.gymnasium_env import Env
from finssim.learning.sb3 import Sb3VecEnv
from finssim.sim import RectangularPool
from finssim.tasks import Environment, EnvironmentSetupError, StationKeeping, task_named
from reference.pair import KINDS, Pair

SHORT = StationKeeping(time_limit=0.5)


def adapter(worlds=4, task=SHORT, stagger=False, **options):
    return Sb3VecEnv(Environment(task, worlds=worlds, **options), stagger=stagger)


@pytest.mark.parametrize("task", ["t1", "pursuit"])
@pytest.mark.filterwarnings("ignore:.*infinity.*")
def test_the_single_environment_passes_sb3s_checker(task):
    check_env(Env(task))


@KINDS
def test_sb3_learns(task):
    """PPO accepts the batch, through SB3's own check that no number is NaN or infinite."""
    venv = VecCheckNan(Sb3VecEnv(task, worlds=4, seed=1), raise_exception=True)
    model = PPO("MlpPolicy", venv, n_steps=4, batch_size=8, n_epochs=1, device="cpu")
    before = [p.detach().clone() for p in model.policy.parameters()]
    model.learn(16)
    assert any(not torch.equal(a, b) for a, b in zip(before, model.policy.parameters(), strict=True))


def test_agents_are_rows():
    """Row 2 w + a is agent a of world w; a world's rows end together, with the last observations of their agents."""
    venv = Sb3VecEnv(Pair(time_limit=0.3), worlds=3, seed=1)
    assert venv.num_envs == 6 and venv.reset()[:, 6].tolist() == [0.0, 1.0] * 3
    push = np.zeros((6, 6), np.float32)
    push[0, 0] = 1.0
    for _ in range(3):
        observation, reward, done, infos = venv.step(push)
    a = venv.environment.arrays
    np.testing.assert_array_equal(reward, a.agent_reward.numpy().ravel())
    np.testing.assert_array_equal(observation, a.observation.numpy().reshape(6, 7))
    np.testing.assert_array_equal(
        [info["terminal_observation"] for info in infos], a.final_observation.numpy().reshape(6, 7)
    )
    assert done.all() and infos[0]["terminal_observation"][3] > 0.05 > abs(
        infos[1]["terminal_observation"][3]
    )
    assert [info["episode"]["l"] for info in infos] == [3] * 6


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
    venv = adapter(1, pool=RectangularPool(length=20.0, width=20.0))
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
    with pytest.raises(EnvironmentSetupError, match="needs auto_reset=True"):
        Sb3VecEnv(Environment(SHORT, auto_reset=False))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "name", "shape"),
    [
        ("camera-docking", "front_camera", (27, 48, 3)),
        ("net", "sonar", (128, 48, 1)),
    ],
)
def test_a_task_that_sees_gives_dictionaries(task, name, shape):
    pytest.importorskip("newton")
    env = Sb3VecEnv(task_named(task, time_limit=0.2), worlds=2, seed=1)
    assert env.reset()[name].shape == (2, *shape)
    still = np.zeros((2, env.action_space.shape[0]))
    env.step(still)
    observation, _, done, infos = env.step(still)
    assert done.all() and infos[0]["terminal_observation"]["state"].shape == (10,)
    assert observation[name].dtype == np.uint8
