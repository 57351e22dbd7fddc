"""PPO of TorchRL on the batched environment: for one agent, and for several that share a network (IPPO, MAPPO).

It uses TorchRL's losses and its generalised advantage, with FinsSim's own rollout on the environment's memory:
TorchRL's collectors copy every step several times.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import IndependentNormal, ProbabilisticActor
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.multiagent import IPPOLoss, MAPPOLoss
from torchrl.objectives.value.functional import vec_generalized_advantage_estimate

from finssim.learning.adapter import age_episodes
from finssim.learning.learners.base import ROLLOUT_SAMPLES, ActingLearner, OnPolicySettings
from finssim.learning.tensors import Tensors
from finssim.learning.torch_networks import stack
from finssim.tasks import Environment


@dataclass(frozen=True, kw_only=True)
class TorchRlSettings(OnPolicySettings):
    """Settings of PPO."""


class Head(nn.Module):
    """Mean and standard deviation of the action; the latter does not depend on the observation."""

    def __init__(self, mean: nn.Module, size: int, log_std: float) -> None:
        super().__init__()
        self.mean, self.log_std = mean, nn.Parameter(torch.full((size,), log_std))

    def forward(self, observation: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the mean of the action for each observation, and its standard deviation."""
        mean = self.mean(observation)
        return mean, self.log_std.exp().expand_as(mean)


class OwnValue(nn.Module):
    """Value of an agent's own observation, (..., agents, size) to (..., agents, 1)."""

    def __init__(self, environment: Environment, hidden: tuple[int, ...]) -> None:
        super().__init__()
        self.value = stack(environment.observation_size, hidden, 1, 1.0)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """Return the value of each observation, a sum of rewards."""
        value: torch.Tensor = self.value(observation)
        return value


class TeamValue(nn.Module):
    """Value for each agent from the concatenated observations of all agents and the agent's index."""

    def __init__(self, environment: Environment, hidden: tuple[int, ...]) -> None:
        super().__init__()
        n = environment.agents
        self.register_buffer("who", torch.eye(n))
        self.value = stack(n * environment.observation_size + n, hidden, 1, 1.0)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """Return the value of each observation, a sum of rewards."""
        *batch, n, size = observation.shape
        everyone = observation.reshape(*batch, 1, n * size).expand(*batch, n, n * size)
        value: torch.Tensor = self.value(torch.cat([everyone, self.who.expand(*batch, n, n)], dim=-1))
        return value


