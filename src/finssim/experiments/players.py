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
from finssim.learning.description import observation_schema
from finssim.tasks import Task
from finssim.vehicles import Vehicle

__all__ = ["PidPlayer", "Player", "PolicyPlayer", "make_player"]


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
        schema = observation_schema(task).model_dump(mode="json")
        policy = Policy.load(directory, vehicle=vehicle, task={"name": task.name, "observation": schema})
        mode = mode_from_dict(policy.description.action, vehicle)
        self.period = policy.description.control_period
        self.action = mode.name
        self.wrench_scale = mode.scale if mode.name.startswith("wrench") else 1.0
        self.policy = policy
        self.trim = trim
        self._directory = Path(directory)

    def reset(self, n: int) -> NDArray[np.float64] | None:
        """A policy remembers nothing; a trim its shift."""
        return self.trim.reset(n) if self.trim else None

    def act(self, memory: Any, arrays: Any, goal: Goal) -> tuple[NDArray[np.float32], Any]:
        """Actions for the environment's observations."""
        observation = arrays.observation.numpy()
        if self.trim is not None:
            measured = _read(arrays)
            memory = self.trim.update(memory, measured, goal.position, self.period)
            observation = self.trim.shown(observation, measured, memory, self.policy.description.observation)
        return self.policy.act(observation), memory

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


def make_player(
    name_or_directory: str | Path, vehicle: Vehicle, task: Task, trim: Trim | None = None
) -> PolicyPlayer | PidPlayer:
    """A PID by its name, or the policy of a directory; a PID has an integral of its own and takes no trim."""
    if str(name_or_directory) in CONTROLLERS:
        return PidPlayer(str(name_or_directory), vehicle, task.name)
    return PolicyPlayer(name_or_directory, vehicle, task, trim)
