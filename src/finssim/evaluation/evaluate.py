"""Implementation of `finssim evaluate`: trials of a controller, on published setpoints and trajectories or in
a task's episodes."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from finssim.agents.agent import agent_for
from finssim.control.policy import read_description
from finssim.core.files import atomic_directory, plain_name
from finssim.core.progress import progress_bar
from finssim.core.provenance import provenance
from finssim.core.quiet import start_warp
from finssim.core.registry import TASKS
from finssim.evaluation import campaign
from finssim.evaluation.campaign import write_json
from finssim.evaluation.figures import ENVELOPE, TRACKS, draw_envelopes, draw_tracking, save_figure
from finssim.evaluation.metrics import (
    PAPER_T2,
    T1_SETPOINTS,
    paper_row,
    paper_t2_row,
    summarize,
    summarize_tracking,
)
from finssim.evaluation.plants import PlantChanges, load_plant
from finssim.evaluation.tables import Columns, Table, cells, figure_text, html_of
from finssim.evaluation.trials import (
    EPISODES,
    ONCE,
    T2_TRAJECTORIES,
    GoalTrial,
    TrialSettings,
    guide_of,
    run_episodes,
    run_trials,
    summarize_episodes,
)
from finssim.robot.record_files import vehicle_of
from finssim.robot.record_reader import open_record
from finssim.tasks import task_named
from finssim.vehicles import Vehicle, catalogue, catalogue_vehicle, load_vehicle

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
    "completion": ("path", ".0%"),
    "max_tilt_deg": ("tilt [°]", ".1f"),
}
CAPTION = "errors: 40-60 s. success: 0.10 m on each axis and 10° for 10 s; t_s: start of the first such 10 s."
T2_CAPTION = (
    "horiz., vert.: RMSE against the reference at the same time. P95: its distance is less for 95 % of the time. "
    "across: RMS distance to the path."
)
EPISODES_CAPTION = "means over episodes; in brackets the 95 % bootstrap interval."


def paper_name(result: Mapping[str, Any]) -> str:
    """Return the row of the paper's table that is closest to the evaluated controller."""
    controller = result["controller"]
    if controller["kind"] != "policy":
        return "PID"
    randomized = " + DR" if controller.get("randomization") else ""
    if result["task"] == "t2":
        return f"calibrated{randomized}"
    if result["plant"]["name"] == "noise" and controller["hydrodynamics"] == "calibrated":
        return "calibrated, localisation noise"
    return f"{controller['hydrodynamics']}{randomized}"


class SummaryForm(NamedTuple):
    """Summary and display of a task that is evaluated as in the paper."""

    kind: str
    """Kind of goal, which is the key of its name in a row."""
    targets: Sequence[str]
    columns: Columns
    """Columns of the table: key -> heading with its unit, format, and a factor."""
    caption: str
    summarize: Callable[[Sequence[Mapping[str, Any]]], dict[str, Any]]
    paper: Callable[[str], dict[str, dict[str, Any]]]
    """Function from the name of the paper's row to its rows, by their names in our table."""
    figure: str
    """File name of the figure."""
    shows: str
    """Caption of the figure."""
    draw: Callable[[Mapping[str, Sequence[GoalTrial]], str], Any]


FORMS: Mapping[str, SummaryForm] = {
    "t1": SummaryForm(
        "setpoint", tuple(T1_SETPOINTS), T1_COLUMNS, CAPTION, summarize, lambda name: {"": paper_row(name)},
        "error_envelope.png", ENVELOPE, draw_envelopes,
    ),
    "t2": SummaryForm(
        "trajectory", T2_TRAJECTORIES, T2_COLUMNS, T2_CAPTION, summarize_tracking,
        lambda name: {target: paper_t2_row(name, target) or {} for target in PAPER_T2[name]},
        "trajectories.png", TRACKS, draw_tracking,
    ),
}  # fmt: skip
"""Forms of the paper's tasks; every other task is evaluated in episodes as in training."""


