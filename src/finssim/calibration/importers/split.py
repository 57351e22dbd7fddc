"""One table of a long log into several, one for each trial."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.findings import finding
from finssim.calibration.importers.column_map import SplitRule
from finssim.calibration.importers.streams import Table

__all__ = ["split_table"]

Rows = NDArray[np.bool_]


def split_table(name: str, table: Table, rule: SplitRule | None) -> dict[str, Table]:
    """Name of a trial -> its part of the table, with times from 0; one part of that name without a rule.

    Raises:
        CalibrationError: The log has not what the rule goes by, or nothing is left.
    """
    if rule is None:
        return {name: table}
    pieces = {
        "phase": _by_phase,
        "gaps": _by_gaps,
        "arming": _by_arming,
        "column": _by_column,
        "windows": _by_windows,
    }[rule.by](name, table, rule)
    long_enough = {
        piece: rows
        for piece, rows in pieces.items()
        if rows.sum() >= 2 and np.ptp(table.t[rows]) >= rule.shortest
    }
    if not long_enough:
        raise CalibrationError(
            f"{name}: splitting by {rule.by} leaves no piece of {rule.shortest:g} s or more"
        )
    return {piece: _part(table, rows) for piece, rows in long_enough.items()}


def _part(table: Table, rows: Rows) -> Table:
    t = table.t[rows]
    return replace(
        table,
        start=table.start + float(t[0]),
        t=np.round(t - t[0], 6),
        channels={column: values[rows] for column, values in table.channels.items()},
        words={column: spoken[rows] for column, spoken in table.words.items()},
        findings=(*table.findings, finding("log_cut", start=t[0], end=t[-1])),
    )


def _words(name: str, table: Table, which: str, what: str) -> NDArray[np.str_]:
    if which not in table.words:
        raise CalibrationError(f"{name}: cannot be split by {which}: {what}")
    return table.words[which]


def _runs(labels: NDArray[np.str_]) -> list[tuple[str, Rows]]:
    """Stretches of equal labels in their order."""
    number = np.concatenate([[0], np.cumsum(labels[1:] != labels[:-1])])
    return [(str(labels[number == i][0]), number == i) for i in range(int(number[-1]) + 1)]


def _numbered(name: str, pieces: list[Rows]) -> dict[str, Rows]:
    digits = len(str(len(pieces)))
    return {f"{name}_{i + 1:0{digits}d}": rows for i, rows in enumerate(pieces)}


def _by_phase(name: str, table: Table, rule: SplitRule) -> dict[str, Rows]:
    """A trial begins with each baseline; without baselines, with each excitation after something else."""
    phase = _words(name, table, "phase", "no source of the map names a phase column")
    opening = "baseline" if (phase == "baseline").any() else "excitation"
    begins = (phase == opening) & np.concatenate([[True], phase[:-1] != opening])
    number = np.cumsum(begins)
    return _numbered(name, [number == i for i in range(1, int(number[-1]) + 1)] if begins.any() else [])


def _by_gaps(name: str, table: Table, rule: SplitRule) -> dict[str, Rows]:
    number = np.concatenate([[0], np.cumsum(np.diff(table.t) > rule.longest_gap)])
    return _numbered(name, [number == i for i in range(int(number[-1]) + 1)])


def _by_arming(name: str, table: Table, rule: SplitRule) -> dict[str, Rows]:
    arming = _words(name, table, "arming", "the log says nothing about arming")
    return _numbered(name, [rows for word, rows in _runs(arming) if word == "armed"])


def _by_column(name: str, table: Table, rule: SplitRule) -> dict[str, Rows]:
    labels = _words(name, table, "split", "no source of the map names a split column")
    runs = [(word, rows) for word, rows in _runs(labels) if word not in ("", "nan", "None")]
    return _numbered(name, [rows for _, rows in runs])


def _by_windows(name: str, table: Table, rule: SplitRule) -> dict[str, Rows]:
    pieces = {window: (table.t >= low) & (table.t <= high) for window, (low, high) in rule.windows.items()}
    empty = [window for window, rows in pieces.items() if not rows.any()]
    if empty:
        raise CalibrationError(
            f"{name}: window {empty[0]} is {list(rule.windows[empty[0]])} s, the log runs to {table.t[-1]:.3f} s"
        )
    return pieces
