"""Imitation with torch: behaviour cloning from demonstrations, and DAgger, in which an expert labels the learner's
states."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
import warp as wp
from torch import nn

from finssim.agents.agent import NOWHERE
from finssim.agents.memory import memory_from, memory_leaves, restarted
from finssim.control.guidance import Known
from finssim.learning.adapter import age_episodes
from finssim.learning.demonstrations import Demonstrations, load
from finssim.learning.learners.base import ActingLearner, expert_in
from finssim.learning.learners.catalogue import LearningError
from finssim.learning.learners.distill import varied
from finssim.learning.tensors import Tensors
from finssim.learning.torch_networks import SeeingNetwork, stack
from finssim.tasks import Environment


@dataclass(frozen=True, kw_only=True)
class BcSettings:
    """Settings of behaviour cloning: regression of the expert's action on the observation."""

    demonstrations: str = ""
    """Folder of a data set, from `finssim collect`."""
    worlds: int = 32
    """Number of worlds in which the policy is evaluated during training; it does not learn from them."""
    steps: int = 4_000_000
    """Samples drawn from the demonstrations, summed over all passes."""
    rollout: int = 8192 * 8
    """Samples between two rows of the curve."""
    batch: int = 512
    learning_rate: float = 1.0e-3
    """Initial learning rate; it decreases linearly to zero."""
    weight_decay: float = 1.0e-5
    hidden: tuple[int, ...] = (64, 64)
    """Units of the hidden layers, ELU; for a task with pictures, those behind the encoder of `distill`."""
    colour: float = 0.3
    """Strength of the colour augmentation of pictures, as in `distill`."""


@dataclass(frozen=True, kw_only=True)
class DaggerSettings:
    """Settings of DAgger (Ross et al. 2011): the learner acts, and the expert labels its observations."""

    expert: str = "pid"
    """A baseline of the task by name, or a policy directory."""
    demonstrations: str = ""
    """Data set to begin with; none if empty."""
    worlds: int = 64
    steps: int = 300_000
    """Control steps, summed over all worlds."""
    rollout: int = 100
    """Control steps of each world between two rounds of learning."""
    expert_rounds: int = 2
    """Initial rounds in which the expert acts; after them the learner does."""
    kept: int = 500_000
    """Size of the sample buffer, with the newest samples."""
    passes: float = 2.0
    """Number of passes over the sample buffer in each round."""
    batch: int = 512
    learning_rate: float = 1.0e-3
    """Initial learning rate; it decreases linearly to zero."""
    weight_decay: float = 1.0e-5
    hidden: tuple[int, ...] = (64, 64)


def demonstrations_for(environment: Environment, folder: str) -> Demonstrations:
    """Load a data set that fits an environment.

    Raises:
        LearningError: No data set is named, or it is from another task, vehicle or action mode.
        DatasetError: It cannot be read.
    """
    if not folder:
        raise LearningError(
            "no demonstrations are named: collect some with finssim collect, and give --set demonstrations=DIR"
        )
    data = load(folder)
    vehicle, sight = environment.simulator.vehicles[0], environment.sight
    shapes = {name: list(x.shape[1:]) for name, x in sight.pictures.items()} if sight else {}
    for quantity, has, required in (
        ("task", data.about["task"], environment.task.name),
        ("action mode", data.about["action"]["mode"], environment.action_mode),
        ("vehicle", data.about["vehicle"]["sha256"], vehicle.sha256),
        ("observation", data.observation.shape[1], environment.observation_size),
        ("pictures", {k: list(x.shape[1:]) for k, x in data.pictures.items()}, shapes),
    ):
        if has != required:
            raise LearningError(
                f"{folder} is of {quantity} {has}, expected {required}: collect demonstrations for this training"
            )
    return data


