"""Common part of the adapters: they make an environment from the arguments of `finssim.make`, and age its episodes."""

from __future__ import annotations

from typing import Any

import numpy as np

from finssim.tasks import Environment, EnvironmentSetupError, Task, make, task_named


def served(
    task: str | Task | Environment,
    options: dict[str, Any],
    *,
    auto_reset: bool = True,
    pictures: bool = False,
) -> Environment:
    """The environment that an adapter serves.

    Args:
        task: A task or its name; or an environment that is there already.
        options: The other arguments of `finssim.make`; none beside an environment.
        auto_reset: Whether the adapter needs episodes to start by themselves.
        pictures: Whether it passes on observations that are dictionaries with pictures.

    Raises:
        EnvironmentSetupError: As `finssim.make`; or an environment that comes with options or resets otherwise, or
            that sees where the adapter passes no pictures on.
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
    """A copy of some rows of observations, of all if not given: arrays, or a dictionary of them."""
    if isinstance(observation, dict):
        return {name: array[rows].copy() for name, array in observation.items()}
    return observation[rows].copy()


def single_agent(environment: Environment, library: str) -> Environment:
    """The environment, if it has one agent, which is all that the library's interface takes."""
    if environment.agents > 1:
        raise EnvironmentSetupError(
            f"task '{environment.task.name}' has {environment.agents} agents, {library} takes one: "
            "use the adapter of PettingZoo, TorchRL, RSL-RL or Stable-Baselines3"
        )
    return environment


def age_episodes(environment: Environment) -> None:
    """Let the episodes that run be of random age, so that from then on some end in every step.

    Learning from all stages of an episode at once is steadier. The ages are drawn from the environment's seed.
    """
    task, rng = environment.task, np.random.default_rng(environment.seed)
    limit = max(1, round(task.time_limit / task.control_step))
    environment.simulator.state.steps.assign(rng.integers(0, limit, environment.worlds).astype(np.int32))
