"""Agents: a PID, a policy or a baseline of a task, for any number of vehicles, in a batch or on a robot."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from finssim.agents.baselines import Rows, part_of_limits
from finssim.agents.catalogue import baseline, baselines_of
from finssim.agents.controllers import CONTROLLERS, controller_for
from finssim.control.guidance import Goal, Known
from finssim.control.modes import mode_from_dict
from finssim.control.policy import DESCRIPTION_FILE, Policy
from finssim.sim import StateRecorder
from finssim.tasks.catalogue import own_class
from finssim.tasks.environment import Environment, Step
from finssim.tasks.task import Task
from finssim.vehicles import Vehicle

TASKS_OF_PIDS = ("t1", "t2")
"""Tasks for which the robot has PIDs."""


NOWHERE = Goal(np.zeros((0, 3)), np.zeros((0, 4)))
"""Empty goal, for an agent whose observation contains all that it may know."""


class AgentError(ValueError):
    """Agent that does not exist, or that does not act as requested."""


def known_in(environment: Environment) -> Known:
    """Return the measurements of an environment: the observations of all agents of all worlds, and the state
    of the first vehicle."""
    arrays = environment.arrays
    observed: Rows = arrays.observation.numpy()
    state = (arrays.position, arrays.quaternion, arrays.velocity)
    sight = environment.sight
    return Known(
        observed.reshape(len(observed) * environment.agents, -1),
        *(np.asarray(array.numpy()[:, 0], dtype=float) for array in state),
        pictures=None if sight is None else {name: x.numpy() for name, x in sight.pictures.items()},
    )


def goals_in(environment: Environment) -> Goal:
    """Return the goals that the task has set, one per world; an empty goal for a team."""
    if environment.agents > 1:
        return NOWHERE
    arrays = environment.arrays
    return Goal(*(np.asarray(a.numpy(), float) for a in (arrays.goal_position, arrays.goal_quaternion)))


class Agent(Protocol):
    """Agent without internal state, which acts on measurements and a goal; its memory is an argument and a result."""

    name: str
    period: float
    """Time between two actions [s]."""
    action: str
    """Name of the action mode."""
    wrench_scale: Any
    """Fraction of each wrench limit that corresponds to an action of 1, one number or (6,)."""

    def reset(self, n: int) -> Any:
        """Return the memory before the first action of n episodes: tuples of arrays with n rows, or None."""

    def act(self, memory: Any, reading: Known, goal: Goal) -> tuple[Rows, Any]:
        """Return the actions, (n, size), and the next memory."""

    def describe(self) -> dict[str, Any]:
        """Return the agent's description as plain data."""


class PolicyAgent:
    """Agent of a policy directory, run with onnxruntime."""

    def __init__(self, directory: str | Path, vehicle: Vehicle, task: Task) -> None:
        """Load a policy for the vehicle and task.

        Args:
            directory: Directory of the policy.
            vehicle: Vehicle, which must be identical to the one that the policy was trained for.
            task: Task, which must be the one that the policy was trained for.

        Raises:
            PolicyError, ControlError: The policy was trained for another vehicle, task or observation, or for
                other limits.
        """
        schema = task.schema.model_dump(mode="json")
        task_data = {"name": task.name, "observation": schema}
        policy = Policy.load(directory, vehicle=vehicle, task=task_data)
        mode = mode_from_dict(policy.description.action, vehicle)
        self.period = policy.description.control_period
        self.action = mode.name
        self.wrench_scale = mode.scale if mode.wrench else 1.0
        self.policy = policy
        self.name = Path(directory).resolve().name

    def reset(self, n: int) -> Any:
        """Return the initial memory of the policy, or None if it has none."""
        return self.policy.reset(n)

    def act(self, memory: Any, reading: Known, goal: Goal) -> tuple[Rows, Any]:
        """Return the actions for the environment's observations, one row per agent and world."""
        return self.policy.step(memory, reading.observation, reading.pictures)

    def describe(self) -> dict[str, Any]:
        """Return the name, the network and the training conditions."""
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
    """Agent of a PID: its wrench, as a fraction of each axis' limit, is allocated as that of a policy."""

    kind, action, wrench_scale = "pid", "wrench6", 1.0

    def __init__(self, name: str, vehicle: Vehicle, task: str = "t1") -> None:
        """Create the controller with a name for a vehicle and a task."""
        self.name = name
        self.controller: Any = controller_for(task, name, vehicle)
        self.period = self.controller.period
        self._limits = np.asarray(vehicle.wrench_limits, dtype=float)

    def reset(self, n: int) -> Any:
        """Return the memory before the first action of n episodes, with zero integrals."""
        return self.controller.reset(n)

    def act(self, memory: Any, reading: Known, goal: Goal) -> tuple[Rows, Any]:
        """Return the wrench of each world as a fraction of the limits; an excess is clipped on each axis
        separately."""
        tau, memory = self.controller.command(memory, reading, goal)
        return part_of_limits(tau, self._limits), memory

    def describe(self) -> dict[str, Any]:
        """Return the name and the period."""
        return {"name": self.name, "kind": self.kind, "action": self.action, "period_s": self.period}


