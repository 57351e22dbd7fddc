"""What randomisation does in one environment: the draws, how their ranges grow, what critics see of them."""

from collections.abc import Iterator

import warp as wp

from finssim.engine import Simulator
from finssim.engine.launch import Pipeline
from finssim.engine.packed import Packed
from finssim.engine.randomize import Draws, Randomization
from finssim.engine.ranges_file import Curriculum, Success
from finssim.engine.ranges_table import ENTRIES, INDEX
from finssim.tasks.arrays import TaskArrays, allocated
from finssim.tasks.given import EnvironmentSetupError
from finssim.tasks.task import Task

# Ranges that grow while a policy learns: with the training's progress, its steps, or success.


LOOK = 50
"""Control steps between two looks at the successes."""


@wp.struct
class Counts:
    """Episodes and successes since the last look, by world, as worlds run on several threads."""

    tried: wp.array(dtype=int)
    succeeded: wp.array(dtype=int)
    held: float  # a success has held at least this [s] ...
    episode_return: float  # ... and returned at least this


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
    """Widens the ranges of one environment's draws, as their `curriculum` says."""

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
        """Part of the full width that is drawn from now."""
        return float(self._width.numpy()[0])

    def restart(self) -> None:
        """Back to the narrow ranges."""
        self._forget()
        self._steps = 0
        self._set(self.plan.start)

    def add(self, pipeline: Pipeline, arrays: TaskArrays) -> None:
        """Append the count of successes, after the task's evaluation and before the next draw."""
        if self.plan.by == "success":
            pipeline.add(count_successes, [arrays, self.counts])

    def progress(self, done: float) -> None:
        """The share of the training that is done, in [0, 1]."""
        if self.plan.by == "progress":
            self._set(self.plan.width(done))

    def after_step(self) -> None:
        """Called after every control step; looks every `LOOK` of them."""
        self._steps += 1
        if self._steps % LOOK:
            return
        if self.plan.by == "success":
            self._judge()
        elif self.plan.by == "steps":
            self._set(self.plan.width(float(self._steps * self._draws.simulator.worlds)))

    def arrays(self) -> Iterator[tuple[str, wp.array]]:
        """What decides how it goes on, by name."""
        counts, table = self.counts, self._draws.table
        yield from (("width", self._width), ("tried", counts.tried), ("succeeded", counts.succeeded))
        yield from (("ends", table.ends), ("probability", table.probability))

    def _judge(self) -> None:
        tried, succeeded = (x.numpy().sum() for x in (self.counts.tried, self.counts.succeeded))
        if tried >= self.plan.episodes:
            share, step = succeeded / tried, self.plan.step
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
        return Success(episode_return=0.0)  # nothing is counted
    raise EnvironmentSetupError(
        f"task '{task.name}' has no hold time: say when an episode succeeds, such as success: {{episode_return: 10}}"
    )


class Drawing:
    """The randomisation of one environment; without one, nothing happens.

    Attributes:
        draws: What is drawn; None without randomisation.
        schedule: How the ranges grow; None where they do not.
        names: Of the privileged numbers of an agent; empty unless they are asked for.
    """

    def __init__(
        self,
        randomization: Randomization | None,
        simulator: Simulator,
        arrays: TaskArrays,
        seen: Packed,
        task: Task,
        privileged: bool,
    ) -> None:
        """Set up what the randomisation needs, and the arrays of the privileged numbers.

        Raises:
            EnvironmentSetupError: Privileged numbers without randomisation, or a schedule that cannot be.
        """
        self._simulator, self._arrays, self._seen = simulator, arrays, seen
        self.draws: Draws | None = None
        self.schedule: Schedule | None = None
        self.names: list[str] = []
        if privileged and randomization is None:
            raise EnvironmentSetupError(
                "privileged numbers are what is drawn: give randomization, or leave privileged out"
            )
        if privileged and randomization is not None:
            self.names = randomization.told(max(len(vehicle.thrusters) for vehicle in simulator.vehicles))
        shape = (simulator.worlds, len(task.agents) * len(self.names))
        for name in ("privileged", "final_privileged"):
            setattr(arrays, name, wp.zeros(shape, dtype=wp.float32, device=simulator.device))
        if randomization is None:
            return
        told = (arrays.privileged, arrays.final_privileged) if privileged else None
        self.draws = randomization.draws(simulator, seen, agents=len(task.agents), privileged=told)
        if randomization.ranges.curriculum is not None:
            self.schedule = Schedule(randomization.ranges.curriculum, self.draws, task)

    def add_step(self, pipeline: Pipeline, seed: int) -> None:
        """Append what comes before the simulator's step."""
        if self.draws is not None:
            self.draws.add_step(pipeline, seed)

    def add_end(self, pipeline: Pipeline) -> None:
        """Append what comes after the task's evaluation."""
        if self.schedule is not None:
            self.schedule.add(pipeline, self._arrays)

    def add_start(self, pipeline: Pipeline, mask: wp.array, seed: int) -> None:
        """Append the draw for the worlds where an episode starts."""
        if self.draws is not None:
            self.draws.add(pipeline, mask, seed)
            self._simulator.add_refresh(pipeline, mask)

    def after_step(self) -> None:
        """Called after every step of the pipeline."""
        if self.schedule is not None:
            self.schedule.after_step()

    def restart(self) -> None:
        """Called before all random streams start over."""
        if self.schedule is not None:
            self.schedule.restart()

    def arrays(self) -> Iterator[tuple[str, wp.array]]:
        """All of it that decides what comes next, by name."""
        if self.draws is None:
            return
        yield "values", self.draws.values
        for part, drawn in (("seen", self._seen), ("tether", self._simulator.tether)):
            yield from ((f"{part}.{name}", array) for name, array in drawn.fields.items())
        if self.schedule is not None:
            yield from ((f"schedule.{name}", array) for name, array in self.schedule.arrays())