def tables_of(result: Mapping[str, Any]) -> list[Table]:
    """Return tables with a row for each target and plant (for several plants in T1, for each plant), and the
    paper's rows."""
    results: Sequence[Mapping[str, Any]] = result.get("plants", [result])
    first, several = results[0], len(results) > 1
    title = f"{first['task']} · {first['controller']['name']} · {first['vehicle']['name']}"
    if not several:
        plant = first["plant"]
        title += f", {first['hydrodynamics']} · plant {plant['name']}: {plant.get('title', '')}"
    if first["task"] not in FORMS:
        return [_episodes_table(results, title)]
    form = FORMS[first["task"]]
    rows: list[list[str] | None] = []
    for result in results:
        prefix, trials = f"{result['plant']['name']}, " if several else "", result["per_trial"]
        names = () if several and form.kind == "setpoint" else dict.fromkeys(t[form.kind] for t in trials)
        for name in names:
            of_target = form.summarize([trial for trial in trials if trial[form.kind] == name])
            rows.append([f"{prefix}{name}", *cells(of_target, form.columns)])
        label = f"{prefix}all" if names else result["plant"]["name"]
        rows += [[label, *cells(result, form.columns)], *([None] if names else [])]
    papers = dict.fromkeys(paper_name(result) for result in results)
    for paper in papers:
        for name, row in form.paper(paper).items():
            rows.append([f"paper, {name or paper}", *cells(row, form.columns)])
    heads = [heading.replace(" [", "\n[") for heading, *_ in form.columns.values()]  # for 80 columns
    note = f"{form.caption} paper: its vehicle in its pool, {', '.join(papers)}, for orientation."
    sentences = [] if several else _remarks(first["per_trial"])
    shown = {form.figure: form.shows}
    heads = [form.kind, *heads]
    return [Table(title=title, heads=heads, rows=rows, note=note, sentences=sentences, pictures=shown)]


