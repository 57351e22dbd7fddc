"""Runs an experiment of the virtual pool: trains what its rows need, plays every trial, writes what came out."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console

from finssim.experiments.on_robot.play import Attendant
from finssim.experiments.on_robot.session import OnRobot
from finssim.experiments.running import Say, run_experiment
from finssim.experiments.transfer.campaign import run_jobs
from finssim.experiments.transfer.intervals import Interval
from finssim.experiments.transfer.job import Job
from finssim.experiments.transfer.policies import Training, trained
from finssim.experiments.transfer.pool_trial import play
from finssim.experiments.transfer.ranges import INTERVALS, interval_ranges
from finssim.experiments.transfer.robot_trial import HARDWARE, run_on_robot
from finssim.experiments.transfer.scores import difference, row_figures
from finssim.experiments.transfer.sentences import sentence
from finssim.experiments.transfer.spec import Row, Spec
from finssim.experiments.transfer.table import markdown_of, print_shown
from finssim.files import atomic_write
from finssim.provenance import provenance
from finssim.vehicles import load_vehicle

__all__ = ["run", "transfer_experiment"]

Results = dict[str, list[dict[str, Any]]]
"""Row -> results of its trials."""

TRAINING_SHARE = 0.4
"""Of the progress bar."""


def run(
    spec: Spec, *, out: Path, as_json: bool = False, console: Console | None = None, **options: Any
) -> dict[str, Any]:
    """Run an experiment with a progress bar, print its table (or one JSON object) and write the directory.

    Arguments as `transfer_experiment`; console is where the table goes, standard output if None.
    """
    return run_experiment(
        f"experiment {spec.name}",
        lambda say: transfer_experiment(spec, out=out, say=say, **options),
        lambda result, screen: print_shown(spec.shown(result), screen),
        out=out,
        as_json=as_json,
        console=console,
        bar=options.get("robot") is None,
    )


def transfer_experiment(
    spec: Spec,
    *,
    out: Path,
    plants: int = 3,
    seeds: int = 3,
    seed: int = 1,
    rows: Sequence[str] | None = None,
    targets: Sequence[str] | None = None,
    severity: str = "realistic",
    camera: str = "corners",
    vehicle: str = "finsrov",
    steps: int | None = None,
    processes: int | None = None,
    robot: OnRobot | None = None,
    attendant: Attendant | None = None,
    say: Say = lambda part, what: None,
) -> dict[str, Any]:
    """Train what the rows need, play every target in every plant with every seed, and write the table.

    The directory keeps policies and trials: a run that was interrupted goes on where it was, and one with more seeds
    plays only what is new.

    Args:
        spec: Which experiment.
        out: Directory for NAME.json, NAME.md, the figure, `policies/` and `trials/`.
        plants: How many pools, each with its own vehicle, camera and water.
        seeds: How many trainings of each policy, each tried with its own noise.
        seed: The first of both.
        rows: Keys of the rows; all if None.
        targets: What is played; the published ones if None.
        severity: Of the pools: nominal, realistic or hard.
        camera: corners or pictures.
        vehicle: Name or file.
        steps: Of each training; the task's own if None.
        processes: Trials at once; as many as processors if None.
        robot: Play on a robot, one trial after the other, instead of in pools; plants, severity and camera are its own.
        attendant: The person beside that robot, instead of the terminal's keyboard.
        say: Told the share that is done and what comes next.

    Returns:
        What NAME.json holds.

    Raises:
        ValueError: An unknown row, target, severity or camera, or a number below 1.
    """
    chosen = {name: _known(spec.rows, name, "row") for name in rows or spec.rows}
    targets = [_known({t: t for t in spec.known_targets}, name, "target") for name in targets or spec.targets]
    for given, known, what in (
        (severity, ("nominal", "realistic", "hard"), "severity"),
        (camera, ("corners", "pictures"), "camera"),
    ):
        _known({word: word for word in known}, given, what)
    if plants < 1 or seeds < 1:
        raise ValueError(f"plants is {plants}, seeds {seeds}: expected at least 1 of each")
    places, run_seeds, folder = range(seed, seed + plants), range(seed, seed + seeds), Path(out)
    policies = _policies(
        spec, chosen, run_seeds, folder, vehicle, steps, lambda part, what: say(TRAINING_SHARE * part, what)
    )
    if robot is not None:  # there is one plant, and nobody chose its severity
        places, severity, camera = range(1), HARDWARE, HARDWARE
    jobs = [
        Job(
            row=name, controller=row.controller or str(policies[row.training or "", s]), target=target,
            vehicle=vehicle, pool_vehicle=vehicle, plant=plant, severity=severity, seed=s, camera=camera,
            **row.changes,
        )
        for name, row in chosen.items() for plant in places for s in run_seeds for target in targets
    ]  # fmt: skip
    if robot is None:
        results = run_jobs(
            jobs, folder / "trials", play, processes=processes,
            say=lambda part, what: say(TRAINING_SHARE + (1.0 - TRAINING_SHARE) * part, what),
        )  # fmt: skip
    else:
        results = run_on_robot(jobs, folder / "trials", robot, attendant=attendant)
    by_row: Results = {name: [r for r in results if r["job"]["row"] == name] for name in chosen}
    by_row = {name: played for name, played in by_row.items() if played}  # all of a row may have been skipped
    told = {
        "experiment": spec.name, "severity": severity, "camera": camera, "plants": list(places),
        "seeds": list(run_seeds), "targets": list(targets), "robot": robot and robot.title,
        "vehicle": {"name": load_vehicle(vehicle).name, "sha256": load_vehicle(vehicle).sha256},
    }  # fmt: skip
    result = {**told, **_scores(spec, by_row), "trials": results, "provenance": provenance()}
    _write(spec, result, by_row, folder)
    return result


def _known(known: Mapping[str, Any], name: str, what: str) -> Any:
    if name not in known:
        raise ValueError(f"unknown {what} '{name}'; available: {', '.join(known)}")
    return known[name]


def _policies(
    spec: Spec,
    rows: Mapping[str, Row],
    seeds: Sequence[int],
    folder: Path,
    vehicle: str,
    steps: int | None,
    say: Say,
) -> dict[tuple[str, int], Path]:
    needed = dict.fromkeys(row.training for row in rows.values() if row.training is not None)

    def ready(training: Training) -> Training:
        if training.randomize != INTERVALS:
            return training
        say(0.0, "identifying the vehicle, for the ranges of its intervals")
        ranges = interval_ranges(folder / "identification", vehicle, seeds[0])
        return replace(training, randomize=str(ranges))

    trainings = [ready(spec.trainings[name]) for name in needed]
    return trained(trainings, seeds, folder / "policies", vehicle=vehicle, steps=steps, say=say)


def _scores(spec: Spec, by_row: Results) -> dict[str, Any]:
    """Figures of every row, all targets together and each alone; differences from the reference; sentences."""
    rows = {}
    for name, results in by_row.items():
        targets = dict.fromkeys(r["job"]["target"] for r in results)
        each = {
            t: row_figures([r for r in results if r["job"]["target"] == t], spec.figures) for t in targets
        }
        rows[name] = {**row_figures(results, spec.figures), "by_target": each}
    differences: dict[str, dict[str, Interval | None]] = {}
    if spec.base in by_row:
        differences = {
            name: {key: difference(by_row[spec.base], results, key) for key in spec.differences}
            for name, results in by_row.items()
            if name != spec.base
        }
    return {
        "rows": rows,
        "base": spec.base,
        "differences": {
            name: {key: d and d.as_json() for key, d in of_row.items()}
            for name, of_row in differences.items()
        },
        "sentences": [sentence(spec.rows[name].module, of_row) for name, of_row in differences.items()],
    }


def _write(spec: Spec, result: Mapping[str, Any], by_row: Results, folder: Path) -> None:
    with atomic_write(folder / f"{spec.name}.json") as temporary:
        temporary.write_text(json.dumps(result, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    with atomic_write(folder / f"{spec.name}.md") as temporary:
        temporary.write_text(markdown_of(spec.shown(result)), encoding="utf-8")
    spec.draw(by_row, folder)