class _Cloner(ActingLearner):
    """Common part of both learners: a network that is fitted to actions, and worlds in which it acts."""

    settings: Any

    def __init__(self, environment: Environment, settings: Any, *, seed: int, device: str = "cpu") -> None:
        super().__init__(environment, settings)
        torch.manual_seed(seed)
        age_episodes(environment)
        self.device = device
        self._worlds = Tensors(environment)
        n, m, sight = environment.observation_size, environment.action_size, environment.sight
        self._pictures = {name: wp.to_torch(x) for name, x in sight.pictures.items()} if sight else {}
        shapes = {name: tuple(x.shape[1:]) for name, x in self._pictures.items()}
        self.policy = (
            SeeingNetwork(n, shapes, m, hidden=settings.hidden)
            if sight
            else stack(n, settings.hidden, m, 0.01)
        ).to(device)
        self.optimizer = torch.optim.Adam(
            self.policy.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay
        )

    def _fit(
        self,
        observation: torch.Tensor,
        action: torch.Tensor,
        count: int,
        pictures: Mapping[str, torch.Tensor] = MappingProxyType({}),
    ) -> float:
        """Fit batches drawn with replacement; return the mean squared error over all of them."""
        for group in self.optimizer.param_groups:
            group["lr"] = self.settings.learning_rate * self.remaining
        total, rounds = 0.0, max(1, count // self.settings.batch)
        for _ in range(rounds):
            index = torch.randint(len(observation), (self.settings.batch,))
            views = {name: varied(x[index], self.settings.colour) for name, x in pictures.items()}
            loss = nn.functional.mse_loss(self.policy(observation[index], **views), action[index])
            self.optimizer.zero_grad()
            loss.backward()
            self.optimizer.step()
            total += float(loss.detach())
        return total / rounds

    def _drive(self, steps: int) -> None:
        with torch.no_grad():
            for _ in range(steps):
                observation = self._worlds.observation.to(self.device, copy=True)
                # Tasks with pictures have one agent.
                observation = observation[:, 0] if self._pictures else observation
                self._worlds.step(self.policy(observation, **self._pictures).clamp(-1.0, 1.0))
                self.tally.look()

    def network(self) -> nn.Module:
        """Return the map from one agent's observation to its action."""
        return self.policy

    def learned(self) -> dict[str, Any]:
        """Return network and optimiser."""
        return {"policy": self.policy.state_dict(), "optimizer": self.optimizer.state_dict()}

    def load_learned(self, state: dict[str, Any]) -> None:
        """Restore the state that `learned` returned."""
        self.policy.load_state_dict(state["policy"])
        self.optimizer.load_state_dict(state["optimizer"])


class Bc(_Cloner):
    """Behaviour cloning."""

    Settings = BcSettings
    settings: BcSettings

    def __init__(
        self, environment: Environment, settings: BcSettings, *, seed: int, device: str = "cpu"
    ) -> None:
        """Load the demonstrations and set up the network."""
        super().__init__(environment, settings, seed=seed, device=device)
        data = demonstrations_for(environment, settings.demonstrations)
        self._observation = torch.from_numpy(data.observation).to(device)
        self._action = torch.from_numpy(data.action).to(device)
        self._shown = {name: torch.from_numpy(x).to(device) for name, x in data.pictures.items()}

    def update(self) -> dict[str, float]:
        """Run one round of regression, then a few control steps for the statistics only.

        The result is a row of the training curve, in the units of the curve.
        """
        count = min(self.settings.rollout, self.settings.steps - self.steps)
        loss = self._fit(self._observation, self._action, count, self._shown)
        self.steps += max(count, 1)
        self._drive(10)
        return {**self.tally.row(), "imitation_loss": loss}


class Dagger(_Cloner):
    """Dataset aggregation."""

    Settings = DaggerSettings
    settings: DaggerSettings

    def __init__(
        self, environment: Environment, settings: DaggerSettings, *, seed: int, device: str = "cpu"
    ) -> None:
        """Load the expert and the initial demonstrations."""
        super().__init__(environment, settings, seed=seed, device=device)
        self._expert = expert_in(environment, settings.expert)
        rows = environment.worlds * environment.agents
        self._fresh = self._expert.reset(rows)
        self._memory = self._fresh
        self._rounds = 0
        n, m = environment.observation_size, environment.action_size
        self._observation, self._action = torch.empty(0, n), torch.empty(0, m)
        if settings.demonstrations:
            data = demonstrations_for(environment, settings.demonstrations)
            self._keep(torch.from_numpy(data.observation), torch.from_numpy(data.action))

    def _keep(self, observation: torch.Tensor, action: torch.Tensor) -> None:
        limit = self.settings.kept
        self._observation = torch.cat([self._observation, observation])[-limit:]
        self._action = torch.cat([self._action, action])[-limit:]

    def update(self) -> dict[str, float]:
        """Run one rollout, labelled by the expert, and regression on the sample buffer.

        The result is a row of the training curve, in the units of the curve.
        """
        with torch.no_grad():
            self._keep(*self._rollout())
        self._rounds += 1
        self.steps += self.environment.worlds * self.settings.rollout
        count = round(self.settings.passes * len(self._observation))
        loss = self._fit(self._observation.to(self.device), self._action.to(self.device), count)
        row = {"imitation_loss": loss, "kept": float(len(self._observation))}
        return {**self.tally.row(), **row}

    def _rollout(self) -> tuple[torch.Tensor, torch.Tensor]:
        observations, labels = [], []
        agents, expert_drives = self.environment.agents, self._rounds < self.settings.expert_rounds
        for _ in range(self.settings.rollout):
            rows = self._worlds.observation.flatten(0, 1).cpu().clone()
            action, self._memory = self._expert.act(self._memory, Known(rows.numpy()), NOWHERE)
            label = torch.from_numpy(np.clip(action, -1.0, 1.0).astype(np.float32))
            observations.append(rows)
            labels.append(label)
            done = label if expert_drives else self.policy(rows.to(self.device)).clamp(-1.0, 1.0)
            terminated, truncated = self._worlds.step(done.to(self._worlds.device))
            self.tally.look()
            ended = (terminated | truncated).cpu().numpy()
            if ended.any():
                mask = np.repeat(ended, agents)
                self._memory = restarted(self._memory, self._fresh, mask)
        return torch.cat(observations), torch.cat(labels)

    def learned(self) -> dict[str, Any]:
        """Return network, optimiser, sample buffer, and the expert's memory."""
        return {
            **super().learned(),
            "observation": self._observation,
            "action": self._action,
            "memory": memory_leaves(self._memory),
            "rounds": self._rounds,
        }

    def load_learned(self, state: dict[str, Any]) -> None:
        """Restore the state that `learned` returned."""
        super().load_learned(state)
        self._observation, self._action = state["observation"], state["action"]
        self._memory, self._rounds = memory_from(state["memory"], self._fresh), state["rounds"]
