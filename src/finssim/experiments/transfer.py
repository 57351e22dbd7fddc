"""Experiments of the virtual pool: what their rows need is trained, every trial played, and a table written."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

from rich.console import Console

from finssim.calibration.output.calibrated_ranges import write_ranges
from finssim.control.policy import Policy
from finssim.control.policy_description import PolicyError
from finssim.experiments.campaign import Say, choice, run_jobs, write_json
from finssim.experiments.identify import identify
from finssim.experiments.on_robot import Attendant, OnRobot
from finssim.experiments.pool_trial import HARDWARE, Job, play, run_on_robot
from finssim.experiments.statistics import Interval, Statistic, paired_difference, with_interval
from finssim.experiments.tables import Shown, markdown_of
from finssim.files import atomic_directory
from finssim.learning.train import train
from finssim.provenance import provenance
from finssim.vehicles import Vehicle, load_vehicle

__all__ = ["INTERVALS", "MEASURES", "Row", "Spec", "Training", "finished", "transfer_experiment"]

Results = Mapping[str, Sequence[Mapping[str, Any]]]
"""Row -> results of its trials."""

TRAINING_SHARE = 0.4
"""Of the progress bar."""
INTERVALS = "intervals"
"""Stands for the ranges that the calibration's intervals give."""
RANGES_FILE = "ranges.yaml"

MEASURES = {
    "success_rate": ("the share of setpoints held", "held [points]", 100.0, "percentage points", ".0f"),
    "e_p_m": ("the position error", "e_p [cm]", 100.0, "cm", ".1f"),
    "e_psi_deg": ("the heading error", "e_psi [°]", 1.0, "°", ".1f"),
    "horizontal_rmse_m": ("the horizontal error", "horizontal [cm]", 100.0, "cm", ".1f"),
    "vertical_rmse_m": ("the vertical error", "vertical [cm]", 100.0, "cm", ".1f"),
    "p95_m": ("the 95th percentile of the distance", "P95 [cm]", 100.0, "cm", ".1f"),
}
"""Key in which rows are compared -> words, heading, factor, unit and format of a difference."""


@dataclass(frozen=True)
class Training:
    """What a policy is trained in."""

    name: str
    task: str = "t1"
    hydrodynamics: str = "calibrated"
    randomize: str | None = None
    """Name or file of ranges."""


@dataclass(frozen=True)
class Row:
    """One row of a table: who steers and what is taken from it."""

    title: str
    training: str | None = None
    """Name of what is trained; None for a PID."""
    paper: str | None = None
    """Row of the paper's table; None where it has none."""
    module: str = ""
    """What the row takes away or puts in place of the reference, as a sentence begins."""
    controller: str = ""
    """Name of the PID."""
    changes: dict[str, Any] = field(default_factory=dict)
    """Fields of its jobs."""


@dataclass(frozen=True, kw_only=True)
class Spec:
    """One experiment."""

    name: str
    """Its command, and the name of its files."""
    rows: Mapping[str, Row]
    """In the order of the table."""
    trainings: Mapping[str, Training]
    targets: Sequence[str]
    """Setpoints or trajectories that are played."""
    known_targets: Sequence[str]
    """All that may be asked for."""
    base: str
    """The row that the others are compared with."""
    figures: Mapping[str, Statistic]
    """Key of a trial's result -> how the trials that have it become one figure."""
    differences: Sequence[str]
    """Keys of `MEASURES` in which rows are compared."""
    paper: Callable[[str], Mapping[str, float]]
    """Row of the paper's table -> key of `differences` -> its figure."""
    shown: Callable[[Mapping[str, Any]], Shown]
    """The table of a result."""
    draw: Callable[[Results, Path], Path | None]
    """Draws the results of the rows into the folder."""

    def paper_differences(self, row: Row) -> dict[str, float] | None:
        """Key of `differences` -> the paper's row less its reference; None where it has not both."""
        base = self.rows[self.base].paper
        if row.paper is None or base is None:
            return None
        theirs, reference = self.paper(row.paper), self.paper(base)
        return {key: theirs[key] - reference[key] for key in self.differences}


