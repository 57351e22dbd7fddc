"""Experiments in the virtual pool: train the policies of the rows, run every trial, and write a table."""

from __future__ import annotations

import shutil
import tempfile
from collections import Counter
from collections.abc import Callable, Generator, Hashable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import yaml
from rich.console import Console

from finssim.agents.controllers import COSTLY
from finssim.control.policy import DESCRIPTION_FILE, Policy, PolicyError
from finssim.control.trajectories import TRAJECTORIES
from finssim.core.files import atomic_directory, contents, plain_name
from finssim.core.provenance import provenance
from finssim.evaluation.campaign import Progress, Show, check_choices, spread, write_json
from finssim.evaluation.evaluate import T1_COLUMNS
from finssim.evaluation.figures import ENVELOPE, TRACKS, draw_envelopes, draw_tracking, save_figure
from finssim.evaluation.metrics import T1_SETPOINTS, paper_row, paper_t2_row
from finssim.evaluation.robot_trials import (
    FIRMWARES,
    HARDWARE,
    OnRobot,
    RobotJob,
    firmware_of,
    play_jobs,
    played_trial,
)
from finssim.evaluation.statistics import Statistic, paired_difference, with_interval
from finssim.evaluation.tables import Columns, Table, cells
from finssim.evaluation.trials import T2_TRAJECTORIES
from finssim.learning.resume import ResumeError
from finssim.learning.train import TrainingSettings, train, training_folder
from finssim.localization.fusion.estimator import MODELS
from finssim.vehicles import Vehicle, load_vehicle

Results = Mapping[str, Sequence[Mapping[str, Any]]]
"""Row -> results of its trials."""

TRAINING_SHARE = 0.4
"""Fraction of the progress bar for trainings [-]."""
DIFFERENCES_NOTE = (
    "Each figure is the mean of row minus reference, over pairs of trials with the same pool, seed and target; in "
    "brackets 95 % from a bootstrap of plants and seeds. paper: the difference of its rows, on hardware, single runs."
)
FORGETFUL = {"integral": False, "history": 0, "last_action": False}
"""Settings of the learner for policies without memory, as in the paper."""

MEASURES: Columns = {
    "success_rate": ("held [points]", "+.0f", 100.0),
    "e_p_m": ("e_p [cm]", "+.1f", 100.0),
    "e_psi_deg": ("e_psi [°]", "+.1f"),
    "t_s_s": ("t_s [s]", "+.1f"),
    "horizontal_rmse_m": ("horizontal [cm]", "+.1f", 100.0),
    "vertical_rmse_m": ("vertical [cm]", "+.1f", 100.0),
    "p95_m": ("P95 [cm]", "+.1f", 100.0),
    "energy": ("energy [N^1.5 s]", "+.0f"),
}
"""Key for comparing rows -> heading, format and factor, for the table of differences."""


@dataclass(frozen=True, kw_only=True)
class ControllerRow:
    """One row of a table: its controller and job settings; see `rows.yaml`."""

    title: str
    training: Mapping[str, Any] | None = None
    """Training of its policy, as in `rows.yaml`; None for a PID."""
    controller: str = ""
    """Name of the PID."""
    paper: str | None = None
    """Name of the row in the paper's table; None if it has none."""
    changes: dict[str, Any] = field(default_factory=dict)
    """Fields of its jobs that differ."""
    targets: Sequence[str] | None = None
    """Targets of this row; None: all."""


