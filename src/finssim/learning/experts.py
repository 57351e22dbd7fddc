"""Who is imitated: a baseline of the task or a policy directory, on many episodes at once."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from finssim.control.policy import Policy
from finssim.control.policy_description import DESCRIPTION_FILE
from finssim.tasks import Environment
from finssim.tasks.baselines import BASELINES, baseline, restarted

__all__ = ["Expert", "ExpertError", "expert_for"]


class ExpertError(ValueError):
    """An expert that does not exist, or that acts otherwise than the environment takes it."""


class Expert(Protocol):
    """Acts for every row of observations, and remembers what it must."""

    name: str

    def reset(self, n: int) -> Any:
        """Memory at the start of n episodes."""

    def act(self, memory: Any, observation: NDArray[Any]) -> tuple[NDArray[np.float32], Any]:
        """Actions (n, size) for observations (n, numbers), and the memory after."""

    def restarted(self, memory: Any, fresh: Any, mask: NDArray[np.bool_]) -> Any:
        """The memory after the episodes where mask is true started over."""


class _BaselineExpert:
    def __init__(self, name: str, environment: Environment) -> None:
        self.name = name
        self._baseline = baseline(environment.task.name, name, environment.simulator.vehicles[0])

    def reset(self, n: int) -> Any:
        return self._baseline.reset(n)

    def act(self, memory: Any, observation: NDArray[Any]) -> tuple[NDArray[np.float32], Any]:
        return self._baseline.act(memory, observation)

    def restarted(self, memory: Any, fresh: Any, mask: NDArray[np.bool_]) -> Any:
        return restarted(memory, fresh, mask)


class _PolicyExpert:
    def __init__(self, directory: Path, environment: Environment) -> None:
        task = environment.task
        schema = task.schema.model_dump(mode="json")
        self._policy = Policy.load(
            directory,
            vehicle=environment.simulator.vehicles[0],
            task={"name": task.name, "observation": schema},
        )
        self.name = directory.resolve().name
        mode = self._policy.description.action["mode"]
        if mode != environment.action_mode:
            raise ExpertError(
                f"{directory} acts by {mode}, expected {environment.action_mode}: collect and train with "
                f"--action {mode}"
            )

    def reset(self, n: int) -> Any:
        return self._policy.reset(n)

    def act(self, memory: Any, observation: NDArray[Any]) -> tuple[NDArray[np.float32], Any]:
        return self._policy.step(memory, observation)

    def restarted(self, memory: Any, fresh: Any, mask: NDArray[np.bool_]) -> Any:
        return restarted(memory, fresh, mask)


def expert_for(environment: Environment, name: str | Path) -> Expert:
    """A baseline of the environment's task by its name, or the policy of a directory.

    Raises:
        ExpertError: There is neither, or it acts in another mode than the environment.
        PolicyError: The policy was trained for another vehicle or task.
    """
    task = environment.task
    if str(name) in BASELINES.get(task.name, {}):
        if environment.action_mode != task.action:
            raise ExpertError(
                f"baseline '{name}' acts by {task.action}, expected {environment.action_mode}: leave --action out"
            )
        return _BaselineExpert(str(name), environment)
    if (Path(name) / DESCRIPTION_FILE).is_file():
        return _PolicyExpert(Path(name), environment)
    known = ", ".join(BASELINES.get(task.name, {})) or "none"
    raise ExpertError(
        f"expert '{name}' is neither a policy directory nor a baseline of task '{task.name}'; baselines: {known}"
    )
