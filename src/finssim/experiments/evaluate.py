"""`finssim evaluate`: trials of a controller, on published setpoints and trajectories or in a task's own episodes."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from finssim.control.guidance import Guide
from finssim.control.trajectories import load_trajectory
from finssim.experiments.campaign import progress_bar, write_json
from finssim.experiments.figures import (
    COLORS,
    clean,
    draw_envelopes,
    error_envelope,
    legend_below,
    new_figure,
    save_figure,
)
from finssim.experiments.metrics import (
    PAPER_T2,
    T1_SETPOINTS,
    paper_row,
    paper_t2_row,
    summarize,
    summarize_tracking,
)
from finssim.experiments.plants import Plant, load_plant
from finssim.experiments.tables import console_table, figure_text
from finssim.experiments.trials import (
    EPISODES,
    T2_TRAJECTORIES,
    run_episodes,
    run_tracking,
    run_trials,
    summarize_episodes,
)
from finssim.files import atomic_directory, plain_name
from finssim.provenance import provenance
from finssim.quiet import start_warp
from finssim.tasks import task_named
from finssim.tasks.agents import agent_for
from finssim.vehicles import Vehicle, load_vehicle

__all__ = [
    "CAPTION",
    "T1_COLUMNS",
    "Evaluation",
    "EvaluationError",
    "TrackingRun",
    "by_setpoint",
    "cells",
    "draw_tracking",
    "evaluate",
    "evaluate_controller",
    "print_comparison",
]

Array = NDArray[np.float64]

EVALUATION_FILE = "evaluation.json"
TRAJECTORIES = "trajectories"

T1_COLUMNS = {
    "success": ("success", ""),
    "e_p_m": ("e_p [m]", ".4f"),
    "e_y_m": ("e_y [m]", ".4f"),
    "e_psi_deg": ("e_psi [°]", ".2f"),
    "t_s_s": ("t_s [s]", ".1f"),
    "J_p_m": ("J_p [m]", ".3f"),
    "J_psi_deg": ("J_psi [°]", ".2f"),
}
"""Key of a result -> its heading, with the paper's names (e_y is the vertical error), and its format."""
T2_COLUMNS = {
    "horizontal_rmse_m": ("horiz. [m]", ".4f"),
    "vertical_rmse_m": ("vert. [m]", ".4f"),
    "p95_m": ("P95 [m]", ".4f"),
    "cross_track_rmse_m": ("across [m]", ".4f"),
    "completion": ("way", ".0%"),
    "max_tilt_deg": ("tilt [°]", ".1f"),
}
CAPTION = (
    "errors: 40-60 s. success: 0.10 m on each axis and 10° for 10 s; t_s: when the first such 10 s begin."
)
T2_CAPTION = (
    "horiz., vert.: RMSE against the reference at the same time. P95: its distance is less for 95 % of the time. "
    "across: RMS distance to the way."
)
EPISODES_CAPTION = "means over episodes; in brackets 95 % of a bootstrap over them."


def cells(row: Mapping[str, Any], columns: Mapping[str, tuple[str, str]] = T1_COLUMNS) -> list[str]:
    """A row's figures as text, in the order of the columns; – where there is none."""
    return [
        f"{row['success']}/{row['trials']}"
        if key == "success"
        else "–"
        if row.get(key) is None
        else format(row[key], form)
        for key, (_, form) in columns.items()
    ]