@dataclass(frozen=True, kw_only=True)
class Spec:
    """One experiment."""

    name: str
    """Name of its command and of its files."""
    title: str
    rows: Mapping[str, ControllerRow]
    """Rows in the order of the table."""
    targets: Sequence[str]
    """Setpoints or trajectories of the experiment."""
    allowed_targets: Sequence[str]
    """All targets that may be requested."""
    kind: str
    """Kind of the targets, in the plural."""
    by_target: bool
    """True if the table has a line for each target."""
    columns: Columns
    """Columns of a row: key -> heading with its unit, format, and a factor."""
    note: str
    bases: Sequence[str]
    """Rows with which the others are compared, one table for each that was run."""
    figures: Mapping[str, Statistic]
    """Key of a trial's result -> statistic over the trials that have it."""
    differences: Sequence[str]
    """Keys of `MEASURES` by which rows are compared."""
    paper: Callable[[str, str], Mapping[str, Any] | None]
    """Function of a row of the paper's table and a target that returns its figures by key; None if it has none."""
    draw: Callable[[Results, Path], Path | None]
    """Function that draws the results of the rows into the folder."""
    picture: tuple[str, str]
    """File name of that figure, and its caption."""

    def paper_differences(self, row: ControllerRow, base: str) -> dict[str, float] | None:
        """Return, by key of `differences`, the paper's row minus that of a base; None if the paper lacks one
        of them.

        Units are those of the rows.
        """
        if row.paper is None or self.rows[base].paper is None:
            return None
        targets = self.targets if self.by_target else [""]
        pairs = [
            (self.paper(row.paper, t) or {}, self.paper(self.rows[base].paper, t) or {}) for t in targets
        ]
        return {
            key: float(np.mean([a[key] - b[key] for a, b in pairs]))
            for key in self.differences
            if all(figures_of_row.get(key) is not None for pair in pairs for figures_of_row in pair)
        }

    def tables(self, result: Mapping[str, Any]) -> list[Table]:
        """Return the table of a result, and those of the differences from the bases, if any."""
        units: Columns = {key: MEASURES[key] for key in self.differences}
        tables = [self._table(result)]
        for base, of_base in result["differences"].items():
            rows = []
            for name, differences in of_base.items():
                rows.append([self.rows[name].title, *cells(differences, units)])
                if theirs := self.paper_differences(self.rows[name], base):
                    rows.append(["  paper", *cells(theirs, units)])
            tables.append(
                Table(
                    title=f"{self.name.upper()}: differences from {self.rows[base].title}",
                    heads=["", *(heading for heading, *_ in units.values())],
                    rows=rows,
                    note=DIFFERENCES_NOTE,
                )
            )
        return tables

    def _table(self, result: Mapping[str, Any]) -> Table:
        """Return the table of a result; the rows state if it was measured on hardware."""
        hardware, rows = result.get("robot"), []
        for name, of_row in result["rows"].items():
            row = self.rows[name]
            title = f"{row.title}, hardware" if hardware else row.title
            for target, figures in (of_row["by_target"] if self.by_target else {"": of_row}).items():
                names = [target] if self.by_target else []
                rows.append([title, *names, *cells(figures, self.columns)])
                if row.paper and (theirs := self.paper(row.paper, target)):
                    rows.append([f"  paper: {row.paper}", *names, *cells(theirs, self.columns)])
        source, units = (
            ("hardware, by the robot's own estimate, whose error is not in it", "seeds")
            if hardware
            else (
                "a virtual pool whose vehicle, water and camera were not used in training",
                "plants and seeds",
            )
        )
        first = ["trajectory"] if self.by_target else []
        return Table(
            title=f"{self.title} ({self.name.upper()})",
            headline=f"{self.name.upper()} {played_in(result, self.kind)}",
            heads=["", *first, *(heading for heading, *_ in self.columns.values())],
            rows=rows,
            note=f"ours: {source}; mean, in brackets 95 % from a bootstrap of {units}{self.note}",
            pictures=dict([self.picture]),
        )


