"""Bootstrapping, library by library, checked against a value in closed form.

If every step gives the reward r, the value of any state under any policy is V = r / (1 - γ) if episodes are only cut by
a time limit, since the task continues, and r if the task ends in every step. With a critic that returns V everywhere,
the target of every step must be V: confusing a cut with an end, or an end with a cut, shifts targets by γ V.
"""

import numpy as np
import pytest
import torch
from rsl_rl.runners import OnPolicyRunner
from stable_baselines3 import PPO as Sb3Ppo
from torch import nn
from torchrl.modules import ValueOperator
from torchrl.objectives.value import GAE

from finssim.learning.gymnasium_env import Env, VectorEnv
from finssim.learning.pettingzoo_env import PettingZooEnv
from finssim.learning.rsl_rl_env import RslRlVecEnv
from finssim.learning.sb3 import Sb3VecEnv
from finssim.learning.torchrl_env import TorchRlEnv
from finssim.tasks import StationKeeping
from finssim.tasks.station_keeping import Reward
from reference.learners import rsl_rl_settings
from reference.pair import constant

GAMMA = 0.9
FLAT = Reward(
    position_scale=1e9, distance=0.0, heading=0.0, turn=0.0, action=0.0, change=0.0, rate=0.0, loss=0.0
)
"""Reward of 1 in every step, wherever the vehicle is."""
CUT = StationKeeping(time_limit=0.5, reward=FLAT)
"""Task that is cut after five steps: the value is 10."""
ENDS = StationKeeping(bounds=(0.0, 0.0), reward=FLAT)
"""Task that ends in every step: the value is 1."""
CASES = pytest.mark.parametrize(("task", "value"), [(CUT, 10.0), (ENDS, 1.0)], ids=["cut", "ends"])
STEPS = 8


def says(layer: nn.Linear, value: float) -> None:
    """Make a critic's last layer return this value everywhere."""
    with torch.no_grad():
        layer.weight.zero_()
        layer.bias.fill_(value)


@CASES
def test_stable_baselines3(task, value):
    env = Sb3VecEnv(task, worlds=3)
    model = Sb3Ppo(
        "MlpPolicy", env, n_steps=STEPS, batch_size=STEPS * 3, n_epochs=1, learning_rate=0.0, gamma=GAMMA
    )
    says(model.policy.value_net, value)
    model.learn(STEPS * 3)
    np.testing.assert_allclose(model.rollout_buffer.returns, value, rtol=1e-5)


@CASES
def test_rsl_rl(task, value, capsys):
    env = RslRlVecEnv(task, worlds=3)
    algorithm = OnPolicyRunner(env, rsl_rl_settings(steps=STEPS, gamma=GAMMA)).alg
    says(algorithm.critic.mlp[-1], value)
    observation = env.get_observations()
    with torch.inference_mode():
        for _ in range(STEPS):
            observation, reward, done, extras = env.step(algorithm.act(observation))
            algorithm.process_env_step(observation, reward, done, extras)
        algorithm.compute_returns(observation)
    np.testing.assert_allclose(algorithm.storage.returns, value, rtol=1e-5)


@CASES
def test_torchrl(task, value):
    critic = ValueOperator(nn.Linear(16, 1))
    says(critic.module, value)
    data = TorchRlEnv(task, worlds=3).rollout(STEPS, break_when_any_done=False)
    GAE(gamma=GAMMA, lmbda=0.95, value_network=critic)(data)
    np.testing.assert_allclose(data["value_target"], value, rtol=1e-5)


def test_torchrl_with_agents():
    """Agent a gets a + 1 in every step, so the values are 10 and 20."""
    critic = ValueOperator(
        nn.Linear(7, 1), in_keys=[("agents", "observation")], out_keys=[("agents", "state_value")]
    )
    with torch.no_grad():
        critic.module.weight.copy_(torch.tensor([[0.0] * 6 + [10.0]]))
        critic.module.bias.fill_(10.0)
    data = TorchRlEnv(constant(time_limit=0.5), worlds=3).rollout(STEPS, break_when_any_done=False)
    for end in ("done", "terminated"):  # TorchRL expects the ends of a group beside its rewards
        shape = data["next", "agents", "reward"].shape
        data["next", "agents", end] = data["next", end].unsqueeze(-1).expand(shape)
    estimator = GAE(gamma=GAMMA, lmbda=0.95, value_network=critic)
    estimator.set_keys(
        **{key: ("agents", key) for key in ("reward", "done", "terminated", "advantage", "value_target")},
        value=("agents", "state_value"),
    )
    estimator(data)
    np.testing.assert_allclose(data["agents", "value_target"][..., 0, 0], 10.0, rtol=1e-5)
    np.testing.assert_allclose(data["agents", "value_target"][..., 1, 0], 20.0, rtol=1e-5)


def target(reward, value, done, after):
    """Return the textbook one-step target: the reward, plus the value of the next state unless the task ended."""
    return reward + GAMMA * value(after) * (1.0 - done)


def place(observation):
    """Return a value that distinguishes states: 10 plus a little of the goal's offset."""
    return 10.0 + observation[..., 0]


@CASES
def test_gymnasiums_batch(task, value):
    """The next state is `final_obs` where an episode ended: with it the target is V, without it another
    state's value."""
    batch, single = VectorEnv(3, task), Env(task)
    batch.reset(seed=1), single.reset(seed=1)
    for _ in range(5):
        observation, reward, terminated, truncated, info = batch.step(np.zeros((3, 6), np.float32))
        if (terminated | truncated).any():
            observation = np.stack(info["final_obs"])
        np.testing.assert_allclose(target(reward, lambda o: value, terminated, observation), value, rtol=1e-5)
        after, alone, over, _, _ = single.step(np.zeros(6, np.float32))
        np.testing.assert_array_equal(
            target(alone, place, over, after), target(reward, place, terminated, observation)[0]
        )
        if over:
            single.reset()


def test_pettingzoo():
    env = PettingZooEnv(constant(time_limit=0.5))
    env.reset()
    while env.agents:
        actions = {name: env.action_space(name).sample() for name in env.agents}
        after, rewards, terminated, truncated, _ = env.step(actions)
        for name, value in (("left", 10.0), ("right", 20.0)):
            assert target(
                rewards[name], lambda o, v=value: v, terminated[name], after[name]
            ) == pytest.approx(value)
    assert all(truncated.values())
