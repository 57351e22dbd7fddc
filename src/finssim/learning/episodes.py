"""Statistics of episodes, stored on the device of the worlds, so that on a GPU no step waits for the host."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.learning.layers import Arrays
from finssim.learning.network import Network, answer_of, first_memory
from finssim.tasks import Environment
from finssim.tasks.arrays import TaskArrays
from finssim.tasks.environment import GREATEST_SEED

# Results of episodes, stored on the device of the worlds: on a GPU no step waits for the host.


TOTALS = ("final_return", "final_length", "final_held", "final_totals", "final_earned")
"""Metrics of the last finished episode in each world."""


class EpisodeEnds:
    """The latest finished episode in each world since the start, or since `clear`.

    Attributes:
        ended: True where an episode ended, bool, (worlds,), of the library of `arrays`.
    """

    def __init__(self, environment: Environment, arrays: Arrays) -> None:
        """Observe an environment's worlds."""
        self._environment, self._arrays = environment, arrays
        a = environment.arrays
        self._copy = TaskArrays()
        self._sources, self._kept = [], []
        for name in TOTALS:
            source = getattr(a, name)
            copy = wp.zeros_like(source)
            setattr(self._copy, name, copy)
            self._sources.append(arrays.view(source))
            self._kept.append(arrays.view(copy))
        self._terminated, self._truncated = arrays.view(a.terminated), arrays.view(a.truncated)
        self.ended = self._terminated != self._terminated

    def done(self) -> Any:
        """Return where an episode ended in the latest step, bool, (worlds,)."""
        return (self._terminated | self._truncated) != 0

    def look(self, worlds: Any) -> None:
        """Store the results of the episodes that ended in the last step, in the worlds `worlds`, bool, (worlds,)."""
        if self._arrays.device is None and not worlds.any():
            return
        self.ended |= worlds
        for source, target in zip(self._sources, self._kept, strict=True):
            mask = worlds[:, None] if target.ndim == 2 else worlds
            target[...] = self._arrays.xp.where(mask, source, target)

    def clear(self) -> None:
        """Discard the stored results."""
        self.ended[...] = False

    def earned(self) -> dict[str, NDArray[np.float64]]:
        """Return the contribution of each reward and each end to the return, by world; see `Task.earned`."""
        return self._environment.task.earned(self._copy)

    def metrics(self) -> tuple[NDArray[np.bool_], dict[str, NDArray[np.float64]]]:
        """Return where an episode ended, and the task's metrics by world in their units, as NumPy: the only copy to
        the host."""
        ended = self._arrays.numpy(self.ended)
        return ended, self._environment.task.metrics(self._copy)


# Progress of a training: means over the last episodes.


SHORTEST_WINDOW = 100
"""Least number of episodes in a mean; with more worlds, one of each world."""


