"""Common part of the adapters: creation of an environment from the arguments of `finssim.make`, and aging of its
episodes."""

from __future__ import annotations

from typing import Any

import numpy as np

from finssim.tasks import Environment, EnvironmentSetupError, Task, make, task_named


def adapter_environment(
    task: str | Task | Environment,
    options: dict[str, Any],
    *,
    auto_reset: bool = True,
    pictures: bool = False,
) -> Environment:
    """Return the environment of an adapter.

    Args:
        task: A task or its name; or an existing environment.
        options: Other arguments of `finssim.make`; none with an existing environment.
        auto_reset: True if the adapter needs episodes to restart automatically.
        pictures: True if the adapter supports observations with pictures.

    Raises:
        EnvironmentSetupError: As for `finssim.make`; or an environment is given with options or with another reset
            mode, or has pictures that the adapter does not support.
    """
    seeing = task.task if isinstance(task, Environment) else task_named(task)
    if seeing.pictures and not pictures:
        raise EnvironmentSetupError(
            f"task '{seeing.name}' observes pictures, which this adapter does not pass on: use that of Gymnasium or "
            "Stable-Baselines3"
        )
    if not isinstance(task, Environment):
        if "auto_reset" in options:
            raise EnvironmentSetupError(
                "auto_reset is given, expected none: the adapter sets it as its library wants it"
            )
        return make(task, auto_reset=auto_reset, **options)
    if options:
        raise EnvironmentSetupError(
            f"an environment is given together with {', '.join(sorted(options))}: give the environment alone, or a task"
        )
    if task.auto_reset != auto_reset:
        raise EnvironmentSetupError(
            f"the environment has auto_reset={task.auto_reset}, this adapter needs auto_reset={auto_reset}"
        )
    return task


def copied(observation: Any, rows: Any = ...) -> Any:
    """Return a copy of some rows of observations, of all by default: arrays, or a dictionary of arrays."""
    if isinstance(observation, dict):
        return {name: array[rows].copy() for name, array in observation.items()}
    return observation[rows].copy()


def single_agent(environment: Environment, library: str) -> Environment:
    """Return the environment if it has one agent; the library's interface supports no more."""
    if environment.agents > 1:
        raise EnvironmentSetupError(
            f"task '{environment.task.name}' has {environment.agents} agents, {library} supports one: "
            "use the adapter of PettingZoo, TorchRL, RSL-RL or Stable-Baselines3"
        )
    return environment


def age_episodes(environment: Environment) -> None:
    """Set the running episodes to random ages, so that some end in every step.

    Training on all stages of an episode at once is more stable. The ages are drawn from the environment's seed.
    """
    task, rng = environment.task, np.random.default_rng(environment.seed)
    limit = max(1, round(task.time_limit / task.control_step))
    environment.simulator.state.steps.assign(rng.integers(0, limit, environment.worlds).astype(np.int32))
