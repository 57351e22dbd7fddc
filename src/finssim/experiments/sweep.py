"""`finssim sweep`: trainings over settings and seeds, on one machine or many, and one table of what came of them."""

from __future__ import annotations

import hashlib
import inspect
import json
import math
import os
import socket
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator
from rich.console import Console

from finssim.experiments.campaign import Progress, keep_result, load_result, spread, write_json
from finssim.experiments.evaluate import evaluate_controller
from finssim.experiments.plants import load_plant
from finssim.experiments.tables import Table, cells
from finssim.files import atomic_directory, plain_name
from finssim.learning.train import train
from finssim.provenance import provenance
from finssim.tasks import TASKS
from finssim.yaml_file import first_problem, read_mapping

RESULT_FILE = "sweep.json"
ROW_FILE = "sweep-row.json"
SAME_FOR_ALL = ("task", "out", "seed", "console", "shown", "interrupted", "resume", "device", "vehicle")
"""Arguments of a training that a sweep sets itself."""
MEASURES: dict[str, tuple[str, ...]] = {
    "t1": ("success", "e_p_m", "e_psi_deg", "t_s_s"),
    "t2": ("horizontal_rmse_m", "vertical_rmse_m", "p95_m"),
}
"""Task of the paper -> columns of its table; the table of another task has all its metrics."""
FILES = ("vehicle", "plants", "randomize")
"""Keys whose values may name files."""


class SweepError(ValueError):
    """A sweep that cannot be run."""


@dataclass(frozen=True)
class Job:
    """One training and the evaluation of what came of it."""

    name: str
    """Of the setting."""
    seed: int
    task: str
    vehicle: str
    options: Mapping[str, Any]
    """Arguments of `finssim.learning.train.train`."""
    plants: tuple[str, ...]
    trials: int | None

    @cached_property  # a file that is changed while the sweep runs must not rename its jobs
    def key(self) -> str:
        """Name of its folder: with a digest of everything that decides what comes of it, files too, then the seed.

        The folders of a setting differ in the number at their end alone.
        """
        about = [self.task, self.vehicle, dict(self.options), self.plants, self.trials]
        digest = hashlib.sha256(json.dumps(about, sort_keys=True, default=str).encode())
        for value in (self.vehicle, *self.plants, *self.options.values()):
            if isinstance(value, str) and Path(value).is_absolute() and Path(value).is_file():
                digest.update(Path(value).read_bytes())
        return f"{self.name}-{digest.hexdigest()[:8]}-seed{self.seed}"


class Evaluate(BaseModel):
    """How each policy is tried."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    plants: tuple[str, ...] = Field(default=("nominal",), min_length=1)
    trials: int | None = Field(default=None, ge=1)


class Span(BaseModel):
    """What an option of a search may be: a number from `low` to `high`, an integer where both are; or of `choice`."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    low: int | float | None = None
    high: int | float | None = None
    log: bool = False
    """Drawn by its logarithm."""
    choice: tuple[Any, ...] = ()

    @model_validator(mode="after")
    def _either(self) -> Span:
        ends = [end for end in (self.low, self.high) if end is not None]
        if len(ends) != (0 if self.choice else 2):
            raise ValueError("expected either 'low' and 'high', or 'choice'")
        if self.low is not None and self.high is not None and self.log and self.low <= 0:
            raise ValueError(f"'log' needs a 'low' above 0, and it is {self.low}")
        if self.low is not None and self.high is not None and not self.low < self.high:
            raise ValueError(f"low is {self.low}, expected less than high, {self.high}")
        return self

    def distribution(self) -> Any:
        """As Optuna has it."""
        from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

        if self.choice:
            return CategoricalDistribution(self.choice)
        integral = isinstance(self.low, int) and isinstance(self.high, int)
        return (IntDistribution if integral else FloatDistribution)(self.low, self.high, log=self.log)