def _remarks(trials: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return remarks on records: why one is incomplete, and the error of its estimate."""

    def name(trial: Mapping[str, Any]) -> str:
        return str(next(trial[key] for key in ("record", "setpoint", "trajectory", "trial") if key in trial))

    faults = [f"{name(trial)}: {trial['fault']}" for trial in trials if trial.get("fault")]
    located = [(name(trial), trial["localization"]) for trial in trials if trial.get("localization")]
    return faults + [
        f"{label}: the robot's estimate was {off['position_m']:.3g} m, {off['heading_deg']:.2g}° off the truth (rms)"
        for label, off in located
    ]


def _episodes_table(results: Sequence[Mapping[str, Any]], title: str) -> Table:
    """Return a table with a row for each measure of an episode, and a column for each plant."""
    first = results[0]
    complete = "" if results[1:] else f" · {first['valid']} of {first['trials']} episodes"
    return Table(
        title=title + complete,
        heads=["measure", *(result["plant"]["name"] for result in results)],
        rows=[
            [name, *(figure_text(result["metrics"][name], ".4g") for result in results)]
            for name in first["metrics"]
        ],
        note=EPISODES_CAPTION,
        sentences=_remarks([trial for result in results for trial in result["per_trial"]]),
        intervals=True,
    )


class EvaluationError(ValueError):
    """Evaluation that cannot be run."""


@dataclass(frozen=True)
class Evaluation:
    """Evaluation of one controller in one plant."""

    result: dict[str, Any]
    """Result that `--json` prints: controller, plant, measures over all trials, `per_trial`, provenance."""
    trials: Sequence[GoalTrial] = ()
    """Trials of T1 and T2, for figures."""

    def __repr__(self) -> str:
        count = len(self.result.get("per_trial", ()))
        return f"<Evaluation of {self.label} in {self.result['task']}: {count} trials>"

    def _repr_html_(self) -> str:
        return "".join(html_of(tables_of(self.result), Path()))

    @property
    def label(self) -> str:
        """Name of the controller and, if not nominal, of the plant."""
        plant = self.result["plant"]["name"]
        name: str = self.result["controller"]["name"]
        return name if plant == "nominal" else f"{name}, {plant}"


@dataclass(frozen=True)
class Evaluations:
    """Evaluation of one controller in one or several plants."""

    each: tuple[Evaluation, ...]

    def as_json(self) -> dict[str, Any]:
        """Return the result as plain data; for several plants as `plants`, in their order."""
        results = [evaluation.result for evaluation in self.each]
        return results[0] if len(results) == 1 else {"plants": results}

    @property
    def table(self) -> Table:
        """Measures by target and plant, with the paper's rows if the task is from the paper."""
        return tables_of(self.as_json())[0]

    @property
    def metrics(self) -> dict[str, Any]:
        """Measures over all trials of the first plant: keys as in `evaluation.json`, errors in m, rad or as named."""
        result = self.each[0].result
        skipped = ("controller", "task", "vehicle", "hydrodynamics", "plant", "provenance", "per_trial")
        return {key: value for key, value in result.items() if key not in skipped}

    def plot(self) -> Any:
        """Return a Matplotlib figure: errors against time (t1), or trajectories from above (t2).

        Raises:
            EvaluationError: The task is evaluated in episodes, whose motion is not stored.
        """
        first = self.each[0].result
        if first["task"] not in FORMS:
            names = ", ".join(FORMS)
            raise EvaluationError(f"task '{first['task']}' has no figure; tasks with one: {names}")
        title = "" if self.each[1:] else first["plant"].get("title", "")
        return FORMS[first["task"]].draw({e.label: e.trials for e in self.each}, title)

    def __repr__(self) -> str:
        return f"<Evaluations: {', '.join(map(repr, self.each))}>"

    def _repr_html_(self) -> str:
        return "".join(html_of(tables_of(self.as_json()), Path()))


def evaluation(
    controller: Mapping[str, Any],
    task: str,
    vehicle: Vehicle,
    plant: Mapping[str, Any],
    measures: Sequence[dict[str, Any]],
    trials: Sequence[GoalTrial] = (),
    **about: Any,
) -> Evaluation:
    """Return the evaluation of trials with their measures.

    Args:
        controller: Description of the controller, as plain data.
        task: Name of the task; in T1 and T2 each trial is named after its goal.
        vehicle: Vehicle in the controller's model.
        plant: Description of the plant, as plain data.
        measures: Measures of each trial.
        trials: Trials of T1 and T2.
        about: Further entries of the result.
    """
    form = FORMS.get(task)
    if form is None:
        summary = summarize_episodes(measures)
    else:
        pairs = enumerate(zip(trials, measures, strict=True))
        rows = [{"trial": i, form.kind: trial.name, **row} for i, (trial, row) in pairs]
        summary = {**form.summarize(rows), "per_trial": rows}
    result = {
        "controller": dict(controller),
        "task": task,
        "vehicle": {"name": vehicle.name, "sha256": vehicle.sha256},
        "hydrodynamics": "calibrated",
        "plant": dict(plant),
        "provenance": provenance(),
        **about,
        **summary,
    }
    return Evaluation(result, trials)


def evaluate(controller: Sequence[str | Path] | str | Path, **arguments: Any) -> dict[str, Any]:
    """Evaluate a controller: success, errors [m, deg], settling time [s]; or errors along trajectories [m].

    Example: finssim evaluate runs/hold --plant current --trials 64 --out runs/hold-current

    Example: finssim evaluate runs/hold --observe sensors

    Example: finssim evaluate runs/track --task t2 --trajectory ellipse --trajectory my-way.csv

    Example: finssim evaluate run.mcap --task t1 --truth mocap.csv

    Args:
        controller (DIR|pid|pid-paper|RECORD): A policy's directory, or pid, or pid-paper, or a class of your
            own, FILE.py:CLASS; or records of one controller on a robot (.mcap).
        arguments: As of `evaluation.evaluate.evaluate_in_plants`.

    Returns:
        The result of the evaluation; for several plants as `plants`, in their order.

    Raises:
        EvaluationError, PolicyError, ControlError, PlantError, VehicleError, OutputError: See these classes.
    """
    return evaluate_in_plants(controller, **arguments).as_json()


def evaluate_in_plants(
    controller: Sequence[str | Path] | str | Path,
    *,
    task: str | None = None,
    vehicle: str | Vehicle | None = None,
    hydrodynamics: str = "calibrated",
    plant: Sequence[str | Path] | str | Path = ("nominal",),
    observe: str | None = None,
    trajectories: Annotated[Sequence[str | Path], "--trajectory"] = (),
    trials: Annotated[int | None, (1, 100_000)] = None,
    truth: Path | None = None,
    seed: int = 1,
    out: Path | None = None,
) -> Evaluations:
    """Evaluate a controller in every plant; errors as for `evaluate`.

    Args:
        controller: A policy's directory or the name of a controller, or records of one on a robot.
        task (TASK): Task; finssim tasks lists them. Your own: FILE.py:CLASS. For records, a task of one
            vehicle. If not given, the policy's task, or t1 for a controller without one.
        vehicle (NAME|FILE): Vehicle in the catalogue, or path of a vehicle file. If not given, that of the
            policy or of the record, or finsrov.
        hydrodynamics (MODEL): Hydrodynamic model: calibrated, simplified or mesh.
        plant (FILE|NAME): Differences from the vehicle file: nominal (none), beyond_cruise, current, foreign,
            held_out, lag, mesh, noise, randomised, sensors, simplified, waves, or a file. May be repeated.
        observe (FILE|NAME): Observation in every plant: truth, estimator, sensors or a file of fixes; that of
            the plant if not given.
        trajectories (FILE|NAME): Trajectories for t2: straight, broken, ellipse, lemniscate (all four if not
            given), circle, figure_eight, helix, or a YAML or CSV file. May be repeated.
        trials: Number of trials in each plant; if not given, t1's eight setpoints for 60 s, or each trajectory, once.
        truth (TABLE): Truth for scoring records, instead of the robot's own estimate: a table (.csv, .parquet) of
            motion capture, t [s], x, y, z [m] and qx, qy, qz, qw or yaw [rad], or the truth file of finssim pool
            or of finssim ardusub-sitl (.mcap).
        seed: Seed of every random number; equal seeds give equal results.
        out: Directory for evaluation.json, trajectories and, for t1 and t2, a figure.

    Returns:
        The result, with the trials of every plant.
    """
    names = [controller] if isinstance(controller, str | Path) else controller
    records = [Path(name) for name in names if str(name).endswith(".mcap")]
    if len(names) > 1 and len(records) < len(names):
        raise EvaluationError(
            "expected one controller, or records of one: give a single name, or .mcap files"
        )
    simulated = {"--observe": observe, "--trials": trials}
    unheeded = [name for name, value in simulated.items() if value is not None]
    unheeded += ["--plant"] if tuple(plant) != ("nominal",) and plant != "nominal" else []
    unheeded += ["--hydrodynamics"] if hydrodynamics != "calibrated" else []
    if records and unheeded:
        options = "it" if len(unheeded) == 1 else "them"
        raise EvaluationError(f"{', '.join(unheeded)}: no effect on a record: omit {options}")
    if truth is not None and not records:
        raise EvaluationError("--truth is for records: a simulation has its own truth")
    task, vehicle = _subject(Path(names[0]), task, vehicle)
    task_named(task)  # refuses an unknown task
    plants = [] if records else _plants([plant] if isinstance(plant, str | Path) else plant)
    plants = plants if observe is None else [plant_file.with_observation(observe) for plant_file in plants]
    with atomic_directory(out, replaces=EVALUATION_FILE) if out is not None else nullcontext() as folder:
        evaluations = [_recorded(records, task, vehicle, trajectories, truth)] if records else []
        for plant_file in plants:
            target = folder and folder / TRAJECTORIES / (plant_file.name if plants[1:] else "")
            settings = TrialSettings(hydrodynamics=hydrodynamics, trials=trials, seed=seed, record=target)
            evaluations.append(
                evaluate_controller(
                    names[0], plant_file, settings, task=task, vehicle=vehicle, trajectories=trajectories
                )
            )
        scored = Evaluations(tuple(evaluations))
        if folder is not None:
            if task in FORMS:
                save_figure(scored.plot(), folder / FORMS[task].figure)
            write_json(folder / EVALUATION_FILE, scored.as_json(), tables_of(scored.as_json()))
    return scored


def _subject(controller: Path, task: str | None, vehicle: str | Vehicle | None) -> tuple[str, str | Vehicle]:
    """Return the task and the vehicle of an evaluation: as given, otherwise those of the policy or of the record.

    Raises:
        EvaluationError: The policy was trained for a vehicle that is not in the catalogue.
        PolicyError, RecordError, VehicleError: The policy or the record cannot be read.
    """
    if controller.suffix == ".mcap" and vehicle is None:
        with open_record(controller) as record:
            vehicle = vehicle_of(record) if "vehicle" in record.metadata else None
    if controller.is_dir() and (task is None or vehicle is None):
        trained = read_description(controller)
        if task is None and trained.task not in TASKS:
            raise EvaluationError(
                f"{controller} was trained for a task '{trained.task}' of your own: name it with --task FILE.py:CLASS"
            )
        task = task or trained.task
        if vehicle is None:
            named = trained.vehicle
            vehicle = catalogue_vehicle(named.name, str(controller)) if named.name in catalogue() else None
            if vehicle is None or vehicle.sha256 != named.sha256:
                raise EvaluationError(
                    f"{controller} was trained for a vehicle '{named.name}' not in the catalogue: give its file "
                    "with --vehicle"
                )
    return task or "t1", vehicle or "finsrov"


def _recorded(
    records: Sequence[Path],
    task: str,
    vehicle: str | Vehicle,
    trajectories: Sequence[str | Path],
    truth: Path | None,
) -> Evaluation:
    """Return the evaluation of records of one controller."""
    from finssim.evaluation.records import read_record

    if len(trajectories) > 1:
        raise EvaluationError("records follow one trajectory each: give at most one --trajectory")
    body = load_vehicle(vehicle)
    guide = guide_of(trajectories[0], body) if trajectories else None
    trials = [read_record(path, task, body, guide=guide, truth=truth) for path in records]
    pilots = [trial.pilot for trial in trials]
    if any(pilot != pilots[0] for pilot in pilots):
        names = ", ".join(dict.fromkeys(str(pilot.get("name")) for pilot in pilots))
        raise EvaluationError(
            f"the records are of several controllers ({names}): evaluate each controller separately"
        )
    measures = [
        {"trial": i, "record": trial.path.name, **trial.scores(task, body)} for i, trial in enumerate(trials)
    ]
    controller = {"kind": "pid", "action": "wrench6", "hydrodynamics": "calibrated"} | pilots[0]
    source = "its own estimate" if truth is None else truth.name
    plant = {"name": "record", "title": f"as recorded, by {source}"}
    files = [{"file": path.name, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()} for path in records]
    about = {"records": files, "truth": truth and truth.name}
    return evaluation(controller, task, body, plant, measures, trials, **about)


def _plants(names: Sequence[str | Path]) -> list[PlantChanges]:
    """Return the plants; each must have a unique name, which identifies its results."""
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
    plant: PlantChanges,
    settings: TrialSettings = ONCE,
    *,
    task: str = "t1",
    vehicle: str | Vehicle = "finsrov",
    trajectories: Sequence[str | Path] = (),
) -> Evaluation:
    """Run the trials in one plant and evaluate them; other arguments as for `evaluate`.

    Args:
        settings: Number of trials, by default each of the eight setpoints or four trajectories once; and
            their worlds.
    """
    if trajectories and task != "t2":
        raise EvaluationError(f"task '{task}' follows no trajectory: omit it, or evaluate t2")
    the_task = task_named(task)
    count = len(trajectories) or (len(FORMS[task].targets) if task in FORMS else EPISODES)
    trials = count if settings.trials is None else settings.trials
    settings = replace(settings, trials=trials)
    if trials < 1:
        raise EvaluationError(f"trials is {trials}, expected 1 or more")
    start_warp()
    body = load_vehicle(vehicle)
    agent = agent_for(controller, body, the_task)
    played: list[GoalTrial] = []
    with progress_bar(f"{trials} trials") as show:
        if task in FORMS:
            guides = [guide_of(x, body) for x in trajectories] or None
            played = run_trials(agent, the_task, body, plant, settings, guides=guides, show=show)
            limits = plant.changed(body).force_limits
            measures = [trial.measures(task, limits) for trial in played]
        else:
            measures = run_episodes(agent, the_task, body, plant, settings, show=show)
    plant_values = plant.model_dump(mode="json", exclude_defaults=True)
    about = {
        "hydrodynamics": plant.hydrodynamics or settings.hydrodynamics,
        "seed": settings.seed,
        **plant.observe_record(body),
    }
    return evaluation(agent.describe(), task, body, plant_values, measures, played, **about)


@dataclass(frozen=True, kw_only=True)
class ControllerTrials(campaign.Job):
    """Trials of one controller in one plant, as a job of a campaign."""

    controller: str
    vehicle: str
    water: PlantChanges
    trials: int | None
    noise: int
    """Seed of the trials."""
    task: str = "t1"


def play(job: ControllerTrials, _: Path) -> dict[str, Any]:
    """Run the trials of a job, and return the result of their evaluation."""
    settings = TrialSettings(trials=job.trials, seed=job.noise)
    return evaluate_controller(job.controller, job.water, settings, task=job.task, vehicle=job.vehicle).result
