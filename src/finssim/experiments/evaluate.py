"""`finssim evaluate`: trials of a controller, on published setpoints and trajectories or in a task's own episodes."""

from __future__ import annotations

import json as json_module
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console
from rich.progress import Progress

from finssim.control.trajectories import load_trajectory
from finssim.control.trim import Trim
from finssim.experiments.episodes import EPISODES, run_episodes, summarize_episodes
from finssim.experiments.episodes_table import draw_episodes, print_episodes, print_episodes_by_plant
from finssim.experiments.metrics import summarize
from finssim.experiments.plants import Plant, load_plant
from finssim.experiments.results_table import print_plants, print_results
from finssim.experiments.setpoints import T1_SETPOINTS
from finssim.experiments.t2_metrics import summarize_tracking
from finssim.experiments.t2_table import print_tracking, print_tracking_plants
from finssim.experiments.t2_trials import T2_TRAJECTORIES, run_tracking
from finssim.experiments.trials import run_trials
from finssim.files import atomic_directory, plain_name
from finssim.provenance import provenance
from finssim.quiet import start_warp
from finssim.tasks import task_named
from finssim.tasks.agents import PolicyAgent, agent_for
from finssim.vehicles import Vehicle, load_vehicle

__all__ = ["EVALUATION_FILE", "Evaluation", "EvaluationError", "evaluate", "evaluate_controller"]

EVALUATION_FILE = "evaluation.json"
TRAJECTORIES = "trajectories"


class EvaluationError(ValueError):
    """An evaluation that cannot be run."""


@dataclass(frozen=True)
class Evaluation:
    """One controller in one plant."""

    result: dict[str, Any]
    """What `--json` prints: who, where, the measures over all trials, `per_trial`, provenance."""
    trials: Any
    """`Trials` of T1, `TrackingTrials` of T2."""

    @property
    def label(self) -> str:
        """Name of the controller and, if not nominal, of the plant."""
        plant = self.result["plant"]["name"]
        name: str = self.result["controller"]["name"]
        return name if plant == "nominal" else f"{name}, {plant}"


def evaluate(
    controller: str | Path | Sequence[Path],
    *,
    task: str = "t1",
    vehicle: str | Vehicle = "finsrov",
    hydrodynamics: str = "calibrated",
    plant: str | Path | Sequence[str | Path] = "nominal",
    observe: str | None = None,
    trajectories: Sequence[str | Path] = (),
    trials: int | None = None,
    trim: bool = False,
    truth: Path | None = None,
    seed: int = 42,
    out: Path | None = None,
    json: bool = False,
    console: Console | None = None,
) -> list[Evaluation]:
    """Run the trials in every plant, print the table (or one JSON object) and write the directory.

    Args:
        controller: A policy directory, pid or pid-paper; or records of one, which are measured as they are.
        task: Key of `TASKS`, or FILE.py:CLASS of one's own; of records a task of one vehicle.
        vehicle: A vehicle, a catalogue name or a file.
        hydrodynamics: Model, unless the plant names one.
        plant: Name or file, or several.
        observe: What is seen in every plant: truth, estimator or sensors; what the plant says if None.
        trajectories: Names or files of what is followed in T2, in turn; the published four if none.
        trials: How many in each plant; the eight setpoints, or the four trajectories, once if None.
        trim: Put the integral of the position error (`control.trim`) in front of a policy.
        truth: Truth file or table of motion capture by which records are measured; their own estimate if None.
        seed: Of what the plant draws.
        out: Directory for `evaluation.json`, the figure and the trajectories; an earlier evaluation is replaced.
        json: Print the result in place of the table.
        console: Where the table goes; standard output if None.

    Returns:
        One evaluation for each plant, in their order.

    Raises:
        EvaluationError, PolicyError, ControlError, PlantError, VehicleError, OutputError: As they say.
    """
    form = _form(task)
    if not isinstance(controller, str | Path):
        evaluations = [_recorded(controller, task, vehicle, trajectories, truth)]
        if out is not None:
            with atomic_directory(out, replaces=EVALUATION_FILE) as folder:
                _write(evaluations, folder, form)
        return _tell(evaluations, form, out, json, console)
    plants = _plants([plant] if isinstance(plant, str | Path) else plant)
    plants = plants if observe is None else [one.seen(observe) for one in plants]
    options: dict[str, Any] = {
        "task": task,
        "vehicle": vehicle,
        "hydrodynamics": hydrodynamics,
        "trajectories": trajectories,
        "trials": trials,
        "trim": trim,
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
            _write(evaluations, folder, form)
    return _tell(evaluations, form, out, json, console)


def _tell(
    evaluations: list[Evaluation], form: Form, out: Path | None, json: bool, console: Console | None
) -> list[Evaluation]:
    """Print the table, or one JSON object."""
    if json:
        print(json_module.dumps(_document(evaluations), allow_nan=False))
        return evaluations
    console = console or Console()
    if len(evaluations) == 1:
        form.show(evaluations[0].result, console)
    else:
        form.show_plants([evaluation.result for evaluation in evaluations], console)
    if out is not None:
        console.print(f"written: {out}", highlight=False, soft_wrap=True)
    return evaluations


def _recorded(
    records: Sequence[Path],
    task: str,
    vehicle: str | Vehicle,
    trajectories: Sequence[str | Path],
    truth: Path | None,
) -> Evaluation:
    """The evaluation of records of one controller."""
    from finssim.experiments.recorded import measured_records

    if len(trajectories) > 1:
        raise EvaluationError("records follow one trajectory each: give at most one --trajectory")
    body = vehicle if isinstance(vehicle, Vehicle) else load_vehicle(vehicle)
    way = trajectories[0] if trajectories else None
    described, measures, trials = measured_records(records, task, body, trajectory=way, truth=truth)
    return Evaluation({**described, **_form(task).summarize(measures), "provenance": provenance()}, trials)


def _plants(names: Sequence[str | Path]) -> list[Plant]:
    """The plants; each must have a name of its own, under which its results are told apart."""
    if not names:
        raise EvaluationError("no plant is given: name at least one, such as 'nominal'")
    plants = [load_plant(name) for name in names]
    for i, plant in enumerate(plants):
        if plant.name in (earlier.name for earlier in plants[:i]):
            raise EvaluationError(f"two plants are named '{plant.name}': give each once, or rename one file")
        if len(plants) > 1:
            plain_name(plant.name, "plant", EvaluationError)
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
    trajectories: Sequence[str | Path] = (),
    trials: int | None = None,
    trim: bool = False,
    seed: int = 42,
    record: Path | None = None,
) -> Evaluation:
    """Run the trials and measure them; arguments as `evaluate`."""
    form = _form(task)
    if trajectories and task != "t2":
        raise EvaluationError(f"task '{task}' follows no trajectory: leave it out, or evaluate t2")
    trials = (len(trajectories) or form.count) if trials is None else trials
    if trials < 1:
        raise EvaluationError(f"trials is {trials}, expected 1 or more")
    start_warp()
    body = vehicle if isinstance(vehicle, Vehicle) else load_vehicle(vehicle)
    the_task = task_named(task)
    guides = {"guides": [load_trajectory(x, vehicle=body) for x in trajectories]} if trajectories else {}
    agent = agent_for(controller, body, the_task, Trim() if trim else None)
    if trim and not isinstance(agent, PolicyAgent):
        raise EvaluationError(f"'{controller}' has an integral of its own: trim a policy, or leave it out")
    screen = Console(stderr=True)
    with Progress(console=screen, transient=True, disable=not screen.is_terminal) as progress:
        bar = progress.add_task(f"{trials} trials", total=1.0)
        done = form.run(
            agent,
            the_task,
            body,
            plant,
            trials=trials,
            hydrodynamics=hydrodynamics,
            seed=seed,
            record=record,
            show=lambda part: progress.update(bar, completed=part),
            **guides,
        )
    result = {
        "controller": agent.describe(),
        "task": task,
        "vehicle": {"name": body.name, "sha256": body.sha256},
        "hydrodynamics": plant.hydrodynamics or hydrodynamics,
        "plant": plant.model_dump(mode="json", exclude_defaults=True),
        **plant.told_of_sight(body),
        "seed": seed,
        **form.summarize(done.measures()),
        "provenance": provenance(),
    }
    return Evaluation(result, done)