@dataclass(frozen=True, kw_only=True)
class TransferSettings:
    """Settings of an experiment: its pools, vehicle, rows and trainings."""

    plants: Annotated[int, (1, 1000)] = 3
    """Number of virtual pools, each with different vehicle, water and camera."""
    seeds: Annotated[int, (1, 1000)] = 3
    """Number of trainings of each policy, each tested with different noise."""
    seed: int = 1
    """Seed of every random number; equal seeds give equal results."""
    severity: str = "realistic"
    """(WORD) Deviation of the pools from the vehicle file: nominal, realistic or hard."""
    camera: str = "corners"
    """(MODE) corners (projected through the rippling water, with noise), or pictures (rendered, with tag
    detection: several times slower)."""
    firmware: str = "mcu"
    """(NAME) Firmware of the vehicle: mcu, ardusub (an autopilot over MAVLink: policies use its axes,
    in a tank with a DVL and a compass instead of the pool and its camera, with setpoints three times as
    far), or ardusub-own (the same, by the autopilot's own position: no DVL on the network)."""
    estimator: str = "error-state"
    """(MODE) State estimator: error-state, with the IMU's accelerations, or constant-velocity, as in
    the paper."""
    rows: Annotated[Sequence[str] | None, ","] = None
    """(NAMES) Rows of the table, separated by commas; default all except nmpc, which needs an extra."""
    vehicle: str = "finsrov"
    """(NAME|FILE) Vehicle in the catalogue, or path of a vehicle file."""
    pool_vehicle: Annotated[str | None, "python"] = None
    """Name or file of the vehicle around which the pools' vehicles are drawn; `vehicle` if None."""
    steps: Annotated[int | None, (1, None)] = None
    """Control steps of the training, summed over all worlds; default that of the task."""
    processes: Annotated[int | None, (1, None)] = None
    """Parallel trainings or trials; default one per processor."""
    address: str | None = None
    """(ADDRESS) Ray cluster to use instead, HOST:PORT or auto."""

    def check(self, robot: OnRobot | None) -> None:
        """Refuse invalid settings, and settings that a robot determines itself.

        Raises:
            ValueError: A severity, camera or estimator is unknown, a number is below 1, or pool settings are
                combined with a robot.
        """
        if robot is not None and (self.plants, self.severity, self.camera) != (3, "realistic", "corners"):
            raise ValueError("a robot has its own plant and camera: omit --plants, --severity and --camera")
        check_choices([self.severity], ("nominal", "realistic", "hard"), "severity", ValueError)
        check_choices([self.camera], ("corners", "pictures"), "camera", ValueError)
        check_choices([self.estimator], MODELS, "estimator", ValueError)
        if self.plants < 1 or self.seeds < 1:
            raise ValueError(f"plants is {self.plants}, seeds {self.seeds}: expected at least 1 of each")


