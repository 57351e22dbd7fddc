"""How well the mean policy does while it is being trained: on episodes that it never learns from, always the same."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.learning.ends import EpisodeEnds
from finssim.learning.layers import Arrays
from finssim.learning.network import Network, asked, first_memory
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

    def __call__(self, network: Any) -> dict[str, float]:
        """Means over the episodes, of each measure over those that have it: a time that was never reached is none.

        Args:
            network: A `Network` in the library of the device (NumPy on `cpu`), or a torch module; of one agent.

        Returns:
            The task's metrics by `evaluation_` and their name, such as evaluation_return and evaluation_success.
        """
        plain = isinstance(network, Network) and self.device == "cpu"
        arrays = Arrays(0, None if plain else self.device)
        e = self.environment
        e.reset(seed=e.seed)
        rows = e.worlds * e.agents
        observation = arrays.view(e.arrays.observation).reshape(rows, -1)
        action = arrays.view(e.arrays.action).reshape(rows, -1)
        memory = first_memory(network, rows, None if plain else self.device)
        ends = EpisodeEnds(e, arrays)
        for _ in range(self._limit):
            with arrays.plain():
                answer, memory = asked(network, observation, memory)
            action[:] = answer
            e.advance()
            ends.look(ends.done() & ~ends.ended)
            if e.device.is_cpu and ends.ended.all():
                break
        ended, measured = ends.metrics()
        return {f"evaluation_{name}": _mean(values[ended]) for name, values in measured.items()}


def _mean(values: NDArray[np.float64]) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else np.nan
