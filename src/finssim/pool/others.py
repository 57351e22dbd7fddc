"""A vehicle that the task commands, in the virtual site: it is told the truth, and acts as the task's script does."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.control.guidance import Guide, Measured, Track
from finssim.control.modes import action_mode
from finssim.engine.launch import Pipeline
from finssim.pool.virtual_pool import VirtualPool
from finssim.robot.robot import Reading
from finssim.tasks.observer import fitted_task, one_world, unscored
from finssim.tasks.task import Batch, Task
from finssim.vehicles import Vehicle

__all__ = ["ScriptedPilot", "TrueState"]

Array = NDArray[np.float64]


class TrueState:
    """In place of a perception: the plant's own state, always known. Of vehicles that belong to the site alone."""

    def __init__(self, world: VirtualPool) -> None:
        """Of the vehicle in a virtual pool."""
        self.vehicle, self._world = world.vehicle, world

    def telemetry(self, now: float, telemetry: Any, time: float) -> None:
        """Nothing that is not known already.

        Args:
            now: When it came [s].
            telemetry: Not used.
            time: When it was measured [s].
        """

    def picture(self, now: float, picture: Any) -> str:
        """Nothing that is not known already."""
        return "not used"

    def reading(self, now: float) -> Reading:
        """The plant's state."""
        plant = self._world.plant
        parts = (plant.position, plant.quaternion, plant.nu)
        position, quaternion, nu = (np.asarray(part, float).copy() for part in parts)
        return Reading(now, position, quaternion, nu, True, std=np.zeros(7))


class ScriptedPilot:
    """Acts as the only vehicle that a task commands does in training: by the task's `command`, from the truth."""

    needs_state = True

    def __init__(
        self,
        task: str | Task,
        vehicles: Sequence[Vehicle],
        truth: Callable[[], Mapping[str, Measured]],
        *,
        action: str | None = None,
        seed: int = 0,
    ) -> None:
        """
        Args:
            task: A task with one vehicle among its `others`.
            vehicles: One for each of its places.
            truth: Where everybody is, by place.
            action: Mode of the agents' actions; the task's own if None.
            seed: Of what it does.

        Raises:
            ControlError: The vehicles cannot do the task.
        """
        self.task = task = fitted_task(task, vehicles, action)
        (self.name,) = task.others
        self.period, self._truth, self._seed = task.control_step, truth, seed
        mode = action or task.action
        self._mode = action_mode(mode, vehicles[-1])
        state, self._arrays = one_world(task, len(self._mode.labels))
        unscored(self._arrays)
        self._state = state
        self._pipeline = Pipeline(1, wp.get_device("cpu"))
        task.add_command(self._pipeline, Batch(state, self._arrays, seed))

    def describe(self) -> dict[str, Any]:
        """Whom the task commands."""
        return {"name": self.name, "kind": "script", "task": self.task.name, "period_s": self.period}

    def reset(self) -> None:
        """Begin again."""
        self._state.steps.zero_()

    def act(self, reading: Measured, guide: Guide, t: float) -> Array:
        """Wanted thrusts in canonical order [N], (n,)."""
        everybody = self._truth()
        for v, name in enumerate(self.task.vehicles):
            one = everybody[name]
            for row, value in (
                ("position", one.position),
                ("quaternion", one.quaternion),
                ("velocity", one.nu),
            ):
                getattr(self._state, row).numpy()[0, v] = value
        self._state.steps.numpy()[0] = max(round(t / self.period), 0)
        self._pipeline.run()
        return self._mode.to_thrusters(np.clip(self._arrays.scripted.numpy()[0], -1.0, 1.0))


def truth_of(worlds: Mapping[str, VirtualPool]) -> dict[str, Track]:
    """The true state of every vehicle, by name."""
    out = {}
    for name, world in worlds.items():
        plant = world.plant
        parts = (plant.position, plant.quaternion, plant.nu)
        out[name] = Track(*(np.asarray(part, float).copy() for part in parts), world.time)
    return out