class EpisodeTally:
    """Statistics of an environment whose first episodes may be shortened; those are not counted.

    If several episodes of a world end between two rows, only the last one counts.
    """

    def __init__(
        self, environment: Environment, shortened: bool = True, arrays: Arrays | None = None
    ) -> None:
        """Observe the worlds.

        Args:
            environment: Their environment.
            shortened: True if their current episodes began earlier.
            arrays: Library that stores the results until a row is requested; NumPy if None.
        """
        arrays = arrays or Arrays(0, None if environment.device.is_cpu else str(environment.device))
        self.environment = environment
        self._arrays, self._ends = arrays, EpisodeEnds(environment, arrays)
        self._rewards = arrays.view(environment.arrays.reward)
        self._shortened = self._ends.done() | True if shortened else self._ends.done() & False
        self._episodes: deque[tuple[float, ...]] = deque(maxlen=max(SHORTEST_WINDOW, environment.worlds))
        self._reward, self._looks = arrays.zeros(1), arrays.zeros(1)

    def look(self) -> None:
        """Count the episodes that ended in the last step, and its reward."""
        self._reward += self._rewards.mean()
        self._looks += 1.0
        done = self._ends.done()
        self._ends.look(done & ~self._shortened)
        self._shortened &= ~done

    def row(self) -> dict[str, float]:
        """Return means over the last episodes, of each reward's contribution, and of the reward since the previous
        row."""
        ended, measured = self._ends.metrics()
        if ended.any():
            success = measured.get("success", np.zeros(self.environment.worlds))
            earned = self._ends.earned()
            parts = [measured["return"], measured["length"], success, *earned.values()]
            columns = [part[ended] for part in parts]
            self._episodes.extend(zip(*(column.tolist() for column in columns), strict=True))
        names = (
            "mean_return",
            "mean_length",
            "held",
            *(f"earned_{n}" for n in self.environment.task.earnings),
        )
        means = np.mean(self._episodes, axis=0) if self._episodes else np.zeros(len(names))
        reward, looks = (float(self._arrays.numpy(x)[0]) for x in (self._reward, self._looks))
        self._start_row()
        return {**dict(zip(names, means.tolist(), strict=True)), "mean_reward": reward / max(looks, 1.0)}

    def _start_row(self) -> None:
        self._ends.clear()
        self._reward[:] = 0.0
        self._looks[:] = 0.0

    def state(self) -> dict[str, Any]:
        """Return the state that `load` restores."""
        return {
            "shortened": self._arrays.numpy(self._shortened),
            "episodes": np.array(self._episodes),
        }

    def load(self, state: dict[str, Any]) -> None:
        """Continue from a state saved between two updates."""
        self._shortened[...] = self._arrays.bools(state["shortened"])
        self._episodes.clear()
        self._episodes.extend(tuple(row) for row in state["episodes"].tolist())
        self._start_row()


# Evaluation of the mean policy during training: on a fixed set of episodes that it never learns from.


HELD_WORLDS = 32
"""Number of episodes in an evaluation: resolves the success rate to about 9 %, in less time than two updates."""


def held_seed(seed: int) -> int:
    """Return the seed of the evaluation episodes, far from the training's own."""
    return (seed + 1_000_003) % (GREATEST_SEED + 1)


class HeldEvaluation:
    """Evaluation of a network in the first episode of every world of a separate environment."""

    def __init__(self, environment: Environment, device: str = "cpu") -> None:
        """Use an environment that resets itself, and a device of torch."""
        self.environment, self.device = environment, device
        task = environment.task
        self._limit = max(1, round(task.time_limit / task.control_step))

    def __call__(self, network: Any) -> dict[str, float]:
        """Return the task's metrics averaged over the episodes, each over those in which it is defined.

        Args:
            network: A `Network` in the library of the device (NumPy on `cpu`), or a torch module; of one agent.

        Returns:
            The task's metrics under `evaluation_` and their name, such as evaluation_return and evaluation_success.
        """
        plain = isinstance(network, Network) and self.device == "cpu"
        arrays = Arrays(0, None if plain else self.device)
        e = self.environment
        e.reset(seed=e.seed)
        rows = e.worlds * e.agents
        observation = arrays.view(e.arrays.observation).reshape(rows, -1)
        action = arrays.view(e.arrays.action).reshape(rows, -1)
        pictures = {} if e.sight is None else {name: arrays.view(x) for name, x in e.sight.pictures.items()}
        memory = first_memory(network, rows, None if plain else self.device)
        ends = EpisodeEnds(e, arrays)
        for _ in range(self._limit):
            with arrays.plain():
                answer, memory = answer_of(network, observation, memory, pictures)
            action[:] = answer
            e.advance()
            ends.look(ends.done() & ~ends.ended)
            if e.device.is_cpu and ends.ended.all():
                break
        ended, measured = ends.metrics()
        return {f"evaluation_{name}": _mean(values[ended]) for name, values in measured.items()}


def _mean(values: NDArray[np.float64]) -> float:
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else np.nan
