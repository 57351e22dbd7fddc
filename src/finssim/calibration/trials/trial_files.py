"""Trials on disk: a folder with `trial.yaml` and `data.csv` or `data.parquet`, or a bare table."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Literal

from finssim.calibration.errors import CalibrationError
from finssim.calibration.trials.header import Header
from finssim.calibration.trials.header_file import header_text, read_header
from finssim.calibration.trials.table_file import read_table, write_table
from finssim.calibration.trials.trial import Trial
from finssim.calibration.trials.trial_table import trial_from_table
from finssim.files import OutputError, atomic_directory

__all__ = ["load_trial", "load_trials", "trials_at", "write_trial"]

HEADER = "trial.yaml"
DATA = ("data.csv", "data.parquet")
SUFFIXES = (".csv", ".parquet")


def load_trial(path: str | os.PathLike[str]) -> Trial:
    """Read one trial.

    Args:
        path: A folder with `data.csv` or `data.parquet` and, if it has one, `trial.yaml`; or a table alone.

    Raises:
        CalibrationError: There is no trial, or one that cannot be used; the message says where and why. What could be
            repaired is told in the trial's `notes` instead.
    """
    path = Path(path)
    name, data, header_path = _locate(path)
    header = read_header(header_path) if header_path else Header()
    table = read_table(data)
    try:
        return trial_from_table(name, table, header, path)
    except CalibrationError as error:
        shown = header_path if header_path and str(error).startswith("convert") else data
        raise CalibrationError(f"{shown}: {error}") from None


def load_trials(paths: Iterable[str | os.PathLike[str]]) -> list[Trial]:
    """Read several trials under unique names, in the order given.

    Args:
        paths: Each a trial, or a folder that holds trials.

    Raises:
        CalibrationError: One cannot be used, there are none, or one is there twice.
    """
    found = [trial for path in paths for trial in trials_at(Path(path))]
    trials = [load_trial(path) for path in found]
    seen: dict[str, Path] = {}
    for path, trial in zip(found, trials, strict=True):
        first = seen.setdefault(trial.sha256, path)
        if first is not path:
            raise CalibrationError(
                f"{path}: holds the same numbers as {first}: a trial given twice would count as two measurements; "
                "leave one out"
            )
    if not trials:
        raise CalibrationError(
            "no trial given: give folders that hold data.csv or data.parquet, or such files"
        )
    names = _unique_names(trials, found)
    return [
        replace(trial, name=name) if name != trial.name else trial
        for trial, name in zip(trials, names, strict=True)
    ]


def write_trial(
    trial: Trial, folder: str | os.PathLike[str], *, format: Literal["csv", "parquet"] = "csv"
) -> None:
    """Write a trial as a folder of `trial.yaml` and data that reads back with the same `sha256`.

    Args:
        trial: In canonical columns; conversions of its header are done and not written.
        folder: New or empty, or an earlier trial of ours, which is replaced.
        format: Of the data.

    Raises:
        CalibrationError: An unknown format.
        OutputError: The folder holds other files, or cannot be written.
    """
    if format not in ("csv", "parquet"):
        raise CalibrationError(f"format is '{format}', expected csv or parquet")
    target = Path(folder)
    if target.is_dir():
        other = sorted({file.name for file in target.iterdir()} - {HEADER, *DATA})
        if other:
            raise OutputError(
                f"cannot write {folder}: the directory holds other files ({other[0]}): give a new one"
            )
    with atomic_directory(target, replaces=HEADER) as temporary:
        (temporary / HEADER).write_text(header_text(trial.header), encoding="utf-8")
        write_table(temporary / f"data.{format}", {"t": trial.t, **trial.channels}, trial.phase)


def _locate(path: Path) -> tuple[str, Path, Path | None]:
    """Name, data file and header file of the trial at a path."""
    if path.name in (HEADER, *DATA) and path.is_file():
        path = path.parent
    if path.is_dir():
        data = [path / file for file in DATA if (path / file).is_file()]
        if len(data) != 1:
            found = "both data.csv and data.parquet" if data else "neither data.csv nor data.parquet"
            raise CalibrationError(f"{path}: holds {found}, expected one of them")
        header = path / HEADER
        return path.resolve().name, data[0], header if header.exists() else None
    if not path.exists():
        raise CalibrationError(
            f"{path}: no such file or folder: give a trial's folder, .csv or .parquet file"
        )
    if path.suffix.lower() not in SUFFIXES:
        raise CalibrationError(
            f"{path}: is no trial: expected a folder with data.csv or data.parquet, or such a file; "
            "other logs are converted by 'finssim trials import'"
        )
    return path.stem, path, None


def trials_at(path: Path) -> list[Path]:
    """The trial at a path, or those in the folder there, in natural order of their names."""
    if not path.is_dir() or any((path / file).is_file() for file in DATA):
        return [path]
    inside = [item for item in path.iterdir() if not item.name.startswith(".")]
    trials = [
        item
        for item in inside
        if (item.is_dir() and any((item / file).is_file() for file in DATA))
        or (item.is_file() and item.suffix.lower() in SUFFIXES)
    ]
    if not trials:
        raise CalibrationError(
            f"{path}: holds no trial: expected data.csv or data.parquet in it or in folders of it"
        )
    return sorted(trials, key=lambda item: [int(w) if w.isdigit() else w for w in _words(item.name)])


def _words(name: str) -> list[str]:
    return re.split(r"(\d+)", name)


def _unique_names(trials: list[Trial], paths: list[Path]) -> list[str]:
    """Names of the trials; equal ones get as many of their parent folders as tells them apart."""
    names = [trial.name for trial in trials]
    parents = [list(path.resolve().parts[-2::-1]) for path in paths]
    depth = 0
    while len(set(names)) < len(names) and depth < max(len(p) for p in parents):
        twice = {name for name in names if names.count(name) > 1}
        names = [
            f"{p[depth]}/{name}" if name in twice and depth < len(p) else name
            for name, p in zip(names, parents, strict=True)
        ]
        depth += 1
    return [
        name if name not in names[:i] else f"{name} ({names[:i].count(name) + 1})"
        for i, name in enumerate(names)
    ]
