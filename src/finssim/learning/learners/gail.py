"""GAIL (Ho and Ermon 2016): PPO whose reward is how well it passes for the expert, as a discriminator judges it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import nn

from finssim.learning.learners.imitation import demonstrations_for
from finssim.learning.learners.torchrl_ppo import TorchRlPpo, TorchRlSettings
from finssim.learning.tensors import Tensors
from finssim.learning.torch_networks import stack
from finssim.tasks import Environment


@dataclass(frozen=True, kw_only=True)
class GailSettings(TorchRlSettings):
    """As PPO's, and those of the discriminator."""

    demonstrations: str = ""
    """Folder of a data set, from `finssim collect`."""
    learning_rate: float = 3.0e-4
    """Less than PPO's: the reward is another one after every round."""
    log_std: float = -2.0
    """Less noise than PPO's: the discriminator knows the learner by it, whatever else it does."""
    clone_passes: int = 100
    """Passes of behaviour cloning over the demonstrations before the first rollout; 0: begin from nothing."""
    discriminator_batch: int = 256
    """Demonstrated steps in one of its gradient steps, and as many of the learner's."""
    discriminator_updates: int = 4
    """Of its gradient steps in a round: many more, and nothing passes any more, so that nothing is learnt."""
    discriminator_rate: float = 3.0e-4
    discriminator_hidden: tuple[int, ...] = (64, 64)
    gradient_penalty: float = 1.0
    """Weight of its squared slope at the demonstrations (Mescheder et al. 2018): the reward must not become a cliff."""


class Discriminator(nn.Module):
    """Logit of an observation and an action being the expert's."""

    def __init__(self, example: torch.Tensor, hidden: tuple[int, ...]) -> None:
        """Scale inputs by what the expert has shown, (N, n + m)."""
        super().__init__()
        self.register_buffer("mean", example.mean(dim=0))
        self.register_buffer("scale", example.std(dim=0).clamp_min(1.0e-3))
        self.logit = stack(example.shape[1], hidden, 1, 1.0)

    def forward(self, pair: torch.Tensor) -> torch.Tensor:
        logit: torch.Tensor = self.logit(((pair - self.mean) / self.scale).clamp(-10.0, 10.0)).squeeze(-1)
        return logit


class JudgedTensors(Tensors):
    """The environment's tensors with the discriminator's reward, -log(1 - D), in place of the task's."""

    def __init__(self, environment: Environment, judge: Discriminator) -> None:
        super().__init__(environment)
        self._judge = judge
        self.pairs: list[torch.Tensor] = []
        """What the learner saw and did since this was emptied, (worlds * agents, n + m) each."""

    def step(self, action: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Act for one control step."""
        done = action.clamp(-1.0, 1.0)
        pair = torch.cat([self.observation, done.view(*self.observation.shape[:2], -1)], dim=-1)
        ends = super().step(action)
        with torch.no_grad():
            self.reward = nn.functional.softplus(self._judge(pair))
        self.pairs.append(pair.flatten(0, 1))
        return ends


class Gail(TorchRlPpo):
    """Generative adversarial imitation."""

    Settings = GailSettings
    rollout_samples = 0
    settings: GailSettings

    def __init__(
        self, environment: Environment, settings: GailSettings, *, seed: int, device: str = "cpu"
    ) -> None:
        """Load the demonstrations; set up generator and discriminator."""
        super().__init__(environment, settings, seed=seed, device=device)
        data = demonstrations_for(environment, settings.demonstrations)
        observation, action = (torch.from_numpy(x).to(device) for x in (data.observation, data.action))
        self._shown = torch.cat([observation, action], dim=-1)
        self.judge = Discriminator(self._shown, settings.discriminator_hidden).to(device)
        self._worlds = JudgedTensors(environment, self.judge)
        self.judge_optimizer = torch.optim.Adam(self.judge.parameters(), lr=settings.discriminator_rate)
        self._clone(observation, action)

    def _clone(self, observation: torch.Tensor, action: torch.Tensor) -> None:
        batch = self.settings.batch
        optimizer = torch.optim.Adam(self.actor.mean.parameters(), lr=1.0e-3)
        for _ in range(self.settings.clone_passes * max(1, len(observation) // batch)):
            index = torch.randint(len(observation), (batch,))
            loss = nn.functional.mse_loss(self.actor.mean(observation[index]), action[index])
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()

    def update(self) -> dict[str, float]:
        """A rollout judged as the discriminator is now, the policy's learning, then the discriminator's."""
        self._worlds.pairs.clear()
        row = super().update()
        done = torch.cat(self._worlds.pairs)
        losses = [self._discriminate(done) for _ in range(self.settings.discriminator_updates)]
        with torch.no_grad():
            passes = torch.sigmoid(self.judge(done)).mean()
        return {**row, "discriminator_loss": sum(losses) / len(losses), "passes_for_expert": float(passes)}

    def _discriminate(self, done: torch.Tensor) -> float:
        """One gradient step: the demonstrations as ones, the learner's own steps as zeros."""
        size = self.settings.discriminator_batch
        expert_rows = self._shown[torch.randint(len(self._shown), (size,))].requires_grad_()
        learner_rows = done[torch.randint(len(done), (size,))]
        yes, no = self.judge(expert_rows), self.judge(learner_rows)
        entropy = nn.functional.binary_cross_entropy_with_logits
        loss = entropy(yes, torch.ones_like(yes)) + entropy(no, torch.zeros_like(no))
        (slope,) = torch.autograd.grad(yes.sum(), expert_rows, create_graph=True)
        objective = (
            loss + 0.5 * self.settings.gradient_penalty * ((slope * self.judge.scale) ** 2).sum(dim=-1).mean()
        )
        self.judge_optimizer.zero_grad()
        objective.backward()
        self.judge_optimizer.step()
        return float(loss.detach())

    def learned(self) -> dict[str, Any]:
        """As PPO's, and the discriminator."""
        judge = {"judge": self.judge.state_dict(), "judge_optimizer": self.judge_optimizer.state_dict()}
        return {**super().learned(), **judge}

    def load_learned(self, state: dict[str, Any]) -> None:
        """Take what `learned` gave."""
        super().load_learned(state)
        self.judge.load_state_dict(state["judge"])
        self.judge_optimizer.load_state_dict(state["judge_optimizer"])
