"""`finssim compare`: a figure and a table of trainings over seeds."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations, product
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from finssim.control.policy import Policy, PolicyDescription
from finssim.experiments.campaign import Progress, run_jobs, write_json
from finssim.experiments.evaluate import Job, play
from finssim.experiments.figures import COLORS, clean, new_figure, save_figure
from finssim.experiments.plants import load_plant
from finssim.experiments.statistics import interquartile_mean, probability_of_improvement, with_bootstrap
from finssim.experiments.tables import Table, figure_text
from finssim.provenance import provenance
from finssim.tasks import TASKS

__all__ = ["MEASURES", "CompareError", "compare", "draw_training", "tables_of"]

CURVES_FILE = "curves.csv"
SEED_AT_END = re.compile(r"[-_]?(?:seed|s)?[-_]?\d+$")
NOT_SETTINGS = ("steps_done", "best_after", "complete", "seconds", "resumed")
"""Of a training's record: what tells how it went."""


class CompareError(ValueError):
    """Trainings that cannot be compared."""


@dataclass(frozen=True)
class Run:
    """One training."""

    path: Path
    description: PolicyDescription
    curves: dict[str, NDArray[np.float64]]
    """Columns of `curves.csv`; empty if it has none."""

    @property
    def seed(self) -> int:
        """Of the training."""
        return self.description.seed

    @property
    def seconds(self) -> float | None:
        """How long it trained [s]."""
        column = self.curves.get("seconds")
        return None if column is None or not len(column) else float(column[-1])


@dataclass(frozen=True)
class Group:
    """Trainings with equal settings and different seeds."""

    name: str
    runs: tuple[Run, ...]


def groups_of(arguments: Sequence[str]) -> list[Group]:
    """Load runs and put them together.

    Args:
        arguments: Policy directories, each `DIR` or `NAME=DIR`; without a name, that of the folder less a number at its
            end (`hold-seed3` belongs to `hold`).

    Raises:
        CompareError: Two runs of a name differ in more than the seed, or have one seed; no run is given, or they do
            different tasks.
        PolicyError: A directory is no policy.
    """
    if not arguments:
        raise CompareError("no run is given: name policy directories, each DIR or NAME=DIR")
    named: dict[str, list[Run]] = {}
    for word in arguments:
        name, label, path = word.rpartition("=")
        folder = Path(path)
        if not label:
            name = SEED_AT_END.sub("", folder.resolve().name) or folder.resolve().name
        named.setdefault(name, []).append(
            Run(folder, Policy.load(folder).description, _curves(folder / CURVES_FILE))
        )
    tasks = {run.description.task for runs in named.values() for run in runs}
    if len(tasks) > 1:
        raise CompareError(f"runs were trained for {', '.join(sorted(tasks))}: compare those of one task")
    if not tasks <= TASKS.keys():
        # FILE.py:CLASS in somebody's policy.yaml would be code to run.
        raise CompareError(
            f"runs were trained for {tasks.pop()!r}, expected one of {', '.join(TASKS)}: policies of other tasks "
            "are evaluated one by one, with finssim evaluate --task FILE.py:CLASS"
        )
    for name, runs in named.items():
        _check(name, runs)
    return [Group(name, tuple(sorted(runs, key=lambda run: run.seed))) for name, runs in named.items()]


def _curves(path: Path) -> dict[str, NDArray[np.float64]]:
    if not path.is_file():
        return {}
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    names = rows[0] if rows else ()
    try:
        return {name: np.array([float(row[name] or "nan") for row in rows]) for name in names}
    except (TypeError, ValueError) as error:
        raise CompareError(
            f"{path}: a cell is no number ({error}): expected the curves of a training"
        ) from error


def _check(name: str, runs: Sequence[Run]) -> None:
    first = runs[0]
    for run in runs[1:]:
        ours, theirs = _settings(first.description), _settings(run.description)
        different = next((key for key in {**ours, **theirs} if ours.get(key) != theirs.get(key)), "")
        if different:
            raise CompareError(
                f"{first.path} and {run.path} are both '{name}', but differ in {different}: "
                "give different names with NAME=DIR"
            )
    seeds = [run.seed for run in runs]
    for seed in seeds:
        if seeds.count(seed) > 1:
            raise CompareError(f"'{name}' has two runs with seed {seed}: give each training once")


def _settings(description: PolicyDescription) -> dict[str, Any]:
    training = {k: v for k, v in description.training.items() if k not in NOT_SETTINGS}
    return {
        "task": description.task,
        "action": description.action,
        "vehicle": description.vehicle.sha256,
        "hydrodynamics": description.hydrodynamics,
        **training,
    }


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


