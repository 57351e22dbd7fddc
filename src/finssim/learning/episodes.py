"""Statistics of episodes, kept on the device of the worlds: on a GPU no step waits for the host."""

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

# How episodes went, kept where the worlds are: on a GPU no step waits for the host.


TOTALS = ("final_return", "final_length", "final_held", "final_totals", "final_earned")
"""Measures of the episode that ended last in each world."""


class EpisodeEnds:
    """The last end of an episode in each world since the start, or since `clear`.

    Attributes:
        ended: Where there was one, bool, (worlds,), of the library of `arrays`.
    """

    def __init__(self, environment: Environment, arrays: Arrays) -> None:
        """Watch an environment's worlds."""
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
        """Keep how the episodes went that ended in the step just done, in the worlds `worlds`, bool, (worlds,)."""
        if self._arrays.device is None and not worlds.any():
            return
        self.ended |= worlds
        for source, target in zip(self._sources, self._kept, strict=True):
            mask = worlds[:, None] if target.ndim == 2 else worlds
            target[...] = self._arrays.xp.where(mask, source, target)

    def clear(self) -> None:
        """Forget them."""
        self.ended[...] = False

    def earned(self) -> dict[str, NDArray[np.float64]]:
        """Return what each reward and each end added to the return, by world; see `Task.earned`."""
        return self._environment.task.earned(self._copy)

    def metrics(self) -> tuple[NDArray[np.bool_], dict[str, NDArray[np.float64]]]:
        """Return where an episode ended, and the task's measures by world in their units, as NumPy: the one copy
        through the host."""
        ended = self._arrays.numpy(self.ended)
        return ended, self._environment.task.metrics(self._copy)


# How the episodes of a training go: means over those that ended last.


SHORTEST_WINDOW = 100
"""Episodes that a mean is taken over, at least; with more worlds, one of each."""


class EpisodeTally:
    """Watches an environment whose first episodes may be shortened; those are not counted.

    Of several episodes of a world that end between two rows, the last one counts.
    """

    def __init__(
        self, environment: Environment, shortened: bool = True, arrays: Arrays | None = None
    ) -> None:
        """Watch the worlds.

        Args:
            environment: Theirs.
            shortened: Whether their present episodes began before.
            arrays: Library in which the ends are kept until a row is asked for; NumPy if None.
        """
        arrays = arrays or Arrays(0, None if environment.device.is_cpu else str(environment.device))
        self.environment = environment
        self._arrays, self._ends = arrays, EpisodeEnds(environment, arrays)
        self._rewards = arrays.view(environment.arrays.reward)
        self._shortened = self._ends.done() | True if shortened else self._ends.done() & False
        self._episodes: deque[tuple[float, ...]] = deque(maxlen=max(SHORTEST_WINDOW, environment.worlds))
        self._reward, self._looks = arrays.zeros(1), arrays.zeros(1)

    def look(self) -> None:
        """Count the episodes that ended in the step just done, and its reward."""
        self._reward += self._rewards.mean()
        self._looks += 1.0
        done = self._ends.done()
        self._ends.look(done & ~self._shortened)
        self._shortened &= ~done

    def row(self) -> dict[str, float]:
        """Means over the last episodes, also of what each reward gave, and of the reward since the row before."""
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
        """Return the state that `load` takes."""
        return {
            "shortened": self._arrays.numpy(self._shortened),
            "episodes": np.array(self._episodes),
        }

    def load(self, state: dict[str, Any]) -> None:
        """Continue from a state that was taken between two updates."""
        self._shortened[...] = self._arrays.bools(state["shortened"])
        self._episodes.clear()
        self._episodes.extend(tuple(row) for row in state["episodes"].tolist())
        self._start_row()


# How well the mean policy does while it is being trained: on episodes that it never learns from, always the same.


HELD_WORLDS = 32
"""Episodes of an evaluation: a share of successes to some 9 %, for less time than two updates take."""


def held_seed(seed: int) -> int:
    """Seed of the held episodes, far from the training's own."""
    return (seed + 1_000_003) % (GREATEST_SEED + 1)


class HeldEvaluation:
    """Evaluation of a network in the first episode of every world of a separate environment."""

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
