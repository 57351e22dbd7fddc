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
"""Tasks that the robot's own PIDs do."""


NOWHERE = Goal(np.zeros((0, 3)), np.zeros((0, 4)))
"""A goal without content: of an agent whose observation holds all that it may know."""


class AgentError(ValueError):
    """An agent that does not exist, or that acts otherwise than it is asked to."""


def known_in(environment: Environment) -> Known:
    """Return the measurements of an environment: the observation of every agent of every world, the first vehicle's
    state."""
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
    """Return the goals that the task has set to the worlds, one each; none for a team."""
    if environment.agents > 1:
        return NOWHERE
    arrays = environment.arrays
    return Goal(*(np.asarray(a.numpy(), float) for a in (arrays.goal_position, arrays.goal_quaternion)))


class Agent(Protocol):
    """An agent without internal state: it sees measurements and a goal; its memory is an argument and a result."""

    name: str
    period: float
    """Time between two actions [s]."""
    action: str
    """Action mode."""
    wrench_scale: Any
    """Share of each wrench limit that action 1 means, one number or (6,)."""

    def reset(self, n: int) -> Any:
        """Memory before the first of n episodes' actions: arrays with n rows, in tuples; or None."""

    def act(self, memory: Any, reading: Known, goal: Goal) -> tuple[Rows, Any]:
        """Actions (n, size) and the memory after."""

    def describe(self) -> dict[str, Any]:
        """Return the agent's description as plain data."""


class PolicyAgent:
    """A policy directory, run with onnxruntime."""

    def __init__(self, directory: str | Path, vehicle: Vehicle, task: Task) -> None:
        """Load a policy for the vehicle and task.

        Args:
            directory: Of the policy.
            vehicle: It must be the very one that the policy was trained for.
            task: It must have been trained for.

        Raises:
            PolicyError, ControlError: It was trained for another vehicle, task, observation or other limits.
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
        """Memory of the policy, if it has one."""
        return self.policy.reset(n)

    def act(self, memory: Any, reading: Known, goal: Goal) -> tuple[Rows, Any]:
        """Actions for the environment's observations, a row for each agent of each world."""
        return self.policy.step(memory, reading.observation, reading.pictures)

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

    kind, action, wrench_scale = "pid", "wrench6", 1.0

    def __init__(self, name: str, vehicle: Vehicle, task: str = "t1") -> None:
        """Make the controller of that name for a vehicle and a task."""
        self.name = name
        self.controller: Any = controller_for(task, name, vehicle)
        self.period = self.controller.period
        self._limits = np.asarray(vehicle.wrench_limits, dtype=float)

    def reset(self, n: int) -> Any:
        """Memory before the first of n episodes' actions: empty integrals."""
        return self.controller.reset(n)

    def act(self, memory: Any, reading: Known, goal: Goal) -> tuple[Rows, Any]:
        """Wrench of each world, as a part of the limits; more than a limit is limited axis by axis."""
        tau, memory = self.controller.command(memory, reading, goal)
        return part_of_limits(tau, self._limits), memory

    def describe(self) -> dict[str, Any]:
        """Name and rate."""
        return {"name": self.name, "kind": self.kind, "action": self.action, "period_s": self.period}


class BaselineAgent(PidAgent):
    """A baseline of a task, which sees the observation alone."""

    kind = "baseline"

    def __init__(self, name: str, vehicle: Vehicle, task: Task, scale: Any = 1.0) -> None:
        """Make the task's baseline of that name for a vehicle; action 1 is `scale` of each limit in the worlds."""
        self.name, self.action, self.scale = name, task.action, scale
        self.controller = baseline(task, name, vehicle)
        self.period = self.controller.period

    def act(self, memory: Any, reading: Known, goal: Goal) -> tuple[Rows, Any]:
        """Actions, a row for each agent of each world."""
        pictures = () if reading.pictures is None else (reading.pictures,)
        action, memory = self.controller.act(memory, reading.observation, *pictures)
        return np.clip(action / self.scale, -1.0, 1.0).astype(np.float32), memory


def agent_for(name_or_directory: str | Path, vehicle: Vehicle, task: Task) -> Agent:
    """A PID or another baseline by its name, the policy of a directory, or the agent of a file, FILE.py:CLASS.

    The PIDs of T1 and T2 are the robot's, which know state and goal; other baselines see what a policy sees.

    Raises:
        AgentError: It is none of these.
        PolicyError, ControlError, EnvironmentSetupError: It does not fit the vehicle or the task, or its file fails.
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
    """Return the expert: a baseline of the task or the policy of a directory, which see the observation alone.

    Args:
        name_or_directory: Which.
        vehicle: Theirs.
        task: Theirs.
        action: Mode of the learner's actions.
        scale: Part of each wrench limit that action 1 of the learner stands for [1].

    Raises:
        AgentError: There is neither, or it acts in another mode than `action`.
        PolicyError: The policy was trained for another vehicle or task.
    """
    baselines = baselines_of(task)
    if str(name_or_directory) in baselines:
        if action != task.action:
            raise AgentError(
                f"baseline '{name_or_directory}' acts by {task.action}, expected {action}: leave --action out"
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
    """Let an agent act, and yield before each decision and after the last.

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
