"""Levels of a task, taken one after the other: the next one when enough of the recent episodes succeeded."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.tasks.environment import Environment
from finssim.tasks.given import EnvironmentSetupError

__all__ = ["LevelPlan", "Levels", "climb"]


@dataclass(frozen=True, kw_only=True)
class LevelPlan:
    """When a level rises; the last one is the task's own."""

    level_from: int = 0
    """Level at the start."""
    level_at: float = 0.8
    """Share of successes at which it rises."""
    level_episodes: int = 200
    """Episodes that the share is taken over, or a few more: as many of each world. All begun at that level."""

    def __post_init__(self) -> None:
        if self.level_from < 0 or not 0.0 < self.level_at <= 1.0 or self.level_episodes < 1:
            raise EnvironmentSetupError(
                f"level_from is {self.level_from}, level_at {self.level_at}, level_episodes {self.level_episodes}: "
                "expected 0 or more, above 0 to 1, and 1 or more"
            )


class Levels:
    """Watches the episodes of an environment, and takes it to the next level when `rise` is called and it is time.

    Attributes:
        plan: When.
        last: The level at which it ends.
    """

    def __init__(self, environment: Environment, plan: LevelPlan) -> None:
        """Begin at the first level; running episodes, which began elsewhere, are not counted.

        Raises:
            EnvironmentSetupError: The task has no levels, or its own is below the first.
        """
        task: Any = environment.task
        if not task.levels:
            raise EnvironmentSetupError(f"task '{task.name}' has no levels: leave level_... out")
        self.plan, self.last, self._environment = plan, int(task.level), environment
        if "success" not in task.metrics(environment.arrays):
            raise EnvironmentSetupError(
                f"task '{task.name}' has no metric 'success', by which its levels rise"
            )
        if plan.level_from > self.last:
            raise EnvironmentSetupError(
                f"level_from is {plan.level_from}, expected at most the task's own level, {self.last}"
            )
        # As many of each world: of the first to end, most are successes, where these end an episode early.
        each = math.ceil(plan.level_episodes / environment.worlds)
        self._recent = np.full((environment.worlds, each), np.nan)
        self._go(plan.level_from)

    @property
    def level(self) -> int:
        """Where it is now."""
        task: Any = self._environment.task
        return int(task.level)

    @property
    def share(self) -> float:
        """Of successes among the episodes counted so far; 0 before the first."""
        counted = self._recent[~np.isnan(self._recent)]
        return float(counted.mean()) if len(counted) else 0.0

    def after_step(self) -> None:
        """Count the episodes that ended in the step just done."""
        e = self._environment
        ended = (e.arrays.terminated.numpy() | e.arrays.truncated.numpy()) != 0
        counted = ended & self._whole
        if counted.any():
            success = e.task.metrics(e.arrays)["success"]
            self._recent[counted] = np.column_stack([self._recent[counted, 1:], success[counted]])
        self._whole |= ended

    def rise(self) -> None:
        """Take the next level if enough episodes succeeded; those that run end by its rules, and are not counted."""
        full = not np.isnan(self._recent).any()
        if full and self.share >= self.plan.level_at and self.level < self.last:
            self._go(self.level + 1)

    def restart(self) -> None:
        """Begin at the first level again."""
        self._go(self.plan.level_from)

    def state(self) -> dict[str, NDArray[Any]]:
        """What decides how it goes on."""
        return {
            "counters.level": np.array(self.level),
            "counters.level_recent": self._recent.copy(),
            "counters.level_whole": self._whole.copy(),
        }

    def load(self, saved: Mapping[str, NDArray[Any]]) -> None:
        """Go on from what `state` gave."""
        if int(saved["counters.level"]) != self.level:
            self._go(int(saved["counters.level"]))
        self._recent = saved["counters.level_recent"].copy()
        self._whole = saved["counters.level_whole"].copy()

    def _go(self, level: int) -> None:
        task: Any = self._environment.task
        self._environment.change(replace(task, level=level))
        self._recent[:] = np.nan
        self._whole = np.zeros(self._environment.worlds, dtype=np.bool_)


def climb(environment: Environment, plan: LevelPlan | None = None) -> Levels:
    """Let an environment begin at a lower level and rise: at `set_progress`, which a training calls before each update.

    Args:
        environment: Its task is at the last level.
        plan: When to rise.

    Raises:
        EnvironmentSetupError: See `Levels`.
    """
    environment.levels = Levels(environment, plan or LevelPlan())
    return environment.levels
