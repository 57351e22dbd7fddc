"""All worlds of an environment as torch tensors in the same memory, as a task in plain torch sees them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
import warp as wp
from torch import Tensor

from finssim.tasks.given import EnvironmentSetupError
from finssim.tasks.task import Batch
from finssim.tasks.torch_kernels import draw

__all__ = ["Worlds"]


class Worlds:
    """Where everything is, by world, in views that the next step overwrites: read them, and write `memory` alone.

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
            kept = wp.to_torch(arrays.answers.memory, requires_grad=False)
            self.memory = dict(zip(memory, kept.split(list(memory.values()), dim=1), strict=True))
        self._action, self._previous = (
            wp.to_torch(x, requires_grad=False) for x in (arrays.action, arrays.previous_action)
        )
        self._steps = wp.to_torch(state.steps, requires_grad=False)
        self._state, self._seed, self._control_step = state, batch.seed, control_step
        self._first = self._place = stage << 16

    position: Tensor
    quaternion: Tensor
    velocity: Tensor

    def begin(self) -> Worlds:
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
        """What the agents did in this step, in [-1, 1]: (worlds, size), or (worlds, agents, size) of several."""
        return self._by_agent(self._action.clamp(-1.0, 1.0))

    @property
    def previous_action(self) -> Tensor:
        """The same of the step before; zero in the first."""
        return self._by_agent(self._previous)

    @property
    def time(self) -> Tensor:
        """Time in the episode [s], (worlds,)."""
        return self._steps * self._control_step

    def zeros(self, *size: int) -> Tensor:
        """Zeros, (worlds, *size)."""
        return torch.zeros((self.count, *size), device=self.device)

    def full(self, row: float | Sequence[float]) -> Tensor:
        """The same number, (worlds,), or the same row, (worlds, size), for every world."""
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
    """A task's memory where nobody keeps one."""

    def __missing__(self, name: str) -> Tensor:
        raise _unknown(f"w.memory['{name}']")


def _unknown(name: str) -> EnvironmentSetupError:
    return EnvironmentSetupError(
        f"it looks at {name}, which reset, reward and inside make, and on a robot none of them runs: look at what is "
        "measured, the goal, the actions and the time alone"
    )
