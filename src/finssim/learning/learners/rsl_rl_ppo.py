"""PPO of RSL-RL on the batched environment, with a critic that observes the plant's parameters if they are
randomised."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict
from torch import nn

from finssim.learning.adapter import age_episodes
from finssim.learning.learners.base import ROLLOUT_SAMPLES, ActingLearner, OnPolicySettings
from finssim.learning.tensors import Tensors
from finssim.learning.torch_networks import stack
from finssim.tasks import Environment


@dataclass(frozen=True, kw_only=True)
class RslRlSettings(OnPolicySettings):
    """Settings of PPO. RSL-RL clips the gradients of policy and value separately."""

    value_weight: float = 1.0
    """Weight of the value's error; policy and value share no weights, so it only scales the value's learning rate."""
    clip_values: bool = False
    """True to limit changes of the values by `clip`; values here are of the order of tens, and would take long to
    reach."""
    asymmetric: bool = True
    """True if the critic observes the randomised parameters of vehicle and water, if the environment provides them."""


class RslRlPpo(ActingLearner):
    """PPO; several agents of a world are separate rows and share the networks."""

    Settings = RslRlSettings
    rollout_samples = ROLLOUT_SAMPLES
    settings: RslRlSettings

    def __init__(
        self, environment: Environment, settings: RslRlSettings, *, seed: int, device: str = "cpu"
    ) -> None:
        """Set up PPO and age the first episodes."""
        super().__init__(environment, settings)
        torch.manual_seed(seed)
        age_episodes(environment)
        self._worlds = Tensors(environment)
        self._rows = environment.worlds * environment.agents
        groups_now = self._observe()
        groups = {"actor": ["policy"], "critic": list(groups_now.keys())}
        noise = {
            "class_name": "GaussianDistribution",
            "std_type": "log",  # a step of the optimiser cannot make it zero
            "init_std": float(torch.tensor(settings.log_std).exp()),
        }
        sizes = {"hidden_dims": list(settings.hidden), "activation": "elu"}
        actor = MLPModel(
            groups_now, groups, "actor", environment.action_size, distribution_cfg=noise, **sizes
        )
        critic = MLPModel(groups_now, groups, "critic", 1, **sizes)
        _begin(actor.mlp, 0.01)
        _begin(critic.mlp, 1.0)
        storage = RolloutStorage(
            "rl", self._rows, settings.rollout, groups_now, [environment.action_size], device
        )
        self.ppo = PPO(
            actor,
            critic,
            storage,
            num_learning_epochs=settings.epochs,
            num_mini_batches=max(1, self._rows * settings.rollout // settings.batch),
            clip_param=settings.clip,
            gamma=settings.discount,
            lam=settings.gae_lambda,
            value_loss_coef=settings.value_weight,
            entropy_coef=settings.entropy_weight,
            learning_rate=settings.learning_rate,
            max_grad_norm=settings.largest_gradient,
            use_clipped_value_loss=settings.clip_values,
            schedule="fixed",  # the rate is set before each update, and decreases linearly to zero
            normalize_advantage_per_mini_batch=True,
            device=device,
        )

    def update(self) -> dict[str, float]:
        """Run one rollout, and `epochs` passes over it.

        The result is a row of the training curve, in the units of the curve.
        """
        self.ppo.train_mode()
        groups = self._observe()
        with torch.inference_mode():
            for _ in range(self.settings.rollout):
                action = self.ppo.act(groups)
                terminated, truncated = self._worlds.step(action)
                self.tally.look()
                groups = self._observe()
                reward = self._worlds.reward.flatten().clone()
                self._add_last_values(reward, truncated & ~terminated)
                self.ppo.process_env_step(groups, reward, self._by_row(terminated | truncated), {})
            self.ppo.compute_returns(groups)
        self.steps += self.environment.worlds * self.settings.rollout
        self._set_rate(self.settings.learning_rate * self.remaining)
        losses = self.ppo.update()
        row = {"value_loss": losses["value"], "policy_gradient_loss": losses["surrogate"]}
        return {**self.tally.row(), "action_std": self.ppo.actor.output_std.mean().item(), **row}

    def network(self) -> nn.Module:
        """Return the map from observation to mean action, as a plain stack of layers."""
        return nn.Sequential(*self.ppo.actor.mlp)

    def learned(self) -> dict[str, Any]:
        """Return networks and optimiser."""
        saved: dict[str, Any] = self.ppo.save()
        return saved

    def load_learned(self, state: dict[str, Any]) -> None:
        """Restore the state that `learned` returned."""
        self.ppo.load(state, None, True)

    def _observe(self, final: bool = False) -> TensorDict:
        """Return copies of the current observations of actor and critic, or of the last ones of finished episodes."""
        e, w = self.environment, self._worlds
        groups = {"policy": (w.final_observation if final else w.observation).reshape(self._rows, -1).clone()}
        privileged = privileged_rows(e, "final_privileged" if final else "privileged")
        if privileged is not None and self.settings.asymmetric:
            groups["privileged"] = privileged.clone()
        return TensorDict(groups, batch_size=[self._rows])

    def _add_last_values(self, reward: torch.Tensor, timed_out: torch.Tensor) -> None:
        """Add the discounted value of an episode's last observation to the reward if the time limit ended the episode.

        RSL-RL itself would use the value of the previous observation.
        """
        rows = self._by_row(timed_out).nonzero().flatten()
        if len(rows):
            reward[rows] += (
                self.settings.discount * self.ppo.critic(self._observe(final=True)[rows]).flatten()
            )

    def _by_row(self, worlds: torch.Tensor) -> torch.Tensor:
        return worlds.repeat_interleave(self.environment.agents)

    def _set_rate(self, rate: float) -> None:
        self.ppo.learning_rate = rate
        for group in self.ppo.optimizer.param_groups:
            group["lr"] = rate


def _begin(mlp: Any, last_gain: float) -> None:
    """Set the initial weights of a network of RSL-RL to those of the other learners."""
    linear = [layer for layer in mlp if isinstance(layer, nn.Linear)]
    sizes = [layer.out_features for layer in linear]
    model = stack(linear[0].in_features, sizes[:-1], sizes[-1], last_gain)
    for ours, theirs in zip((x for x in model if isinstance(x, nn.Linear)), linear, strict=True):
        theirs.load_state_dict(ours.state_dict())


def privileged_rows(environment: Environment, name: str = "privileged") -> torch.Tensor | None:
    """Return the privileged observations of a critic, one row per agent; None if there are none.

    They are a view of the environment's memory.

    Args:
        environment: The worlds.
        name: `privileged`, or `final_privileged` for the previous episode, where one ended in this step.
    """
    array = getattr(environment.arrays, name, None)
    if array is None or not array.size:
        return None
    tensor: torch.Tensor = wp.to_torch(array)
    return tensor.view(environment.worlds * environment.agents, -1)
