"""PPO of skrl learns to hold a pose, in some ten seconds."""

import torch
from skrl.agents.torch.ppo import PPO
from skrl.memories.torch import RandomMemory
from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
from skrl.resources.schedulers.torch import KLAdaptiveLR
from skrl.trainers.torch import SequentialTrainer
from skrl.utils import set_seed
from torch import nn

from finssim.learning import SkrlEnv, bootstrapping

set_seed(1)
torch.set_num_threads(1)  # a second thread gains nothing on so small a network
ROLLOUTS, STEPS, WORLDS = 60, 32, 256
worlds = SkrlEnv("t1", worlds=WORLDS, vehicle="finsrov", seed=1, stagger=True)
spaces = {"observation_space": worlds.observation_space, "action_space": worlds.action_space, "device": "cpu"}


def layers(inputs: int, outputs: int) -> nn.Sequential:
    """A small network."""
    return nn.Sequential(nn.Linear(inputs, 64), nn.ELU(), nn.Linear(64, 64), nn.ELU(), nn.Linear(64, outputs))


class Policy(GaussianMixin, Model):
    """Mean from the observation, one standard deviation for all of them."""

    def __init__(self) -> None:
        Model.__init__(self, **spaces)
        GaussianMixin.__init__(self)
        self.mean = layers(self.num_observations, self.num_actions)
        self.log_std = nn.Parameter(torch.full((self.num_actions,), -1.0))

    def compute(self, inputs: dict, role: str) -> tuple[torch.Tensor, dict]:
        return self.mean(inputs["observations"]), {"log_std": self.log_std}


class Value(DeterministicMixin, Model):
    """Estimate the value of an observation."""

    def __init__(self) -> None:
        Model.__init__(self, **spaces)
        DeterministicMixin.__init__(self)
        self.value = layers(self.num_observations, 1)

    def compute(self, inputs: dict, role: str) -> tuple[torch.Tensor, dict]:
        return self.value(inputs["observations"]), {}


agent = bootstrapping(PPO)(  # with the last observation of an episode where time ended it
    models={"policy": Policy(), "value": Value()},
    memory=RandomMemory(memory_size=STEPS, num_envs=WORLDS, device="cpu"),
    cfg={
        "rollouts": STEPS,
        "learning_epochs": 5,
        "mini_batches": 4,
        "discount_factor": 0.98,
        "learning_rate": 1e-3,
        "learning_rate_scheduler": KLAdaptiveLR,
        "learning_rate_scheduler_kwargs": {"kl_threshold": 0.02},
        "value_loss_scale": 0.5,
        "value_clip": 0.0,
        "time_limit_bootstrap": True,
        "experiment": {"write_interval": 0, "checkpoint_interval": 0},
    },
    **spaces,
)


def held() -> float:
    """Share of 64 new episodes that end with the pose held for ten seconds, without action noise."""
    trial = SkrlEnv("t1", worlds=64, vehicle="finsrov", seed=2)
    observation, _ = trial.reset()
    with torch.no_grad():
        for _ in range(200):
            observation, *_ = trial.step(agent.policy.mean(observation))
    return trial.environment.task.metrics(trial.environment.arrays)["success"].mean()


before = held()
quiet = {"timesteps": ROLLOUTS * STEPS, "disable_progressbar": True, "close_environment_at_exit": False}
SequentialTrainer(env=worlds, agents=agent, cfg=quiet).train()
print(f"held before: {before:.0%}, after {ROLLOUTS * STEPS * WORLDS:,} control steps: {held():.0%}")
