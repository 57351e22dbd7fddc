"""Tasks in plain torch: four functions over all worlds; everything else is as in a task in Warp."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any, ClassVar

import torch
import warp as wp
from torch import Tensor

from finssim.sim.launch import KernelSequence
from finssim.sim.state import State
from finssim.tasks.arrays import Answers, TaskArrays, allocated
from finssim.tasks.given import EnvironmentSetupError
from finssim.tasks.task import Batch, Task
from finssim.tasks.terms import End, RewardTerm, Terms, Total

# The terms of every task in plain torch, which use the answers of its functions; and its draws.


@wp.func
def answered_start(state: State, arrays: TaskArrays, w: int):
    """Take the start that `reset` gave."""
    for v in range(state.position.shape[1]):
        state.position[w, v] = arrays.answers.position[w, v]
        state.quaternion[w, v] = wp.normalize(arrays.answers.quaternion[w, v])
        state.velocity[w, v] = arrays.answers.velocity[w, v]
    arrays.goal_position[w] = arrays.answers.goal_position[w]
    arrays.goal_quaternion[w] = wp.normalize(arrays.answers.goal_quaternion[w])
    for i in range(arrays.answers.memory.shape[1]):
        arrays.answers.memory[w, i] = arrays.answers.begun[w, i]


@wp.func
def answered_reward(arrays: TaskArrays, w: int, a: int) -> float:
    """Return what `reward` returned."""
    return arrays.answers.reward[w, a]


@wp.func
def answered_end(arrays: TaskArrays, w: int) -> bool:
    """Return whether `terminated` was true."""
    return arrays.answers.terminated[w] != 0


@wp.func
def answered_inside(arrays: TaskArrays, w: int) -> bool:
    """Return whether `inside` was true."""
    return arrays.answers.inside[w] != 0


@wp.func
def answered_count(arrays: TaskArrays, w: int, k: int, was: float) -> float:
    """Return the sum of what `counted` returned by this name, both in its unit."""
    return was + arrays.answers.counted[w, k]


@wp.kernel(enable_backward=False)
def draw(
    out: wp.array2d(dtype=float),
    episode: wp.array(dtype=int),
    steps: wp.array(dtype=int),
    seed: int,
    place: int,
    normal: int,
):
    """Fill rows with draws from [0, 1), or of a standard normal: by seed, world, episode, step and place alone."""
    w = wp.tid()
    world_seed = wp.rand_init(seed + 15485863 * episode[w], w)
    rng = wp.rand_init(wp.randi(world_seed) + 104729 * steps[w], place)
    for i in range(out.shape[1]):
        out[w, i] = wp.where(normal != 0, wp.randn(rng), wp.randf(rng))


# All worlds of an environment as torch tensors in the same memory, as a task in plain torch sees them.


class Worlds:
    """State of everything by world, in views that the next step overwrites: read them, and write `memory` alone.

    A world of one vehicle has rows (worlds, ...); of several (worlds, vehicles, ...), agents first.

    Attributes:
        count: Worlds.
        device: Of all tensors.
        position: Body origin, world frame, z up and 0 on the water [m], (..., 3).
        quaternion: Body to world, xyzw, (..., 4).
        velocity: Body frame, linear and then angular [m/s, rad/s], (..., 6).
        goal_position: What `reset` gave, world frame [m], (worlds, 3).
        goal_quaternion: What `reset` gave, (worlds, 4).
        held: Time within the tolerance of success up to the step before, without a break [s], (worlds,).
        memory: The task's own numbers by name, (worlds, size).

    On a robot nothing is drawn or scored: `held` and `memory` are not known there, and who looks at them is refused.
    """

    def __init__(
        self, batch: Batch, memory: Mapping[str, int], control_step: float, *, stage: int, measured: bool
    ) -> None:
        """Look at an environment.

        Args:
            batch: Its arrays.
            memory: Names and sizes of what the task keeps.
            control_step: [s]
            stage: Number of what is being done: no two of them draw the same.
            measured: Show what is measured in place of the truth.
        """
        state, arrays = batch.state, batch.arrays
        source = arrays if measured else state
        self.count = int(state.steps.shape[0])
        self._agents = int(arrays.agent_reward.shape[1])
        alone = state.position.shape[1] == 1
        for name in ("position", "quaternion", "velocity"):
            rows = wp.to_torch(getattr(source, name), requires_grad=False)
            setattr(self, name, rows[:, 0] if alone else rows)
        self.device = wp.device_to_torch(state.steps.device)
        self.goal_position = wp.to_torch(arrays.goal_position, requires_grad=False)
        self.goal_quaternion = wp.to_torch(arrays.goal_quaternion, requires_grad=False)
        self._held = wp.to_torch(arrays.held, requires_grad=False)
        self.memory: Mapping[str, Tensor] = _Unknown()
        if arrays.answers.memory is not None:
            memory_rows = wp.to_torch(arrays.answers.memory, requires_grad=False)
            self.memory = dict(zip(memory, memory_rows.split(list(memory.values()), dim=1), strict=True))
        self._action, self._previous = (
            wp.to_torch(x, requires_grad=False) for x in (arrays.action, arrays.previous_action)
        )
        self._steps = wp.to_torch(state.steps, requires_grad=False)
        self._state, self._seed, self._control_step = state, batch.seed, control_step
        self._first = self._place = stage << 16

    position: Tensor
    quaternion: Tensor
    velocity: Tensor

    def begin(self) -> "Worlds":
        """Start a call of the task's functions: draws are counted from here."""
        self._place = self._first
        return self

    @property
    def held(self) -> Tensor:
        """Time within the tolerance of success up to the step before, without a break [s], (worlds,)."""
        if isinstance(self.memory, _Unknown):
            raise _unknown("w.held")
        return self._held

    @property
    def action(self) -> Tensor:
        """Actions of the agents in this step, in [-1, 1]: (worlds, size), or (worlds, agents, size) of several; zero
        before the first."""
        done = self._action.clamp(-1.0, 1.0)
        return self._by_agent(torch.where(self._steps[:, None] > 0, done, torch.zeros_like(done)))

    @property
    def previous_action(self) -> Tensor:
        """Actions of the step before; zero in the first."""
        return self._by_agent(self._previous)

    @property
    def time(self) -> Tensor:
        """Time in the episode [s], (worlds,)."""
        return self._steps * self._control_step

    def zeros(self, *size: int) -> Tensor:
        """Zeros, (worlds, *size). They have the unit of what is put there."""
        return torch.zeros((self.count, *size), device=self.device)

    def full(self, row: float | Sequence[float]) -> Tensor:
        """Return the same number, (worlds,), or the same row, (worlds, size), for every world. The unit is kept."""
        values = torch.as_tensor(row, dtype=torch.float32, device=self.device)
        return values.expand(self.count, *values.shape)

    def uniform(self, low: float | Sequence[float], high: float | Sequence[float]) -> Tensor:
        """Draws between two numbers, (worlds,), or from a box, (worlds, size).

        They follow from seed, world, episode, step, and from how many draws there were before in this call: equal seeds
        give equal runs, however many worlds there are. `torch.rand` knows nothing of these.
        """
        ends = [torch.as_tensor(end, dtype=torch.float32, device=self.device) for end in (low, high)]
        parts = self._drawn(max(ends[0].numel(), ends[1].numel()), normal=False)
        return ends[0] + (parts if ends[0].dim() or ends[1].dim() else parts[:, 0]) * (ends[1] - ends[0])

    def normal(self, size: int) -> Tensor:
        """Draws of a standard normal, (worlds, size); see `uniform`."""
        return self._drawn(size, normal=True)

    def _drawn(self, size: int, normal: bool) -> Tensor:
        out = torch.empty((self.count, size), device=self.device)
        self._place += 1
        inputs = [wp.from_torch(out), self._state.episode, self._state.steps, self._seed, self._place]
        wp.launch(draw, dim=self.count, inputs=[*inputs, int(normal)], device=self._state.steps.device)
        return out

    def _by_agent(self, rows: Tensor) -> Tensor:
        return rows if self._agents == 1 else rows.view(self.count, self._agents, -1)


