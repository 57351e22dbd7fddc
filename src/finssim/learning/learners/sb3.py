"""PPO of Stable-Baselines3 on the batched environment."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from torch import nn

from finssim.learning.episodes import EpisodeTally
from finssim.learning.learners.base import ROLLOUT_SAMPLES, ActingLearner, OnPolicySettings
from finssim.learning.sb3 import Sb3VecEnv
from finssim.tasks import Environment

# What the learners of Stable-Baselines3 share: the worlds under a tally, and a logger that only collects.


class TalliedWorlds(Sb3VecEnv):
    """Worlds of which some episodes end in every step, and each step is tallied."""

    def __init__(self, tally: EpisodeTally) -> None:
        """Adapt the tally's environment."""
        super().__init__(tally.environment, stagger=True)
        self.tally = tally

    def step_wait(
        self,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """As every SB3 environment; and the tally looks."""
        result = super().step_wait()
        self.tally.look()
        return result


class Sb3Learner(ActingLearner):
    """One of SB3's algorithms, an update at a time: what its `learn` does, without its loop."""

    def start(self, model: Any) -> None:
        """Take the algorithm and start its first episodes."""
        self.model = model
        model.set_logger(Logger(None, []))
        _, callback = BaseAlgorithm._setup_learn(model, self.settings.steps * self.environment.agents)
        self.callback: BaseCallback = callback

    def counted(self) -> None:
        """Bring steps and the share of the training up to date."""
        self.steps = self.model.num_timesteps // self.environment.agents
        self.model._update_current_progress_remaining(self.steps, self.settings.steps)

    def losses(self, *names: str) -> dict[str, float]:
        """What the algorithm logged of its last update; 0 before the first."""
        logged = {name: float(self.model.logger.name_to_value.get(f"train/{name}", 0.0)) for name in names}
        self.model.logger.name_to_value.clear()
        return logged

    def learned(self) -> dict[str, Any]:
        """Parameters and counters; what else an algorithm has it adds."""
        m = self.model
        return {
            "policy": m.policy.state_dict(),
            "timesteps": m.num_timesteps,
            "updates": m._n_updates,
            "observation": m._last_obs,
            "starts": m._last_episode_starts,
        }

    def load_learned(self, state: dict[str, Any]) -> None:
        """Take what `learned` gave."""
        m = self.model
        m.policy.load_state_dict(state["policy"])
        m.num_timesteps, m._n_updates = int(state["timesteps"]), int(state["updates"])
        m._last_obs, m._last_episode_starts = state["observation"], state["starts"]
        self.counted()


# PPO of Stable-Baselines3 on the batched environment.


def ppo_arguments(settings: OnPolicySettings) -> dict[str, Any]:
    """The settings as SB3's PPO takes them."""
    return {
        "learning_rate": lambda left: settings.learning_rate * max(left, 0.0),
        "n_steps": settings.rollout,
        "batch_size": settings.batch,
        "n_epochs": settings.epochs,
        "gamma": settings.discount,
        "gae_lambda": settings.gae_lambda,
        "clip_range": settings.clip,
        "vf_coef": settings.value_weight,
        "max_grad_norm": settings.largest_gradient,
        "ent_coef": settings.entropy_weight,
    }


class Sb3Ppo(Sb3Learner):
    """PPO; several agents of a world are rows of their own and share the network."""

    Settings = OnPolicySettings
    rollout_samples = ROLLOUT_SAMPLES
    settings: OnPolicySettings
    algorithm: Any = PPO
    policy = "MlpPolicy"

    def __init__(
        self, environment: Environment, settings: OnPolicySettings, *, seed: int, device: str = "cpu"
    ) -> None:
        """Set up PPO and start its first episodes."""
        super().__init__(environment, settings)
        arguments = {**ppo_arguments(settings), "policy_kwargs": self.policy_arguments()}
        self.start(
            self.algorithm(self.policy, TalliedWorlds(self.tally), seed=seed, device=device, **arguments)
        )

    def policy_arguments(self) -> dict[str, Any]:
        """The networks' settings as SB3 takes them."""
        s = self.settings
        return {"net_arch": list(s.hidden), "activation_fn": nn.ELU, "log_std_init": s.log_std}

    def update(self) -> dict[str, float]:
        """One rollout, and `epochs` passes over it."""
        m = self.model
        m.collect_rollouts(m.env, self.callback, m.rollout_buffer, n_rollout_steps=m.n_steps)
        self.counted()
        m.train()
        losses = self.losses(
            "value_loss", "policy_gradient_loss", "approx_kl", "clip_fraction", "explained_variance"
        )
        return {**self.tally.row(), "action_std": torch.exp(m.policy.log_std).mean().item(), **losses}

    def network(self) -> nn.Module:
        """Observation to mean action, as a plain stack of layers."""
        policy: Any = self.model.policy
        return nn.Sequential(policy.mlp_extractor.policy_net, policy.action_net)

    def learned(self) -> dict[str, Any]:
        """And the optimiser."""
        return {**super().learned(), "optimizer": self.model.policy.optimizer.state_dict()}

    def load_learned(self, state: dict[str, Any]) -> None:
        """And the optimiser."""
        super().load_learned(state)
        self.model.policy.optimizer.load_state_dict(state["optimizer"])
