"""What a sweep file asks for, and the jobs that it makes."""

from __future__ import annotations

import hashlib
import inspect
import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from finssim.experiments.plants import load_plant
from finssim.files import plain_name
from finssim.learning.train import train
from finssim.tasks import TASKS
from finssim.yaml_file import read_mapping

__all__ = ["Job", "Sweep", "SweepError", "load_sweep"]

SAME_FOR_ALL = ("task", "out", "seed", "console", "shown", "interrupted", "resume", "device", "vehicle")
"""Arguments of a training that a sweep sets itself."""
FILES = ("randomize",)
"""Settings that may name a file."""


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

        Those of a setting differ in the number at their end alone, so that `finssim compare` takes them together.
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
    evaluate: Evaluate = Evaluate()

    @field_validator("seeds", mode="before")
    @classmethod
    def _counted(cls, value: Any) -> Any:
        return tuple(range(1, value + 1)) if isinstance(value, int) and not isinstance(value, bool) else value

    @model_validator(mode="after")
    def _known(self) -> Sweep:
        if self.task not in TASKS:
            raise ValueError(f"task is '{self.task}', expected one of {', '.join(TASKS)}")
        if not self.seeds or len(set(self.seeds)) < len(self.seeds):
            raise ValueError(f"seeds are {list(self.seeds)}, expected at least one, each once")
        known = [name for name in inspect.signature(train).parameters if name not in SAME_FOR_ALL]
        for options in (self.train, self.grid, *self.settings.values()):
            for name in options:
                if name not in known:
                    raise ValueError(f"'{name}' is no option of a training; available: {', '.join(known)}")
        return self

    def jobs(self) -> list[Job]:
        """Every setting with every seed; seed by seed, so that each setting has some results early."""
        combinations = [dict(zip(self.grid, values, strict=True)) for values in product(*self.grid.values())]
        variants = [
            (_named(name, combination), {**self.train, **own, **combination})
            for name, own in (self.settings or {"": {}}).items()
            for combination in combinations
        ]
        return [
            Job(name, seed, self.task, self.vehicle, options, self.evaluate.plants, self.evaluate.trials)
            for seed in self.seeds
            for name, options in variants
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
        sweep = Sweep.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        text = first["msg"].removeprefix("Value error, ")
        raise SweepError(f"{path}: {where + ': ' if where else ''}{text}") from error
    sweep = _with_paths(sweep, Path(path).parent)
    for name in sweep.evaluate.plants:
        load_plant(name)
    return sweep


def _with_paths(sweep: Sweep, folder: Path) -> Sweep:
    def placed(options: dict[str, Any]) -> dict[str, Any]:
        return {name: _place(value, folder) if name in FILES else value for name, value in options.items()}

    return sweep.model_copy(
        update={
            "vehicle": _place(sweep.vehicle, folder),
            "train": placed(sweep.train),
            "settings": {name: placed(options) for name, options in sweep.settings.items()},
            "grid": {
                name: [_place(value, folder) for value in values] if name in FILES else values
                for name, values in sweep.grid.items()
            },
            "evaluate": sweep.evaluate.model_copy(
                update={"plants": tuple(_place(name, folder) for name in sweep.evaluate.plants)}
            ),
        }
    )


def _place(value: Any, folder: Path) -> Any:
    """A file beside the sweep file by its whole path; anything else as it is."""
    beside = folder / value if isinstance(value, str) else None
    return str(beside.resolve()) if beside is not None and beside.is_file() else value
