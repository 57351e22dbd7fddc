"""Who is evaluated: a policy or a PID, each at its own rate, through the same actions and the same allocator."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from finssim.control.controllers import CONTROLLERS, controller_for
from finssim.control.modes import mode_from_dict
from finssim.control.policy import Policy
from finssim.control.tracking import Controller, Goal
from finssim.control.trim import Trim
from finssim.tasks import Task
from finssim.tasks.baselines import BASELINES, baseline
from finssim.vehicles import Vehicle

__all__ = ["BaselinePlayer", "PidPlayer", "Player", "PolicyPlayer", "make_player"]

TASKS_OF_PIDS = ("t1", "t2")
"""Tasks that the robot's own PIDs do."""


class Player(Protocol):
    """Sees what the environment measured and gives its actions."""

    period: float
    """Time between two actions [s]."""
    action: str
    """Action mode."""
    wrench_scale: Any
    """Part of each wrench limit that action 1 stands for, one number or (6,)."""

    def reset(self, n: int) -> Any:
        """Memory before the first of n trials' actions."""

    def act(self, memory: Any, arrays: Any, goal: Goal) -> tuple[NDArray[np.float32], Any]:
        """Actions (n, size) and the memory after; `arrays` are the environment's."""

    def describe(self) -> dict[str, Any]:
        """Who it is, as plain data."""


class PolicyPlayer:
    """A policy directory, run with onnxruntime."""

    def __init__(self, directory: str | Path, vehicle: Vehicle, task: Task, trim: Trim | None = None) -> None:
        """Load a policy for the vehicle and task, with an integral in front of it or none.

        Raises:
            PolicyError, ControlError: It was trained for another vehicle, task, observation or other limits.
        """
        schema = task.schema.model_dump(mode="json")
        policy = Policy.load(directory, vehicle=vehicle, task={"name": task.name, "observation": schema})
        mode = mode_from_dict(policy.description.action, vehicle)
        self.period = policy.description.control_period
        self.action = mode.name
        self.wrench_scale = mode.scale if mode.name.startswith("wrench") else 1.0
        self.policy = policy
        self.trim = trim
        self._directory = Path(directory)

    def reset(self, n: int) -> tuple[Any, Any]:
        """Memory of the policy, if it has one, and shift of the trim."""
        return self.policy.reset(n), self.trim.reset(n) if self.trim else None

    def act(self, memory: Any, arrays: Any, goal: Goal) -> tuple[NDArray[np.float32], Any]:
        """Actions for the environment's observations, a row for each agent of each world."""
        observation = arrays.observation.numpy().reshape(-1, self.policy.description.observation.size)
        remembered, shift = memory
        if self.trim is not None:
            measured = _read(arrays)
            shift = self.trim.update(shift, measured, goal.position, self.period)
            observation = self.trim.shown(observation, measured, shift, self.policy.description.observation)
        action, remembered = self.policy.step(remembered, observation)
        return action, (remembered, shift)

    def describe(self) -> dict[str, Any]:
        """Name, network, and what it was trained in."""
        d = self.policy.description
        randomization = d.training.get("randomization")
        return {
            "name": self._directory.resolve().name,
            "kind": "policy",
            "trim": asdict(self.trim) if self.trim else None,
            "action": self.action,
            "period_s": self.period,
            "hydrodynamics": d.hydrodynamics,
            "randomization": randomization["name"] if randomization else None,
            "seed": d.seed,
            "files": dict(d.files),
        }


@dataclass(frozen=True)
class _Measured:
    position: Any
    quaternion: Any
    nu: Any


def _read(arrays: Any) -> _Measured:
    """What the environment measured of vehicle 0 in every world."""
    parts = (arrays.position, arrays.quaternion, arrays.velocity)
    return _Measured(*(array.numpy()[:, 0].astype(float) for array in parts))


class PidPlayer:
    """A PID by name: its wrench, as a part of each axis' limit, goes through the same allocation as a policy's."""

    action = "wrench6"
    wrench_scale = 1.0

    def __init__(self, name: str, vehicle: Vehicle, task: str = "t1") -> None:
        """Make the controller of that name for a vehicle and a task."""
        self.name = name
        self.controller: Controller = controller_for(task, name, vehicle)
        self.period = self.controller.period
        self._limits = np.asarray(vehicle.wrench_limits, dtype=float)

    def reset(self, n: int) -> Any:
        """Empty integrals."""
        return self.controller.reset(n)

    def act(self, memory: Any, arrays: Any, goal: Goal) -> tuple[NDArray[np.float32], Any]:
        """Wrench of each world, as a part of the limits; more than a limit is limited axis by axis."""
        tau, memory = self.controller.command(memory, _read(arrays), goal)
        part = np.divide(tau, self._limits, out=np.zeros_like(tau), where=self._limits > 0.0)
        return part.astype(np.float32), memory

    def describe(self) -> dict[str, Any]:
        """Name and rate."""
        return {"name": self.name, "kind": "pid", "action": self.action, "period_s": self.period}


class BaselinePlayer:
    """A baseline of a task, which sees the observation alone."""

    wrench_scale = 1.0

    def __init__(self, name: str, vehicle: Vehicle, task: Task) -> None:
        """Make the task's baseline of that name for a vehicle."""
        self.name, self.action = name, task.action
        self.baseline = baseline(task.name, name, vehicle)
        self.period = self.baseline.period
        self._size = task.observation_size

    def reset(self, n: int) -> Any:
        """Memory before the first of n episodes' actions."""
        return self.baseline.reset(n)

    def act(self, memory: Any, arrays: Any, goal: Goal) -> tuple[NDArray[np.float32], Any]:
        """Actions, a row for each agent of each world."""
        return self.baseline.act(memory, arrays.observation.numpy().reshape(-1, self._size))

    def describe(self) -> dict[str, Any]:
        """Name and rate."""
        return {"name": self.name, "kind": "baseline", "action": self.action, "period_s": self.period}


def make_player(
    name_or_directory: str | Path, vehicle: Vehicle, task: Task, trim: Trim | None = None
) -> PolicyPlayer | PidPlayer | BaselinePlayer:
    """A PID or another baseline by its name, or the policy of a directory; only a policy takes a trim.

    The PIDs of T1 and T2 are the robot's, which know the goal; a baseline of another task sees what a policy sees.
    """
    if task.name in TASKS_OF_PIDS and str(name_or_directory) in CONTROLLERS:
        return PidPlayer(str(name_or_directory), vehicle, task.name)
    if str(name_or_directory) in BASELINES.get(task.name, {}):
        return BaselinePlayer(str(name_or_directory), vehicle, task)
    return PolicyPlayer(name_or_directory, vehicle, task, trim)