def transfer_experiment(
    spec: Spec,
    *,
    out: Path,
    targets: Annotated[Sequence[str] | None, "python"] = None,
    settings: Annotated[TransferSettings, "options"] = TransferSettings(),
    robot: OnRobot | None = None,
    console: Console | None = None,
    progress: Progress = lambda part, text: None,
    show: Show = lambda job, result: None,
) -> dict[str, Any]:
    """Train the policies of the rows, run every target in every plant with every seed, and write the table.

    The directory stores policies and trials: an interrupted run continues, and a run with more seeds
    executes only the new trials.

    Args:
        spec: The experiment.
        out (DIR): Directory for JSON, Markdown, figures, policies and trials; an interrupted one is continued.
        targets: Targets; None: the published ones.
        settings: Pools, vehicle, rows and trainings.
        robot: Robot on which trials run in sequence instead of in pools; it has its own plant, severity and camera.
        console: Console for the robot's state; None: standard error.
        progress: Function that receives the completed fraction and the next step.
        show: Function that receives each trial of a pool and its result as soon as it is complete.

    Returns:
        Content of NAME.json.

    Raises:
        ValueError: A row, target, severity or camera is unknown, or a number is below 1.
    """
    settings.check(robot)
    usual = [name for name, row in spec.rows.items() if row.controller not in COSTLY]
    rows, targets = list(settings.rows or usual), list(targets or spec.targets)
    check_choices(rows, spec.rows, "row", ValueError)
    check_choices(targets, spec.allowed_targets, "target", ValueError)
    chosen, folder, vehicle = {name: spec.rows[name] for name in rows}, Path(out), settings.vehicle
    pools, run_seeds = (range(settings.seed, settings.seed + n) for n in (settings.plants, settings.seeds))
    firmware = firmware_of(settings.firmware, load_vehicle(vehicle), robot)
    action, site, sees = FIRMWARES[firmware]
    severity, camera = settings.severity, settings.camera
    spread_over: dict[str, Any] = {"processes": settings.processes, "address": settings.address}
    train_missing = partial(
        controllers_of,
        spec.name, chosen, run_seeds, folder, TrainingSettings(vehicle=vehicle, steps=settings.steps, action=action),
        lambda part, text: progress(TRAINING_SHARE * part, text), **spread_over,
    )  # fmt: skip
    if robot is not None:  # there is only one plant, and its severity cannot be chosen
        pools, severity, camera = range(1), HARDWARE, HARDWARE
        site = robot.site if firmware != "mcu" else site
    elif firmware != "mcu":
        camera = sees

    def jobs_of(names: Sequence[str], controllers: Mapping[tuple[str, int], str]) -> list[RobotJob]:
        return [
            RobotJob(
                row=name, controller=controllers[name, s], target=target, vehicle=vehicle,
                pool_vehicle=settings.pool_vehicle or vehicle, plant=plant, severity=severity, seed=s, site=site,
                firmware=firmware, estimator=settings.estimator, **{"camera": camera, **chosen[name].changes},
            )
            for name in names for plant in pools for s in run_seeds for target in chosen[name].targets or targets
        ]  # fmt: skip

    ready, beside = [name for name, row in chosen.items() if row.training is None], {}
    controllers = {(name, s): chosen[name].controller for name in ready for s in run_seeds}
    if robot is None and settings.address is None and settings.seeds == 1:
        # With few trainings, the remaining processors run other rows.
        learned = [name for name in chosen if name not in ready]
        beside["more"] = lambda: jobs_of(learned, train_missing())
    else:
        controllers, ready = train_missing(), list(chosen)
    results = play_jobs(
        jobs_of(ready, controllers), folder / "trials", robot, console=console, show=show, **spread_over, **beside,
        progress=lambda part, text: progress(TRAINING_SHARE + (1.0 - TRAINING_SHARE) * part, text),
    )  # fmt: skip
    by_row = {name: [r for r in results if r["job"]["row"] == name] for name in chosen}
    by_row = {
        name: played for name, played in by_row.items() if played
    }  # all trials of a row may have been skipped
    body = load_vehicle(vehicle)
    result = {
        "experiment": spec.name, "severity": severity, "camera": camera, "estimator": settings.estimator,
        "plants": list(pools), "seeds": list(run_seeds), "targets": targets, "robot": robot and robot.title,
        "vehicle": {"name": body.name, "sha256": body.sha256},
        **scores(spec, by_row), "trials": results, "provenance": provenance(),
    }  # fmt: skip
    write_json(folder / f"{spec.name}.json", result, spec.tables(result))
    spec.draw(by_row, folder)
    return result


def controllers_of(
    task: str,
    rows: Mapping[str, ControllerRow],
    seeds: Sequence[int],
    folder: Path,
    training: TrainingSettings,
    progress: Progress = lambda part, text: None,
    *,
    processes: int | None = None,
    address: str | None = None,
) -> dict[tuple[str, int], str]:
    """Return the controllers by row and seed; policies that are not complete in the folder are trained.

    Args:
        task: Task of the policies.
        rows: Rows of a table.
        seeds: Seeds of the trainings.
        folder: Folder of the experiment, whose `policies` contains the directories.
        training: Vehicle, action mode and control steps of each training; a row and its seed change the other
            settings.
        progress: Function that receives the completed fraction and the remaining work.
        processes, address: Number of parallel processes and cluster, as in `campaign.spread`.

    Returns:
        (row, seed) -> directory of a policy, or the name of a PID.
    """
    controllers, body, missing = {}, load_vehicle(training.vehicle), {}
    for (name, row), seed in product(rows.items(), seeds):
        controllers[name, seed] = row.controller
        if row.training is None:
            continue
        options = {"name": name, "remembers": False, **row.training}
        label, remembers = options.pop("name"), options.pop("remembers")
        policy = folder / "policies" / f"{label}-seed{seed}"
        controllers[name, seed] = str(policy)
        if not finished(policy, body):
            options |= {"seed": seed, "settings": {} if remembers else FORGETFUL}
            missing[policy] = (task, replace(training, **options))
    with closing(train_policies(missing, processes, address)) as done:
        for remaining, (_, error) in zip(reversed(range(len(missing))), done, strict=True):
            if error is not None:
                raise error
            progress(1.0 - remaining / len(missing), f"{remaining} trainings left")
    return controllers


