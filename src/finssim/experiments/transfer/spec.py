"""What an experiment in the virtual pool consists of, as data: rows, trainings, targets and figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from finssim.experiments.transfer.intervals import Statistic
from finssim.experiments.transfer.policies import Training
from finssim.experiments.transfer.table import Shown

__all__ = ["Row", "Spec"]


@dataclass(frozen=True, kw_only=True)
class Row:
    """One row of a table: who steers and what is taken from it."""

    title: str
    training: str | None = None
    """Name of what is trained; None for a PID."""
    controller: str = ""
    """Name of the PID."""
    changes: dict[str, Any] = field(default_factory=dict)
    """Fields of its jobs."""
    paper: str | None = None
    """Row of the paper's table; None where it has none."""
    module: str = ""
    """What the row takes away or puts in place of the reference, as a sentence begins."""


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
    """Keys in which rows are compared."""
    paper_differences: Callable[[str | None, str | None], dict[str, float] | None]
    """Rows of the paper's table -> key of `differences` -> first less second; None where it has not both."""
    shown: Callable[[Mapping[str, Any]], Shown]
    """The table of a result."""
    draw: Callable[[Mapping[str, list[dict[str, Any]]], Path], Path | None]
    """Draws the results of the rows into the folder."""
