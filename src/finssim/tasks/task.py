"""Tasks: observation, action and reward, as terms, and the length of an episode."""

import hashlib
import inspect
import itertools
import linecache
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from functools import cache
from types import UnionType
from typing import Any, ClassVar, NamedTuple, Union, get_args, get_origin, get_type_hints

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.control.policy import ObservationEntry, ObservationSchema
from finssim.core.page import notebook_html
from finssim.physics.lanes import LANES
from finssim.sim import Dock, RectangularPool
from finssim.sim.launch import KernelSequence
from finssim.sim.state import State
from finssim.tasks import terms as library
from finssim.tasks.arrays import TaskArrays, allocated
from finssim.tasks.blocks import evaluate_in_blocks
from finssim.tasks.measurement import MeasurementNoise
from finssim.tasks.picture import ObservedPicture
from finssim.tasks.terms import ObservationPart, Terms
from finssim.tasks.validation import EnvironmentSetupError
from finssim.vehicles import Vehicle


class Batch(NamedTuple):
    """State, arrays and seed of one environment, for the kernels of a task."""

    state: State
    arrays: TaskArrays
    seed: int


@dataclass(frozen=True, kw_only=True)
class Task:
    """Base class of every task: plain data, and the terms from which its kernels are generated; see
    `finssim.tasks.terms`."""

    agents: ClassVar[tuple[str, ...]] = ("vehicle",)
    """Names of the vehicles that learn, in the order of the world's vehicles."""
    others: ClassVar[tuple[str, ...]] = ()
    """Names of the vehicles after them, which the task commands."""
    title: ClassVar[str] = ""
    """Title of the task, in a few words."""
    needs: ClassVar[tuple[str, ...]] = ()
    """Axes that every vehicle of the task must control; other vehicles are refused before training starts."""
    action: ClassVar[str] = "wrench6"
    """Default action mode."""
    pool: ClassVar[RectangularPool | None] = RectangularPool()
    """Default walls and floor; None is open water."""
    moving: ClassVar[bool] = False
    """True if the goal moves: a robot then needs a trajectory, otherwise a pose."""
    world: ClassVar[str] = ""
    """Site that the vehicle's cameras and sonars render, of the catalogue or a file; empty: none."""
    pictures: ClassVar[tuple[ObservedPicture, ...]] = ()
    """Pictures that are observed besides the numbers."""
    ranges: ClassVar[tuple[str, ...]] = ()
    """Altimeters and rangefinders of the vehicle's `perception` whose ranges are observed, as `arrays.ranges[w,
    i]`."""
    landmark: ClassVar[str] = ""
    """Object of the world whose pose is the goal's."""
    marks: ClassVar[tuple[str, ...]] = ()
    """Objects whose positions in the goal's axes are in `reference.position`, one after the other."""
    held_out: ClassVar[bool] = False
    """True if the world's appearances are drawn from those that are held out of training."""
    teacher: ClassVar[tuple[ObservationPart, ...]] = ()
    """Observation of a teacher in training, instead of the numbers and pictures."""
    succeeds: ClassVar[str] = ""
    """Criterion of success: `held`, for `hold` seconds at the end of an episode; `once`, for `hold` seconds at any
    time; or the name of an end. Empty: no success is defined."""
    fails: ClassVar[tuple[str, ...]] = ()
    """Ends that exclude a success, even if its criterion was met before."""
    baselines: ClassVar[Mapping[str, str | Callable[..., Any]]] = {}
    """Classical controllers with the observation of a policy, by name: `module:class`, created by its `for_vehicle`, or
    a function that returns the controller of a vehicle (`finssim.agents.baselines.Baseline`)."""

    name: str
    observation: tuple[ObservationPart, ...] = field(repr=False)
    control_step: float = 0.1
    """Time between actions [s]."""
    substeps: int = 4
    """Physics steps between actions."""
    time_limit: float = 20.0
    """Length of an episode in training [s]."""
    training_noise: MeasurementNoise = field(default_factory=MeasurementNoise)
    """Errors of the controller's observations in training."""

    def _repr_html_(self) -> str:
        rows = [(part.name, str(part.size), part.unit, f"{part.scale:g}") for part in self.observation]
        title = f"Task {self.name}: {self.action}, every {self.control_step:g} s for {self.time_limit:g} s"
        return notebook_html(title, ("observation", "numbers", "unit", "scale"), rows)

    def terms(self) -> Terms:
        """Return the terms of the task."""
        raise TypeError(f"task '{self.name}' has no terms: define terms()")

    def settings_class(self) -> type:
        """Return the class of the kernels' settings: tasks with the same class and equal terms share kernels."""
        return type(self)

    @property
    def totals(self) -> tuple[str, ...]:
        """Names of the quantities counted in an episode, among its `metrics`: success, the terms' totals, the ends."""
        terms = self.terms()
        first = ("success", "success_time") if self.succeeds == "once" else ()
        return (*first, *(total.name for total in terms.totals), *(end.name for end in terms.ends))

    @property
    def earnings(self) -> tuple[str, ...]:
        """Names of the contributions to the return: the rewards, then the ends."""
        terms = self.terms()
        return (*(reward.name for reward in terms.rewards), *(end.name for end in terms.ends))

    @property
    def observation_size(self) -> int:
        """Numbers in the observation of an agent."""
        return sum(part.size for part in self.observation)

    def for_teacher(self) -> "Task":
        """Return the same task for a teacher, which observes the `teacher` parts and no pictures."""
        blind: dict[str, Any] = {"observation": self.teacher, "world": "", "pictures": ()}
        return replace(self, **blind)

    @property
    def errors(self) -> tuple[int, ...]:
        """Elements of an agent's observation that are 0 at the goal, by the parts' `errors`."""
        firsts = itertools.accumulate((part.size for part in self.observation), initial=0)
        return tuple(
            first + i for first, part in zip(firsts, self.observation, strict=False) for i in part.errors
        )

    @property
    def schema(self) -> ObservationSchema:
        """Observation of an agent in the form of a policy directory, part by part."""
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
        """Return the settings as plain data: ranges, limits, reward weights."""

        def plain(v: Any) -> Any:
            if isinstance(v, tuple):
                return tuple(plain(item) for item in v)
            return asdict(v) if is_dataclass(v) and not isinstance(v, type) else v

        return {
            setting.name: plain(getattr(self, setting.name))
            for setting in fields(self)
            if setting.name != "observation"
        }

    @property
    def vehicles(self) -> tuple[str, ...]:
        """Names of all vehicles in a world: agents, then others."""
        return (*self.agents, *self.others)

    def fitted(self, vehicles: Sequence[Vehicle]) -> "Task":
        """Return the task scaled to these vehicles: the task itself, unless sizes and speeds depend on the
        vehicles."""
        return self

    def arena(self) -> RectangularPool | None:
        """Return the default walls and floor; None is open water."""
        return self.pool

    def dock(self) -> Dock | None:
        """Return the dock that the vehicle enters, one in every world, whose pose is the goal's; None without one."""
        return None

    def site(self, arrays: TaskArrays, seed: int) -> Any:
        """Return the described world drawn for an episode, in which a virtual site's sensors measure; or None.

        Args:
            arrays: Arrays of the episode.
            seed: Seed of noise in the world.
        """
        return None

    def allocate(self, arrays: TaskArrays, worlds: int, device: wp.Device) -> None:
        """Allocate the arrays that only this task uses; none by default."""

    def arrays(self, worlds: int, action_size: int, device: wp.Device) -> TaskArrays:
        """Return zeroed arrays; the environment fills or aliases the measured ones.

        Args:
            worlds: Number of worlds.
            action_size: Numbers in the action of a vehicle.
            device: Warp device of the arrays.
        """
        agents, totals, earned = len(self.agents), len(self.totals), len(self.earnings)
        observation, action = agents * self.observation_size, agents * action_size
        taught = agents * sum(part.size for part in self.teacher)
        out: TaskArrays = allocated(
            TaskArrays, worlds, device, action=action, previous_action=action, observation=observation, taught=taught,
            final_observation=observation, scripted=len(self.others) * action_size, agent_reward=agents, totals=totals,
            final_totals=totals, earned=earned, final_earned=earned, ranges=len(self.ranges),
        )  # fmt: skip
        out.action_size = action_size
        if agents == 1:
            out.reward = out.agent_reward.reshape(worlds)
        out.goal_quaternion.fill_(wp.quat(0.0, 0.0, 0.0, 1.0))
        self.allocate(out, worlds, device)
        return out

    def success_rule(self) -> str:
        """Return the criterion of success, with its numbers, in a few words."""
        hold = getattr(self, "hold", None)
        return "as defined by metrics" if hold is None else f"within its tolerance for {hold:g} s, at the end"

    def add_command(self, pipeline: KernelSequence, batch: Batch) -> None:
        """Append the kernel that commands the `others`, before each step."""
        pipeline.add(kernels_of(self).command, [batch.state, batch.arrays, settings_of(self), batch.seed])

    def add_evaluate(self, pipeline: KernelSequence, batch: Batch) -> None:
        """Append the kernel that follows each step: reward, ends, observation."""
        kernels, terms = kernels_of(self), self.terms()
        weights = [reward.weight for reward in terms.rewards] + [end.reward for end in terms.ends]
        inputs = [batch.state, batch.arrays, settings_of(self), kernels.weights(*(weights or [0.0]))]
        blocks = evaluate_in_blocks(kernels.score, inputs) if pipeline.in_blocks else None
        pipeline.add(blocks or kernels.evaluate, inputs, block=LANES if blocks else None)

    def add_spawn(self, pipeline: KernelSequence, batch: Batch, mask: wp.array) -> None:
        """Append the start of an episode where mask (by world, int32) is not 0."""
        pipeline.add(kernels_of(self).spawn, [batch.state, batch.arrays, settings_of(self), batch.seed, mask])

    def add_observe(self, pipeline: KernelSequence, batch: Batch, mask: wp.array) -> None:
        """Append the first observation of the episodes that start where mask is not 0."""
        pipeline.add(kernels_of(self).observe, [batch.arrays, settings_of(self), mask])

    def metrics(self, arrays: TaskArrays) -> dict[str, NDArray[np.float64]]:
        """Return the metrics of the last finished episode, by world.

        Returns:
            Name -> numbers (worlds,): return, length in control steps, time within the tolerance at the end [s], the
            task's `totals`, and, of a task with success, success (0 or 1) and, unless it must hold to the end,
            success_time [s], which is nan without a success.
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
        for name in self.fails:
            out["success"] *= 1.0 - out[name]
        if "success_time" in out:
            out["success_time"][out["success"] == 0.0] = np.nan
        return out

    def earned(self, arrays: TaskArrays) -> dict[str, NDArray[np.float64]]:
        """Return the contribution of each reward and end to the return of the last finished episode, (worlds,) by
        name."""
        columns = arrays.final_earned.numpy()
        return {name: np.array(columns[:, i], dtype=np.float64) for i, name in enumerate(self.earnings)}


# The kernels of a task, generated from its terms, and the struct of its settings for the kernels.
#
# Each stage of an episode is one kernel, common to all tasks except for the terms that it calls: what every task does
# at the start, in each step and at the end of an episode is defined once. The arguments of a term have these names:
#
#     state   the true state                      a     number of the agent; a reward without it is the team's
#     arrays  measurements, goals, counts         k     the index given with the term
#     p       the task's settings                 key   of an episode's draws, at its start
#     w       number of the world                 seed  of all draws
#
# After a step there are also: any of the task's totals by its name, before the step; `was` for a term's own total;
# `held`, the uninterrupted time within the tolerance of success [s]; and every shared value by its name. Instead of a
# function, a term may be the name of such a value.


APART = ("name", "observation", "training_noise", "communication")
"""Fields of a task that are not settings of its kernels."""
VECTORS = {
    (float, 2): wp.vec2, (float, 3): wp.vec3, (float, 4): wp.vec4,
    (int, 2): wp.vec2i, (int, 3): wp.vec3i, (int, 4): wp.vec4i,
}  # fmt: skip
"""Tuple of numbers -> type in a kernel."""
STAGES = {
    "evaluate": "state: State, arrays: TaskArrays, p: P, weights: W, world_offset: int",
    "spawn": "state: State, arrays: TaskArrays, p: P, seed: int, mask: wp.array(dtype=int), world_offset: int",
    "observe": "arrays: TaskArrays, p: P, mask: wp.array(dtype=int), world_offset: int",
    "command": "state: State, arrays: TaskArrays, p: P, seed: int, world_offset: int",
}
"""The kernels and their arguments."""
SCORE = "score(state: State, arrays: TaskArrays, p: P, weights: W, w: int) -> bool"
"""Function that evaluates a step of a world that is not frozen, and returns whether its episode ends."""
EVALUATE = [
    "w = world_offset + wp.tid()",
    "if state.frozen[w] != 0:",
    "    report_frozen(state, arrays, w)",
    "elif score(state, arrays, p, weights, w):",
    "    close_episode(state, arrays, w)",
]
KEY = "seed + 15485863 * state.episode[w]"


class Kernels(NamedTuple):
    """The stages of a task's episodes, each a kernel over worlds; see `STAGES`."""

    weights: Any
    """Type of the vector of reward weights: those of the terms, then of the ends."""
    score: Any
    """Function that evaluates a world's step; see `SCORE`."""
    evaluate: wp.Kernel
    """Kernel after each step."""
    spawn: wp.Kernel
    """Kernel at the start of an episode."""
    observe: wp.Kernel
    """Kernel of the first observation of an episode."""
    command: wp.Kernel | None = None
    """Kernel before each step, for a task with scripted vehicles."""


