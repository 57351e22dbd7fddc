"""How episodes went, kept where the worlds are: on a GPU no step waits for the host."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.learning.layers import Arrays
from finssim.tasks import Environment
from finssim.tasks.arrays import TaskArrays

__all__ = ["EpisodeEnds"]

TOTALS = ("final_return", "final_length", "final_held", "final_totals", "final_earned")
"""What tasks measure an episode by, of the one that ended last in each world."""


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
        """Where an episode ended in the step just done, bool, (worlds,)."""
        return (self._terminated | self._truncated) != 0

    def look(self, where: Any) -> None:
        """Keep how the episodes went that ended in the step just done, in the worlds `where`, bool, (worlds,)."""
        if self._arrays.device is None and not where.any():
            return
        self.ended |= where
        for source, kept in zip(self._sources, self._kept, strict=True):
            mask = where[:, None] if kept.ndim == 2 else where
            kept[...] = self._arrays.xp.where(mask, source, kept)

    def clear(self) -> None:
        """Forget them."""
        self.ended[...] = False

    def earned(self) -> dict[str, NDArray[np.float64]]:
        """What each reward and each end added to the return, by world; see `Task.earned`."""
        return self._environment.task.earned(self._copy)

    def metrics(self) -> tuple[NDArray[np.bool_], dict[str, NDArray[np.float64]]]:
        """Where there was an end, and the task's measures by world, as NumPy: the one copy through the host."""
        ended = self._arrays.numpy(self.ended)
        return ended, self._environment.task.metrics(self._copy)
