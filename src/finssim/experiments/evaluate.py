"""`finssim evaluate`: 60 s trials of a controller on the published setpoints; table, JSON, figure, trajectories."""

from __future__ import annotations

import json as json_module
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress

from finssim.experiments.metrics import summarize
from finssim.experiments.plants import Plant, load_plant
from finssim.experiments.players import make_player
from finssim.experiments.results_table import print_plants, print_results
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
    plant: str | Path | Sequence[str | Path] = "nominal",
    trials: int | None = None,
    seed: int = 42,
    out: Path | None = None,
    json: bool = False,
    console: Console | None = None,
) -> list[Evaluation]:
    """Run the trials in every plant, print the table (or one JSON object) and write the directory.

    Args:
        controller: A policy directory, pid or pid-paper.
        task: Key of `TASKS`.
        vehicle: A vehicle, a catalogue name or a file.
        hydrodynamics: Model, unless the plant names one.
        plant: Name or file, or several.
        trials: How many in each plant; the eight setpoints once if None.
        seed: Of what the plant draws.
        out: Directory for `evaluation.json`, the figure and the trajectories; an earlier evaluation is replaced.
        json: Print the result in place of the table.
        console: Where the table goes; standard output if None.

    Returns:
        One evaluation for each plant, in their order.

    Raises:
        EvaluationError, PolicyError, ControlError, PlantError, VehicleError, OutputError: As they say.
    """
    plants = _plants([plant] if isinstance(plant, str | Path) else plant)
    count = len(T1_SETPOINTS) if trials is None else trials
    options: dict[str, Any] = {
        "task": task,
        "vehicle": vehicle,
        "hydrodynamics": hydrodynamics,
        "trials": count,
        "seed": seed,
    }
    if out is None:
        evaluations = [evaluate_controller(controller, one, **options) for one in plants]
    else:
        with atomic_directory(out, replaces=EVALUATION_FILE) as folder:
            records = folder / TRAJECTORIES
            evaluations = [
                evaluate_controller(
                    controller, one, record=records / one.name if len(plants) > 1 else records, **options
                )
                for one in plants
            ]
            _write(evaluations, folder)
    if json:
        print(json_module.dumps(_document(evaluations), allow_nan=False))
        return evaluations
    console = console or Console()
    if len(evaluations) == 1:
        print_results(evaluations[0].result, console)
    else:
        print_plants([evaluation.result for evaluation in evaluations], console)
    if out is not None:
        console.print(f"written: {out}", highlight=False, soft_wrap=True)
    return evaluations


def _plants(names: Sequence[str | Path]) -> list[Plant]:
    """The plants; each must have a name of its own, under which its results are told apart."""
    if not names:
        raise EvaluationError("no plant is given: name at least one, such as 'nominal'")
    plants = [load_plant(name) for name in names]
    for i, plant in enumerate(plants):
        if plant.name in (earlier.name for earlier in plants[:i]):
            raise EvaluationError(f"two plants are named '{plant.name}': give each once, or rename one file")
        if len(plants) > 1 and (plant.name in ("", "..") or Path(plant.name).name != plant.name):
            raise EvaluationError(f"plant '{plant.name}' cannot name a folder: rename it")
    return plants


def _document(evaluations: Sequence[Evaluation]) -> dict[str, Any]:
    """What is printed and stored: the object of one plant, or those of several under `plants`."""
    results = [evaluation.result for evaluation in evaluations]
    return results[0] if len(results) == 1 else {"plants": results}


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


def _write(evaluations: Sequence[Evaluation], folder: Path) -> None:
    from finssim.experiments.envelope import error_envelope, save_envelopes

    text = json_module.dumps(_document(evaluations), indent=2, allow_nan=False) + "\n"
    (folder / EVALUATION_FILE).write_text(text, encoding="utf-8")
    envelopes = {
        e.label: error_envelope([e.trials.series(i) for i in range(len(e.trials.setpoints))])
        for e in evaluations
    }
    title = evaluations[0].result["plant"].get("title", "") if len(evaluations) == 1 else ""
    save_envelopes(envelopes, folder / FIGURE_FILE, title)