_made: dict[tuple[Any, ...], Kernels] = {}


def kernels_of(task: Task) -> Kernels:
    """Return the kernels of a task; tasks with equal terms share them.

    Raises:
        EnvironmentSetupError: A term has an unknown argument.
    """
    writer = _Writer(task)
    text = writer.text()
    key = (task.settings_class(), text, tuple(writer.functions.values()))
    if key not in _made:
        _made[key] = _compiled(task, text, writer.functions)
    return _made[key]


class _Writer:
    """Generator of the source of a task's kernels."""

    def __init__(self, task: Task) -> None:
        self.task, self.terms = task, task.terms()
        self.functions: dict[str, Any] = {}
        """Name in the source -> function."""
        self._totals = {name: f"arrays.totals[w, {i}]" for i, name in enumerate(task.totals)}
        self._agents = f"for a in range({len(task.agents)}):"

    def text(self) -> str:
        """Return the complete source."""
        stages = {name: getattr(self, f"_{name}")() for name in STAGES if name != "evaluate"}
        stages = {"evaluate": EVALUATE, **stages}
        sources = [_function(f"{name}({STAGES[name]})", lines) for name, lines in stages.items() if lines]
        look = _function("look(arrays: TaskArrays, p: P, w: int)", self._look())
        return "\n".join([look, _function(SCORE, self._score()), *sources])

    def _value(self, term: Any, role: str, **values: str) -> str:
        """Return the expression of a term in the source: a call with its arguments by name, or a value by its name."""
        where = f"task '{self.task.name}': {role}"
        if isinstance(term, str) and term in values:
            return values[term]
        if not (isinstance(term, wp.Function) and term.func):
            known = ", ".join(values) or "none here"
            raise EnvironmentSetupError(
                f"{where} is {term!r}, expected a function with @wp.func, or the name of a value ({known})"
            )
        scope = {name: name for name in ("arrays", "p", "w", "a")} | values
        names = inspect.signature(term.func).parameters
        for name in names:
            if name not in scope:
                raise EnvironmentSetupError(
                    f"{where} ({term.key}) has the argument '{name}', expected of: {', '.join(scope)}"
                )
        label = next(
            (n for n, f in self.functions.items() if f is term), f"t{len(self.functions)}_{term.key}"
        )
        self.functions[label] = term
        return f"{label}({', '.join(scope[name] for name in names)})"

    def _shared(self, terms: Mapping[str, Any], scope: dict[str, str]) -> tuple[list[str], dict[str, str]]:
        """Return the lines that compute shared values, and the scope with their names."""
        lines, scope = [], dict(scope)
        for name, term in terms.items():
            lines.append(f"s_{name} = {self._value(term, f'shared {name!r}', **scope)}")
            scope[name] = f"s_{name}"
        return lines, scope

    def _look(self) -> list[str]:
        """Return the lines that write the observation of every agent."""
        values, shared = self._shared(self.terms.seen, {})
        writes: list[str] = []
        rows = {"observation": self.task.observation if self.terms.shown else (), "taught": self.task.teacher}
        parts = [(row, part) for row, parts_of_row in rows.items() for part in parts_of_row]
        sizes = {row: sum(part.size for part in parts_of_row) for row, parts_of_row in rows.items()}
        first = dict.fromkeys(rows, 0)
        for i, (row, part) in enumerate(parts):
            value = self._value(part.term, f"observation '{part.name}'", **shared, k=str(part.index))
            number = f"x{i}" if part.size == 1 else f"x{i}[i]"
            if part.scale != 1.0:
                number = f"{number} / {float(part.scale)!r}"
            if part.clip is not None:
                number = f"wp.clamp({number}, {-float(part.clip)!r}, {float(part.clip)!r})"
            values.append(f"x{i} = {value}")
            loop = f"for i in range({part.size}):"
            writes += [loop, f"    arrays.{row}[w, a * {sizes[row]} + {first[row]} + i] = {number}"]
            first[row] += part.size
        return [self._agents, *_indented([*values, *writes] or ["pass"])]

    def _score(self) -> list[str]:
        """Return the lines of a step; all terms precede all writes, so that the compiler evaluates common
        expressions once."""
        terms, scope = self.terms, {"state": "state", **self._totals}
        advance = [] if terms.advance is None else [self._value(terms.advance, "advance", **scope)]
        shared, scope = self._shared(terms.shared, scope)
        inside = "False" if terms.inside is None else self._value(terms.inside, "inside", **scope)
        scope["held"] = "held"
        ends = [
            f"e{i} = first_time({self._value(end.term, f'end {end.name!r}', **scope)}, ended)\n"
            f"ended = either(ended, e{i})"
            for i, end in enumerate(terms.ends)
        ]
        counts, counted = self._counts(scope)
        return [
            "t = float(state.steps[w]) * p.control_step",
            "arrays.time[w] = t",
            *advance,
            *shared,
            f"held = wp.where({inside}, arrays.held[w] + p.control_step, 0.0)",
            "ended = bool(False)",
            *"\n".join(ends).splitlines(),
            "late = t >= p.time_limit - 0.5 * p.control_step",
            *counts,
            *self._rewards(scope),
            *counted,
            "arrays.held[w] = held",
            "arrays.terminated[w] = wp.where(ended, 1, 0)",
            "over = either(ended, late)",
            "arrays.truncated[w] = wp.where(first_time(late, ended), 1, 0)",
            "arrays.done[w] = wp.where(over, 1, 0)",
            "arrays.episode_return[w] = arrays.episode_return[w] + reward",
            "remember_actions(arrays, w)",
            "look(arrays, p, w)",
            "return over",
        ]

    def _rewards(self, scope: Mapping[str, str]) -> list[str]:
        """Return the lines that compute every reward once, for all agents or for each, their sum, and their sums over
        the episode."""
        values = [self._value(term.term, f"reward {term.name!r}", **scope) for term in self.terms.rewards] + [
            f"wp.where(e{i}, 1.0, 0.0)" for i, _ in enumerate(self.terms.ends)
        ]
        numbers, count = range(len(values)), float(len(self.task.agents))
        each = [i for i in numbers if re.search(r"\ba\b", values[i])]
        lines = [f"r{i} = weights[{i}] * {values[i]}" for i in numbers]
        means = [f"m{i} / {count!r}" if i in each else f"r{i}" for i in numbers]
        loop = [
            *(lines[i] for i in each),
            f"total = {' + '.join(f'r{i}' for i in numbers) or '0.0'}",
            *(f"m{i} += r{i}" for i in each),
            "arrays.agent_reward[w, a] = total",
            f"reward += total / {count!r}",
        ]
        return [
            *(lines[i] for i in numbers if i not in each),
            *(f"m{i} = float(0.0)" for i in each),
            "reward = float(0.0)",
            self._agents,
            *_indented(loop),
            *(f"arrays.earned[w, {i}] = arrays.earned[w, {i}] + {mean}" for i, mean in enumerate(means)),
            "arrays.reward[w] = reward",
        ]

    def _counts(self, scope: Mapping[str, str]) -> tuple[list[str], list[str]]:
        """Return the lines that compute the totals, each from all previous ones, and the lines that write them."""
        values, writes, totals = [], [], self._totals
        if self.task.succeeds == "once":
            writes += [
                f"if held >= p.hold - 0.5 * p.control_step and {totals['success']} == 0.0:",
                f"    {totals['success']} = 1.0",
                f"    {totals['success_time']} = t",
            ]
        for i, total in enumerate(self.terms.totals):
            local = {"was": totals[total.name], "k": str(total.index)}
            values.append(f"n{i} = {self._value(total.term, f'total {total.name!r}', **scope, **local)}")
            writes.append(f"{totals[total.name]} = n{i}")
        ends = enumerate(self.terms.ends)
        writes += [f"{totals[end.name]} = wp.where(e{i}, 1.0, 0.0)" for i, end in ends if end.name in totals]
        return values, writes

    def _spawn(self) -> list[str]:
        scope = {"state": "state", "seed": "seed", "key": "key"}
        start = self._value(self.terms.start, "start", **scope)
        firsts = {total.name: total.first for total in self.terms.totals if total.first != 0.0}
        shared: list[str] = []
        if not all(isinstance(first, int | float) for first in firsts.values()):
            shared, scope = self._shared(self.terms.shared, scope)
        for name, first in firsts.items():
            number = isinstance(first, int | float)
            value = first if number else self._value(first, f"first of total {name!r}", **scope)
            shared.append(f"{self._totals[name]} = float({value})")
        head = ["w = world_offset + wp.tid()", "if mask[w] == 0:", "    return"]
        return [*head, f"key = {KEY}", "open_episode(arrays, w)", start, *shared]

    def _observe(self) -> list[str]:
        begin = [] if self.terms.begin is None else [self._value(self.terms.begin, "begin")]
        return ["w = world_offset + wp.tid()", "if mask[w] != 0:", *_indented([*begin, "look(arrays, p, w)"])]

    def _command(self) -> list[str]:
        if self.terms.command is None:
            return []
        scope = {"state": "state", "seed": "seed", "key": f"({KEY})"}
        return ["w = world_offset + wp.tid()", self._value(self.terms.command, "command", **scope)]


