"""Whole episodes of any task: a controller, vehicles and a plant, one world per episode, all stepped together."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.experiments.plants import Plant
from finssim.tasks import Task
from finssim.tasks.agents import NOWHERE, Agent
from finssim.tasks.rollout import rollout
from finssim.vehicles import Vehicle

__all__ = ["EPISODES", "Episodes", "run_episodes", "summarize_episodes"]

EPISODES = 64
"""Unless told otherwise: an interval of a rate is then some ±0.12."""
LABELS = ("trial", "record", "fault", "localization", "clock_offset_s")
"""What a trial's row has besides its metrics."""
RESAMPLES = 2000
SEED = 20261122


class EpisodeError(ValueError):
    """Episodes that cannot be run."""


@dataclass(frozen=True)
class Episodes:
    """How each episode went."""

    metrics: Mapping[str, NDArray[np.float64]]
    """`Task.metrics`, (n,) each; NaN where there is none, such as a time never reached, or a world that broke."""

    def measures(self) -> list[dict[str, Any]]:
        """The metrics of each episode with its number; None where there is none."""
        count = len(next(iter(self.metrics.values())))
        rows = ({name: float(values[i]) for name, values in self.metrics.items()} for i in range(count))
        return [
            {"trial": i, **{k: x if np.isfinite(x) else None for k, x in row.items()}}
            for i, row in enumerate(rows)
        ]


def run_episodes(
    agent: Agent,
    task: Task,
    vehicle: Vehicle,
    plant: Plant,
    *,
    trials: int = EPISODES,
    hydrodynamics: str = "calibrated",
    seed: int = 42,
    record: Path | None = None,
    crash_directory: Path = Path("finssim-frozen"),
    show: Callable[[float], None] = lambda part: None,
) -> Episodes:
    """Run one episode in each of `trials` worlds to its end; starts and goals are those of training, drawn with `seed`.

    Args:
        agent: Who acts; several agents of a world share it.
        task: What is to be done.
        vehicle: As its file has it and the agent knows it, every one of a world; the plant changes what they deliver.
        plant: What differs.
        trials: How many episodes.
        hydrodynamics: Model, unless the plant names one.
        seed: Of everything drawn.
        record: New folder for every state, command and thrust; none if None.
        crash_directory: Where the last states of a world that broke are written.
        show: Called with the part done.

    Raises:
        EpisodeError: The agent acts at another rate than the task.
    """
    if abs(agent.period - task.control_step) > 1e-9:
        raise EpisodeError(
            f"the controller acts every {agent.period:g} s, expected {task.control_step:g} s: "
            f"episodes of '{task.name}' are measured at the rate of the task"
        )
    environment = plant.environment(
        agent,
        task,
        vehicle,
        worlds=trials,
        hydrodynamics=hydrodynamics,
        seed=seed,
        crash_directory=crash_directory,
    )
    running = np.ones(trials, dtype=np.bool_)
    found = {name: np.full(trials, np.nan) for name in task.metrics(environment.arrays)}
    longest = round(task.time_limit / task.control_step) + 1
    for k, step in rollout(agent, environment, longest, lambda t: NOWHERE, record=record):
        if step is None:
            continue
        ended = running & (step.terminated | step.truncated)
        if ended.any():
            # A world that broke is terminated but not done; having begun anew, it is not frozen any more.
            whole = ended & (environment.arrays.done.numpy() != 0)
            for name, values in task.metrics(environment.arrays).items():
                found[name][whole] = values[whole]
            running &= ~ended
        show(k / longest)
        if not running.any():
            break
    return Episodes(found)


def summarize_episodes(trials: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """One controller's row: means over the episodes, and where a bootstrap over them puts each mean.

    Returns:
        `trials`, `valid` (episodes whose world did not break), `metrics` (name -> value, ci95) and `per_trial`.
    """
    names = [name for name in trials[0] if name not in LABELS]
    rng = np.random.default_rng(SEED)
    metrics: dict[str, Any] = {}
    for name in names:
        values = np.array([trial[name] for trial in trials if trial[name] is not None], dtype=float)
        if not len(values):
            metrics[name] = {"value": None, "ci95": None}
            continue
        means = values[rng.integers(0, len(values), (RESAMPLES, len(values)))].mean(axis=1)
        low, high = np.quantile(means, (0.025, 0.975))
        metrics[name] = {"value": float(values.mean()), "ci95": [float(low), float(high)]}
    return {
        "trials": len(trials),
        "valid": sum(trial["return"] is not None for trial in trials),
        "metrics": metrics,
        "per_trial": [dict(trial) for trial in trials],
    }
