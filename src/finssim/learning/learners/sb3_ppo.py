"""PPO of Stable-Baselines3 on the batched environment."""

from __future__ import annotations

from typing import Any

import torch
from stable_baselines3 import PPO
from torch import nn

from finssim.learning.learners.on_policy import OnPolicySettings, fitted
from finssim.learning.learners.sb3_worlds import Sb3Learner, TalliedWorlds
from finssim.tasks import Environment, Task

__all__ = ["Sb3Ppo", "settings_for"]


def settings_for(task: Task, learner: str = "Sb3Ppo", **given: Any) -> OnPolicySettings:
    """The settings of a training; `given` as `on_policy.fitted` takes it."""
    return fitted(OnPolicySettings(), task, **given)


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