def _write(evaluations: Sequence[Evaluation], folder: Path, form: Form) -> None:
    text = json_module.dumps(_document(evaluations), indent=2, allow_nan=False) + "\n"
    (folder / EVALUATION_FILE).write_text(text, encoding="utf-8")
    title = evaluations[0].result["plant"].get("title", "") if len(evaluations) == 1 else ""
    form.draw(evaluations, folder, title)


def _draw_envelopes(evaluations: Sequence[Evaluation], folder: Path, title: str) -> None:
    from finssim.experiments.envelope import error_envelope, save_envelopes

    envelopes = {
        e.label: error_envelope([e.trials.series(i) for i in range(len(e.trials.setpoints))])
        for e in evaluations
    }
    save_envelopes(envelopes, folder / "error_envelope.png", title)


def _draw_paths(evaluations: Sequence[Evaluation], folder: Path, title: str) -> None:
    from finssim.experiments.t2_figure import save_tracking

    runs = {
        e.label: [(guide, e.trials.t, e.trials.position[:, i]) for i, guide in enumerate(e.trials.guides)]
        for e in evaluations
    }
    save_tracking(runs, folder / "trajectories.png", title)


def _summarize_tracking(trials: Sequence[dict[str, Any]]) -> dict[str, Any]:
    return {**summarize_tracking(trials), "per_trial": list(trials)}


class Form(NamedTuple):
    """How the trials of one task are run, summed up and shown."""

    count: int
    """Trials, unless told otherwise."""
    run: Callable[..., Any]
    summarize: Callable[[Sequence[dict[str, Any]]], dict[str, Any]]
    show: Callable[[Any, Console], None]
    show_plants: Callable[[Any, Console], None]
    draw: Callable[[Sequence[Evaluation], Path, str], None]


FORMS = {
    "t1": Form(len(T1_SETPOINTS), run_trials, summarize, print_results, print_plants, _draw_envelopes),
    "t2": Form(
        len(T2_TRAJECTORIES),
        run_tracking,
        _summarize_tracking,
        print_tracking,
        print_tracking_plants,
        _draw_paths,
    ),
}
"""Tasks that are measured as in the paper."""


EPISODIC = Form(
    EPISODES, run_episodes, summarize_episodes, print_episodes, print_episodes_by_plant, draw_episodes
)
"""Of every other task: episodes as in training, measured by the task."""


def _form(task: str) -> Form:
    task_named(task)  # which refuses one that there is not
    return FORMS.get(task, EPISODIC)
