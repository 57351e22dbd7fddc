"""PPO of Stable-Baselines3 on the batched environment."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from torch import nn

from finssim.learning.episodes import EpisodeTally
from finssim.learning.learners.base import ROLLOUT_SAMPLES, ActingLearner, OnPolicySettings
from finssim.learning.sb3 import Sb3VecEnv
from finssim.tasks import Environment


class TalliedWorlds(Sb3VecEnv):
    """Worlds in which some episodes end in every step, with statistics of each step."""

    def __init__(self, tally: EpisodeTally) -> None:
        """Adapt the environment of the statistics."""
        super().__init__(tally.environment, stagger=True)
        self.tally = tally

    def step_wait(
        self,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Return the step as every SB3 environment does, and count its episodes."""
        result = super().step_wait()
        self.tally.look()
        return result


class Sb3Ppo(ActingLearner):
    """SB3's PPO, one update at a time: its `learn` method without the loop.

    Several agents of a world are separate rows and share the network.
    """

    Settings = OnPolicySettings
    rollout_samples = ROLLOUT_SAMPLES
    settings: OnPolicySettings

    def __init__(
        self, environment: Environment, settings: OnPolicySettings, *, seed: int, device: str = "cpu"
    ) -> None:
        """Set up PPO and start its first episodes."""
        super().__init__(environment, settings)
        s = settings
        self.model: Any = PPO(
            "MlpPolicy",
            TalliedWorlds(self.tally),
            learning_rate=lambda remaining: s.learning_rate * max(remaining, 0.0),
            n_steps=s.rollout,
            batch_size=s.batch,
            n_epochs=s.epochs,
            gamma=s.discount,
            gae_lambda=s.gae_lambda,
            clip_range=s.clip,
            vf_coef=s.value_weight,
            max_grad_norm=s.largest_gradient,
            ent_coef=s.entropy_weight,
            policy_kwargs={"net_arch": list(s.hidden), "activation_fn": nn.ELU, "log_std_init": s.log_std},
            seed=seed,
            device=device,
        )
        self.model.set_logger(Logger(None, []))  # a logger that only collects values
        _, callback = self.model._setup_learn(s.steps * environment.agents)
        self.callback: BaseCallback = callback

    def update(self) -> dict[str, float]:
        """Run one rollout, and `epochs` passes over it.

        The result is a row of the training curve, in the units of the curve.
        """
        m = self.model
        m.collect_rollouts(m.env, self.callback, m.rollout_buffer, n_rollout_steps=m.n_steps)
        self._count()
        m.train()
        names = "value_loss", "policy_gradient_loss", "approx_kl", "clip_fraction", "explained_variance"
        logged = {name: float(m.logger.name_to_value.get(f"train/{name}", 0.0)) for name in names}
        m.logger.name_to_value.clear()
        return {**self.tally.row(), "action_std": torch.exp(m.policy.log_std).mean().item(), **logged}

    def _count(self) -> None:
        """Update the number of steps and the remaining fraction of the training."""
        self.steps = self.model.num_timesteps // self.environment.agents
        self.model._update_current_progress_remaining(self.steps, self.settings.steps)

    def network(self) -> nn.Module:
        """Return the map from observation to mean action, as a plain stack of layers."""
        policy: Any = self.model.policy
        return nn.Sequential(policy.mlp_extractor.policy_net, policy.action_net)

    def learned(self) -> dict[str, Any]:
        """Return parameters, optimiser and counters."""
        m = self.model
        return {
            "policy": m.policy.state_dict(),
            "optimizer": m.policy.optimizer.state_dict(),
            "timesteps": m.num_timesteps,
            "updates": m._n_updates,
            "observation": m._last_obs,
            "starts": m._last_episode_starts,
        }

    def load_learned(self, state: dict[str, Any]) -> None:
        """Restore the state that `learned` returned."""
        m = self.model
        m.policy.load_state_dict(state["policy"])
        m.policy.optimizer.load_state_dict(state["optimizer"])
        m.num_timesteps, m._n_updates = int(state["timesteps"]), int(state["updates"])
        m._last_obs, m._last_episode_starts = state["observation"], state["starts"]
        self._count()