class TorchRlPpo(ActingLearner):
    """PPO of one agent. Tensors are (worlds, agents, size), or (time, worlds, agents, size)."""

    Settings = TorchRlSettings
    rollout_samples = ROLLOUT_SAMPLES
    settings: TorchRlSettings
    value = OwnValue
    """Network of the critic."""

    def __init__(
        self, environment: Environment, settings: TorchRlSettings, *, seed: int, device: str = "cpu"
    ) -> None:
        """Set up networks, loss and optimiser, and age the first episodes."""
        super().__init__(environment, settings)
        torch.manual_seed(seed)
        age_episodes(environment)
        self._worlds = Tensors(environment)
        mean = stack(environment.observation_size, settings.hidden, environment.action_size, 0.01)
        self.actor = Head(mean, environment.action_size, settings.log_std).to(device)
        self.critic = self.value(environment, settings.hidden).to(device)
        self.loss = self._loss(
            ProbabilisticActor(
                TensorDictModule(self.actor, in_keys=["observation"], out_keys=["loc", "scale"]),
                in_keys=["loc", "scale"],
                distribution_class=IndependentNormal,
                return_log_prob=True,
            ),
            TensorDictModule(self.critic, in_keys=["observation"], out_keys=["state_value"]),
            clip_epsilon=settings.clip,
            entropy_bonus=settings.entropy_weight > 0.0,
            entropy_coeff=settings.entropy_weight,
            critic_coeff=settings.value_weight,
            loss_critic_type="l2",
            log_explained_variance=False,
        )
        self._parameters = [*self.actor.parameters(), *self.critic.parameters()]
        self.optimizer = torch.optim.Adam(self._parameters, lr=settings.learning_rate, eps=1e-5)

    def _loss(self, actor: Any, critic: Any, **options: Any) -> Any:
        return ClipPPOLoss(
            actor, critic, normalize_advantage=True, normalize_advantage_exclude_dims=(-2,), **options
        )

    def update(self) -> dict[str, float]:
        """Run one rollout, and `epochs` passes over it.

        The result is a row of the training curve, in the units of the curve.
        """
        with torch.no_grad():
            samples = self._rollout()
        self.steps += self.environment.worlds * self.settings.rollout
        for group in self.optimizer.param_groups:
            group["lr"] = self.settings.learning_rate * self.remaining
        losses = [self._learn(batch) for _ in range(self.settings.epochs) for batch in self._batches(samples)]
        policy, value = torch.stack(losses).mean(dim=0).tolist()
        row = {"action_std": self.actor.log_std.exp().mean().item(), "value_loss": value}
        return {**self.tally.row(), **row, "policy_gradient_loss": policy}

    def _rollout(self) -> TensorDict:
        """Act for `rollout` control steps; return samples (rollout * worlds, agents, ...)."""
        w, s, observations = self._worlds, self.settings, []
        actions, rewards, ends, kills, lasts = [], [], [], [], []
        for _ in range(s.rollout):
            observations.append(w.observation.clone())
            mean, std = self.actor(observations[-1])
            actions.append(mean + std * torch.randn_like(mean))
            terminated, truncated = w.step(actions[-1])
            self.tally.look()
            rewards.append(w.reward.clone())
            ends.append(terminated | truncated)
            kills.append(terminated)
            lasts.append(w.final_observation[ends[-1]])  # indexing by a mask copies
        observation, action = torch.stack(observations), torch.stack(actions)
        value = self.critic(observation)
        after = torch.cat([value[1:], self.critic(w.observation)[None]])
        done = torch.stack(ends)
        # At the end of an episode, the next value is that of its own last observation, not of the next episode's first.
        after[done] = self.critic(torch.cat(lasts))
        advantage, target = self._advantage(value, after, torch.stack(rewards), done, torch.stack(kills))
        loc, scale = self.actor(observation)
        log_prob = IndependentNormal(loc, scale).log_prob(action)
        keys = self.loss.tensor_keys
        parts = {
            "observation": observation, keys.action: action, keys.sample_log_prob: log_prob,
            keys.advantage: advantage, keys.value_target: target,
        }  # fmt: skip
        return TensorDict(
            {k: v.flatten(0, 1) for k, v in parts.items()}, [s.rollout * self.environment.worlds]
        )

    def _advantage(
        self,
        value: torch.Tensor,
        after: torch.Tensor,
        reward: torch.Tensor,
        done: torch.Tensor,
        killed: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return advantages and value targets, (time, worlds, agents, 1), from values of that shape."""
        s = self.settings

        def time_last(x: torch.Tensor) -> torch.Tensor:
            full = x.reshape(*x.shape[:2], -1, 1).expand_as(value)
            return full.movedim(0, -2).contiguous()

        estimates = vec_generalized_advantage_estimate(
            s.discount, s.gae_lambda, *(time_last(x) for x in (value, after, reward, done, killed))
        )
        advantage, target = (x.movedim(-2, 0) for x in estimates)
        return advantage, target

    def _batches(self, samples: TensorDict) -> Any:
        count = max(1, len(samples) * self.environment.agents // self.settings.batch)
        for index in torch.randperm(len(samples)).tensor_split(count):
            yield samples[index.to(samples["observation"].device)]

    def _learn(self, batch: TensorDict) -> torch.Tensor:
        """Make one gradient step; return the losses of policy and value."""
        losses = self.loss(batch)
        parts = [losses[f"loss_{name}"] for name in ("objective", "critic")]
        extra = losses["loss_entropy"] if self.settings.entropy_weight > 0.0 else 0.0
        self.optimizer.zero_grad()
        (parts[0] + parts[1] + extra).backward()
        nn.utils.clip_grad_norm_(self._parameters, self.settings.largest_gradient)
        self.optimizer.step()
        return torch.stack([part.detach() for part in parts])

    def network(self) -> nn.Module:
        """Return the map from one agent's observation to its mean action, as a plain stack of layers."""
        return self.actor.mean

    def learned(self) -> dict[str, Any]:
        """Return networks and optimiser."""
        parts = {"actor": self.actor, "critic": self.critic, "optimizer": self.optimizer}
        return {name: part.state_dict() for name, part in parts.items()}

    def load_learned(self, state: dict[str, Any]) -> None:
        """Restore the state that `learned` returned."""
        self.actor.load_state_dict(state["actor"])
        self.critic.load_state_dict(state["critic"])
        self.optimizer.load_state_dict(state["optimizer"])


class TorchRlIppo(TorchRlPpo):
    """PPO of several agents with a shared network; each value depends on the agent's own observation (de Witt et
    al. 2020)."""

    def _loss(self, actor: Any, critic: Any, **options: Any) -> Any:
        return IPPOLoss(actor, critic, **options)


class TorchRlMappo(TorchRlPpo):
    """PPO of several agents with a shared network; values depend on all agents' observations (Yu et al. 2022)."""

    value = TeamValue

    def _loss(self, actor: Any, critic: Any, **options: Any) -> Any:
        return MAPPOLoss(actor, critic, **options)