def transfer_experiment(
    spec: Spec,
    *,
    out: Path,
    plants: Annotated[int, (1, 1000)] = 3,
    seeds: Annotated[int, (1, 1000)] = 3,
    seed: int = 1,
    severity: str = "realistic",
    camera: str = "corners",
    rows: Annotated[Sequence[str] | None, ","] = None,
    targets: Annotated[Sequence[str] | None, "python"] = None,
    vehicle: str = "finsrov",
    steps: Annotated[int | None, (1, None)] = None,
    processes: Annotated[int | None, (1, None)] = None,
    robot: OnRobot | None = None,
    attendant: Attendant | None = None,
    say: Say = lambda part, what: None,
) -> dict[str, Any]:
    """Train what the rows need, play every target in every plant with every seed, and write the table.

    The directory keeps policies and trials: a run that was interrupted goes on where it was, and one with more seeds
    plays only what is new.

    Args:
        spec: Which experiment.
        out (DIR): Directory for JSON, Markdown, figures, policies and trials; one that was interrupted goes on.
        plants: Virtual pools, each with its own vehicle, water and camera.
        seeds: Trainings of each policy, each tried with its own noise.
        seed: Seed of every random number; equal seeds give equal results.
        severity (WORD): How far the pools are from the vehicle file: nominal, realistic or hard.
        camera (MODE): corners (projected through the rippling water, with noise), or pictures (drawn, and searched for
            tags: several times slower).
        rows (NAMES): Rows of the table, separated by commas; all if not given.
        targets: What is played; the published ones if None.
        vehicle (NAME|FILE): Vehicle of the catalogue, or the path of a vehicle file.
        steps: Control steps to learn from, all worlds together; what the task needs if not given.
        processes: Trials at once; as many as processors if not given.
        robot: Play on a robot, one trial after the other, instead of in pools; plants, severity and camera are its own.
        attendant: The person beside that robot, instead of the terminal's keyboard.
        say: Told the share that is done and what comes next.

    Returns:
        What NAME.json holds.

    Raises:
        ValueError: An unknown row, target, severity or camera, or a number below 1.
    """
    if robot is not None and (plants, severity, camera) != (3, "realistic", "corners"):
        raise ValueError("a robot has its own plant and camera: leave --plants, --severity and --camera out")
    rows, targets = list(rows or spec.rows), list(targets or spec.targets)
    for known, kind, names in (
        (spec.rows, "row", rows),
        (spec.known_targets, "target", targets),
        (("nominal", "realistic", "hard"), "severity", [severity]),
        (("corners", "pictures"), "camera", [camera]),
    ):
        for name in names:
            choice(known, name, kind, ValueError)
    if plants < 1 or seeds < 1:
        raise ValueError(f"plants is {plants}, seeds {seeds}: expected at least 1 of each")
    chosen = {name: spec.rows[name] for name in rows}
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
    by_row = {name: [r for r in results if r["job"]["row"] == name] for name in chosen}
    by_row = {name: played for name, played in by_row.items() if played}  # all of a row may have been skipped
    body = load_vehicle(vehicle)
    result = {
        "experiment": spec.name, "severity": severity, "camera": camera, "plants": list(places),
        "seeds": list(run_seeds), "targets": targets, "robot": robot and robot.title,
        "vehicle": {"name": body.name, "sha256": body.sha256},
        **_scores(spec, by_row), "trials": results, "provenance": provenance(),
    }  # fmt: skip
    write_json(folder / f"{spec.name}.json", result, markdown_of(spec.shown(result)))
    spec.draw(by_row, folder)
    return result


def _policies(
    spec: Spec,
    rows: Mapping[str, Row],
    seeds: Sequence[int],
    folder: Path,
    vehicle: str,
    steps: int | None,
    say: Say,
) -> dict[tuple[str, int], Path]:
    trainings = [
        spec.trainings[name] for name in dict.fromkeys(row.training for row in rows.values() if row.training)
    ]
    if any(training.randomize == INTERVALS for training in trainings):
        say(0.0, "identifying the vehicle, for the ranges of its intervals")
        ranges = str(_interval_ranges(folder / "identification", vehicle, seeds[0]))
        trainings = [replace(t, randomize=ranges) if t.randomize == INTERVALS else t for t in trainings]
    return trained(trainings, seeds, folder / "policies", vehicle=vehicle, steps=steps, say=say)


def _interval_ranges(folder: Path, vehicle: str, seed: int) -> Path:
    """The ranges file in a folder; where there is none yet, the vehicle is identified from trials first."""
    if not (folder / RANGES_FILE).is_file():
        with atomic_directory(folder, replaces=RANGES_FILE) as place:
            found = identify(place, vehicle, seed=seed, shown=folder)
            write_ranges(found.fit, place / RANGES_FILE, found.vehicle)
    return folder / RANGES_FILE


def trained(
    trainings: Iterable[Training],
    seeds: Iterable[int],
    folder: Path,
    *,
    vehicle: str,
    steps: int | None = None,
    say: Say = lambda part, what: None,
) -> dict[tuple[str, int], Path]:
    """Policy directories of every training and seed; what is finished in the folder is not trained again.

    Args:
        trainings: Each under a name of its own.
        seeds: Of the trainings.
        folder: Where the directories are and come.
        vehicle: Name or file.
        steps: Control steps of each; the task's own if None.
        say: Told the share that is done and what comes next.

    Returns:
        (name, seed) -> directory.
    """
    plan = [(training, seed) for training in trainings for seed in seeds]
    policies: dict[tuple[str, int], Path] = {}
    for done, (training, seed) in enumerate(plan):
        policies[training.name, seed] = place = folder / f"{training.name}-seed{seed}"
        say(done / len(plan), f"training {training.name}, seed {seed}")
        if not finished(place):
            train(
                training.task, out=place, vehicle=vehicle, hydrodynamics=training.hydrodynamics,
                randomize=training.randomize, seed=seed, steps=steps, console=Console(stderr=True, quiet=True),
            )  # fmt: skip
    return policies


