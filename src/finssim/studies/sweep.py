"""`finssim sweep`: train every combination of a grid with several seeds, and evaluate each policy in one table."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass, fields
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from finssim.core.files import plain_name
from finssim.core.progress import Progress
from finssim.core.provenance import provenance
from finssim.core.yaml_file import first_problem, read_mapping
from finssim.evaluation.campaign import run_jobs, write_json
from finssim.evaluation.evaluate import ControllerTrials, play
from finssim.evaluation.plants import load_plant
from finssim.evaluation.tables import Table, cells
from finssim.learning.train import TrainingSettings
from finssim.studies.transfer import finished, train_policies
from finssim.tasks import numeric_tasks
from finssim.vehicles import load_vehicle

RESULT_FILE = "sweep.json"
SAME_FOR_ALL = ("seed", "device", "vehicle")
"""Settings of a training that are set by the sweep itself."""
MEASURES: dict[str, tuple[str, ...]] = {
    "t1": ("success", "e_p_m", "e_psi_deg", "t_s_s"),
    "t2": ("horizontal_rmse_m", "vertical_rmse_m", "p95_m"),
}
"""Task of the paper -> columns of its table; tables of other tasks show all metrics."""
FILES = ("vehicle", "plants", "randomize")
"""Keys whose values may name files."""
TRAINING_SHARE = 0.9
"""Fraction of the progress bar for trainings [-]."""
EVALUATION_SEED = 1


class SweepError(ValueError):
    """Sweep that cannot run."""


@dataclass(frozen=True)
class Training:
    """One training of a sweep."""

    setting: str
    """Name of the combination."""
    seed: int
    options: Mapping[str, Any]
    """Fields of `TrainingSettings` that differ from the defaults."""
    run: str
    """Name of its directory: setting, a digest of everything that determines the policy except the seed, and
    the seed."""


class Evaluate(BaseModel):
    """Evaluation of each policy."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    plants: tuple[str, ...] = Field(default=("nominal",), min_length=1)
    trials: int | None = Field(default=None, ge=1)


