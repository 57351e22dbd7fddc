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
from finssim.tasks.arrays import TaskArrays, TorchResults, allocated
from finssim.tasks.task import Batch, Task
from finssim.tasks.terms import End, RewardTerm, Terms, Total
from finssim.tasks.validation import EnvironmentSetupError

# Terms of every task in plain torch, which read the results of its functions, and the random draws.


@wp.func
def result_start(state: State, arrays: TaskArrays, w: int):
    """Copy the start that `reset` returned."""
    for v in range(state.position.shape[1]):
        state.position[w, v] = arrays.torch_results.position[w, v]
        state.quaternion[w, v] = wp.normalize(arrays.torch_results.quaternion[w, v])
        state.velocity[w, v] = arrays.torch_results.velocity[w, v]
    arrays.goal_position[w] = arrays.torch_results.goal_position[w]
    arrays.goal_quaternion[w] = wp.normalize(arrays.torch_results.goal_quaternion[w])
    for i in range(arrays.torch_results.memory.shape[1]):
        arrays.torch_results.memory[w, i] = arrays.torch_results.begun[w, i]


@wp.func
def result_reward(arrays: TaskArrays, w: int, a: int) -> float:
    """Return the result of `reward`."""
    return arrays.torch_results.reward[w, a]


@wp.func
def result_end(arrays: TaskArrays, w: int) -> bool:
    """Return the result of `terminated`."""
    return arrays.torch_results.terminated[w] != 0


@wp.func
def result_inside(arrays: TaskArrays, w: int) -> bool:
    """Return the result of `inside`."""
    return arrays.torch_results.inside[w] != 0


@wp.func
def result_count(arrays: TaskArrays, w: int, k: int, was: float) -> float:
    """Return the sum of the results of `counted` under this name, both in its unit."""
    return was + arrays.torch_results.counted[w, k]


@wp.kernel(enable_backward=False)
def draw(
    out: wp.array2d(dtype=float),
    episode: wp.array(dtype=int),
    steps: wp.array(dtype=int),
    seed: int,
    place: int,
    normal: int,
):
    """Fill rows with draws from [0, 1), or from a standard normal, that depend only on seed, world, episode, step
    and `place`, a number of the draw."""
    w = wp.tid()
    world_seed = wp.rand_init(seed + 15485863 * episode[w], w)
    rng = wp.rand_init(wp.randi(world_seed) + 104729 * steps[w], place)
    for i in range(out.shape[1]):
        out[w, i] = wp.where(normal != 0, wp.randn(rng), wp.randf(rng))


# All worlds of an environment as torch tensors in the same memory, for a task in plain torch.