def _indented(lines: Iterable[str]) -> list[str]:
    return [f"    {line}" for line in lines]


def _function(head: str, lines: Sequence[str]) -> str:
    return "\n".join([f"def {head}:", *_indented(lines)]) + "\n"


_numbers = itertools.count()


def _compiled(task: Task, text: str, functions: Mapping[str, Any]) -> Kernels:
    """Compile the kernels of a source, in a separate Warp module."""
    kind = task.settings_class()
    digest = hashlib.sha256(text.encode()).hexdigest()[:8]
    name = f"{kind.__module__}.{kind.__qualname__}_{digest}"
    if any(kernels.evaluate.module.name == name for kernels in _made.values()):
        # Other functions with the same names.
        name = f"{name}_{next(_numbers)}"
    path = f"<kernels of {name}>"
    linecache.cache[path] = (len(text), None, text.splitlines(keepends=True), path)  # Warp reads the source
    terms = task.terms()
    W = wp.types.vector(length=max(len(terms.rewards) + len(terms.ends), 1), dtype=float)
    space: dict[str, Any] = {
        **vars(library), "__name__": name, "wp": wp, "State": State, "TaskArrays": TaskArrays, "P": _struct(kind),
        "W": W, **functions,
    }  # fmt: skip
    exec(compile(text, path, "exec"), space)
    module = wp.get_module(name)
    for name_of in ("look", "score"):
        space[name_of] = wp.func(space[name_of], module=module)
    compiled = [
        wp.kernel(space[stage], enable_backward=False, module=module) for stage in STAGES if stage in space
    ]
    return Kernels(W, space["score"], *compiled)


