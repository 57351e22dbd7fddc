"""Whole episodes of any task: a controller, vehicles and a plant, one world per episode, all stepped together."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.control.tracking import Goal
from finssim.engine import Recorder
from finssim.experiments.plants import Plant
from finssim.experiments.players import Player
from finssim.tasks import Environment, Task
from finssim.vehicles import Vehicle

__all__ = ["EPISODES", "Episodes", "run_episodes", "summarize_episodes"]

EPISODES = 64
"""Unless told otherwise: an interval of a rate is then some ±0.12."""
RESAMPLES = 2000
SEED = 20261122
NOWHERE = Goal(np.zeros((0, 3)), np.zeros((0, 4)))
"""What a player of episodes is told of a goal: nothing, its observation has what it may know."""


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
    player: Player,
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
        player: Who acts; several agents of a world share it.
        task: What is to be done.
        vehicle: As its file has it and the player knows it, every one of a world; the plant changes what they deliver.
        plant: What differs.
        trials: How many episodes.
        hydrodynamics: Model, unless the plant names one.
        seed: Of everything drawn.
        record: New folder for every state, command and thrust; none if None.
        crash_directory: Where the last states of a world that broke are written.
        show: Called with the part done.

    Raises:
        EpisodeError: The player acts at another rate than the task.
    """
    if abs(player.period - task.control_step) > 1e-9:
        raise EpisodeError(
            f"the controller acts every {player.period:g} s, expected {task.control_step:g} s: "
            f"episodes of '{task.name}' are measured at the rate of the task"
        )
    environment = Environment(
        task,
        plant.changed(vehicle),
        nominal=vehicle,
        worlds=trials,
        hydrodynamics=plant.hydrodynamics or hydrodynamics,
        action=player.action,
        wrench_scale=player.wrench_scale,
        seed=seed,
        crash_directory=crash_directory,
        **plant.environment_arguments(),
    )
    with nullcontext() if record is None else Recorder(environment.simulator, record) as recorder:
        return Episodes(_play(player, environment, recorder, show))


def _play(
    player: Player, environment: Environment, recorder: Recorder | None, show: Callable[[float], None]
) -> dict[str, NDArray[np.float64]]:
    """The metrics of the first episode of every world."""
    task, arrays, worlds = environment.task, environment.arrays, environment.worlds
    running = np.ones(worlds, dtype=np.bool_)
    found = {name: np.full(worlds, np.nan) for name in task.metrics(arrays)}
    rows = worlds * environment.agents
    memory = player.reset(rows)
    longest = round(task.time_limit / task.control_step) + 1
    for k in range(longest):
        if recorder is not None:
            recorder.record()
        action, memory = player.act(memory, arrays, NOWHERE)
        shape = (
            (worlds, environment.action_size) if environment.agents == 1 else (worlds, environment.agents, -1)
        )
        step = environment.step(np.asarray(action, dtype=np.float32).reshape(shape))
        ended = running & (step.terminated | step.truncated)
        if ended.any():
            # A world that broke is terminated but not done; having begun anew, it is not frozen any more.
            whole = ended & (arrays.done.numpy() != 0)
            for name, values in task.metrics(arrays).items():
                found[name][whole] = values[whole]
            running &= ~ended
        show(max(k + 1, 1) / longest)
        if not running.any():
            break
    return found


def summarize_episodes(trials: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """One controller's row: means over the episodes, and where a bootstrap over them puts each mean.

    Returns:
        `trials`, `valid` (episodes whose world did not break), `metrics` (name -> value, ci95) and `per_trial`.
    """
    names = [name for name in trials[0] if name != "trial"]
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
