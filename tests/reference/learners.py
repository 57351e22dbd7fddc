"""Small learners of the libraries, for tests of what the environments tell them."""

import torch
from skrl.agents.torch.ppo import PPO
from skrl.memories.torch import RandomMemory
from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
from skrl.multi_agents.torch.mappo import MAPPO
from torch import nn

from finssim.learning.skrl_env import bootstrapping

QUIET = {
    "experiment": {"write_interval": 0, "checkpoint_interval": 0},
    "learning_epochs": 1,
    "mini_batches": 1,
}


class Policy(GaussianMixin, Model):
    def __init__(self, observations, states, actions):
        Model.__init__(
            self, observation_space=observations, state_space=states, action_space=actions, device="cpu"
        )
        GaussianMixin.__init__(self)
        self.net = nn.Linear(self.num_observations, self.num_actions)
        self.log_std = nn.Parameter(torch.zeros(self.num_actions))

    def compute(self, inputs, role):
        return self.net(inputs["observations"]), {"log_std": self.log_std}


class Value(DeterministicMixin, Model):
    """Of the state where there is one, else of the observation."""

    def __init__(self, observations, states, actions):
        Model.__init__(
            self, observation_space=observations, state_space=states, action_space=actions, device="cpu"
        )
        DeterministicMixin.__init__(self)
        self.net = nn.Linear(self.num_states or self.num_observations, 1)

    def compute(self, inputs, role):
        seen = inputs["observations"] if inputs.get("states") is None else inputs["states"]
        return self.net(seen), {}


def ppo(env, **settings):
    """A PPO agent with bootstrapping at time limits."""
    spaces = env.observation_space, env.state_space, env.action_space
    return bootstrapping(PPO)(
        models={"policy": Policy(*spaces), "value": Value(*spaces)},
        memory=RandomMemory(memory_size=settings.get("rollouts", 4), num_envs=env.num_envs, device="cpu"),
        observation_space=spaces[0],
        state_space=spaces[1],
        action_space=spaces[2],
        device="cpu",
        cfg={"rollouts": 4, "time_limit_bootstrap": True, **QUIET, **settings},
    )


def mappo(env, **settings):
    """A MAPPO agent of skrl with bootstrapping at time limits."""
    names = env.possible_agents
    # skrl takes an empty dictionary for one that has forgotten the agents.
    empty = {
        f"{what}_kwargs": {name: {} for name in names}
        for what in (
            "learning_rate_scheduler",
            "observation_preprocessor",
            "state_preprocessor",
            "value_preprocessor",
        )
    }
    spaces = {n: (env.observation_spaces[n], env.state_spaces[n], env.action_spaces[n]) for n in names}
    return bootstrapping(MAPPO)(
        possible_agents=names,
        models={n: {"policy": Policy(*spaces[n]), "value": Value(*spaces[n])} for n in names},
        memories={
            n: RandomMemory(memory_size=settings.get("rollouts", 4), num_envs=env.num_envs, device="cpu")
            for n in names
        },
        observation_spaces=env.observation_spaces,
        state_spaces=env.state_spaces,
        action_spaces=env.action_spaces,
        device="cpu",
        cfg={"rollouts": 4, "time_limit_bootstrap": True, **QUIET, **empty, **settings},
    )


def rsl_rl_settings(steps=4, gamma=0.9, rate=1e-3):
    """What RSL-RL's runner needs to know."""
    model = {"class_name": "MLPModel", "hidden_dims": [8], "activation": "elu"}
    noise = {"class_name": "GaussianDistribution", "init_std": 0.5, "std_type": "log"}
    return {
        "num_steps_per_env": steps,
        "save_interval": 100,
        "obs_groups": {"actor": ["policy"], "critic": ["critic"]},
        "actor": {**model, "distribution_cfg": noise},
        "critic": model,
        "algorithm": {
            "class_name": "PPO",
            "gamma": gamma,
            "learning_rate": rate,
            "schedule": "fixed",
            "num_learning_epochs": 1,
            "num_mini_batches": 1,
        },
    }
