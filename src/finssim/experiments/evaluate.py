"""`finssim evaluate`: 60 s trials of a controller on the published setpoints; table, JSON, figure, trajectories."""

from __future__ import annotations

import json as json_module
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress

from finssim.experiments.metrics import summarize
from finssim.experiments.plants import Plant, load_plant
from finssim.experiments.players import make_player
from finssim.experiments.results_table import print_results
from finssim.experiments.setpoints import T1_SETPOINTS
from finssim.experiments.trials import Trials, run_trials
from finssim.files import atomic_directory
from finssim.provenance import provenance
from finssim.quiet import start_warp
from finssim.tasks import TASKS
from finssim.vehicles import Vehicle, load_vehicle

__all__ = ["EVALUATION_FILE", "Evaluation", "EvaluationError", "evaluate", "evaluate_controller"]

EVALUATION_FILE = "evaluation.json"
FIGURE_FILE = "error_envelope.png"
TRAJECTORIES = "trajectories"


class EvaluationError(ValueError):
    """An evaluation that cannot be run."""


@dataclass(frozen=True)
class Evaluation:
    """One controller in one plant."""

    result: dict[str, Any]
    """What `--json` prints: who, where, the measures over all trials, `per_trial`, provenance."""
    trials: Trials

    @property
    def label(self) -> str:
        """Name of the controller and, if not nominal, of the plant."""
        plant = self.result["plant"]["name"]
        name: str = self.result["controller"]["name"]
        return name if plant == "nominal" else f"{name}, {plant}"


def evaluate(
    controller: str | Path,
    *,
    task: str = "t1",
    vehicle: str | Vehicle = "finsrov",
    hydrodynamics: str = "calibrated",
    plant: str | Path | None = None,
    trials: int | None = None,
    seed: int = 42,
    out: Path | None = None,
    json: bool = False,
    console: Console | None = None,
) -> Evaluation:
    """Run the trials, print the table (or one JSON object) and write the directory.

    Args:
        controller: A policy directory, pid or pid-paper.
        task: Key of `TASKS`.
        vehicle: A vehicle, a catalogue name or a file.
        hydrodynamics: Model, unless the plant names one.
        plant: Name or file; nominal if None.
        trials: How many; the eight setpoints once if None.
        seed: Of what the plant draws.
        out: Directory for `evaluation.json`, the figure and the trajectories; an earlier evaluation is replaced.
        json: Print the result in place of the table.
        console: Where the table goes; standard output if None.

    Raises:
        EvaluationError, PolicyError, ControlError, PlantError, VehicleError, OutputError: As they say.
    """
    chosen = load_plant("nominal" if plant is None else plant)
    count = len(T1_SETPOINTS) if trials is None else trials
    options: dict[str, Any] = {
        "task": task,
        "vehicle": vehicle,
        "hydrodynamics": hydrodynamics,
        "trials": count,
        "seed": seed,
    }
    if out is None:
        evaluation = evaluate_controller(controller, chosen, **options)
    else:
        with atomic_directory(out, replaces=EVALUATION_FILE) as folder:
            evaluation = evaluate_controller(controller, chosen, record=folder / TRAJECTORIES, **options)
            _write(evaluation, folder)
    if json:
        print(json_module.dumps(evaluation.result, allow_nan=False))
        return evaluation
    console = console or Console()
    print_results(evaluation.result, console)
    if out is not None:
        console.print(f"written: {out}", highlight=False, soft_wrap=True)
    return evaluation


def evaluate_controller(
    controller: str | Path,
    plant: Plant,
    *,
    task: str = "t1",
    vehicle: str | Vehicle = "finsrov",
    hydrodynamics: str = "calibrated",
    trials: int = 8,
    seed: int = 42,
    record: Path | None = None,
) -> Evaluation:
    """Run the trials and measure them; arguments as `evaluate`."""
    if task not in TASKS:
        raise EvaluationError(f"unknown task '{task}'; available: {', '.join(TASKS)}")
    if trials < 1:
        raise EvaluationError(f"trials is {trials}, expected 1 or more")
    start_warp()
    body = vehicle if isinstance(vehicle, Vehicle) else load_vehicle(vehicle)
    the_task = TASKS[task]()
    player = make_player(controller, body, the_task)
    screen = Console(stderr=True)
    with Progress(console=screen, transient=True, disable=not screen.is_terminal) as progress:
        bar = progress.add_task(f"{trials} trials", total=1.0)
        done = run_trials(
            player,
            the_task,
            body,
            plant,
            trials=trials,
            hydrodynamics=hydrodynamics,
            seed=seed,
            record=record,
            show=lambda part: progress.update(bar, completed=part),
        )
    result = {
        "controller": player.describe(),
        "task": task,
        "vehicle": {"name": body.name, "sha256": body.sha256},
        "hydrodynamics": plant.hydrodynamics or hydrodynamics,
        "plant": plant.model_dump(mode="json", exclude_defaults=True),
        "seed": seed,
        **summarize(done.measures()),
        "provenance": provenance(),
    }
    return Evaluation(result, done)


def _write(evaluation: Evaluation, folder: Path) -> None:
    from finssim.experiments.envelope import error_envelope, save_envelopes

    text = json_module.dumps(evaluation.result, indent=2, allow_nan=False) + "\n"
    (folder / EVALUATION_FILE).write_text(text, encoding="utf-8")
    trials = evaluation.trials
    envelope = error_envelope([trials.series(i) for i in range(len(trials.setpoints))])
    save_envelopes(
        {evaluation.label: envelope}, folder / FIGURE_FILE, evaluation.result["plant"].get("title", "")
    )