class Worlds:
    """State of all worlds, in views that the next step overwrites; everything except `memory` is read-only.

    With one vehicle per world, rows are (worlds, ...); with several (worlds, vehicles, ...), agents first.

    Attributes:
        count: Number of worlds.
        device: Device of all tensors.
        position: Body origin, world frame, z up and 0 on the water [m], (..., 3).
        quaternion: Body to world, xyzw, (..., 4).
        velocity: Body frame, linear and then angular [m/s, rad/s], (..., 6).
        goal_position: Goal that `reset` returned, world frame [m], (worlds, 3).
        goal_quaternion: Goal that `reset` returned, (worlds, 4).
        held: Uninterrupted time within the tolerance of success up to the previous step [s], (worlds,).
        memory: The task's own numbers by name, (worlds, size).

    On a robot, random draws and rewards are not available: reading `held` or `memory` is then refused.
    """

    def __init__(
        self, batch: Batch, memory: Mapping[str, int], control_step: float, *, stage: int, measured: bool
    ) -> None:
        """Create views of an environment.

        Args:
            batch: State and arrays of the environment.
            memory: Names and sizes of the task's own numbers.
            control_step: [s]
            stage: Number of the stage; each stage has its own draws.
            measured: True for measurements instead of the true state.
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
        if arrays.torch_results.memory is not None:
            memory_rows = wp.to_torch(arrays.torch_results.memory, requires_grad=False)
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
        """Restart the count of draws, at the start of a call of the task's functions."""
        self._place = self._first
        return self

    @property
    def held(self) -> Tensor:
        """Uninterrupted time within the tolerance of success up to the previous step [s], (worlds,)."""
        if isinstance(self.memory, _Unknown):
            raise _unknown("w.held")
        return self._held

    @property
    def action(self) -> Tensor:
        """Actions of the agents in this step, in [-1, 1]: (worlds, size), or (worlds, agents, size) of several; zero
        before the first step."""
        done = self._action.clamp(-1.0, 1.0)
        return self._by_agent(torch.where(self._steps[:, None] > 0, done, torch.zeros_like(done)))

    @property
    def previous_action(self) -> Tensor:
        """Actions of the previous step; zero in the first."""
        return self._by_agent(self._previous)

    @property
    def time(self) -> Tensor:
        """Time in the episode [s], (worlds,)."""
        return self._steps * self._control_step

    def zeros(self, *size: int) -> Tensor:
        """Return zeros, (worlds, *size), of any unit."""
        return torch.zeros((self.count, *size), device=self.device)

    def full(self, row: float | Sequence[float]) -> Tensor:
        """Return the same number, (worlds,), or the same row, (worlds, size), for every world. The unit is kept."""
        values = torch.as_tensor(row, dtype=torch.float32, device=self.device)
        return values.expand(self.count, *values.shape)

    def uniform(self, low: float | Sequence[float], high: float | Sequence[float]) -> Tensor:
        """Return draws between two numbers, (worlds,), or from a box, (worlds, size).

        They depend on seed, world, episode, step, and the number of earlier draws in this call: equal seeds give equal
        runs, for any number of worlds. `torch.rand` does not have this property.
        """
        ends = [torch.as_tensor(end, dtype=torch.float32, device=self.device) for end in (low, high)]
        parts = self._drawn(max(ends[0].numel(), ends[1].numel()), normal=False)
        return ends[0] + (parts if ends[0].dim() or ends[1].dim() else parts[:, 0]) * (ends[1] - ends[0])

    def normal(self, size: int) -> Tensor:
        """Return draws from a standard normal, (worlds, size); see `uniform`."""
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
    """Memory of a task outside an episode; reading it is refused."""

    def __missing__(self, name: str) -> Tensor:
        raise _unknown(f"w.memory['{name}']")


def _unknown(name: str) -> EnvironmentSetupError:
    return EnvironmentSetupError(
        f"it reads {name}, which depends on reset, reward and inside, and these do not run on a robot: use "
        "only the measured state, the goal, the actions and the time"
    )


RESET, OBSERVE, SCORE, SCRIPT = range(4)
"""Stages, each with separate draws."""


@dataclass(frozen=True, kw_only=True)
class Start:
    """Start of an episode in every world; only worlds that start one use it.

    Rows are (worlds, ...), or (worlds, vehicles, ...) for several vehicles; None means zero, or no rotation.
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
    """Initial values of the task's own numbers, in its units, (worlds, size); zero for omitted ones."""


