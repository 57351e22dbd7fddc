"""Ranges that grow while a policy learns: with the training's progress, with success, or each end by itself."""

from collections.abc import Iterator

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.engine.launch import Pipeline
from finssim.engine.randomize import Draws
from finssim.engine.ranges_schedule import Automatic, Curriculum, Success
from finssim.engine.ranges_table import ENTRIES, INDEX
from finssim.tasks.arrays import TaskArrays
from finssim.tasks.given import EnvironmentSetupError
from finssim.tasks.task import Task

__all__ = ["LOOK", "Schedule"]

LOOK = 50
"""Control steps between two looks at the successes."""


@wp.struct
class Counts:
    """Episodes and successes since the last look, (worlds, slots): slot 0 tried no end, 1 + i the end i.

    Each world counts for itself: worlds run on several threads.
    """

    tried: wp.array2d(dtype=int)
    succeeded: wp.array2d(dtype=int)
    held: float  # a success has held at least this [s] ...
    episode_return: float  # ... and returned at least this


@wp.kernel(enable_backward=False)
def count_successes(arrays: TaskArrays, probe: wp.array(dtype=int), counts: Counts, world_offset: int):
    """Count the episodes that ended in this step."""
    w = world_offset + wp.tid()
    if arrays.done[w] == 0:
        return
    slot = probe[w] + 1
    counts.tried[w, slot] = counts.tried[w, slot] + 1
    good = arrays.final_held[w] >= counts.held - 1.0e-4 and arrays.final_return[w] >= counts.episode_return
    if good:
        counts.succeeded[w, slot] = counts.succeeded[w, slot] + 1


class Schedule:
    """Widens the ranges of one environment's draws, as their `curriculum` or `automatic` says.

    Attributes:
        names: The entries whose ranges it moves.
        parts: Part of the way from the nominal number to the low and to the high end now, (2, len(names)).
    """

    def __init__(self, plan: Curriculum | Automatic, draws: Draws, task: Task) -> None:
        """Start with the narrow ranges.

        Raises:
            EnvironmentSetupError: Success is not defined, or no range could widen.
        """
        self.plan, self._draws = plan, draws
        self.names = [name for name in draws.names if _moves(name, draws, plan)]
        if not self.names:
            raise EnvironmentSetupError(
                f"ranges '{draws.randomization.ranges.name}': nothing that is drawn can widen: give ranges "
                "[low, high], or leave curriculum and automatic out"
            )
        self._parts = wp.zeros((2, len(self.names)), dtype=wp.float64, device="cpu")
        if isinstance(plan, Automatic):
            draws.probe_ends(self.names, plan.probability)
        self.counts = _counts(_success(plan, task), draws, len(self.names))
        self._steps = 0
        self.restart()

    @property
    def parts(self) -> NDArray[np.float64]:
        """See the class."""
        return np.array(self._parts.numpy())

    @property
    def width(self) -> float:
        """Mean part of the full width that is drawn from now."""
        return float(self.parts.mean())

    def restart(self) -> None:
        """Back to the narrow ranges."""
        self._forget(slice(None))
        self._steps = 0
        start = self.plan.start
        self._set(np.full((2, len(self.names)), start))

    def add(self, pipeline: Pipeline, arrays: TaskArrays) -> None:
        """Append the count of successes, after the task's evaluation and before the next draw."""
        if isinstance(self.plan, Automatic) or self.plan.by == "success":
            pipeline.add(count_successes, [arrays, self._draws.probe, self.counts])

    def progress(self, done: float) -> None:
        """The share of the training that is done, in [0, 1]."""
        if isinstance(self.plan, Curriculum) and self.plan.by == "progress":
            self._set(np.full((2, len(self.names)), self.plan.width(done)))

    def after_step(self) -> None:
        """Called after every control step; looks every `LOOK` of them."""
        self._steps += 1
        if self._steps % LOOK:
            return
        if isinstance(self.plan, Automatic):
            self._judge_ends(self.plan)
        elif self.plan.by == "success":
            self._judge_all(self.plan)
        elif self.plan.by == "steps":
            worlds = self._draws.simulator.worlds
            self._set(np.full((2, len(self.names)), self.plan.width(float(self._steps * worlds))))

    def arrays(self) -> Iterator[tuple[str, wp.array]]:
        """What decides how it goes on, by name."""
        yield from (
            ("parts", self._parts),
            ("tried", self.counts.tried),
            ("succeeded", self.counts.succeeded),
        )
        yield from (("ends", self._draws.table.ends), ("probability", self._draws.table.probability))

    def _judge_all(self, plan: Curriculum) -> None:
        tried, succeeded = (x.numpy().sum() for x in (self.counts.tried, self.counts.succeeded))
        if tried >= plan.episodes:
            self._set(np.clip(self.parts + _move(plan, succeeded / tried), 0.0, 1.0))
            self._forget(slice(None))

    def _judge_ends(self, plan: Automatic) -> None:
        tried, succeeded = (x.numpy().sum(axis=0)[1:] for x in (self.counts.tried, self.counts.succeeded))
        ripe = np.flatnonzero(tried >= plan.episodes)
        if not len(ripe):
            return
        parts = self.parts
        for end in ripe:
            name, side = divmod(int(end), 2)
            parts[side, name] = np.clip(
                parts[side, name] + _move(plan, succeeded[end] / tried[end]), 0.0, 1.0
            )
        self._set(parts)
        self._forget(1 + ripe)

    def _forget(self, slots: slice | NDArray[np.int64]) -> None:
        for array in (self.counts.tried, self.counts.succeeded):
            values = array.numpy().copy()
            values[:, slots] = 0
            array.assign(values)

    def _set(self, parts: NDArray[np.float64]) -> None:
        if self._steps and np.array_equal(parts, self._parts.numpy()):
            return
        self._parts.assign(parts)
        self._draws.set_width({name: (low, high) for name, low, high in zip(self.names, *parts, strict=True)})


def _moves(name: str, draws: Draws, plan: Curriculum | Automatic) -> bool:
    """Whether a schedule moves an entry's range: no direction; and each end by itself only where there are two."""
    own = draws.distributions[name]
    if ENTRIES[INDEX[name]].angle:
        return False
    ends = own.uniform or own.log_uniform
    return isinstance(plan, Curriculum) or (
        ends is not None and ends[0] < ends[1] and own.probability == 1.0 and not name.startswith("waves.")
    )


def _move(plan: Curriculum | Automatic, rate: float) -> float:
    return plan.step if rate >= plan.widen_at else -plan.step if rate < plan.narrow_at else 0.0


def _success(plan: Curriculum | Automatic, task: Task) -> Success:
    if plan.success is not None:
        return plan.success
    hold = getattr(task, "hold", None)
    if hold:
        return Success(held=hold)
    if isinstance(plan, Curriculum) and plan.by != "success":
        return Success(episode_return=0.0)  # nothing is counted
    raise EnvironmentSetupError(
        f"task '{task.name}' has no hold time: say when an episode succeeds, such as success: {{episode_return: 10}}"
    )


def _counts(success: Success, draws: Draws, names: int) -> Counts:
    counts = Counts()
    shape = (draws.simulator.worlds, 1 + 2 * names)
    counts.tried = wp.zeros(shape, dtype=wp.int32, device=draws.simulator.device)
    counts.succeeded = wp.zeros(shape, dtype=wp.int32, device=draws.simulator.device)
    counts.held = 0.0 if success.held is None else success.held
    counts.episode_return = -1.0e30 if success.episode_return is None else success.episode_return
    return counts