class Sweep(BaseModel):
    """Sweep file."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    task: str
    vehicle: str = "finsrov"
    seeds: tuple[int, ...]
    """Seeds of the trainings: a list, or their number, starting at 1."""
    train: dict[str, Any] = Field(default_factory=dict)
    """Options of every training, as in `finssim train`."""
    grid: dict[str, list[Any]] = Field(default_factory=dict)
    """Option of a training, or settings.NAME of its learner -> values; every combination is trained."""
    evaluate: Evaluate = Evaluate()

    @field_validator("seeds", mode="before")
    @classmethod
    def _counted(cls, value: Any) -> Any:
        return tuple(range(1, value + 1)) if isinstance(value, int) and not isinstance(value, bool) else value

    @model_validator(mode="after")
    def _check_options(self) -> Sweep:
        without_pictures = numeric_tasks()
        if self.task not in without_pictures:
            raise ValueError(f"task is '{self.task}', expected one of {', '.join(without_pictures)}")
        if not self.seeds or len(set(self.seeds)) < len(self.seeds):
            raise ValueError(f"seeds are {list(self.seeds)}, expected at least one, each once")
        available = [option.name for option in fields(TrainingSettings) if option.name not in SAME_FOR_ALL]
        for name in (*self.train, *self.grid):
            if name not in available and not (name in self.grid and name.startswith("settings.")):
                raise ValueError(
                    f"'{name}' is not an option of a training; available: {', '.join(available)}, and in a grid "
                    "settings.NAME of the learner"
                )
        return self

    def trainings(self) -> list[Training]:
        """Return every combination with every seed; ordered by seed, so that each combination has some
        results early.

        Raises:
            SweepError: A combination cannot name a directory.
            VehicleError: The vehicle cannot be read.
        """
        vehicle = load_vehicle(self.vehicle).sha256
        runs = {}
        for values in product(*self.grid.values()):
            combination = dict(zip(self.grid, values, strict=True))
            options = _options(self.train, combination)
            digest = hashlib.sha256(
                json.dumps([self.task, vehicle, options], sort_keys=True, default=str).encode()
            )
            for value in options.values():
                if isinstance(value, str) and Path(value).is_absolute() and Path(value).is_file():
                    digest.update(Path(value).read_bytes())
            name = _name(combination)
            runs[f"{name}-{digest.hexdigest()[:8]}"] = name, options
        return [
            Training(name, seed, options, f"{run}-seed{seed}")
            for seed in self.seeds
            for run, (name, options) in runs.items()
        ]


def _options(options: Mapping[str, Any], combination: Mapping[str, Any]) -> dict[str, Any]:
    """Return options of a training with a combination of the grid; settings.NAME is a setting of the learner."""
    result = dict(options)
    for name, value in combination.items():
        option, _, setting = name.partition(".")
        result[option] = {**result.get("settings", {}), setting: value} if setting else value
    return result


def _name(combination: Mapping[str, Any]) -> str:
    """Return the name of a combination, which is also that of a directory.

    Raises:
        SweepError: The combination cannot name a directory.
    """
    parts = [
        f"{name.removeprefix('settings.')}-{Path(value).stem if isinstance(value, str) else value}"
        for name, value in combination.items()
    ]
    return plain_name("_".join(parts) or "run", "setting", SweepError)


def load_sweep(path: str | Path) -> Sweep:
    """Read a sweep file; files that it names are relative to its own directory.

    Raises:
        SweepError: The file is missing or invalid; the message names the key.
        PlantError: A plant is missing or invalid, which is reported before the first training.
    """
    data = read_mapping(Path(path), SweepError, such_as="task: t1")
    try:
        data = _placed(data, Path(path).parent)
    except SweepError as error:
        raise SweepError(f"{path}: {error}") from None
    try:
        sweep = Sweep.model_validate(data)
    except ValidationError as error:
        raise SweepError(f"{path}: {first_problem(error, Sweep)}") from error
    for name in sweep.evaluate.plants:
        load_plant(name)
    return sweep


def _placed(value: Any, folder: Path, key: Any = "") -> Any:
    """Return the content of a sweep file, with absolute paths of files in its folder."""
    if isinstance(value, dict):
        return {name: _placed(item, folder, key if key in FILES else name) for name, item in value.items()}
    if isinstance(value, list):
        return [_placed(item, folder, key) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        raise SweepError(f"{key} is {value}, expected a finite number")
    path = folder / value if isinstance(value, str) and key in FILES else None
    return str(path.resolve()) if path is not None and path.is_file() else value


def sweep(
    file: Path,
    *,
    out: Path,
    address: str | None = None,
    processes: Annotated[int | None, (1, None)] = None,
    progress: Progress = lambda part, text: None,
) -> dict[str, Any]:
    """Train every combination of a grid with every seed on one machine or several, and evaluate each policy;
    resumes.

    Exit status 3: a training failed, as the table shows.

    Example: finssim sweep sweep.yaml --out swept

    Args:
        file (FILE): Sweep file: task, seeds, grid (.yaml).
        out (DIR): Directory of the runs; existing ones are kept.
        address (ADDRESS): Ray cluster to use, HOST:PORT or auto; default only this machine.
        processes: Parallel trainings on this machine; default one per processor.
        progress: Receives the completed fraction and the remaining work.

    Returns:
        Content of `sweep.json`: `rows` (name, seed, run, options, and training_s and plants, or error), `ok`,
        provenance.

    Raises:
        SweepError: The file cannot be used.
        ClusterError: No cluster answers.
        KeyboardInterrupt: Ctrl-C was pressed; finished policies and evaluations are kept.
    """
    plan = load_sweep(file)
    trainings, errors = {out / "runs" / training.run: training for training in plan.trainings()}, {}
    missing = {
        policy: (plan.task, TrainingSettings(vehicle=plan.vehicle, seed=training.seed, **training.options))
        for policy, training in trainings.items()
        if not finished(policy)
    }
    with closing(train_policies(missing, processes, address)) as done:
        for remaining, (policy, error) in zip(reversed(range(len(missing))), done, strict=True):
            if error is not None:
                errors[policy] = f"{type(error).__name__}: {error}"
            progress(TRAINING_SHARE * (1.0 - remaining / len(missing)), f"{remaining} trainings left")
    jobs = [
        ControllerTrials(
            row=training.setting, target=plan.task, plant=number, seed=training.seed, noise=EVALUATION_SEED,
            controller=str(policy), vehicle=plan.vehicle, water=load_plant(name), trials=plan.evaluate.trials,
            task=plan.task,
        )
        for policy, training in trainings.items() if policy not in errors
        for number, name in enumerate(plan.evaluate.plants, 1)
    ]  # fmt: skip
    results = run_jobs(
        jobs, out / "evaluations", play, processes=processes, address=address,
        progress=lambda part, text: progress(TRAINING_SHARE + (1.0 - TRAINING_SHARE) * part, text),
    )  # fmt: skip
    plants: dict[Path, dict[str, Any]] = {}
    for job, evaluation in zip(jobs, results, strict=True):
        figures = {key: value for key, value in evaluation.items() if key not in ("key", "job")}
        plants.setdefault(Path(job.controller), {})[job.water.name] = figures
    result = {
        "rows": [
            {
                "name": training.setting, "seed": training.seed, "run": training.run, "options": training.options,
                **({"error": errors[policy]} if policy in errors else
                   {"training_s": _seconds(policy), "plants": plants[policy]}),
            }
            for policy, training in trainings.items()
        ],
        "ok": not errors,
        "provenance": provenance(),
    }  # fmt: skip
    write_json(out / RESULT_FILE, result, tables_of(result))
    return result


def _seconds(policy: Path) -> float:
    """Return the duration of a policy's training, without set-up [s]."""
    curves = np.genfromtxt(policy / "curves.csv", delimiter=",", names=True, ndmin=1)
    return float(curves["seconds"][-1])


def tables_of(result: Mapping[str, Any]) -> list[Table]:
    """Return a table with a row for each run and plant: its measures, or the error."""
    evaluated = [entry for row in result["rows"] for entry in row.get("plants", {}).values()]
    first: dict[str, Any] = evaluated[0] if evaluated else {}
    measures = list(first.get("metrics", ())) or [
        name for name in MEASURES.get(str(first.get("task")), ()) if name in first
    ]
    measures = measures or ["error"]
    counted = "success" if "metrics" not in first else ""
    columns = {name: (name, "" if name == counted else ".4g") for name in measures}
    rows = []
    for row in result["rows"]:
        if "error" in row:
            texts = [row["error"], *[""] * len(measures)][: len(measures)]
            rows.append([row["name"], str(row["seed"]), "–", "–", *texts])
        for plant, entry in row.get("plants", {}).items():
            texts = cells(entry.get("metrics", entry), columns)
            rows.append([row["name"], str(row["seed"]), plant, f"{row['training_s']:.0f}", *texts])
    heads = ["run", "seed", "plant", "time [s]", *measures]
    return [Table(title="Sweep", heads=heads, rows=rows, left=(0, 2))]
