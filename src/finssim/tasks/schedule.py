"""Curriculum: ranges that grow during training, with its progress, its steps, or the success rate."""

from collections.abc import Iterator

import warp as wp

from finssim.sim.launch import KernelSequence
from finssim.sim.randomize import Draws
from finssim.sim.ranges_file import Curriculum, Success
from finssim.sim.ranges_table import ENTRIES, INDEX
from finssim.tasks.arrays import TaskArrays, allocated
from finssim.tasks.task import Task
from finssim.tasks.validation import EnvironmentSetupError

LOOK = 50
"""Control steps between two evaluations of the curriculum."""


@wp.struct
class Counts:
    """Episodes and successes since the last evaluation, by world, because worlds run on several threads."""

    tried: wp.array(dtype=int)
    succeeded: wp.array(dtype=int)
    held: float  # least hold time of a success [s]
    episode_return: float  # least sum of rewards of a success


@wp.kernel(enable_backward=False)
def count_successes(arrays: TaskArrays, counts: Counts, world_offset: int):
    """Count the episodes that ended in this step."""
    w = world_offset + wp.tid()
    if arrays.done[w] == 0:
        return
    counts.tried[w] = counts.tried[w] + 1
    good = arrays.final_held[w] >= counts.held - 1.0e-4 and arrays.final_return[w] >= counts.episode_return
    if good:
        counts.succeeded[w] = counts.succeeded[w] + 1


class Schedule:
    """Schedule that widens the ranges of one environment's draws, by their `curriculum`."""

    def __init__(self, plan: Curriculum, draws: Draws, task: Task) -> None:
        """Start with the narrow ranges.

        Raises:
            EnvironmentSetupError: Success is not defined, or no range could widen.
        """
        self.plan, self._draws = plan, draws
        self._names = [name for name in draws.names if not ENTRIES[INDEX[name]].angle]
        if not self._names:
            raise EnvironmentSetupError(
                f"ranges '{draws.randomization.ranges.name}': nothing that is drawn can widen: give ranges "
                "[low, high], or leave curriculum out"
            )
        worlds, device, success = draws.simulator.worlds, draws.simulator.device, _success(plan, task)
        self._width = wp.zeros(1, dtype=wp.float64, device="cpu")
        self.counts: Counts = allocated(Counts, worlds, device)
        self.counts.held = 0.0 if success.held is None else success.held
        self.counts.episode_return = -1.0e30 if success.episode_return is None else success.episode_return
        self.restart()

    @property
    def width(self) -> float:
        """Fraction of the full width that is currently drawn."""
        return float(self._width.numpy()[0])

    def restart(self) -> None:
        """Return to the narrow ranges."""
        self._forget()
        self._steps = 0
        self._set(self.plan.start)

    def add(self, pipeline: KernelSequence, arrays: TaskArrays) -> None:
        """Append the count of successes, after the task's evaluation and before the next draw."""
        if self.plan.by == "success":
            pipeline.add(count_successes, [arrays, self.counts])

    def progress(self, done: float) -> None:
        """Set the completed fraction of the training, in [0, 1]."""
        if self.plan.by == "progress":
            self._set(self.plan.width(done))

    def after_step(self) -> None:
        """Update the width after a control step; evaluated every `LOOK` steps."""
        self._steps += 1
        if self._steps % LOOK:
            return
        if self.plan.by == "success":
            self._judge()
        elif self.plan.by == "steps":
            self._set(self.plan.width(float(self._steps * self._draws.simulator.worlds)))

    def arrays(self) -> Iterator[tuple[str, wp.array]]:
        """Yield the arrays that determine the further schedule, by name. Each has the unit of its attribute."""
        counts, table = self.counts, self._draws.table
        yield from (("width", self._width), ("tried", counts.tried), ("succeeded", counts.succeeded))
        yield from (("ends", table.ends), ("probability", table.probability))

    def _judge(self) -> None:
        episodes, succeeded = (x.numpy().sum() for x in (self.counts.tried, self.counts.succeeded))
        if episodes >= self.plan.episodes:
            share, step = succeeded / episodes, self.plan.step
            move = step if share >= self.plan.widen_at else -step if share < self.plan.narrow_at else 0.0
            self._set(min(max(self.width + move, 0.0), 1.0))
            self._forget()

    def _forget(self) -> None:
        self.counts.tried.zero_()
        self.counts.succeeded.zero_()

    def _set(self, width: float) -> None:
        if self._steps and width == self.width:
            return
        self._width.fill_(width)
        self._draws.set_width(width, self._names)


def _success(plan: Curriculum, task: Task) -> Success:
    if plan.success is not None:
        return plan.success
    hold = getattr(task, "hold", None)
    if hold:
        return Success(held=hold)
    if plan.by != "success":
        return Success(episode_return=0.0)  # the curriculum does not count successes
    raise EnvironmentSetupError(
        f"task '{task.name}' has no hold time: define success, such as success: {{episode_return: 10}}"
    )