class BaselineAgent(PidAgent):
    """Agent of a task's baseline, which uses only the observation."""

    kind = "baseline"

    def __init__(self, name: str, vehicle: Vehicle, task: Task, scale: Any = 1.0) -> None:
        """Create the task's baseline with a name for a vehicle; an action of 1 is `scale` of each limit in
        the worlds."""
        self.name, self.action, self.scale = name, task.action, scale
        self.controller = baseline(task, name, vehicle)
        self.period = self.controller.period

    def act(self, memory: Any, reading: Known, goal: Goal) -> tuple[Rows, Any]:
        """Return the actions, one row per agent and world."""
        pictures = () if reading.pictures is None else (reading.pictures,)
        action, memory = self.controller.act(memory, reading.observation, *pictures)
        return np.clip(action / self.scale, -1.0, 1.0).astype(np.float32), memory


def agent_for(name_or_directory: str | Path, vehicle: Vehicle, task: Task) -> Agent:
    """Return the agent for a PID's or a baseline's name, a policy directory, or FILE.py:CLASS.

    The PIDs of T1 and T2 are those of the robot, which use state and goal; other baselines use the policy's
    observation.

    Raises:
        AgentError: The argument is none of these.
        PolicyError, ControlError, EnvironmentSetupError: The agent does not match the vehicle or the task, or
            its file fails.
    """
    name = str(name_or_directory)
    if ".py:" in name:
        own: Agent = own_class(name, object, "agent")(vehicle, task)
        return own
    controllers = tuple(CONTROLLERS) if task.name in TASKS_OF_PIDS else ()
    baselines = baselines_of(task)
    if name in controllers:
        return PidAgent(name, vehicle, task.name)
    if name in baselines:
        return BaselineAgent(name, vehicle, task)
    if not Path(name_or_directory).exists():
        have = ", ".join(dict.fromkeys([*controllers, *baselines]))
        raise AgentError(
            f"'{name}' is neither a policy directory nor a controller of task '{task.name}'; controllers: "
            f"{have or 'none'}, or FILE.py:CLASS"
        )
    return PolicyAgent(name_or_directory, vehicle, task)


def expert_for(
    name_or_directory: str | Path, vehicle: Vehicle, task: Task, action: str, scale: Any = 1.0
) -> PolicyAgent | BaselineAgent:
    """Return the expert: a baseline of the task or the policy of a directory, which use only the observation.

    Args:
        name_or_directory: Name of the baseline or directory of the policy.
        vehicle: Vehicle of the expert.
        task: Task of the expert.
        action: Action mode of the learner.
        scale: Fraction of each wrench limit that corresponds to an action of 1 of the learner [1].

    Raises:
        AgentError: There is neither, or it uses an action mode other than `action`.
        PolicyError: The policy was trained for another vehicle or task.
    """
    baselines = baselines_of(task)
    if str(name_or_directory) in baselines:
        if action != task.action:
            raise AgentError(
                f"baseline '{name_or_directory}' uses action mode {task.action}, expected {action}: omit --action"
            )
        return BaselineAgent(str(name_or_directory), vehicle, task, scale)
    if not (Path(name_or_directory) / DESCRIPTION_FILE).is_file():
        raise AgentError(
            f"expert '{name_or_directory}' is neither a policy directory nor a baseline of task '{task.name}'; "
            f"baselines: {', '.join(baselines) or 'none'}"
        )
    expert = PolicyAgent(name_or_directory, vehicle, task)
    if expert.action != action:
        raise AgentError(
            f"{name_or_directory} uses action mode {expert.action}, expected {action}: collect and train with --action "
            f"{expert.action}"
        )
    return expert


# Rollout of an agent in a batch of worlds.


def rollout(
    agent: Agent,
    environment: Environment,
    steps: int,
    goal: Callable[[float], Goal],
    *,
    record: Path | None = None,
) -> Iterator[tuple[int, Step | None]]:
    """Let an agent act, and yield before each decision and after the last one.

    Args:
        agent: Acting agent; several agents of a world share it.
        environment: Environment in its current state.
        steps: Number of decisions, unless the iteration is ended earlier.
        goal: Function from the time since the start [s] to the goal.
        record: New folder for all states, commands and thrusts; no recording if None.

    Yields:
        The number of decisions so far, and the environment's result for the last one; None before the first.
    """
    worlds, agents = environment.worlds, environment.agents
    shape = (worlds, -1) if agents == 1 else (worlds, agents, -1)
    memory = agent.reset(worlds * agents)
    step: Step | None = None
    with nullcontext() if record is None else StateRecorder(environment.simulator, record) as recorder:
        for k in range(steps + 1):
            yield k, step
            if recorder is not None:
                recorder.record()
            if k < steps:
                action, memory = agent.act(memory, known_in(environment), goal(k * agent.period))
                step = environment.step(np.asarray(action, dtype=np.float32).reshape(shape))
