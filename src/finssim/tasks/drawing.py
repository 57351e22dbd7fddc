"""What randomisation does in one environment: the draws, how their ranges grow, what agents and logs are told."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.engine import Simulator
from finssim.engine.launch import Pipeline
from finssim.engine.packed import Packed
from finssim.engine.randomize import Draws, Randomization
from finssim.engine.ranges_schedule import Automatic, Curriculum, Success
from finssim.engine.ranges_table import ENTRIES, INDEX
from finssim.files import atomic_write
from finssim.provenance import provenance
from finssim.tasks.arrays import TaskArrays
from finssim.tasks.given import EnvironmentSetupError
from finssim.tasks.task import Task
from finssim.text_table import write_csv

__all__ = ["LOOK", "Drawing", "LogError", "Schedule"]


# Ranges that grow while a policy learns: with the training's progress, with success, or each end by itself.


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


# What was drawn for every episode, and how the episode went: kept while a run goes on, written as CSV.

OUTCOME = ("world", "episode", "length", "episode_return", "held", "vehicle")
"""First columns of a table of episodes."""


class LogError(ValueError):
    """A log of draws that cannot be written."""


class DrawLog:
    """Collects, world by world, what each episode had when it ends."""

    def __init__(self, draws: Draws, arrays: TaskArrays) -> None:
        """Start with the episodes that are running."""
        self._draws, self._arrays = draws, arrays
        self._values: list[NDArray[np.float32]] = []
        self._rows: list[NDArray[np.float64]] = []
        self._now = self._draws.numpy()
        self._episode = np.array(draws.simulator.state.episode.numpy())
        self._open = np.ones(len(self._episode), bool)

    def look(self) -> None:
        """Take what the running episodes have; episodes that were cut off from outside are left out."""
        episode = np.array(self._draws.simulator.state.episode.numpy())
        self._open |= episode != self._episode
        self._now, self._episode = self._draws.numpy(), episode

    def after_step(self) -> None:
        """Take the episodes that ended in this step."""
        a = self._arrays
        ended = np.flatnonzero((a.done.numpy() != 0) & self._open)
        if not len(ended):
            return
        columns = (a.final_length, a.final_return, a.final_held)
        outcome = np.stack([array.numpy()[ended].astype(float) for array in columns], axis=1)
        self._values.append(self._now[ended])
        self._rows.append(np.column_stack([ended, self._episode[ended], outcome]))
        self._now[ended] = self._draws.values.numpy()[ended][..., [INDEX[n] for n in self._draws.names]]
        episode = self._draws.simulator.state.episode.numpy()[ended]
        self._open[ended] = episode != self._episode[ended]  # without automatic reset a world waits for one
        self._episode[ended] = episode

    def episodes(self) -> dict[str, NDArray[np.float64]]:
        """A column by name, (rows,): a row for each vehicle of each episode that ended, in the order of their ends.

        First `OUTCOME`: world, number of the episode in it (from 1), control steps, return, time held inside the
        tolerance when it ended [s] and vehicle; then every entry that varies, in its unit, factors of 1 being nominal.
        """
        names, vehicles = self._draws.names, len(self._draws.simulator.vehicles)
        rows = np.concatenate([np.zeros((0, len(OUTCOME) - 1)), *self._rows])
        drawn = np.concatenate([np.zeros((0, vehicles, len(names))), *self._values])
        vehicle = np.tile(np.arange(vehicles), len(rows))
        table = np.column_stack(
            [np.repeat(rows, vehicles, axis=0), vehicle, drawn.reshape(len(vehicle), len(names))]
        )
        return dict(zip((*OUTCOME, *names), table.T, strict=True))

    def save(self, path: str | Path) -> Path:
        """Write the episodes so far as a .csv table; PATH.json beside it says what they were drawn from.

        Raises:
            LogError: Another suffix.
            OutputError: The place cannot be written.
        """
        target, draws = Path(path), self._draws
        if target.suffix != ".csv":
            raise LogError(f"{path} ends in '{target.suffix}', expected .csv")
        about = {
            "ranges": draws.randomization.ranges.model_dump(mode="json"),
            "units": {name: ENTRIES[INDEX[name]].unit for name in draws.names},
            "vehicles": [{"name": v.name, "sha256": v.sha256} for v in draws.simulator.vehicles],
            "seed": draws.simulator.seed,
            "provenance": provenance(),
        }
        columns = self.episodes()
        with atomic_write(target) as temporary:
            write_csv(
                temporary,
                list(columns),
                [[f"{x:.7g}" for x in row] for row in zip(*columns.values(), strict=True)],
            )
        with atomic_write(f"{target}.json") as temporary:
            temporary.write_text(json.dumps(about, indent=2) + "\n", encoding="utf-8")
        return target


class Drawing:
    """The randomisation of one environment; without one, nothing happens.

    Attributes:
        draws: What is drawn; None without randomisation.
        schedule: How the ranges grow; None where they do not.
        names: Of the privileged numbers of an agent; empty unless they are asked for.
        log: What was drawn for the episodes that ended; None until `start_log`.
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
        self.log: DrawLog | None = None
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
        plan = randomization.ranges.curriculum or randomization.ranges.automatic
        if plan is not None:
            self.schedule = Schedule(plan, self.draws, task)

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

    def start_log(self) -> DrawLog:
        """Keep what is drawn from now on.

        Raises:
            EnvironmentSetupError: Nothing is drawn.
        """
        if self.draws is None:
            raise EnvironmentSetupError("nothing is drawn that could be logged: give randomization")
        self.log = DrawLog(self.draws, self._arrays)
        return self.log

    def after_step(self) -> None:
        """Called after every step of the pipeline."""
        if self.schedule is not None:
            self.schedule.after_step()
        if self.log is not None:
            self.log.after_step()

    def after_reset(self) -> None:
        """Called after episodes were started from outside."""
        if self.log is not None:
            self.log.look()

    def restart(self) -> None:
        """Called before all random streams start over."""
        if self.schedule is not None:
            self.schedule.restart()

    def arrays(self) -> Iterator[tuple[str, wp.array]]:
        """All of it that decides what comes next, by name."""
        if self.draws is None:
            return
        yield "values", self.draws.values
        yield "probe", self.draws.probe
        for part, drawn in (("seen", self._seen), ("tether", self._simulator.tether)):
            yield from ((f"{part}.{name}", array) for name, array in drawn.fields.items())
        if self.schedule is not None:
            yield from ((f"schedule.{name}", array) for name, array in self.schedule.arrays())
