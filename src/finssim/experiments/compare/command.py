"""`finssim compare`: a figure and a table of trainings over seeds."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

from rich.console import Console

from finssim.experiments.compare.runs import Group, groups_of
from finssim.experiments.compare.scores import evaluated, less_is_better, measures_of, scores_of
from finssim.experiments.compare.statistics import (
    better,
    interquartile_mean,
    plain,
    probability_of_improvement,
    with_bootstrap,
)
from finssim.experiments.compare.table import markdown, print_comparison
from finssim.experiments.plants import load_plant
from finssim.experiments.running import Say, run_experiment
from finssim.files import atomic_write
from finssim.provenance import provenance

__all__ = ["compare", "comparison"]

RESULT_FILE = "compare.json"
FEWEST = 3
"""Seeds of each side, below which nothing is said: drawn from two, an interval hardly has a width."""


def compare(
    runs: Sequence[str],
    *,
    out: Path,
    vehicle: str = "finsrov",
    plant: str = "nominal",
    trials: int | None = None,
    measures: Sequence[str] = (),
    seed: int = 42,
    as_json: bool = False,
    console: Console | None = None,
) -> dict[str, Any]:
    """Evaluate every run on the same trials, and write `compare.json`, `compare.md` and `compare.png`.

    Args:
        runs: Policy directories, each DIR or NAME=DIR; those of one name differ in the seed alone.
        out: Directory; evaluations that are there already are not made again.
        vehicle: Name or file that all are evaluated with.
        plant: Name or file.
        trials: Of each run; the task's own number if None.
        measures: Which to compare; the task's own if none.
        seed: Of what the plant draws.
        as_json: Print one JSON object in place of the table.
        console: Where the table goes; standard output if None.

    Raises:
        CompareError, EvaluationError, PolicyError, PlantError, VehicleError, OutputError: As they say.
    """
    groups = groups_of(runs)

    def work(say: Say) -> dict[str, Any]:
        from finssim.experiments.compare.figure import draw_comparison  # Matplotlib is slow to import

        found = evaluated(
            groups,
            load_plant(plant),
            out / "evaluations",
            vehicle=vehicle,
            trials=trials,
            seed=seed,
            show=say,
        )
        result = {
            **comparison(groups, found, measures),
            "vehicle": vehicle,
            "plant": plant,
            "seed": seed,
            "provenance": provenance(),
        }
        draw_comparison(groups, result, out / "compare.png")
        for name, text in (
            (RESULT_FILE, json.dumps(result, indent=1) + "\n"),
            ("compare.md", markdown(result)),
        ):
            with atomic_write(out / name) as temporary:
                Path(temporary).write_text(text, encoding="utf-8")
        return result

    return run_experiment("comparing", work, print_comparison, out=out, as_json=as_json, console=console)


def comparison(
    groups: Sequence[Group],
    found: Mapping[tuple[str, int], Sequence[Mapping[str, Any]]],
    asked: Sequence[str] = (),
) -> dict[str, Any]:
    """Interquartile means over seeds and targets with intervals, and for each pair how likely one beats the other.

    Args:
        groups: Who is compared.
        found: Trials by (group, seed).
        asked: Measures; the task's own if none.

    Returns:
        `task`, `measures` (name -> whether less is better), `groups` (name -> runs, seeds, steps, seconds, measures)
        and `pairs` (a, b, measure, probability that a is better, ci95, verdict: better, worse or open).
    """
    task = groups[0].runs[0].description.task
    names = measures_of(task, next(iter(found.values())), asked)
    scores = {
        (group.name, name): scores_of([found[group.name, run.seed] for run in group.runs], name)
        for group in groups
        for name in names
    }
    rows: dict[str, Any] = {}
    for group in groups:
        seconds = [run.seconds for run in group.runs if run.seconds is not None]
        rows[group.name] = {
            "runs": [str(run.place) for run in group.runs],
            "seeds": [run.seed for run in group.runs],
            "steps": group.runs[0].description.training.get("steps"),
            "seconds": sum(seconds) / len(seconds) if seconds else None,
            "measures": {
                name: plain(with_bootstrap([scores[group.name, name]], interquartile_mean)) for name in names
            },
        }
    pairs = [_pair(a.name, b.name, name, scores) for a, b in combinations(groups, 2) for name in names]
    return {
        "task": task,
        "measures": {name: less_is_better(name) for name in names},
        "groups": rows,
        "pairs": pairs,
    }


def _pair(a: str, b: str, measure: str, scores: Mapping[tuple[str, str], Any]) -> dict[str, Any]:
    less = less_is_better(measure)
    found = with_bootstrap(
        [scores[a, measure], scores[b, measure]],
        lambda x, y: probability_of_improvement(x, y, less),
    )
    assert found is not None  # groups have runs
    enough = min(len(scores[name, measure]) for name in (a, b)) >= FEWEST
    verdict = {True: "better", False: "worse", None: "open"}[better(found) if enough else None]
    return {
        "a": a, "b": b, "measure": measure, "probability": found.value, "ci95": [found.low, found.high],
        "verdict": verdict,
    }  # fmt: skip
