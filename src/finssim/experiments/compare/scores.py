"""Scores of trainings: every policy is evaluated on the same trials, which are kept so that a second call is quick."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.experiments.compare.runs import CompareError, Group, Run
from finssim.experiments.evaluate import evaluate_controller
from finssim.experiments.plants import Plant
from finssim.files import atomic_write
from finssim.vehicles import load_vehicle

__all__ = ["MEASURES", "evaluated", "less_is_better", "measures_of", "scores_of"]

MEASURES: dict[str, tuple[str, ...]] = {
    "t1": ("success", "e_p_m", "e_psi_deg", "t_s_s"),
    "t2": ("horizontal_rmse_m", "vertical_rmse_m", "p95_m"),
}
"""What is compared unless told otherwise; of other tasks success and return."""
MORE_IS_BETTER = ("success", "complete", "completion", "return", "held", "captured", "capture")
STRATA = ("setpoint", "trajectory")
"""Keys of a trial that tell trials of different difficulty apart."""


def less_is_better(measure: str) -> bool:
    """Whether a measure is an error, a time or an effort."""
    return measure not in MORE_IS_BETTER


def measures_of(task: str, trials: Sequence[Mapping[str, Any]], asked: Sequence[str] = ()) -> tuple[str, ...]:
    """The measures to compare.

    Raises:
        CompareError: One that is asked for is not measured.
    """
    have = [key for key, value in trials[0].items() if isinstance(value, bool | int | float) or value is None]
    for name in asked:
        if name not in have:
            raise CompareError(f"no measure '{name}' of task '{task}'; available: {', '.join(have)}")
    preferred = MEASURES.get(task, ("success", "return"))
    return tuple(asked) or tuple(name for name in preferred if name in have) or tuple(have[:1])


def evaluated(
    groups: Sequence[Group],
    plant: Plant,
    folder: Path,
    *,
    vehicle: str,
    trials: int | None,
    seed: int,
    show: Callable[[float, str], None],
) -> dict[tuple[str, int], list[dict[str, Any]]]:
    """The trials of every run by (group, seed); what is in the folder already is not evaluated again."""
    found: dict[tuple[str, int], list[dict[str, Any]]] = {}
    count, done = sum(len(group.runs) for group in groups), 0
    for group in groups:
        for run in group.runs:
            show(done / count, f"evaluating {group.name}, seed {run.seed}")
            found[group.name, run.seed] = _trials(
                run, plant, folder, vehicle=vehicle, trials=trials, seed=seed
            )
            done += 1
    return found


def _trials(
    run: Run, plant: Plant, folder: Path, *, vehicle: str, trials: int | None, seed: int
) -> list[dict[str, Any]]:
    about = {
        "files": run.description.files,
        "vehicle": load_vehicle(vehicle).sha256,
        "plant": plant.model_dump(mode="json"),
        "trials": trials,
        "seed": seed,
    }
    path = folder / f"{run.place.resolve().name}-{run.description.files['policy.onnx'][:10]}.json"
    if path.is_file():
        kept = json.loads(path.read_text(encoding="utf-8"))
        if kept["about"] == about:
            return list(kept["result"]["per_trial"])
    task = run.description.task
    result = evaluate_controller(
        run.place, plant, task=task, vehicle=vehicle, trials=trials, seed=seed
    ).result
    with atomic_write(path) as temporary:
        Path(temporary).write_text(json.dumps({"about": about, "result": result}), encoding="utf-8")
    return list(result["per_trial"])


def scores_of(runs: Sequence[Sequence[Mapping[str, Any]]], measure: str) -> NDArray[np.float64]:
    """Scores (runs, strata): the mean over a run's trials of a stratum; a trial without a value is infinitely bad."""
    worst = math.inf if less_is_better(measure) else -math.inf
    rows = []
    for trials in runs:
        strata: dict[str, list[float]] = {}
        for trial in trials:
            stratum = next((str(trial[key]) for key in STRATA if key in trial), "all")
            value = trial[measure]
            strata.setdefault(stratum, []).append(worst if value is None else float(value))
        rows.append([float(np.mean(values)) for values in strata.values()])
    return np.array(rows, dtype=float)
