"""What a task is: what is seen, done and paid for, as terms, and how long an episode takes."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.control.policy_description import ObservationEntry, ObservationSchema
from finssim.engine import Dock, Pool
from finssim.engine.launch import Pipeline
from finssim.engine.state import State
from finssim.tasks.arrays import TaskArrays
from finssim.tasks.kernels import kernels_of, settings_of
from finssim.tasks.measurement import MeasurementNoise
from finssim.tasks.terms import Terms
from finssim.vehicles import Vehicle


@dataclass(frozen=True)
class ObservationPart:
    """A named run of numbers in the observation: value / scale, then limited to ±clip."""

    name: str
    size: int
    unit: str
    scale: float = 1.0
    clip: float | None = None
    term: Any = field(default=None, repr=False)
    """What gives the value, from what is measured: a float, or a vector of `size`. None in a task in plain torch."""
    index: int = 0
    """The term's argument `k`: of which team-mate, how far ahead, ..."""


class Batch(NamedTuple):
    """What the parts of a task work on in one environment."""

    state: State
    arrays: TaskArrays
    seed: int


@dataclass(frozen=True, kw_only=True)
class Task:
    """Base of every task: plain data, and the terms that make kernels of it; see `finssim.tasks.terms`."""

    agents: ClassVar[tuple[str, ...]] = ("vehicle",)
    """Names of the vehicles that learn, in the order of the world's vehicles."""
    others: ClassVar[tuple[str, ...]] = ()
    """Names of the vehicles after them, which the task commands."""
    title: ClassVar[str] = ""
    """What is to be done, in a few words."""
    needs: ClassVar[tuple[str, ...]] = ()
    """Axes that every vehicle of the task must control; another is refused before anything is trained."""
    action: ClassVar[str] = "wrench6"
    """Action mode, unless another is asked for."""
    pool: ClassVar[Pool | None] = Pool()
    """Walls and floor, unless others are asked for; None is open water."""
    levels: ClassVar[int] = 0
    """How many there are, of a task whose setting `level` says how hard it is; 0: it has none."""
    moving: ClassVar[bool] = False
    """Whether what it goes to moves: a robot is then given a trajectory, otherwise a pose."""
    succeeds: ClassVar[str] = ""
    """When an episode is a success: `held`, for `hold` seconds at its end; `once`, for `hold` seconds at any time; or
    the name of an end. Empty: nothing is."""

    name: str
    observation: tuple[ObservationPart, ...] = field(repr=False)
    control_step: float = 0.1
    """Time between actions [s]."""
    substeps: int = 4
    """Physics steps between actions."""
    time_limit: float = 20.0
    """Length of an episode in training [s]."""
    training_noise: MeasurementNoise = field(default_factory=MeasurementNoise)
    """On what the controller sees in training."""

    def terms(self) -> Terms:
        """Of what the task is made."""
        raise TypeError(f"task '{self.name}' does not say of what it is made: define terms()")

    def settings_class(self) -> type:
        """The class whose settings its kernels take: tasks of one such class and equal terms share kernels."""
        return type(self)

    @property
    def totals(self) -> tuple[str, ...]:
        """Names of what is counted in an episode, a part of `metrics`: success, the terms' totals, the ends."""
        terms = self.terms()
        first = ("success", "success_time") if self.succeeds == "once" else ()
        return (*first, *(total.name for total in terms.totals), *(end.name for end in terms.ends))

    @property
    def earnings(self) -> tuple[str, ...]:
        """Names of what adds to the return: the rewards, then the ends."""
        terms = self.terms()
        return (*(reward.name for reward in terms.rewards), *(end.name for end in terms.ends))

    @property
    def observation_size(self) -> int:
        """Numbers in the observation of an agent."""
        return sum(part.size for part in self.observation)

    @property
    def schema(self) -> ObservationSchema:
        """The observation of an agent as a policy directory tells it, part by part."""
        entries, first = [], 0
        for part in self.observation:
            clip = None if part.clip is None else (-part.clip, part.clip)
            indices = tuple(range(first, first + part.size))
            entries.append(
                ObservationEntry(name=part.name, indices=indices, unit=part.unit, scale=part.scale, clip=clip)
            )
            first += part.size
        return ObservationSchema(size=first, entries=tuple(entries))

    def record(self) -> dict[str, Any]:
        """The settings as plain data: ranges, limits, reward weights."""
        kept = {one.name: getattr(self, one.name) for one in fields(self) if one.name != "observation"}
        return {
            name: asdict(v) if is_dataclass(v) and not isinstance(v, type) else v for name, v in kept.items()
        }

    @property
    def vehicles(self) -> tuple[str, ...]:
        """Names of all vehicles in a world: agents, then others."""
        return (*self.agents, *self.others)

    def fitted(self, vehicles: Sequence[Vehicle]) -> "Task":
        """The task as these vehicles do it: itself, unless sizes and speeds follow from the vehicles."""
        return self

    def arena(self) -> Pool | None:
        """Walls and floor, unless others are asked for; None is open water."""
        return self.pool

    def dock(self) -> Dock | None:
        """What stands in every world for the vehicle to enter; its pose is the goal's. None: nothing does."""
        return None

    def allocate(self, arrays: TaskArrays, worlds: int, device: wp.Device) -> None:
        """Give `arrays` what only this task uses; nothing unless the task says so."""

    def success_rule(self) -> str:
        """What counts as a success, with its numbers, in a few words."""
        hold = getattr(self, "hold", None)
        return "as metrics tells" if hold is None else f"within its tolerance for {hold:g} s, at the end"

    def add_command(self, pipeline: Pipeline, batch: Batch) -> None:
        """Append what commands the `others`, before each step."""
        pipeline.add(kernels_of(self).command, [batch.state, batch.arrays, settings_of(self), batch.seed])

    def add_evaluate(self, pipeline: Pipeline, batch: Batch) -> None:
        """Append what comes after each step: reward, ends, observation."""
        made, terms = kernels_of(self), self.terms()
        weights = [reward.weight for reward in terms.rewards] + [end.reward for end in terms.ends]
        inputs = [batch.state, batch.arrays, settings_of(self), made.weights(*(weights or [0.0]))]
        pipeline.add(made.evaluate, inputs)

    def add_spawn(self, pipeline: Pipeline, batch: Batch, mask: wp.array) -> None:
        """Append the start of an episode where mask (by world, int32) is not 0."""
        pipeline.add(kernels_of(self).spawn, [batch.state, batch.arrays, settings_of(self), batch.seed, mask])

    def add_observe(self, pipeline: Pipeline, batch: Batch, mask: wp.array) -> None:
        """Append the first observation of the episodes that start where mask is not 0."""
        pipeline.add(kernels_of(self).observe, [batch.arrays, settings_of(self), mask])

    def metrics(self, arrays: TaskArrays) -> dict[str, NDArray[np.float64]]:
        """How the episode that ended last went, by world.

        Returns:
            Name to numbers (worlds,): return, length in control steps, time held inside the tolerance at the end [s],
            the task's `totals`, and, of a task with success, success (0 or 1) and, unless it is to hold to the end,
            success_time [s], nan where there was none.
        """
        totals = arrays.final_totals.numpy()
        columns = {
            "return": arrays.final_return.numpy(),
            "length": arrays.final_length.numpy(),
            "held": arrays.final_held.numpy(),
            **{name: totals[:, i] for i, name in enumerate(self.totals)},
        }
        out = {name: np.array(values, dtype=np.float64) for name, values in columns.items()}
        if self.succeeds == "held":
            hold: float = getattr(self, "hold", 0.0)
            out["success"] = np.where(
                out["held"] >= max(hold, self.control_step) - 0.5 * self.control_step, 1.0, 0.0
            )
        elif self.succeeds and self.succeeds != "once":
            out["success"] = np.where(out[self.succeeds] > 0.0, 1.0, 0.0)
            out["success_time"] = self.control_step * out["length"]
        if "success_time" in out:
            out["success_time"][out["success"] == 0.0] = np.nan
        return out

    def earned(self, arrays: TaskArrays) -> dict[str, NDArray[np.float64]]:
        """What each reward and each end added to the return of the episode that ended last, (worlds,) by name."""
        columns = arrays.final_earned.numpy()
        return {name: np.array(columns[:, i], dtype=np.float64) for i, name in enumerate(self.earnings)}
