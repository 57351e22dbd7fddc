"""Who acts: a PID, a policy or a baseline of a task, for any number of vehicles at once, in a batch or on a robot."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from finssim.control.guidance import Controller, Goal, Known
from finssim.control.modes import mode_from_dict
from finssim.control.pid import CONTROLLERS, controller_for
from finssim.control.policy import DESCRIPTION_FILE, Policy
from finssim.engine import Recorder
from finssim.tasks.baselines import BASELINES, baseline
from finssim.tasks.environment import Environment
from finssim.tasks.given import Step
from finssim.tasks.task import Task
from finssim.vehicles import Vehicle

__all__ = [
    "NOWHERE",
    "Agent",
    "AgentError",
    "BaselineAgent",
    "Known",
    "PidAgent",
    "PolicyAgent",
    "Readings",
    "WorldReadings",
    "agent_for",
    "expert_for",
    "rollout",
]


Array = NDArray[np.float64]

TASKS_OF_PIDS = ("t1", "t2")
"""Tasks that the robot's own PIDs do."""


NOWHERE = Goal(np.zeros((0, 3)), np.zeros((0, 4)))
"""A goal that tells nothing: of an agent whose observation has all that it may know."""


class AgentError(ValueError):
    """An agent that does not exist, or that acts otherwise than it is asked to."""


class Readings(Protocol):
    """What is known of n vehicles at a time; a `Measured` for controllers."""

    @property
    def observation(self) -> NDArray[Any]:
        """Of the task, (n, size)."""

    @property
    def position(self) -> Array:
        """Body origins, world frame [m], (n, 3)."""

    @property
    def quaternion(self) -> Array:
        """Body to world, xyzw, (n, 4)."""

    @property
    def nu(self) -> Array:
        """Body frame [m/s, rad/s], (n, 6)."""


class WorldReadings:
    """What an environment measured: of every agent its observation, of the first vehicle of each world its state."""

    def __init__(self, arrays: Any, agents: int = 1) -> None:
        """
        Args:
            arrays: Of the environment.
            agents: In each world.
        """
        self._arrays, self._agents = arrays, agents

    @property
    def observation(self) -> NDArray[np.float32]:
        """A row for each agent of each world."""
        observed: NDArray[np.float32] = self._arrays.observation.numpy()
        return observed.reshape(len(observed) * self._agents, -1)

    position = property(lambda self: self._first(self._arrays.position))
    quaternion = property(lambda self: self._first(self._arrays.quaternion))
    nu = property(lambda self: self._first(self._arrays.velocity))

    @staticmethod
    def _first(array: Any) -> Array:
        return np.asarray(array.numpy()[:, 0], dtype=float)


class Agent(Protocol):
    """Sees readings and goals, nothing else, and keeps no state: its memory goes in with every call and comes back."""

    name: str
    period: float
    """Time between two actions [s]."""
    action: str
    """Action mode."""
    wrench_scale: Any
    """Part of each wrench limit that action 1 stands for, one number or (6,)."""

    def reset(self, n: int) -> Any:
        """Memory before the first of n episodes' actions: arrays with n rows, in tuples or dataclasses; or None."""

    def act(self, memory: Any, readings: Readings, goal: Goal) -> tuple[NDArray[np.float32], Any]:
        """Actions (n, size) and the memory after."""

    def describe(self) -> dict[str, Any]:
        """Who it is, as plain data."""


class PolicyAgent:
    """A policy directory, run with onnxruntime."""

    def __init__(
        self,
        directory: str | Path,
        vehicle: Vehicle,
        task: Task,
        *,
        period: float | None = None,
    ) -> None:
        """Load a policy for the vehicle and task.

        Args:
            directory: Of the policy.
            vehicle: It must be the very one that the policy was trained for.
            task: It must have been trained for.
            period: Time between two decisions at which it would be asked [s]; None: its own.

        Raises:
            PolicyError, ControlError: It was trained for another vehicle, task, observation or other limits.
        """
        schema = task.schema.model_dump(mode="json")
        known = {"name": task.name, "observation": schema}
        policy = Policy.load(directory, vehicle=vehicle, task=known, control_period=period)
        mode = mode_from_dict(policy.description.action, vehicle)
        self.period = policy.description.control_period
        self.action = mode.name
        self.wrench_scale = mode.scale if mode.wrench else 1.0
        self.policy = policy
        self.name = Path(directory).resolve().name

    def reset(self, n: int) -> Any:
        """Memory of the policy, if it has one."""
        return self.policy.reset(n)

    def act(self, memory: Any, readings: Readings, goal: Goal) -> tuple[NDArray[np.float32], Any]:
        """Actions for the environment's observations, a row for each agent of each world."""
        return self.policy.step(memory, readings.observation)

    def describe(self) -> dict[str, Any]:
        """Name, network, and what it was trained in."""
        d = self.policy.description
        randomization = d.training.get("randomization")
        return {
            "name": self.name,
            "kind": "policy",
            "action": self.action,
            "period_s": self.period,
            "hydrodynamics": d.hydrodynamics,
            "randomization": randomization["name"] if randomization else None,
            "seed": d.seed,
            "files": dict(d.files),
        }