def train_policies(
    trainings: Mapping[Path, tuple[str, TrainingSettings]],
    processes: int | None = None,
    address: str | None = None,
) -> Generator[tuple[Path, BaseException | None], None, None]:
    """Train policies in parallel, on this machine or a cluster.

    A training that was killed, or whose machine was lost, resumes from its last checkpoint.

    Args:
        trainings: Directory of the policy -> its task, and the settings of its training.
        processes, address: Number of parallel processes and cluster, as in `campaign.spread`.

    Yields:
        A directory and None as soon as its policy is written; or a directory and the error of its training.
    """
    work = _train_here if address is None else _train_away
    at_once = 1 if len(trainings) == 1 else processes
    with closing(spread(work, list(trainings.items()), at_once, address, resumable=True)) as done:
        for (policy, _), outcome in done:
            error = outcome.exception()
            if error is None and address is not None:
                with atomic_directory(policy, replaces=DESCRIPTION_FILE) as scratch:
                    for name, content in outcome.result().items():
                        (scratch / plain_name(name, "file of a policy", PolicyError)).write_bytes(content)
            yield policy, error


Planned = tuple[Path, tuple[str, TrainingSettings]]
"""Directory of a policy; its task, and the settings of its training."""


def _train_here(planned: Planned) -> None:
    """Train on this machine into the directory of the policy, and remove the checkpoints."""
    policy, _ = planned
    _train(planned, policy)
    shutil.rmtree(training_folder(policy), ignore_errors=True)


def _train_away(
    planned: Planned, checkpoint: Mapping[str, bytes], store: Callable[[dict[str, bytes]], None]
) -> dict[str, bytes]:
    """Train on any machine; return the files of the policy directory by name.

    Args:
        planned: The training.
        checkpoint: Files of the checkpoint from which it resumes, by name; empty at the start.
        store: Function that stores the files of a checkpoint.
    """
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "policy"
        if checkpoint:
            earlier = training_folder(out) / "checkpoint-0"
            earlier.mkdir(parents=True)
            for name, content in checkpoint.items():
                (earlier / plain_name(name, "file of a checkpoint", PolicyError)).write_bytes(content)
        _train(planned, out, saved=lambda path: store(contents(path)))
        return contents(out)


def _train(planned: Planned, out: Path, **options: Any) -> None:
    """Train a policy into a directory, resuming from the last checkpoint if that is of the same training.

    A training with several processes restarts: its checkpoints do not contain the state of all processes.
    """
    console = Console(stderr=True, quiet=True)
    if planned[1][1].processes == 1 and training_folder(out).is_dir():
        try:
            train(*planned[1], out=out, resume=True, console=console, **options)
            return
        except ResumeError:
            pass  # it has other settings, or was written by an earlier version
    train(*planned[1], out=out, console=console, **options)


def finished(directory: Path, vehicle: Vehicle | None = None) -> bool:
    """Return whether a directory contains a complete policy, not an interrupted or truncated one.

    Args:
        directory: Directory.
        vehicle: Vehicle that the policy must be for; None: any.
    """
    try:
        return bool(Policy.load(directory, vehicle=vehicle).description.training.get("complete"))
    except PolicyError:
        return False


def scores(spec: Spec, by_row: Results) -> dict[str, Any]:
    """Return the figures of every row, over all targets and for each target, and differences from the reference."""
    rows = {}
    for name, results in by_row.items():
        targets = dict.fromkeys(result["job"]["target"] for result in results)
        each = {
            target: row_figures([r for r in results if r["job"]["target"] == target], spec.figures)
            for target in targets
        }
        rows[name] = {**row_figures(results, spec.figures), "by_target": each}
    paired = {
        name: {key: _by_trial(results, key) for key in spec.differences} for name, results in by_row.items()
    }
    differences = {
        base: {
            name: {key: paired_difference(paired[base][key], values) for key, values in of_row.items()}
            for name, of_row in paired.items()
            if name != base
        }
        for base in spec.bases
        if base in paired and len(paired) > 1
    }
    return {"rows": rows, "differences": differences}


