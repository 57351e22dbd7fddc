"""Trainings that are compared: policy directories, put together into groups that differ in the seed alone."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.control.policy import Policy
from finssim.control.policy_description import PolicyDescription
from finssim.tasks import TASKS

__all__ = ["CompareError", "Group", "Run", "groups_of"]

CURVES_FILE = "curves.csv"
SEED_AT_END = re.compile(r"[-_]?(?:seed|s)?[-_]?\d+$")
NOT_SETTINGS = ("steps_done", "complete", "seconds", "resumed")
"""Of a training's record: what tells how it went."""


class CompareError(ValueError):
    """Trainings that cannot be compared."""


@dataclass(frozen=True)
class Run:
    """One training."""

    place: Path
    description: PolicyDescription
    curves: dict[str, NDArray[np.float64]]
    """Columns of `curves.csv`; empty if it has none."""

    @property
    def seed(self) -> int:
        """Of the training."""
        return self.description.seed

    @property
    def seconds(self) -> float | None:
        """How long it trained [s]."""
        column = self.curves.get("seconds")
        return None if column is None or not len(column) else float(column[-1])


@dataclass(frozen=True)
class Group:
    """Trainings with equal settings and different seeds."""

    name: str
    runs: tuple[Run, ...]


def groups_of(words: Sequence[str]) -> list[Group]:
    """Load runs and put them together.

    Args:
        words: Policy directories, each `DIR` or `NAME=DIR`; without a name, that of the folder less a number at its end
            (`hold-seed3` belongs to `hold`).

    Raises:
        CompareError: Two runs of a name differ in more than the seed, or have one seed; no run is given, or they do
            different tasks.
        PolicyError: A directory is no policy.
    """
    if not words:
        raise CompareError("no run is given: name policy directories, each DIR or NAME=DIR")
    named: dict[str, list[Run]] = {}
    for word in words:
        name, given, place = word.rpartition("=")
        folder = Path(place)
        if not given:
            name = SEED_AT_END.sub("", folder.resolve().name) or folder.resolve().name
        named.setdefault(name, []).append(_load(folder))
    tasks = {run.description.task for runs in named.values() for run in runs}
    if len(tasks) > 1:
        raise CompareError(f"runs were trained for {', '.join(sorted(tasks))}: compare those of one task")
    if not tasks <= TASKS.keys():
        # FILE.py:CLASS in somebody's policy.yaml would be code to run.
        raise CompareError(
            f"runs were trained for {tasks.pop()!r}, expected one of {', '.join(TASKS)}: policies of other tasks "
            "are evaluated one by one, with finssim evaluate --task FILE.py:CLASS"
        )
    for name, runs in named.items():
        _check(name, runs)
    return [Group(name, tuple(sorted(runs, key=lambda run: run.seed))) for name, runs in named.items()]


def _load(folder: Path) -> Run:
    return Run(folder, Policy.load(folder).description, _curves(folder / CURVES_FILE))


def _curves(path: Path) -> dict[str, NDArray[np.float64]]:
    if not path.is_file():
        return {}
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    names = rows[0] if rows else ()
    try:
        return {name: np.array([float(row[name] or "nan") for row in rows]) for name in names}
    except (TypeError, ValueError) as error:
        raise CompareError(
            f"{path}: a cell is no number ({error}): expected the curves of a training"
        ) from error


def _check(name: str, runs: Sequence[Run]) -> None:
    first = runs[0]
    for run in runs[1:]:
        different = _difference(first.description, run.description)
        if different:
            raise CompareError(
                f"{first.place} and {run.place} are both '{name}', but differ in {different}: "
                "name them apart with NAME=DIR"
            )
    seeds = [run.seed for run in runs]
    for seed in seeds:
        if seeds.count(seed) > 1:
            raise CompareError(f"'{name}' has two runs with seed {seed}: give each training once")


def _difference(a: PolicyDescription, b: PolicyDescription) -> str:
    """The first setting in which two trainings differ; empty if none."""
    left, right = (_settings(description) for description in (a, b))
    for key in {**left, **right}:
        if left.get(key) != right.get(key):
            return key
    return ""


def _settings(description: PolicyDescription) -> dict[str, Any]:
    training = {k: v for k, v in description.training.items() if k not in NOT_SETTINGS}
    return {
        "task": description.task,
        "action": description.action,
        "vehicle": description.vehicle.sha256,
        "hydrodynamics": description.hydrodynamics,
        **training,
    }
