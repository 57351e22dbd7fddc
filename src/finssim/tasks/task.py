"""What a task is: an observation schema, times, and the kernels that score, start and observe an episode."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, ClassVar, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.control.policy_description import ObservationEntry, ObservationSchema
from finssim.engine import Dock, Pool
from finssim.engine.launch import Pipeline
from finssim.engine.state import State
from finssim.tasks.arrays import TaskArrays
from finssim.tasks.measurement import MeasurementNoise
from finssim.vehicles import Vehicle


@dataclass(frozen=True)
class ObservationPart:
    """A named run of numbers in the observation: value / scale, then limited to ±clip."""

    name: str
    size: int
    unit: str
    scale: float = 1.0
    clip: float | None = None


class Batch(NamedTuple):
    """What the parts of a task work on in one environment."""

    state: State
    arrays: TaskArrays
    parameters: Any
    """What `Task.parameters` gave."""
    seed: int


@dataclass(frozen=True, kw_only=True)
class Task:
    """Base of every task: plain data; its kernels are class attributes.

    `evaluate(state, arrays, parameters, world_offset)` after each step, `spawn(state, arrays, parameters, seed, mask,
    world_offset)` where an episode starts, `observe(arrays, mask, world_offset)` for its first observation. A task with
    `others` has `script(state, arrays, parameters, seed, world_offset)` too: it runs before each step and writes
    `arrays.scripted`. The `add_` methods put them where they belong; a task that is not of kernels has its own.
    """

    agents: ClassVar[tuple[str, ...]] = ("vehicle",)
    """Names of the vehicles that learn, in the order of the world's vehicles."""
    others: ClassVar[tuple[str, ...]] = ()
    """Names of the vehicles after them, which the task commands."""
    title: ClassVar[str] = ""
    """What is to be done, in a few words."""
    action: ClassVar[str] = "wrench6"
    """Action mode, unless another is asked for."""
    pool: ClassVar[Pool | None] = Pool()
    """Walls and floor, unless others are asked for; None is open water."""
    levels: ClassVar[int] = 0
    """How many there are, of a task whose setting `level` says how hard it is; 0: it has none."""
    moving: ClassVar[bool] = False
    """Whether what it goes to moves: a robot is then given a trajectory, otherwise a pose."""
    totals: ClassVar[tuple[str, ...]] = ()
    """Names of what the kernels count in `arrays.totals`; zero at the start of an episode, and a part of `metrics`."""

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
    evaluate: ClassVar[Any]
    spawn: ClassVar[Any]
    observe: ClassVar[Any]
    script: ClassVar[Any] = None

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
        settings = asdict(self)
        del settings["observation"]
        return settings

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

    def parameters(self) -> Any:
        """The struct that the kernels take."""
        raise TypeError(f"task '{self.name}' does not say what its kernels take: define parameters()")

    def add_script(self, pipeline: Pipeline, batch: Batch) -> None:
        """Append what commands the `others`, before each step."""
        pipeline.add(self.script, [batch.state, batch.arrays, batch.parameters, batch.seed])

    def add_evaluate(self, pipeline: Pipeline, batch: Batch) -> None:
        """Append what comes after each step: reward, ends, observation."""
        pipeline.add(self.evaluate, [batch.state, batch.arrays, batch.parameters])

    def add_spawn(self, pipeline: Pipeline, batch: Batch, mask: wp.array) -> None:
        """Append the start of an episode where mask (by world, int32) is not 0."""
        pipeline.add(self.spawn, [batch.state, batch.arrays, batch.parameters, batch.seed, mask])

    def add_observe(self, pipeline: Pipeline, batch: Batch, mask: wp.array) -> None:
        """Append the first observation of the episodes that start where mask is not 0."""
        pipeline.add(self.observe, [batch.arrays, mask])

    def metrics(self, arrays: TaskArrays) -> dict[str, NDArray[np.float64]]:
        """How the episode that ended last went, by world.

        Returns:
            Name to numbers (worlds,): return, length in control steps, time held inside the tolerance at the end [s],
            the task's `totals`, and what the task makes of them, such as success (0 or 1).
        """
        totals = arrays.final_totals.numpy()
        columns = {
            "return": arrays.final_return.numpy(),
            "length": arrays.final_length.numpy(),
            "held": arrays.final_held.numpy(),
            **{name: totals[:, i] for i, name in enumerate(self.totals)},
        }
        return {name: np.array(values, dtype=np.float64) for name, values in columns.items()}
