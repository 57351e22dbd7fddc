"""The PettingZoo environment passes PettingZoo's tests, and ends the episode of all agents together."""

import numpy as np
import pytest
from pettingzoo.test import parallel_api_test, parallel_seed_test

from finssim.learning.pettingzoo_env import PettingZooEnv
from finssim.tasks import EnvironmentSetupError, StationKeeping
from reference.pair import KINDS, Pair


@pytest.mark.slow
@KINDS
@pytest.mark.filterwarnings("error")
def test_the_api_test_passes(task):
    parallel_api_test(PettingZooEnv(task))


@pytest.mark.slow
@KINDS
def test_the_seed_test_passes(task):
    parallel_seed_test(lambda: PettingZooEnv(task), num_cycles=50)


def actions(env, value=0.1):
    return {name: np.full(env.action_space(name).shape, value, np.float32) for name in env.possible_agents}


def test_agents_have_their_own_observations_actions_and_rewards():
    env = PettingZooEnv(Pair())
    observations, infos = env.reset(seed=3)
    assert env.agents == ["left", "right"] and infos == {"left": {}, "right": {}}
    assert [observations[name][6] for name in env.agents] == [0.0, 1.0]
    np.testing.assert_array_equal(env.state(), np.concatenate(list(observations.values())))
    assert env.state_space.contains(env.state())
    push = {"left": np.array([1, 0, 0, 0, 0, 0], np.float32), "right": np.zeros(6, np.float32)}
    for _ in range(5):
        observations, rewards, *_ = env.step(push)
    assert observations["left"][3] > 0.1 > abs(observations["right"][3])
    assert rewards == dict(zip(env.agents, env.environment.arrays.agent_reward.numpy()[0], strict=True))


def test_time_truncates_all_agents_with_their_last_observations():
    env = PettingZooEnv(Pair(time_limit=0.3))
    env.reset(seed=1)
    for _ in range(3):
        observations, _, terminated, truncated, infos = env.step(actions(env))
    assert truncated == {"left": True, "right": True} and terminated == {"left": False, "right": False}
    assert env.agents == [] and infos["right"]["episode"]["length"] == 3.0
    final = env.environment.arrays.final_observation.numpy()[0].reshape(2, 7)
    np.testing.assert_array_equal([observations["left"], observations["right"]], final)
    with pytest.raises(EnvironmentSetupError, match="call reset first"):
        env.step(actions(env))


def test_leaving_terminates():
    env = PettingZooEnv(StationKeeping(bounds=(0.0, 0.0)))
    env.reset()
    *_, terminated, truncated, _ = env.step(actions(env))
    assert terminated == {"vehicle": True} and truncated == {"vehicle": False}


def test_what_cannot_be_is_refused():
    with pytest.raises(EnvironmentSetupError, match="worlds is 2, expected 1: PettingZoo steps one world"):
        PettingZooEnv("t1", worlds=2)
    env = PettingZooEnv(Pair())
    env.reset()
    with pytest.raises(EnvironmentSetupError, match="no action for right"):
        env.step({"left": np.zeros(6, np.float32)})