class _Unknown(dict[str, Tensor]):
    """A task's memory if it keeps none."""

    def __missing__(self, name: str) -> Tensor:
        raise _unknown(f"w.memory['{name}']")


def _unknown(name: str) -> EnvironmentSetupError:
    return EnvironmentSetupError(
        f"it looks at {name}, which reset, reward and inside make, which do not run on a robot: use "
        "only the measured state, the goal, the actions and the time"
    )


RESET, OBSERVE, SCORE, SCRIPT = range(4)
"""Stages, each with separate draws."""


@dataclass(frozen=True, kw_only=True)
class Start:
    """Start of an episode in every world; it is used where one starts.

    Rows are (worlds, ...), of several vehicles (worlds, vehicles, ...); what is None is zero, or no rotation.
    """

    position: Tensor
    """Body origin, world frame [m], (..., 3)."""
    quaternion: Tensor | None = None
    """Body to world, xyzw, (..., 4); of any length above 0."""
    velocity: Tensor | None = None
    """Body frame, linear and then angular [m/s, rad/s], (..., 6)."""
    goal_position: Tensor | None = None
    """World frame [m], (worlds, 3)."""
    goal_quaternion: Tensor | None = None
    """(worlds, 4)"""
    memory: Mapping[str, Tensor] = field(default_factory=dict)
    """The task's own numbers that do not begin at zero, in its units, (worlds, size)."""