@dataclass(frozen=True, kw_only=True)
class TorchTask(Task):
    """Base class of tasks in plain torch. Define `name`, `observation`, and the functions; `w` is always all worlds.

    In each step `reward`, `terminated`, `inside` and `counted` are called with the true state, then `observe` with
    measurements; at the start of episodes `reset`, and `observe` again. Gradients are disabled.
    """

    succeeds: ClassVar[str] = "held"
    totals: ClassVar[tuple[str, ...]] = ()  # type: ignore[misc]
    """Names of the quantities that `counted` returns."""
    memory: ClassVar[Mapping[str, int]] = {}
    """Numbers that persist within an episode: name and size. `reward` may write `w.memory[name][:] = ...`."""

    hold: float = 0.0
    """Uninterrupted time within the tolerance at the end of an episode, for success [s]; at least one step."""

    def reset(self, w: Worlds) -> Start:
        """Return the start of an episode; random numbers come from `w.uniform` and `w.normal`."""
        raise EnvironmentSetupError(f"task '{self.name}': define reset(self, w) -> Start")

    def observe(self, w: Worlds) -> Sequence[Tensor]:
        """Return the observation of an agent: a tensor for each part of `observation`, in the part's unit.

        The caller divides them by the part's scale and limits them to its clip. Shapes: (worlds, size), or (worlds,
        agents, size) of several agents; a size of 1 may be omitted.
        """
        raise EnvironmentSetupError(f"task '{self.name}': define observe(self, w) -> tensors")

    def reward(self, w: Worlds) -> Tensor:
        """Return the reward of the latest step: (worlds,), or (worlds, agents) of several agents."""
        raise EnvironmentSetupError(f"task '{self.name}': define reward(self, w) -> tensor")

    def terminated(self, w: Worlds) -> Tensor:
        """Return where the episode failed, bool, (worlds,): no further reward is possible. The time limit applies
        in any case."""
        return w.zeros()

    def inside(self, w: Worlds) -> Tensor:
        """Return where the tolerance of success is met [bool], (worlds,); False by default."""
        return w.zeros()

    def counted(self, w: Worlds) -> Mapping[str, Tensor]:
        """Return the increments of the `totals` of the episode in this step, (worlds,) by name.

        Each has the unit of its total.
        """
        return {}

    def script(self, w: Worlds) -> Tensor:
        """Return the actions of the `others` in the next step, (worlds, others, size), each in [-1, 1]."""
        raise EnvironmentSetupError(f"task '{self.name}' has others: define script(self, w) -> tensor")

    def terms(self) -> Terms:
        """Return the terms common to all torch tasks, which read the results of their functions."""
        return Terms(
            start=result_start,
            shown=False,
            rewards=(RewardTerm("reward", result_reward, 1.0),),
            ends=(End("terminated", result_end),),
            inside=result_inside,
            totals=tuple(Total(name, result_count, index=i) for i, name in enumerate(self.totals)),
        )

    def settings_class(self) -> type:
        """Return this class: its kernels only copy the results of the functions, so they are compiled once for all
        tasks."""
        return TorchTask if type(self).terms is TorchTask.terms else type(self)

    def allocate(self, arrays: TaskArrays, worlds: int, device: wp.Device) -> None:
        """Allocate the results of the functions."""
        vehicles, memory = len(self.vehicles), sum(self.memory.values())
        arrays.torch_results = allocated(
            TorchResults, worlds, device, reward=len(self.agents), counted=len(self.totals), position=vehicles,
            quaternion=vehicles, velocity=vehicles, begun=memory, memory=memory,
        )  # fmt: skip

    def add_command(self, pipeline: KernelSequence, batch: Batch) -> None:
        """Append the call that commands the `others`."""
        w, out = self._worlds(batch, SCRIPT), batch.arrays.scripted
        pipeline.call(
            partial(_run, batch, lambda: self._copy_result("script", self.script(w.begin()).flatten(1), out))
        )

    def add_evaluate(self, pipeline: KernelSequence, batch: Batch) -> None:
        """Append reward, ends and observation."""
        true, measured = self._worlds(batch, SCORE), self._worlds(batch, OBSERVE, measured=True)

        frozen = wp.to_torch(batch.state.frozen, requires_grad=False)[:, None, None]

        def score() -> None:
            self._score(true.begin(), batch.arrays)
            self._write_observation(measured.begin(), batch.arrays, frozen == 0)

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
            partial(
                _run,
                batch,
                lambda: self._write_observation(measured.begin(), batch.arrays, starts != 0),
                mask,
            )
        )

    def _worlds(self, batch: Batch, stage: int, measured: bool = False) -> Worlds:
        return Worlds(batch, self.memory, self.control_step, stage=stage, measured=measured)

    def _score(self, w: Worlds, arrays: TaskArrays) -> None:
        torch_results = arrays.torch_results
        self._copy_result("reward", self.reward(w), torch_results.reward)
        self._copy_result("terminated", self.terminated(w), torch_results.terminated)
        self._copy_result("inside", self.inside(w), torch_results.inside)
        counted = self.counted(w)
        if counted.keys() != set(self.totals):
            raise EnvironmentSetupError(
                f"task '{self.name}': counted gives {', '.join(counted) or 'nothing'}, expected the totals: "
                f"{', '.join(self.totals) or 'none'}"
            )
        if counted:
            rows = [counted[name].reshape(w.count, 1) for name in self.totals]
            self._copy_result("counted", torch.cat(rows, dim=1), torch_results.counted)

    def _write_observation(self, w: Worlds, arrays: TaskArrays, mask: Tensor) -> None:
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
        torch_results, start = arrays.torch_results, self.reset(w)
        for name in ("position", "quaternion", "velocity", "goal_position", "goal_quaternion"):
            value, out = getattr(start, name), getattr(torch_results, name)
            if value is not None:
                self._copy_result(f"reset: {name}", value, out)
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
            self._copy_result("reset: memory", full, torch_results.begun)

    def _copy_result(self, name: str, value: Any, out: wp.array) -> None:
        """Copy the result of a function to the array that the kernels read."""
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
    """Call a torch function in the order of Warp's kernels; on a CPU only if mask is None or set in any world."""
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
