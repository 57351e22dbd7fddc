"""How the episodes of a training go: means over those that ended last."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np

from finssim.tasks import Environment

__all__ = ["EpisodeTally"]

SHORTEST_WINDOW = 100
"""Episodes that a mean is taken over, at least; with more worlds, one of each."""


class EpisodeTally:
    """Watches an environment whose first episodes may be shortened; those are not counted."""

    def __init__(self, environment: Environment, shortened: bool = True) -> None:
        """Watch the worlds; `shortened` says whether their present episodes began before."""
        self.environment = environment
        self._whole = np.full(environment.worlds, not shortened)
        self._episodes: deque[tuple[float, float, float]] = deque(
            maxlen=max(SHORTEST_WINDOW, environment.worlds)
        )
        self._reward, self._looks = 0.0, 0

    def look(self) -> None:
        """Count the episodes that ended in the step just done, and its reward."""
        a = self.environment.arrays
        self._reward += float(a.reward.numpy().mean())
        self._looks += 1
        ended = np.flatnonzero(a.terminated.numpy() | a.truncated.numpy())
        if not len(ended):
            return
        whole = ended[self._whole[ended]]
        if len(whole):
            measured = self.environment.task.metrics(a)
            success = measured.get("success", np.zeros(self.environment.worlds))
            columns = [measured["return"][whole], measured["length"][whole], success[whole]]
            self._episodes.extend(zip(*(column.tolist() for column in columns), strict=True))
        self._whole[ended] = True

    def row(self) -> dict[str, float]:
        """Means over the last episodes, and of the reward since the row before."""
        means = np.mean(self._episodes, axis=0) if self._episodes else np.zeros(3)
        reward = self._reward / max(self._looks, 1)
        self._reward, self._looks = 0.0, 0
        names = ("mean_return", "mean_length", "held")
        return {**dict(zip(names, means.tolist(), strict=True)), "mean_reward": reward}

    def state(self) -> dict[str, Any]:
        """What `load` takes."""
        return {"whole": self._whole.copy(), "episodes": np.array(self._episodes).reshape(-1, 3)}

    def load(self, state: dict[str, Any]) -> None:
        """Go on from a state that was taken between two updates."""
        self._whole = state["whole"].copy()
        self._episodes.clear()
        self._episodes.extend(tuple(row) for row in state["episodes"].tolist())
        self._reward, self._looks = 0.0, 0