def settings_of(task: Task) -> Any:
    """Return the struct of a task's settings: its numbers, those of nested dataclasses, and derived properties.

    It contains every field and property with an annotation of float, int, bool, a tuple of two to four of these, or a
    dataclass of these, under its own name.

    Raises:
        EnvironmentSetupError: The task is not fitted to vehicles.
    """
    return _filled(task, task.settings_class(), f"task '{task.name}'")


def _filled(owner_value: Any, kind: type, owner: str) -> Any:
    struct = _struct(kind)
    out = struct()
    for name, variable in struct.vars.items():
        value = getattr(owner_value, name)
        if value is None:
            raise EnvironmentSetupError(f"{owner} is not fitted to vehicles: call fitted([...]) first")
        if is_dataclass(value):
            value = _filled(value, type(value), owner)
        setattr(out, name, variable.type(*value) if isinstance(value, tuple) else value)
    return out


@cache
def _struct(kind: type) -> Any:
    """Return the Warp struct of the fields of a dataclass that kernels support; None if there are none."""
    annotations = _hints(kind)
    hints = {member.name: annotations.get(member.name) for member in fields(kind) if member.name not in APART}
    for name, value in inspect.getmembers(kind, lambda member: isinstance(member, property)):
        if not hasattr(Task, name) and value.fget is not None:
            hints[name] = _hints(value.fget).get("return")
    types = {
        name: kernel_type for name, hint in hints.items() if (kernel_type := _kernel_type(hint)) is not None
    }
    if not types:
        return None
    struct = type(kind.__name__, (), {"__annotations__": types, "__module__": kind.__module__})
    # Local classes of the same name are different classes.
    struct.__qualname__ = f"{kind.__qualname__}Settings" + (
        str(next(_numbers)) if "<" in kind.__qualname__ else ""
    )
    return wp.struct(struct)


def _hints(annotated: Any) -> dict[str, Any]:
    """Return the annotations of a class or function; none if they use names that are only imported for type
    checking."""
    try:
        return get_type_hints(annotated)
    except NameError:
        return {}


def _kernel_type(hint: Any) -> Any:
    """Return the type in a kernel, also for an optional dataclass; None if kernels do not support it."""
    parts = get_args(hint)
    if get_origin(hint) in (Union, UnionType):
        rest = [part for part in parts if part is not type(None)]
        return _struct(rest[0]) if len(rest) == 1 and is_dataclass(rest[0]) else None
    if get_origin(hint) is tuple:
        return VECTORS.get((parts[0], len(parts))) if len(set(parts)) == 1 else None
    if isinstance(hint, type) and is_dataclass(hint):
        return _struct(hint)
    return hint if hint in (float, int, bool) else None