def row_figures(results: Sequence[Mapping[str, Any]], figures: Mapping[str, Statistic]) -> dict[str, Any]:
    """Return the figures of one row.

    Args:
        results: Results of its trials, as returned by `run_jobs`.
        figures: Key -> statistic over the trials that have it.

    Returns:
        `trials`, `success` (count), `stopped` (trials that ended in a fault), `worst_success` (fewest
        successes of a plant and seed, of `per_cluster` trials each), and by key an interval, or None if no
        trial has a figure.
    """
    clusters = Counter((r["job"]["plant"], r["job"]["seed"]) for r in results)
    held = Counter((r["job"]["plant"], r["job"]["seed"]) for r in results if r["success"])
    out: dict[str, Any] = {
        "trials": len(results),
        "success": held.total(),
        "stopped": sum(bool(r["fault"]) for r in results),
        "worst_success": min(held[cluster] for cluster in clusters),
        "per_cluster": max(clusters.values()),
    }
    for key, statistic in figures.items():
        values: dict[Hashable, list[float]] = {}
        for (plant, seed, _), x in _by_trial(results, key).items():
            values.setdefault((plant, seed), []).append(x)
        out[key] = with_interval(values, statistic)
    return out


def _by_trial(results: Sequence[Mapping[str, Any]], key: str) -> dict[tuple[int, int, str], float]:
    """Return plant, seed and target -> figure of that trial, if it has one."""
    measure = "success" if key == "success_rate" else key
    return {
        (r["job"]["plant"], r["job"]["seed"], r["job"]["target"]): float(r[measure])
        for r in results
        if r.get(measure) is not None
    }


ROWS: Mapping[str, Mapping[str, ControllerRow]] = {
    task: {name: ControllerRow(**row) for name, row in rows.items()}
    for task, rows in yaml.safe_load(
        Path(__file__).with_name("rows.yaml").read_text(encoding="utf-8")
    ).items()
}
"""Task -> rows of its table, in their order."""
T1_DRAWN = ("calibrated", "mesh", "simplified", "pid-paper", "pid", "calibrated-pool")
"""Rows in the figure: the paper's four curves, and ours."""

T2_DRAWN = 4
"""Greatest number of rows in the figure that can be distinguished."""


def played_in(result: Mapping[str, Any], targets_name: str) -> str:
    """Return the site of an experiment, and its vehicle, as text."""
    plants, seeds = len(result["plants"]), len(result["seeds"])
    of = f"{targets_name}: {len(result['targets'])}; {result['vehicle']['name']} {result['vehicle']['sha256'][:12]}"
    if result.get("robot"):
        return f"on hardware, robot {result['robot']}, by its own estimate; seeds: {seeds}, {of}"
    filtered = result.get("estimator", "constant-velocity")
    pool = f"severity {result['severity']}, camera {result['camera']}, estimator {filtered}; plants: {plants}"
    return f"in the virtual pool, {pool}, seeds: {seeds}, {of}"


def _draw_t1(by_row: Results, folder: Path) -> Path:
    """Draw position and yaw error over time, for the rows of `T1_DRAWN` that were run, or all rows."""
    drawn = {name: by_row[name] for name in T1_DRAWN if name in by_row} or by_row
    runs = {
        ROWS["t1"][name].title: [played_trial(r, folder / "trials") for r in results]
        for name, results in drawn.items()
    }
    hardware = any(r["job"]["severity"] == HARDWARE for results in by_row.values() for r in results)
    title = f"T1 {'on hardware' if hardware else 'in the virtual pool'}: median and middle half"
    return save_figure(draw_envelopes(runs, title), folder / "t1_envelopes.png")