class PidAgent:
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

    def act(self, memory: Any, readings: Readings, goal: Goal) -> tuple[NDArray[np.float32], Any]:
        """Wrench of each world, as a part of the limits; more than a limit is limited axis by axis."""
        tau, memory = self.controller.command(memory, readings, goal)
        part = np.divide(tau, self._limits, out=np.zeros_like(tau), where=self._limits > 0.0)
        return part.astype(np.float32), memory

    def describe(self) -> dict[str, Any]:
        """Name and rate."""
        return {"name": self.name, "kind": "pid", "action": self.action, "period_s": self.period}


class BaselineAgent:
    """A baseline of a task, which sees the observation alone."""

    wrench_scale = 1.0

    def __init__(self, name: str, vehicle: Vehicle, task: Task) -> None:
        """Make the task's baseline of that name for a vehicle."""
        self.name, self.action = name, task.action
        self.baseline = baseline(task.name, name, vehicle)
        self.period = self.baseline.period

    def reset(self, n: int) -> Any:
        """Memory before the first of n episodes' actions."""
        return self.baseline.reset(n)

    def act(self, memory: Any, readings: Readings, goal: Goal) -> tuple[NDArray[np.float32], Any]:
        """Actions, a row for each agent of each world."""
        return self.baseline.act(memory, readings.observation)

    def describe(self) -> dict[str, Any]:
        """Name and rate."""
        return {"name": self.name, "kind": "baseline", "action": self.action, "period_s": self.period}


def agent_for(
    name_or_directory: str | Path, vehicle: Vehicle, task: Task
) -> PolicyAgent | PidAgent | BaselineAgent:
    """A PID or another baseline by its name, or the policy of a directory.

    The PIDs of T1 and T2 are the robot's, which know state and goal; other baselines see what a policy sees.

    Raises:
        PolicyError, ControlError: It does not fit the vehicle or the task.
    """
    if task.name in TASKS_OF_PIDS and str(name_or_directory) in CONTROLLERS:
        return PidAgent(str(name_or_directory), vehicle, task.name)
    if str(name_or_directory) in BASELINES.get(task.name, {}):
        return BaselineAgent(str(name_or_directory), vehicle, task)
    return PolicyAgent(name_or_directory, vehicle, task)


def expert_for(
    name_or_directory: str | Path, vehicle: Vehicle, task: Task, action: str
) -> PolicyAgent | BaselineAgent:
    """Who is imitated: a baseline of the task or the policy of a directory, which see the observation alone.

    Raises:
        AgentError: There is neither, or it acts in another mode than `action`.
        PolicyError: The policy was trained for another vehicle or task.
    """
    known = BASELINES.get(task.name, {})
    if str(name_or_directory) in known:
        if action != task.action:
            raise AgentError(
                f"baseline '{name_or_directory}' acts by {task.action}, expected {action}: leave --action out"
            )
        return BaselineAgent(str(name_or_directory), vehicle, task)
    if not (Path(name_or_directory) / DESCRIPTION_FILE).is_file():
        raise AgentError(
            f"expert '{name_or_directory}' is neither a policy directory nor a baseline of task '{task.name}'; "
            f"baselines: {', '.join(known) or 'none'}"
        )
    expert = PolicyAgent(name_or_directory, vehicle, task)
    if expert.action != action:
        raise AgentError(
            f"{name_or_directory} acts by {expert.action}, expected {action}: collect and train with --action "
            f"{expert.action}"
        )
    return expert


# An agent in a batch of worlds, decision after decision.


def rollout(
    agent: Agent,
    environment: Environment,
    steps: int,
    goal: Callable[[float], Goal],
    *,
    record: Path | None = None,
) -> Iterator[tuple[int, Step | None]]:
    """Let an agent act; whoever iterates looks at the worlds before each decision and after the last.

    Args:
        agent: Who acts; several agents of a world share it.
        environment: As it stands.
        steps: How many decisions, unless the iteration is ended before.
        goal: Where to go at a time since the start [s].
        record: New folder for every state, command and thrust; none if None.

    Yields:
        How many decisions were made, and what the environment said to the last one; None before the first.
    """
    worlds, agents = environment.worlds, environment.agents
    shape = (worlds, -1) if agents == 1 else (worlds, agents, -1)
    readings, memory = WorldReadings(environment.arrays, agents), agent.reset(worlds * agents)
    step: Step | None = None
    with nullcontext() if record is None else Recorder(environment.simulator, record) as recorder:
        for k in range(steps + 1):
            yield k, step
            if recorder is not None:
                recorder.record()
            if k < steps:
                action, memory = agent.act(memory, readings, goal(k * agent.period))
                step = environment.step(np.asarray(action, dtype=np.float32).reshape(shape))
