"""The skrl environments: skrl's trainer takes every task, ends are right, and values come from last observations."""

import numpy as np
import pytest
import torch
from skrl.trainers.torch import SequentialTrainer

from finssim.learning.skrl_env import SkrlEnv, SkrlTeamEnv
from finssim.tasks import StationKeeping, make, numeric_tasks
from reference.learners import mappo, ppo
from reference.pair import Pair

NUMERIC = numeric_tasks()

SHORT = StationKeeping(time_limit=0.5)


def train(env, agent, steps):
    cfg = {"timesteps": steps, "disable_progressbar": True, "close_environment_at_exit": False}
    SequentialTrainer(env=env, agents=agent, cfg=cfg).train()


@pytest.mark.parametrize("task", [*NUMERIC, Pair()], ids=[*NUMERIC, "pair"])
def test_the_trainer_trains_on_every_task(task):
    env = SkrlEnv(task, worlds=3)
    agent = ppo(env)
    before = agent.policy.net.weight.clone()
    train(env, agent, 8)
    assert not torch.equal(before, agent.policy.net.weight)


def test_a_team_is_trained_by_mappo():
    env = SkrlTeamEnv(Pair(time_limit=0.3), worlds=3, seed=1)
    agent = mappo(env)
    before = agent.policies["right"].net.weight.clone()
    train(env, agent, 8)
    assert not torch.equal(before, agent.policies["right"].net.weight)
    assert env.state()["left"].shape == (3, 14) and env.state_spaces["left"].shape == (14,)


def test_ends_and_last_observations_are_the_environments():
    env, plain = SkrlEnv(SHORT, worlds=4, seed=2), make(SHORT, worlds=4, seed=2)
    env.reset(), plain.reset()
    for k in range(5):
        observation, reward, terminated, truncated, infos = env.step(torch.full((4, 6), 0.1))
        step = plain.step(np.full((4, 6), 0.1, np.float32))
        assert not terminated.any() and truncated.flatten().tolist() == [k == 4] * 4
        np.testing.assert_array_equal(observation, step.observation)
        np.testing.assert_array_equal(reward[:, 0], step.reward)
        led_to = step.final_observation if k == 4 else step.observation
        np.testing.assert_array_equal(infos["final_observations"], led_to)
    assert infos["episode"]["length"] == 5.0


def test_a_value_comes_from_the_last_observation_not_from_the_next_episode():
    """Rewards in skrl's memory are ours, plus γ V(last observation) where time ended an episode."""
    env = SkrlEnv(SHORT, worlds=4, seed=3)
    agent = ppo(env, rollouts=100, discount_factor=0.9)
    agent.init(trainer_cfg=None)
    agent.enable_training_mode(True)
    observations, _ = env.reset()
    for k in range(5):
        with torch.no_grad():
            actions, _ = agent.act(observations, None, timestep=k, timesteps=5)
            after, rewards, terminated, truncated, infos = env.step(actions)
            kept = rewards.clone()
            agent.record_transition(
                observations=observations, states=None, actions=actions, rewards=rewards, next_observations=after,
                next_states=None, terminated=terminated, truncated=truncated, infos=infos, timestep=k, timesteps=5,
            )  # fmt: skip
            value = agent.value.net(infos["final_observations"])
        observations = after
    torch.testing.assert_close(agent.memory.get_tensor_by_name("rewards")[4], kept + 0.9 * value)
    assert not torch.allclose(value, agent.value.net(after))


def test_staggered_episodes_end_at_different_times():
    env = SkrlEnv(StationKeeping(time_limit=2.0), worlds=200, stagger=True)
    env.reset()
    for _ in range(20):
        assert 0 < env.step(torch.zeros(200, 6))[3].sum() < 60


def test_rows_and_dictionaries_are_the_same_worlds():
    """Row 2 w + a of `SkrlEnv` is row w of agent a of `SkrlTeamEnv`."""
    rows, team = SkrlEnv(Pair(), worlds=3, seed=2), SkrlTeamEnv(Pair(), worlds=3, seed=2)
    assert rows.num_envs == 6 and team.num_envs == 3 and team.num_agents == 2
    rows.reset(), team.reset()
    action = torch.rand(3, 2, 6)
    one = rows.step(action.flatten(0, 1))
    two = team.step({"left": action[:, 0], "right": action[:, 1]})
    for a, name in enumerate(("left", "right")):
        for flat, by_agent in zip(one[:4], two[:4], strict=True):
            assert torch.equal(flat.view(3, 2, -1)[:, a], by_agent[name])