def finished(place: Path, vehicle: Vehicle | None = None) -> bool:
    """Whether a whole policy lies there: not one that was interrupted, or cut short while it was written.

    Args:
        place: Directory.
        vehicle: That it must be for; any if None.
    """
    try:
        return bool(Policy.load(place, vehicle=vehicle).description.training.get("complete"))
    except PolicyError:
        return False


def _scores(spec: Spec, by_row: Results) -> dict[str, Any]:
    """Figures of every row, all targets together and each alone; differences from the reference; sentences."""
    rows = {}
    for name, results in by_row.items():
        targets = dict.fromkeys(r["job"]["target"] for r in results)
        each = {
            t: row_figures([r for r in results if r["job"]["target"] == t], spec.figures) for t in targets
        }
        rows[name] = {**row_figures(results, spec.figures), "by_target": each}
    others = by_row.keys() - {spec.base} if spec.base in by_row else ()
    differences = {
        name: {key: _difference(by_row[spec.base], by_row[name], key) for key in spec.differences}
        for name in by_row
        if name in others
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


def row_figures(results: Sequence[Mapping[str, Any]], figures: Mapping[str, Statistic]) -> dict[str, Any]:
    """The figures of one row.

    Args:
        results: Of its trials, as `run_jobs` gives them.
        figures: Key -> how the trials that have it become one figure.

    Returns:
        `trials`, `success` (count), `stopped` (trials that ended in a fault), `worst_success` (fewest successes of a
        plant and seed, of `per_cluster` trials each), and by key an interval, or None where no trial has a figure.
    """
    clusters: dict[Hashable, list[Mapping[str, Any]]] = {}
    for result in results:
        clusters.setdefault((result["job"]["plant"], result["job"]["seed"]), []).append(result)
    counts = [sum(bool(r["success"]) for r in group) for group in clusters.values()]
    out: dict[str, Any] = {
        "trials": len(results),
        "success": sum(counts),
        "stopped": sum(bool(r["fault"]) for r in results),
        "worst_success": min(counts),
        "per_cluster": max(len(group) for group in clusters.values()),
    }
    for key, statistic in figures.items():
        values = {
            cluster: [x for r in group if (x := _figure(r, key)) is not None]
            for cluster, group in clusters.items()
        }
        interval = with_interval(values, statistic)
        out[key] = interval and interval.as_json()
    return out


def _difference(
    reference: Sequence[Mapping[str, Any]], other: Sequence[Mapping[str, Any]], key: str
) -> Interval | None:
    """Mean of other - reference over the trials that both have a figure for, paired by plant, seed and target."""
    ours, theirs = (
        {
            (r["job"]["plant"], r["job"]["seed"], r["job"]["target"]): x
            for r in results
            if (x := _figure(r, key)) is not None
        }
        for results in (reference, other)
    )
    return paired_difference(ours, theirs)


def _figure(result: Mapping[str, Any], key: str) -> float | None:
    value = result["success"] if key == "success_rate" else result[key]
    return None if value is None else float(value)


def sentence(module: str, differences: Mapping[str, Interval | None]) -> str:
    """What a module changes, with what the intervals leave open said as such.

    Args:
        module: How the sentence begins, such as "Domain randomisation".
        differences: Key of `MEASURES` -> other less reference; None where no pair of trials has both.
    """
    clear = [_clause(key, d) for key, d in differences.items() if d is not None and d.excludes_zero]
    unclear = [MEASURES[key][0] for key, d in differences.items() if d is not None and not d.excludes_zero]
    unpaired = [MEASURES[key][0] for key, d in differences.items() if d is None]
    parts = []
    if clear:
        parts.append(f"{module} {_listed(clear)}")
    if unclear:
        start = "it" if clear else module
        parts.append(f"{start} makes no difference to {_listed(unclear)} that the intervals support")
    if unpaired:
        parts.append(f"{_listed(unpaired)} cannot be compared: no pair of trials has both")
    return "; ".join(parts) + "."


def _clause(key: str, d: Interval) -> str:
    words, _, factor, unit, form = MEASURES[key]
    verb = "raises" if d.value > 0.0 else "lowers"
    low, high = sorted(abs(factor * x) for x in (d.low, d.high))
    space = "" if unit == "°" else " "
    return f"{verb} {words} by {abs(factor * d.value):{form}}{space}{unit} [{low:{form}}, {high:{form}}]"


def _listed(items: list[str]) -> str:
    return items[0] if len(items) == 1 else f"{', '.join(items[:-1])} and {items[-1]}"