def _draw_t2(by_row: Results, folder: Path) -> Path | None:
    """Draw the trial with the median error of each row and trajectory; return None if none was played."""
    runs = {}
    for name, results in by_row.items():
        flown: dict[str, list[Mapping[str, Any]]] = {}
        for result in sorted((r for r in results if r["p95_m"] is not None), key=lambda r: float(r["p95_m"])):
            flown.setdefault(result["job"]["target"], []).append(result)
        middle = [of_target[len(of_target) // 2] for of_target in flown.values()]
        if middle:
            runs[ROWS["t2"][name].title] = [played_trial(result, folder / "trials") for result in middle]
    if not runs:
        return None
    return save_figure(draw_tracking(dict(list(runs.items())[:T2_DRAWN])), folder / "t2_paths.png")


def _paper_t1(row: str, target: str) -> Mapping[str, Any]:
    theirs = paper_row(row)
    return {**theirs, "success_rate": theirs["success"] / theirs["trials"]}


T1 = Spec(
    name="t1",
    title="Station keeping",
    rows=ROWS["t1"],
    targets=tuple(T1_SETPOINTS),
    allowed_targets=tuple(T1_SETPOINTS),
    kind="setpoints",
    by_target=False,
    columns=T1_COLUMNS,
    note=". paper: its vehicle in its pool, one seed. errors: 40-60 s; e_y is vertical; "
    "success: 0.10 m on each axis and 10° for 10 s. t_s (median) and jitter are of successful trials.",
    bases=("calibrated", "pid"),
    figures={
        **dict.fromkeys(
            ("success_rate", "e_p_m", "e_y_m", "e_psi_deg", "J_p_m", "J_psi_deg", "energy"), np.mean
        ),
        "t_s_s": np.median,
    },
    differences=("success_rate", "e_p_m", "e_psi_deg", "t_s_s", "energy"),
    paper=_paper_t1,
    draw=_draw_t1,
    picture=("t1_envelopes.png", ENVELOPE),
)
"""Specification of `finssim experiment t1`."""
T2 = Spec(
    name="t2",
    title="Trajectory tracking",
    rows=ROWS["t2"],
    targets=T2_TRAJECTORIES,
    allowed_targets=tuple(TRAJECTORIES),
    kind="trajectories",
    by_target=True,
    columns={
        "success": ("done", ""),
        "horizontal_rmse_m": ("horizontal RMSE [m]", ".3f"),
        "vertical_rmse_m": ("vertical RMSE [m]", ".3f"),
        "p95_m": ("3-D P95 [m]", ".3f"),
    },
    note="; done: trials that reached the end. paper: its vehicle in its pool.",
    bases=("calibrated-dr", "pid"),
    figures=dict.fromkeys(
        ("horizontal_rmse_m", "vertical_rmse_m", "p95_m", "cross_track_rmse_m", "energy"), np.mean
    ),
    differences=("horizontal_rmse_m", "vertical_rmse_m", "p95_m", "energy"),
    paper=paper_t2_row,
    draw=_draw_t2,
    picture=("t2_paths.png", TRACKS),
)
"""Specification of `finssim experiment t2`."""
SPECS: Mapping[str, Spec] = {"t1": T1, "t2": T2}


def t1(*, setpoints: Annotated[Sequence[str] | None, ","] = None, **options: Any) -> dict[str, Any]:
    """Station keeping in the virtual pool (the paper's Table IV): success, errors [m, deg], time to settle
    [s], jitter.

    With --robot, run the published protocol on a vehicle, with instructions on the screen; results are marked
    as hardware.

    Example: finssim experiment t1 --rows calibrated,pid --seeds 1 --out t1

    Example: finssim experiment t1 --rows pid --seeds 1 --robot serial:/dev/ttyUSB0 --pool-file p.yaml --arm
    --out hw

    Args:
        setpoints (NAMES): Setpoints, separated by commas; default all published ones.
        options: As of `studies.transfer.transfer_experiment`.
    """
    return transfer_experiment(T1, targets=setpoints, **options)


def t2(*, trajectories: Annotated[Sequence[str] | None, ","] = None, **options: Any) -> dict[str, Any]:
    """Trajectory tracking in the virtual pool (the paper's Table V): horizontal and vertical RMSE, 3-D P95 [m].

    With --robot, run the published protocol on a vehicle, with instructions on the screen; results are marked
    as hardware.

    Example: finssim experiment t2 --rows calibrated-dr,pid --trajectories lemniscate --seeds 1 --out t2

    Args:
        trajectories (NAMES): Trajectories, separated by commas; default all published ones.
        options: As of `studies.transfer.transfer_experiment`.
    """
    return transfer_experiment(T2, targets=trajectories, **options)


def tables_of(result: Mapping[str, Any]) -> list[Table]:
    """Return the tables of an experiment."""
    return SPECS[result["experiment"]].tables(result)