class Search(BaseModel):
    """Settings that Optuna proposes from how those before them did, by its tree-structured Parzen estimator."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    trials: int = Field(ge=1, le=100_000)
    """Settings that are tried."""
    batch: int = Field(default=4, ge=1)
    """Of these at once, none of which knows of the others."""
    minimise: str | None = None
    """Measure of an evaluation, whose mean over seeds and plants is to be small."""
    maximise: str | None = None
    """Or large."""
    options: dict[str, Span] = Field(min_length=1)
    """Option of a training, or settings.NAME of its learner -> what it may be."""

    @model_validator(mode="after")
    def _single_measure(self) -> Search:
        for name in self.options:
            if "." in name and not name.startswith("settings."):
                raise ValueError(f"'{name}' is no option: one with a dot is settings.NAME, of the learner")
        if (self.minimise is None) == (self.maximise is None):
            raise ValueError("expected either 'minimise' or 'maximise', a measure such as e_p_m")
        return self


class Sweep(BaseModel):
    """A sweep file."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    task: str
    vehicle: str = "finsrov"
    seeds: tuple[int, ...]
    """Of the trainings: a list, or how many, from 1."""
    train: dict[str, Any] = Field(default_factory=dict)
    """Options of every training, as `finssim train` takes them."""
    settings: dict[str, dict[str, Any]] = Field(default_factory=dict)
    """Name -> options that differ."""
    grid: dict[str, list[Any]] = Field(default_factory=dict)
    """Option -> values; every combination is a setting, on top of each of `settings`."""
    search: Search | None = None
    """Instead of settings and grid."""
    evaluate: Evaluate = Evaluate()

    @field_validator("seeds", mode="before")
    @classmethod
    def _counted(cls, value: Any) -> Any:
        return tuple(range(1, value + 1)) if isinstance(value, int) and not isinstance(value, bool) else value

    @model_validator(mode="after")
    def _check_options(self) -> Sweep:
        if self.task not in TASKS:
            raise ValueError(f"task is '{self.task}', expected one of {', '.join(TASKS)}")
        if not self.seeds or len(set(self.seeds)) < len(self.seeds):
            raise ValueError(f"seeds are {list(self.seeds)}, expected at least one, each once")
        available = [name for name in inspect.signature(train).parameters if name not in SAME_FOR_ALL]
        if self.search is not None and (self.settings or self.grid):
            raise ValueError("a search proposes the settings itself: leave 'settings' and 'grid' out")
        searched = {name.partition(".")[0]: None for name in self.search.options} if self.search else {}
        for options in (self.train, self.grid, searched, *self.settings.values()):
            for name in options:
                if name not in available:
                    raise ValueError(
                        f"'{name}' is no option of a training; available: {', '.join(available)}"
                    )
        return self

    def jobs(self) -> list[Job]:
        """Every setting with every seed; seed by seed, so that each setting has some results early."""
        combinations = [dict(zip(self.grid, values, strict=True)) for values in product(*self.grid.values())]
        variants = [
            (_named(name, combination), {**self.train, **setting, **combination})
            for name, setting in (self.settings or {"": {}}).items()
            for combination in combinations
        ]
        return self.jobs_of(dict(variants))

    def jobs_of(self, variants: Mapping[str, Mapping[str, Any]]) -> list[Job]:
        """Settings, each with every seed.

        Args:
            variants: Name -> options of the training.
        """
        return [
            Job(name, seed, self.task, self.vehicle, options, self.evaluate.plants, self.evaluate.trials)
            for seed in self.seeds
            for name, options in variants.items()
        ]


def _named(name: str, combination: Mapping[str, Any]) -> str:
    """Of a setting: its own name and what the grid sets, as it names a folder.

    Raises:
        SweepError: It cannot.
    """
    parts = [name] if name else []
    parts += [f"{option}-{Path(str(value)).stem}" for option, value in combination.items()]
    return plain_name("_".join(parts) or "run", "setting", SweepError)


def load_sweep(path: str | Path) -> Sweep:
    """Read a sweep file; files that it names are taken from its own folder.

    Raises:
        SweepError: It is not there, or something in it is not as expected; says where.
        PlantError: A plant that it names is not there, or wrong: told now, and not after the first training.
    """
    data = read_mapping(Path(path), SweepError, such_as="task: t1")
    try:
        data = _placed(data, Path(path).parent)
    except SweepError as error:
        raise SweepError(f"{path}: {error}") from None
    try:
        sweep = Sweep.model_validate(data)
    except ValidationError as error:
        raise SweepError(f"{path}: {first_problem(error)}") from error
    for name in sweep.evaluate.plants:
        load_plant(name)
    return sweep