def measures_of(
    task: str, trials: Sequence[Mapping[str, Any]], requested: Sequence[str] = ()
) -> tuple[str, ...]:
    """The measures to compare.

    Raises:
        CompareError: One that is asked for is not measured.
    """
    have = [key for key, value in trials[0].items() if isinstance(value, bool | int | float) or value is None]
    for name in requested:
        if name not in have:
            raise CompareError(f"no measure '{name}' of task '{task}'; available: {', '.join(have)}")
    preferred = MEASURES.get(task, ("success", "return"))
    return tuple(requested) or tuple(name for name in preferred if name in have) or tuple(have[:1])


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


NOTE = (
    "interquartile mean over seeds and targets; in brackets 95 % of a bootstrap over the seeds, stratified by target. "
    "With fewer than five seeds an interval is too narrow; with fewer than three no group is called better."
)
VERDICTS = {
    "better": "{a} is better than {b} in {measure}",
    "worse": "{b} is better than {a} in {measure}",
    "open": "{a} and {b} are not distinguishable in {measure}",
}


def tables_of(result: Mapping[str, Any]) -> list[Table]:
    """A row for each group, and what the intervals support of each pair and leave open."""
    rows = [
        [
            name,
            str(len(group["seeds"])),
            figure_text(group["steps"], ",.0f"),
            figure_text(group["seconds"], ".0f"),
            *(figure_text(group["measures"][measure], ".4g") for measure in result["measures"]),
        ]
        for name, group in result["groups"].items()
    ]
    sentences = []
    for pair in result["pairs"]:
        low, high = pair["ci95"]
        chance = f"chance that {pair['a']} is better: {pair['probability']:.2f} [{low:.2f}, {high:.2f}]"
        sentences.append(f"{VERDICTS[pair['verdict']].format(**pair)} ({chance})")
    table = Table(
        title=f"{result['task']}, plant {result['plant']}",
        heads=["", "seeds", "steps", "time [s]", *result["measures"]],
        rows=rows,
        note=NOTE,
        sentences=sentences,
        intervals=True,
    )
    return [table]


CURVES = {
    "evaluation_success": "success, evaluated",
    "evaluation_return": "return, evaluated",
    "held": "share that held at the end",
    "mean_return": "return in training",
}
"""Columns of a training's curves and what they are."""
POINTS = 60
"""Of a curve."""
CURVE_RESAMPLES = 200


def draw_training(groups: Sequence[Group], path: Path) -> Path:
    """Write a figure of the first two of `CURVES` that every run has."""
    runs = [run for group in groups for run in group.runs]
    curves = [name for name in CURVES if all(_drawable(run, name) for run in runs)][:2]
    figure = new_figure(3.6 * max(len(curves), 1), 3.0)
    for axes, name in zip(figure.subplots(1, max(len(curves), 1), squeeze=False)[0], curves, strict=False):
        _draw_curves(axes, groups, name, legend=len(groups) > 1)
    return save_figure(figure, path)


def _drawable(run: Run, name: str) -> bool:
    return bool(np.isfinite(run.curves.get(name, np.empty(0))).any())


