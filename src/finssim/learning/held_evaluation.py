"""How well the mean policy does while it is being trained: on episodes that it never learns from, always the same."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from finssim.learning.recurrent import asked, first_memory
from finssim.tasks import Environment
from finssim.tasks.environment import GREATEST_SEED

__all__ = ["HELD_WORLDS", "HeldEvaluation", "held_seed"]

HELD_WORLDS = 32
"""Episodes of an evaluation: a share of successes to some 9 %, for less time than two updates take."""


def held_seed(seed: int) -> int:
    """Seed of the held episodes, far from the training's own."""
    return (seed + 1_000_003) % (GREATEST_SEED + 1)


class HeldEvaluation:
    """Runs a network through the first episode of every world of an environment of its own."""

    def __init__(self, environment: Environment, device: str = "cpu") -> None:
        """Take an environment that resets itself, and torch's device."""
        self.environment, self.device = environment, device
        task = environment.task
        self._limit = max(1, round(task.time_limit / task.control_step))

    def __call__(self, network: nn.Module) -> dict[str, float]:
        """Means over the episodes, of each measure over those that have it: a time that was never reached is none.

        Args:
            network: Observation of one agent to its action, or a `RecurrentNetwork`; its mode (train, eval) stays.

        Returns:
            The task's metrics by `evaluation_` and their name, such as evaluation_return and evaluation_success.
        """
        e = self.environment
        e.reset(seed=e.seed)
        memory = first_memory(network, e.worlds * e.agents, self.device)
        waiting, found = np.ones(e.worlds, dtype=np.bool_), {}
        for _ in range(self._limit):
            memory = self._act(network, memory)
            ended = (e.arrays.terminated.numpy() | e.arrays.truncated.numpy()) != 0
            for name, values in e.task.metrics(e.arrays).items() if (ended & waiting).any() else ():
                found.setdefault(name, np.zeros(e.worlds))[ended & waiting] = values[ended & waiting]
            waiting &= ~ended
            if not waiting.any():
                break
        return {f"evaluation_{name}": _mean(values[~waiting]) for name, values in found.items()}

    def _act(self, network: nn.Module, memory: torch.Tensor | None) -> torch.Tensor | None:
        """One control step of all worlds; the memory after it, which in worlds that start over is of no interest."""
        e = self.environment
        rows = e.arrays.observation.numpy().reshape(e.worlds * e.agents, -1)
        with torch.no_grad():
            action, memory = asked(network, torch.as_tensor(rows, device=self.device), memory)
        e.arrays.action.assign(action.cpu().numpy().reshape(e.worlds, -1))
        e.advance()
        return memory


def _mean(values: NDArray[np.float64]) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else np.nan
