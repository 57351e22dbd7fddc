"""How the episodes of a training go: means over those that ended last."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np

from finssim.learning.ends import EpisodeEnds
from finssim.learning.layers import Arrays
from finssim.tasks import Environment

__all__ = ["EpisodeTally"]

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
        self._reward, self._looks = arrays.zeros(1), 0

    def look(self) -> None:
        """Count the episodes that ended in the step just done, and its reward."""
        self._reward += self._rewards.mean()
        self._looks += 1
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
        reward = float(self._arrays.numpy(self._reward)[0]) / max(self._looks, 1)
        self._start_row()
        return {**dict(zip(names, means.tolist(), strict=True)), "mean_reward": reward}

    def _start_row(self) -> None:
        self._ends.clear()
        self._reward[:] = 0.0
        self._looks = 0

    def state(self) -> dict[str, Any]:
        """What `load` takes."""
        return {
            "shortened": self._arrays.numpy(self._shortened),
            "episodes": np.array(self._episodes),
        }

    def load(self, state: dict[str, Any]) -> None:
        """Go on from a state that was taken between two updates."""
        self._shortened[...] = self._arrays.bools(state["shortened"])
        self._episodes.clear()
        self._episodes.extend(tuple(row) for row in state["episodes"].tolist())
        self._start_row()