def curve_of(group: Group, name: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Steps (n,) as far as every run of a group came, and low, middle and high of a column there, (3, n).

    The middle is the interquartile mean over the runs, low and high are where a bootstrap over them puts it.
    """
    last = min(float(run.curves["steps"][-1]) for run in group.runs)
    steps = np.linspace(last / POINTS, last, POINTS)
    rows = np.array([_at(steps, run, name) for run in group.runs])
    band = np.empty((3, POINTS))
    for k in range(POINTS):
        figure = with_bootstrap([rows[:, k : k + 1]], interquartile_mean, CURVE_RESAMPLES)
        band[:, k] = figure["ci95"][0], figure["value"], figure["ci95"][1]
    return steps, band


def _at(steps: NDArray[np.float64], run: Run, name: str) -> NDArray[np.float64]:
    """A column between its rows; one without a number, as before the first episode ended, is left out."""
    finite = np.isfinite(run.curves[name])
    return np.interp(steps, run.curves["steps"][finite], run.curves[name][finite])


def _draw_curves(axes: Any, groups: Sequence[Group], name: str, *, legend: bool) -> None:
    for i, group in enumerate(groups):
        steps, (low, middle, high) = curve_of(group, name)
        color = COLORS[i % len(COLORS)]
        axes.fill_between(steps / 1e6, low, high, color=color, alpha=0.2, linewidth=0.0)
        axes.plot(steps / 1e6, middle, color=color, label=group.name)
    axes.set_xlabel("control steps [million]", fontsize=8)
    axes.set_title(CURVES[name], fontsize=10)
    if legend:
        axes.legend(frameon=False, fontsize=8)
    clean(axes)


RESULT_FILE = "compare.json"
FEWEST = 3
"""Seeds of each side, below which nothing is said: drawn from two, an interval hardly has a width."""


def compare(
    runs: Sequence[str],
    *,
    out: Path,
    measures: Annotated[Sequence[str], "--measure"] = (),
    vehicle: str = "finsrov",
    plant: str = "nominal",
    trials: Annotated[int | None, (1, 100_000)] = None,
    seed: int = 1,
    progress: Progress = lambda part, text: None,
) -> dict[str, Any]:
    """Compare trainings over seeds: interquartile means, probability of improvement, learning curves.

    Example: finssim compare runs/hold-seed1 runs/hold-seed2 runs/hold-seed3 cloned=runs/bc-1 --out compared

    Args:
        runs (RUN...): Policy directories, each DIR or NAME=DIR; those of one name differ only in the seed.
        out (DIR): Directory for table, figure and evaluations.
        measures: Metric to compare; the task's metrics if not given. May be repeated.
        vehicle (NAME|FILE): Vehicle in the catalogue, or path of a vehicle file.
        plant (FILE|NAME): What differs from the vehicle file, as in finssim evaluate.
        trials: Trials per run; the default of evaluate if not given.
        seed: Seed of every random number; equal seeds give equal results.
        progress: Told the share that is done and what comes next.

    Raises:
        CompareError, EvaluationError, PolicyError, PlantError, VehicleError, OutputError: As they say.
    """
    groups = groups_of(runs)
    water = load_plant(plant)
    jobs = [
        Job(
            row=group.name, target=run.description.task, task=run.description.task, seed=run.seed, noise=seed,
            controller=str(run.path), vehicle=vehicle, water=water, trials=trials,
        )
        for group in groups for run in group.runs
    ]  # fmt: skip
    results = run_jobs(jobs, out / "evaluations", play, progress=progress)
    scored = {(job.row, job.seed): r["per_trial"] for job, r in zip(jobs, results, strict=True)}
    result = {
        **comparison(groups, scored, measures),
        "vehicle": vehicle,
        "plant": plant,
        "seed": seed,
        "provenance": provenance(),
    }
    draw_training(groups, out / "compare.png")
    write_json(out / RESULT_FILE, result, tables_of(result))
    return result


def comparison(
    groups: Sequence[Group],
    trials: Mapping[tuple[str, int], Sequence[Mapping[str, Any]]],
    requested: Sequence[str] = (),
) -> dict[str, Any]:
    """Interquartile means over seeds and targets with intervals, and for each pair how likely one beats the other.

    Args:
        groups: Who is compared.
        trials: Trials by (group, seed).
        requested: Measures; the task's own if none.

    Returns:
        `task`, `measures` (name -> whether less is better), `groups` (name -> runs, seeds, steps, seconds, measures)
        and `pairs` (a, b, measure, probability that a is better, ci95, verdict: better, worse or open).
    """
    task = groups[0].runs[0].description.task
    names = measures_of(task, next(iter(trials.values())), requested)
    scores = {
        (group.name, name): scores_of([trials[group.name, run.seed] for run in group.runs], name)
        for group in groups
        for name in names
    }
    rows: dict[str, Any] = {}
    for group in groups:
        seconds = [run.seconds for run in group.runs if run.seconds is not None]
        rows[group.name] = {
            "runs": [str(run.path) for run in group.runs],
            "seeds": [run.seed for run in group.runs],
            "steps": group.runs[0].description.training.get("steps"),
            "seconds": sum(seconds) / len(seconds) if seconds else None,
            "measures": {
                name: with_bootstrap([scores[group.name, name]], interquartile_mean) for name in names
            },
        }
    pairs = []
    for (a, b), name in product(combinations([group.name for group in groups], 2), names):
        both = scores[a, name], scores[b, name]
        improvement = partial(probability_of_improvement, less_is_better=less_is_better(name))
        chance = with_bootstrap(both, improvement)
        low, high = chance["ci95"]
        verdict = "better" if low > 0.5 else "worse" if high < 0.5 else "open"
        verdict = verdict if min(map(len, both)) >= FEWEST else "open"
        about = {"a": a, "b": b, "measure": name, "verdict": verdict}
        pairs.append({**about, "probability": chance["value"], "ci95": chance["ci95"]})
    return {
        "task": task,
        "measures": {name: less_is_better(name) for name in names},
        "groups": rows,
        "pairs": pairs,
    }
