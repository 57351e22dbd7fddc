"""Arguments of adapters: a task with the arguments of `finssim.make`, or an environment."""

import numpy as np
import pytest

from finssim.learning.adapter import adapter_environment, age_episodes
from finssim.learning.gymnasium_env import Env
from finssim.learning.pettingzoo_env import PettingZooEnv
from finssim.learning.rsl_rl_env import RslRlVecEnv
from finssim.learning.sb3 import Sb3VecEnv
from finssim.learning.torchrl_env import TorchRlEnv
from finssim.tasks import EnvironmentSetupError, StationKeeping, make
from reference.pair import Pair


@pytest.mark.parametrize("adapter", [Env, PettingZooEnv, RslRlVecEnv, Sb3VecEnv, TorchRlEnv])
def test_every_adapter_takes_the_arguments_of_make(adapter):
    """Vehicle, hydrodynamics, action mode, ranges, measured state and seed reach the environment."""
    options = {"vehicle": "bluerov2_heavy", "hydrodynamics": "calibrated", "action": "wrench4", "seed": 4}
    environment = adapter("t2", randomize="hold_for_position", observe="estimator", **options).environment
    assert environment.task.name == "t2" and environment.action_mode == "wrench4" and environment.seed == 4
    assert environment.simulator.vehicles[0].name == "bluerov2_heavy"
    assert environment.noise.present and environment.randomization is not None


def test_an_environment_is_taken_as_it_is():
    environment = make("t1", worlds=2)
    assert adapter_environment(environment, {}) is environment
    with pytest.raises(EnvironmentSetupError, match="together with seed, worlds: give the environment alone"):
        adapter_environment(environment, {"worlds": 3, "seed": 1})
    with pytest.raises(EnvironmentSetupError, match="auto_reset=True, this adapter needs auto_reset=False"):
        adapter_environment(environment, {}, auto_reset=False)
    with pytest.raises(EnvironmentSetupError, match="the adapter sets it"):
        adapter_environment("t1", {"auto_reset": False})


def test_several_agents_are_sent_to_the_libraries_that_take_them():
    with pytest.raises(EnvironmentSetupError, match="task 'pair' has 2 agents, Gymnasium supports one: use"):
        Env(Pair())


def test_aged_episodes_are_of_every_age():
    environment = make(StationKeeping(time_limit=2.0), worlds=500, seed=3)
    age_episodes(environment)
    ages = environment.simulator.state.steps.numpy()
    assert np.bincount(ages, minlength=20).shape == (20,) and np.bincount(ages).min() > 5