def _placed(value: Any, folder: Path, key: Any = "") -> Any:
    """What a sweep file holds, with files beside it by their whole paths."""
    if isinstance(value, dict):
        return {name: _placed(item, folder, key if key in FILES else name) for name, item in value.items()}
    if isinstance(value, list):
        return [_placed(item, folder, key) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        raise SweepError(f"{key} is {value}, expected a finite number")
    beside = folder / value if isinstance(value, str) and key in FILES else None
    return str(beside.resolve()) if beside is not None and beside.is_file() else value


def play(job: Job) -> tuple[dict[str, Any], dict[str, bytes]]:
    """Train and evaluate, on whatever machine.

    Returns:
        A row of the table (results by plant, time, machine) and the files of the policy directory by name.
    """
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        out, about = Path(folder) / "policy", {"task": job.task, "vehicle": job.vehicle}
        train(out=out, seed=job.seed, console=Console(quiet=True), **about, **job.options)
        row = {"training_s": time.perf_counter() - began, "machine": socket.gethostname()}
        evaluations = (
            evaluate_controller(out, load_plant(x), trials=job.trials, **about) for x in job.plants
        )
        row["plants"] = {evaluation.result["plant"]["name"]: evaluation.result for evaluation in evaluations}
        return row, {path.name: path.read_bytes() for path in out.iterdir()}


def sweep(
    file: Path,
    *,
    out: Path,
    address: str | None = None,
    processes: Annotated[int | None, (1, None)] = None,
    progress: Progress = lambda part, text: None,
) -> dict[str, Any]:
    """Train every setting with every seed on one machine or several, and evaluate each policy; resumes.

    Exit status 3: a training failed, as the table shows.

    Example: finssim sweep sweep.yaml --out swept

    Args:
        file (FILE): Sweep file: task, seeds, settings (.yaml).
        out (DIR): Directory of the runs; existing ones are kept.
        address (ADDRESS): Ray cluster to use, HOST:PORT or auto; only this machine if not given.
        processes: Parallel trainings on this machine; one per processor if not given.
        progress: Told the share that is done.

    Returns:
        What `sweep.json` has: `rows` (name, seed, run, training_s, machine, plants; or `error`), `ok`, provenance.

    Raises:
        SweepError: The file says what cannot be.
        ClusterError: No cluster answers.
        KeyboardInterrupt: After Ctrl-C; what was finished stays.
    """
    plan, runs, began = load_sweep(file), out / "runs", time.perf_counter()
    rows: dict[str, dict[str, Any]] = {}
    screen = Console(stderr=True)
    total = len(plan.seeds) * plan.search.trials if plan.search else len(plan.jobs())

    def played(jobs: Sequence[Job]) -> list[dict[str, Any]]:
        """The rows of jobs, those that are missing after playing them."""
        for job in jobs:
            if (path := runs / job.key / ROW_FILE).is_file():
                rows[job.key] = load_result(path)
        missing = [job for job in jobs if job.key not in rows]
        if missing:
            with closing(spread(play, missing, processes, address)) as outcomes:
                for job, outcome in outcomes:
                    rows[job.key] = row = _keep(job, outcome.exception() or outcome.result(), runs)
                    progress(len(rows) / total, f"{len(rows)} of {total} trainings")
                    if not screen.is_terminal:
                        error = f": {row['error']}" if "error" in row else ""
                        screen.print(f"{len(rows)} of {total}: {job.key}{error}", highlight=False)
        return [rows[job.key] for job in jobs]

    best = _searched(plan, plan.search, played) if plan.search else None
    result = {
        "rows": list(rows.values()) if plan.search else played(plan.jobs()),
        **({"best": best} if plan.search else {}),
        "ok": all("error" not in row for row in rows.values()),
        "seconds": time.perf_counter() - began,
        "provenance": provenance(),
    }
    write_json(out / RESULT_FILE, result, tables_of(result))
    return result


def _searched(
    plan: Sweep, search: Search, played: Callable[[Sequence[Job]], list[dict[str, Any]]]
) -> dict[str, Any]:
    """Play what Optuna proposes, batch by batch; an interrupted search proposes the same again.

    Args:
        plan: Of which it is.
        search: What is proposed.
        played: Rows of jobs.

    Returns:
        The best setting: `name`, `options`, `measure`, and `value`, its mean; nothing if every training failed.

    Raises:
        SweepError: No such measure.
    """
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    direction, measure = ("minimize", search.minimise) if search.minimise else ("maximize", search.maximise)
    study = optuna.create_study(direction=direction, sampler=optuna.samplers.TPESampler(seed=plan.seeds[0]))
    space = {name: span.distribution() for name, span in search.options.items()}
    variants: dict[str, Mapping[str, Any]] = {}
    for first in range(0, search.trials, search.batch):
        proposed = [study.ask(space) for _ in range(min(search.batch, search.trials - first))]
        names = [f"try-{trial.number:04d}" for trial in proposed]
        variants |= {
            name: _with(plan.train, trial.params) for name, trial in zip(names, proposed, strict=True)
        }
        results = played(plan.jobs_of({name: variants[name] for name in names}))
        for name, trial in zip(names, proposed, strict=True):
            values = [
                _value(entry, str(measure)) for row in results if row["name"] == name
                for entry in row.get("plants", {}).values()
            ]  # fmt: skip
            failed = not values or None in values or any("error" in r for r in results if r["name"] == name)
            state = optuna.trial.TrialState.FAIL if failed else None
            study.tell(trial, None if failed else float(np.mean(np.array(values, float))), state=state)
    done = study.get_trials(states=[optuna.trial.TrialState.COMPLETE])
    if not done:
        return {}
    name = f"try-{study.best_trial.number:04d}"
    return {"name": name, "options": dict(study.best_params), "measure": measure, "value": study.best_value}


def _with(options: Mapping[str, Any], proposed: Mapping[str, Any]) -> dict[str, Any]:
    """Options of a training with what is proposed; settings.NAME goes to its learner."""
    top_level = {name: value for name, value in proposed.items() if "." not in name}
    inner = {name.partition(".")[2]: value for name, value in proposed.items() if "." in name}
    return {
        **options,
        **top_level,
        **({"settings": {**dict(options.get("settings", {})), **inner}} if inner else {}),
    }


def _value(result: Mapping[str, Any], measure: str) -> float | None:
    """A measure of an evaluation; of successes their share.

    Raises:
        SweepError: It is not measured.
    """
    have = {key: entry["value"] for key, entry in result.get("metrics", {}).items()} or {
        key: entry for key, entry in result.items() if isinstance(entry, int | float) or entry is None
    }
    if measure not in have:
        raise SweepError(f"search: no measure '{measure}'; available: {', '.join(have)}")
    value = have[measure]
    return value / result["trials"] if measure == "success" and "metrics" not in result else value


def _keep(job: Job, outcome: Any, runs: Path) -> dict[str, Any]:
    """A job's row; with its policy it is written whole or not at all."""
    about = {"name": job.name, "seed": job.seed, "run": job.key, "options": dict(job.options)}
    if isinstance(outcome, BaseException):
        return {**about, "error": f"{type(outcome).__name__}: {outcome}"}
    row, files = {**about, **outcome[0]}, outcome[1]
    with atomic_directory(runs / job.key, replaces=ROW_FILE) as folder:
        for name, content in files.items():
            (folder / plain_name(name, "file of a policy", SweepError)).write_bytes(content)
        keep_result(folder / ROW_FILE, row)
    return row


def tables_of(result: Mapping[str, Any]) -> list[Table]:
    """A row for each run and plant: its measures, or what went wrong."""
    evaluated = [entry for row in result["rows"] for entry in row.get("plants", {}).values()]
    first: dict[str, Any] = evaluated[0] if evaluated else {}
    measures = list(first.get("metrics", ())) or [
        name for name in MEASURES.get(str(first.get("task")), ()) if name in first
    ]
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
    tables = [Table(title="Sweep", heads=heads, rows=rows, left=(0, 2))]
    if best := result.get("best"):
        rows = [[name, str(value)] for name, value in best["options"].items()]
        title = f"Best: {best['name']}, {best['measure']} {best['value']:.4g}"
        tables.append(Table(title=title, heads=["option", "value"], rows=rows, left=(0, 1)))
    return tables