def by_trajectory(trials: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """A row for each trajectory, in the order in which they were followed first."""
    names = dict.fromkeys(str(trial["trajectory"]) for trial in trials)
    return {name: summarize_tracking([x for x in trials if x["trajectory"] == name]) for name in names}


def by_setpoint(trials: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """A row for each setpoint."""
    names = sorted({trial["setpoint"] for trial in trials})
    return {name: summarize([trial for trial in trials if trial["setpoint"] == name]) for name in names}


def paper_name(result: Mapping[str, Any]) -> str:
    """The row of the paper's table that is nearest to what was evaluated."""
    controller = result["controller"]
    if controller["kind"] == "pid":
        return "PID"
    if result["plant"]["name"] == "noise" and controller["hydrodynamics"] == "calibrated":
        return "calibrated, localisation noise"
    return f"{controller['hydrodynamics']}{' + DR' if controller.get('randomization') else ''}"


def paper_kind(result: Mapping[str, Any]) -> str:
    """The rows of the paper's table of tracking that are nearest to what was evaluated."""
    controller = result["controller"]
    if controller["kind"] == "pid":
        return "PID"
    return "calibrated + DR" if controller.get("randomization") else "calibrated"


def _headline(results: Sequence[Mapping[str, Any]]) -> str:
    """Who was evaluated, and of one plant where."""
    first = results[0]
    who = f"{first['task']} · {first['controller']['name']} · {first['vehicle']['name']}"
    plant = first["plant"]
    where = f", {first['hydrodynamics']} · plant {plant['name']}: {plant.get('title', '')}"
    return who + where if len(results) == 1 else who


def _print(
    console: Console, name: str, columns: Mapping[str, tuple[str, str]], rows: Sequence[Any], note: str
) -> None:
    heads = [heading.replace(" [", "\n[") for heading, _ in columns.values()]  # 80 columns are enough then
    console.print(console_table([name, *heads], rows))
    console.print(note, highlight=False)


def print_results(results: Sequence[Mapping[str, Any]], console: Console) -> None:
    """Print the table of one evaluation of T1, a row for each setpoint, or of several plants, a row for each."""
    console.print(_headline(results), highlight=False)
    if len(results) > 1:
        print_comparison(results, console, by="plant")
        return
    result, paper = results[0], paper_name(results[0])
    rows = [[name, *cells(row)] for name, row in by_setpoint(result["per_trial"]).items()]
    rows = [*rows, None, ["all", *cells(result)], None, ["paper", *cells(paper_row(paper))]]
    note = f"{CAPTION} paper: its vehicle in its pool, {paper}, for orientation."
    _print(console, "setpoint", T1_COLUMNS, rows, note)


def print_comparison(results: Sequence[Mapping[str, Any]], console: Console, by: str = "controller") -> None:
    """Print a row for each evaluation, named by its controller or plant, and the paper's rows that answer to them."""
    papers = dict.fromkeys(paper_name(result) for result in results)
    rows = [[result[by]["name"], *cells(result)] for result in results]
    rows = [*rows, None, *([f"paper, {name}", *cells(paper_row(name))] for name in papers)]
    _print(console, by, T1_COLUMNS, rows, f"{CAPTION} paper: its real vehicle in its pool.")


def print_tracking(results: Sequence[Mapping[str, Any]], console: Console) -> None:
    """Print the table of one evaluation of T2, a row for each trajectory, or of several plants, for each in each."""
    console.print(_headline(results), highlight=False)
    parts = [by_trajectory(result["per_trial"]) for result in results]
    if len(results) > 1:
        plants = [result["plant"]["name"] for result in results]
        rows: list[Any] = []
        for plant, part in zip(plants, parts, strict=True):
            rows += [[f"{plant}, {name}", *cells(row, T2_COLUMNS)] for name, row in part.items()] + [None]
        _print(console, "plant, trajectory", T2_COLUMNS, rows, T2_CAPTION)
        return
    result, kind = results[0], paper_kind(results[0])
    rows = [[name, *cells(row, T2_COLUMNS)] for name, row in parts[0].items()]
    rows += [None, ["all", *cells(result, T2_COLUMNS)], None]
    rows += [[f"paper, {name}", *cells(paper_t2_row(kind, name), T2_COLUMNS)] for name in PAPER_T2[kind]]
    note = f"{T2_CAPTION} paper: its vehicle in its pool, {kind}, for orientation."
    _print(console, "trajectory", T2_COLUMNS, rows, note)


def print_episodes(results: Sequence[Mapping[str, Any]], console: Console) -> None:
    """Print a row for each measure of an episode, and a column for each plant."""
    first = results[0]
    whole = f" · {first['valid']} of {first['trials']} episodes" if len(results) == 1 else ""
    console.print(_headline(results) + whole, highlight=False)
    rows = [
        [name, *(figure_text(result["metrics"][name], ".4g") for result in results)]
        for name in first["metrics"]
    ]
    heads = ["measure", *(result["plant"]["name"] for result in results)]
    console.print(console_table(heads, rows, caption=EPISODES_CAPTION, caption_justify="left"))
    for trial in (trial for result in results for trial in result["per_trial"] if trial.get("fault")):
        console.print(f"{trial['record']}: {trial['fault']}", highlight=False, markup=False)


def draw_episodes(evaluations: Sequence[Any], folder: Path, title: str) -> None:
    """`episodes.png`: for each measure, every episode as a point, a column for each plant, the mean as a bar."""
    names = list(evaluations[0].result["metrics"])
    columns = min(len(names), 4)
    rows = -(-len(names) // columns)
    figure = new_figure(2.6 * columns, 2.4 * rows, title)
    rng = np.random.default_rng(0)
    for k, name in enumerate(names):
        axes = figure.add_subplot(rows, columns, k + 1)
        for i, evaluation in enumerate(evaluations):
            values = [trial[name] for trial in evaluation.result["per_trial"] if trial[name] is not None]
            color = COLORS[i % len(COLORS)]
            spread = i + rng.uniform(-0.3, 0.3, len(values))
            axes.plot(spread, values, ".", color=color, alpha=0.5, markersize=4)
            if values:
                axes.hlines(np.mean(values), i - 0.4, i + 0.4, color=color, linewidth=2)
        clean(axes)
        axes.set_title(name, fontsize=9)
        axes.set_xticks(range(len(evaluations)), [e.label for e in evaluations], fontsize=7, rotation=20)
        axes.set_xlim(-0.6, len(evaluations) - 0.4)
    save_figure(figure, folder / "episodes.png")


TrackingRun = tuple[Guide, Array, Array]
"""What was followed; times since the start [s], (T,); positions, world frame [m], (T, 3)."""


def draw_tracking(runs: Mapping[str, Sequence[TrackingRun]], title: str = "") -> Any:
    """The figure: a row for each trajectory, its way from above on the left, distances to the reference on the right.

    Args:
        runs: Legend label -> runs; each controller's runs of one trajectory are drawn in one colour.
        title: Written above, or left out when empty.
    """
    guides = {guide.name: guide for each in runs.values() for guide, _, _ in each}
    figure = new_figure(9.0, 2.4 * len(guides) + 0.8, title)
    rows = figure.subplots(len(guides), 2, squeeze=False, width_ratios=(1.0, 1.2))
    for (above, beside), guide in zip(rows, guides.values(), strict=True):
        way = guide.at(np.linspace(0.0, guide.duration, 1001)).position
        above.plot(way[:, 0], way[:, 1], color="0.2", linewidth=1.0, linestyle="--", label="reference")
        for i, (label, each) in enumerate(runs.items()):
            _draw(above, beside, [run for run in each if run[0].name == guide.name], label, COLORS[i % 6])
        above.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
        above.set_title(guide.name, fontsize=10, loc="left")
        beside.set(xlabel="time [s]", ylabel="distance [mm]", xlim=(0.0, guide.duration))
        beside.set_ylim(bottom=0.0)
        clean(above, beside)
    legend_below(figure, rows[0][0], 4)
    return figure


def _draw(above: Any, beside: Any, runs: Sequence[TrackingRun], label: str, color: str) -> None:
    """All runs of one controller on one trajectory; only the first has the label."""
    for k, (guide, t, position) in enumerate(runs):
        during = (t >= 0.0) & (t <= guide.duration + 1e-6)
        t, position = t[during], position[during]
        error = np.linalg.norm(position - guide.at(t).position, axis=-1)
        style = {"color": color, "linewidth": 1.2, "alpha": 0.9 if len(runs) == 1 else 0.5}
        above.plot(position[:, 0], position[:, 1], label=label if k == 0 else None, **style)
        beside.plot(t, 1e3 * error, **style)


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
    controller: Sequence[str | Path] | str | Path,
    *,
    task: str = "t1",
    vehicle: str | Vehicle = "finsrov",
    hydrodynamics: str = "calibrated",
    plant: Sequence[str | Path] | str | Path = ("nominal",),
    observe: str | None = None,
    trajectories: Annotated[Sequence[str | Path], "--trajectory"] = (),
    trials: Annotated[int | None, (1, 100_000)] = None,
    truth: Path | None = None,
    seed: int = 42,
    out: Path | None = None,
    as_json: bool = False,
    console: Console | None = None,
) -> list[Evaluation]:
    """Try a controller: success, errors [m, deg], time to settle [s]; or errors along trajectories [m].

    Example: finssim evaluate runs/hold --plant current --trials 64 --out runs/hold-current

    Example: finssim evaluate runs/hold --observe sensors

    Example: finssim evaluate runs/track --task t2 --trajectory ellipse --trajectory my-way.csv

    Example: finssim evaluate run.mcap --task t1 --truth mocap.csv

    Args:
        controller (DIR|pid|pid-paper|RECORD): A policy's directory, or pid, or pid-paper; or records of one controller
            on a robot (.mcap).
        task (TASK): Task to be tried on; finssim tasks lists them. One's own: FILE.py:CLASS. Of records a task of one
            vehicle.
        vehicle (NAME|FILE): Vehicle of the catalogue, or the path of a vehicle file.
        hydrodynamics (MODEL): Hydrodynamic model: calibrated, simplified or mesh.
        plant (FILE|NAME): What differs from the vehicle file: nominal (nothing), current, lag, mesh, noise, randomised,
            sensors, simplified, waves, or a file. May be given several times.
        observe (FILE|NAME): What is seen in every plant: truth, estimator, sensors or a file of fixes; what the plant
            says if not given.
        trajectories (FILE|NAME): What t2 follows: straight, broken, ellipse, lemniscate (all four if not given),
            circle, figure_eight, helix, or a YAML or CSV file. May be given several times.
        trials: Trials in each plant; if not given, t1's eight setpoints for 60 s, or each trajectory, once.
        truth (TABLE): By which records are measured, in place of the robot's own estimate: a table (.csv, .parquet) of
            motion capture, t [s], x, y, z [m] and qx, qy, qz, qw or yaw [rad], or the truth file of finssim pool.
        seed: Seed of every random number; equal seeds give equal results.
        out: Directory for evaluation.json, the figure and trajectories.
        json: Print one JSON object instead of tables.
        console: Where the table goes; standard output if None.

    Returns:
        One evaluation for each plant, in their order.

    Raises:
        EvaluationError, PolicyError, ControlError, PlantError, VehicleError, OutputError: As they say.
    """
    form, names = _form(task), [controller] if isinstance(controller, str | Path) else controller
    records = [Path(name) for name in names if str(name).endswith(".mcap")]
    if len(names) > 1 and len(records) < len(names):
        raise EvaluationError(
            "one controller at a time, or records of one: give a single name, or .mcap files"
        )
    simulated = {"--observe": observe, "--trials": trials}
    unheeded = [name for name, value in simulated.items() if value is not None]
    unheeded += ["--plant"] if tuple(plant) != ("nominal",) and plant != "nominal" else []
    if records and unheeded:
        raise EvaluationError(f"a record was made once and for all: leave {', '.join(unheeded)} out")
    if truth is not None and not records:
        raise EvaluationError("--truth tells of records: a simulation knows its own")
    plants = [] if records else _plants([plant] if isinstance(plant, str | Path) else plant)
    plants = plants if observe is None else [one.seen(observe) for one in plants]
    with atomic_directory(out, replaces=EVALUATION_FILE) if out is not None else nullcontext() as folder:
        evaluations = [_recorded(records, task, vehicle, trajectories, truth)] if records else []
        for one in plants:
            place = folder and folder / TRAJECTORIES / (one.name if plants[1:] else "")
            evaluations.append(
                evaluate_controller(
                    names[0],
                    one,
                    task=task,
                    vehicle=vehicle,
                    trajectories=trajectories,
                    record=place,
                    hydrodynamics=hydrodynamics,
                    trials=trials,
                    seed=seed,
                )
            )
        results = [evaluation.result for evaluation in evaluations]
        document = results[0] if len(results) == 1 else {"plants": results}
        if folder is not None:
            write_json(folder / EVALUATION_FILE, document)
            form.draw(evaluations, folder, results[0]["plant"].get("title", "") if len(results) == 1 else "")
    if as_json:
        print(json.dumps(document, allow_nan=False))
        return evaluations
    console = console or Console()
    form.show(results, console)
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


def evaluate_controller(
    controller: str | Path,
    plant: Plant,
    *,
    task: str = "t1",
    vehicle: str | Vehicle = "finsrov",
    hydrodynamics: str = "calibrated",
    trajectories: Sequence[str | Path] = (),
    trials: int | None = None,
    seed: int = 42,
    record: Path | None = None,
) -> Evaluation:
    """Run the trials in one plant and measure them; arguments as `evaluate`.

    Args:
        hydrodynamics: Model, unless the plant names one.
        trials: How many; the eight setpoints, or the four trajectories, once if None.
        seed: Of what the plant draws.
        record: New folder for every state, command and thrust; none if None.
    """
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
    agent = agent_for(controller, body, the_task)
    with progress_bar(f"{trials} trials") as show:
        done = form.run(
            agent,
            the_task,
            body,
            plant,
            trials=trials,
            hydrodynamics=hydrodynamics,
            seed=seed,
            record=record,
            show=show,
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


def _draw_envelopes(evaluations: Sequence[Evaluation], folder: Path, title: str) -> None:
    envelopes = {e.label: error_envelope(e.trials.all_series()) for e in evaluations}
    save_figure(draw_envelopes(envelopes, title), folder / "error_envelope.png")


def _draw_paths(evaluations: Sequence[Evaluation], folder: Path, title: str) -> None:
    runs = {
        e.label: [(guide, e.trials.t, e.trials.position[:, i]) for i, guide in enumerate(e.trials.guides)]
        for e in evaluations
    }
    save_figure(draw_tracking(runs, title), folder / "trajectories.png")


class Form(NamedTuple):
    """How the trials of one task are run, summed up and shown."""

    count: int
    """Trials, unless told otherwise."""
    run: Callable[..., Any]
    summarize: Callable[[Sequence[dict[str, Any]]], dict[str, Any]]
    show: Callable[[Any, Console], None]
    draw: Callable[[Sequence[Evaluation], Path, str], None]


FORMS = {
    "t1": Form(len(T1_SETPOINTS), run_trials, summarize, print_results, _draw_envelopes),
    "t2": Form(
        len(T2_TRAJECTORIES),
        run_tracking,
        lambda trials: {**summarize_tracking(trials), "per_trial": list(trials)},
        print_tracking,
        _draw_paths,
    ),
}
"""Tasks that are measured as in the paper."""


EPISODIC = Form(EPISODES, run_episodes, summarize_episodes, print_episodes, draw_episodes)
"""Of every other task: episodes as in training, measured by the task."""


def _form(task: str) -> Form:
    task_named(task)  # which refuses one that there is not
    return FORMS.get(task, EPISODIC)