@dataclass(frozen=True, kw_only=True)
class TorchTask(Task):
    """Base of tasks in plain torch. Give `name`, `observation`, and the functions; `w` is always all worlds.

    Called in each step: `reward`, `terminated`, `inside`, `counted`, which see the truth, then `observe`, which sees
    what is measured; where episodes begin `reset`, and `observe` again. Gradients are off.
    """

    succeeds: ClassVar[str] = "held"
    totals: ClassVar[tuple[str, ...]] = ()  # type: ignore[misc]
    """Names of what `counted` counts."""
    memory: ClassVar[Mapping[str, int]] = {}
    """Numbers that the task keeps within an episode: name and size. `reward` may write `w.memory[name][:] = ...`."""

    hold: float = 0.0
    """Success: inside for so long, without a break, when the episode ends [s]; at least one step."""

    def reset(self, w: Worlds) -> Start:
        """Return the start of an episode; random numbers come from `w.uniform` and `w.normal`."""
        raise NotImplementedError(f"task '{self.name}': define reset(self, w) -> Start")

    def observe(self, w: Worlds) -> Sequence[Tensor]:
        """Return the observation of an agent: a tensor for each part of `observation`, in the part's unit.

        They are divided by the part's scale and limited to its clip here. Shapes: (worlds, size), or (worlds, agents,
        size) of several agents; a size of 1 may be left out.
        """
        raise NotImplementedError(f"task '{self.name}': define observe(self, w) -> tensors")

    def reward(self, w: Worlds) -> Tensor:
        """Return the reward of the latest step: (worlds,), or (worlds, agents) of several agents."""
        raise NotImplementedError(f"task '{self.name}': define reward(self, w) -> tensor")

    def terminated(self, w: Worlds) -> Tensor:
        """Return where the episode failed, bool, (worlds,): no further reward is possible. Time ends it in any case."""
        return w.zeros()

    def inside(self, w: Worlds) -> Tensor:
        """Return where the tolerance of success is met [bool], (worlds,); nowhere unless defined."""
        return w.zeros()

    def counted(self, w: Worlds) -> Mapping[str, Tensor]:
        """Return what this step adds to the `totals` of the episode, (worlds,) by name.

        Each has the unit of its total.
        """
        return {}

    def script(self, w: Worlds) -> Tensor:
        """Actions of the `others` in the step to come, (worlds, others, size), each in [-1, 1]."""
        raise NotImplementedError(f"task '{self.name}' has others: define script(self, w) -> tensor")

    def terms(self) -> Terms:
        """Return the terms that every task of this kind uses once its functions have answered."""
        return Terms(
            start=answered_start,
            shown=False,
            rewards=(RewardTerm("reward", answered_reward, 1.0),),
            ends=(End("terminated", answered_end),),
            inside=answered_inside,
            totals=tuple(Total(name, answered_count, index=i) for i, name in enumerate(self.totals)),
        )

    def settings_class(self) -> type:
        """This class: its kernels only carry what the functions answer, and need not be compiled for every task."""
        return TorchTask if type(self).terms is TorchTask.terms else type(self)

    def allocate(self, arrays: TaskArrays, worlds: int, device: wp.Device) -> None:
        """Room for what the functions answer."""
        vehicles, memory = len(self.vehicles), sum(self.memory.values())
        arrays.answers = allocated(
            Answers, worlds, device, reward=len(self.agents), counted=len(self.totals), position=vehicles,
            quaternion=vehicles, velocity=vehicles, begun=memory, memory=memory,
        )  # fmt: skip

    def add_command(self, pipeline: KernelSequence, batch: Batch) -> None:
        """Append what commands the `others`."""
        w, out = self._worlds(batch, SCRIPT), batch.arrays.scripted
        pipeline.call(
            partial(_run, batch, lambda: self._answer("script", self.script(w.begin()).flatten(1), out))
        )

    def add_evaluate(self, pipeline: KernelSequence, batch: Batch) -> None:
        """Append reward, ends and observation."""
        true, measured = self._worlds(batch, SCORE), self._worlds(batch, OBSERVE, measured=True)

        frozen = wp.to_torch(batch.state.frozen, requires_grad=False)[:, None, None]

        def score() -> None:
            self._score(true.begin(), batch.arrays)
            self._look(measured.begin(), batch.arrays, frozen == 0)

        pipeline.call(partial(_run, batch, score))
        super().add_evaluate(pipeline, batch)

    def add_spawn(self, pipeline: KernelSequence, batch: Batch, mask: wp.array) -> None:
        """Append the start of an episode where mask is not 0."""
        w = self._worlds(batch, RESET)
        pipeline.call(partial(_run, batch, lambda: self._begin(w.begin(), batch.arrays), mask))
        super().add_spawn(pipeline, batch, mask)

    def add_observe(self, pipeline: KernelSequence, batch: Batch, mask: wp.array) -> None:
        """Append the first observation where mask is not 0."""
        measured = self._worlds(batch, OBSERVE, measured=True)
        starts = wp.to_torch(mask, requires_grad=False)[:, None, None]
        pipeline.call(
            partial(_run, batch, lambda: self._look(measured.begin(), batch.arrays, starts != 0), mask)
        )

    def _worlds(self, batch: Batch, stage: int, measured: bool = False) -> Worlds:
        return Worlds(batch, self.memory, self.control_step, stage=stage, measured=measured)

    def _score(self, w: Worlds, arrays: TaskArrays) -> None:
        answers = arrays.answers
        self._answer("reward", self.reward(w), answers.reward)
        self._answer("terminated", self.terminated(w), answers.terminated)
        self._answer("inside", self.inside(w), answers.inside)
        counted = self.counted(w)
        if counted.keys() != set(self.totals):
            raise EnvironmentSetupError(
                f"task '{self.name}': counted gives {', '.join(counted) or 'nothing'}, expected the totals: "
                f"{', '.join(self.totals) or 'none'}"
            )
        if counted:
            rows = [counted[name].reshape(w.count, 1) for name in self.totals]
            self._answer("counted", torch.cat(rows, dim=1), answers.counted)

    def _look(self, w: Worlds, arrays: TaskArrays, mask: Tensor) -> None:
        """Write the observation of the worlds `mask`, bool, (worlds, 1, 1)."""
        parts, agents = self.observe(w), len(self.agents)
        if len(parts) != len(self.observation):
            raise EnvironmentSetupError(
                f"task '{self.name}': observe gives {len(parts)} tensors, expected {len(self.observation)}: one for "
                "each part of the observation"
            )
        rows = wp.to_torch(arrays.observation, requires_grad=False).view(w.count, agents, -1)
        first = 0
        for part, part_value in zip(self.observation, parts, strict=True):
            if part_value.numel() != w.count * agents * part.size or part_value.shape[0] != w.count:
                raise EnvironmentSetupError(
                    f"task '{self.name}': observe gives '{part.name}' of shape {tuple(part_value.shape)}, expected "
                    f"{_shape(w.count, agents, part.size)}"
                )
            values = part_value.reshape(w.count, agents, part.size)
            values = values if part.scale == 1.0 else values / part.scale
            values = values if part.clip is None else values.clamp(-part.clip, part.clip)
            old = rows[..., first : first + part.size]
            old[:] = torch.where(mask, values, old)
            first += part.size

    def _begin(self, w: Worlds, arrays: TaskArrays) -> None:
        answers, start = arrays.answers, self.reset(w)
        for name in ("position", "quaternion", "velocity", "goal_position", "goal_quaternion"):
            value, out = getattr(start, name), getattr(answers, name)
            if value is not None:
                self._answer(f"reset: {name}", value, out)
            elif name.endswith("quaternion"):
                out.fill_(wp.quat(0.0, 0.0, 0.0, 1.0))
            else:
                out.zero_()
        unknown = start.memory.keys() - self.memory.keys()
        if unknown:
            raise EnvironmentSetupError(
                f"task '{self.name}': reset gives memory '{min(unknown)}', expected of: "
                f"{', '.join(self.memory) or 'none'}"
            )
        if self.memory:
            rows = [start.memory.get(name, w.zeros(size)) for name, size in self.memory.items()]
            full = torch.cat([row.reshape(w.count, -1) for row in rows], dim=1)
            self._answer("reset: memory", full, answers.begun)

    def _answer(self, name: str, value: Any, out: wp.array) -> None:
        """Copy what a function gave to where the kernels look for it."""
        target = wp.to_torch(out, requires_grad=False)
        if (
            not isinstance(value, Tensor)
            or value.numel() != target.numel()
            or value.shape[0] != target.shape[0]
        ):
            got = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
            expected = tuple(n for i, n in enumerate(target.shape) if n > 1 or i != 1)
            raise EnvironmentSetupError(
                f"task '{self.name}': {name} gives {got}, expected a tensor {expected}"
            )
        target.copy_(value.reshape(target.shape))


def _shape(worlds: int, agents: int, size: int) -> tuple[int, ...]:
    return (worlds, size) if agents == 1 else (worlds, agents, size)


def _run(batch: Batch, function: Callable[[], None], mask: wp.array | None = None) -> None:
    """Call what works in torch, in the order of Warp's kernels; on a CPU only if mask, where given, is set anywhere."""
    with _in_line(batch.state.steps.device), torch.no_grad():
        if mask is None or mask.device.is_cuda or bool(wp.to_torch(mask).any()):
            function()


@contextmanager
def _in_line(device: wp.Device) -> Iterator[None]:
    """On a GPU, run torch's work after the kernels that Warp queued."""
    if device.is_cpu:
        yield
    else:
        with torch.cuda.stream(wp.stream_to_torch(device)):
            yield
