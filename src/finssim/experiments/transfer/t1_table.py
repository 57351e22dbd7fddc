"""The station-keeping table: ours with intervals, the paper's beside them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from finssim.experiments.paper_results import paper_row
from finssim.experiments.results_table import COLUMNS, FORMATS, cells
from finssim.experiments.transfer.spec import Row
from finssim.experiments.transfer.table import OURS, THEIRS, Shown, mark, ours, where, with_ci

__all__ = ["t1_table"]

NOTE = (
    ". paper: its vehicle in its pool, one seed. errors: 40-60 s; e_y is vertical; "
    "success: 0.10 m on each axis and 10° for 10 s. t_s (median) and jitter are of successful trials."
)


def t1_table(result: Mapping[str, Any], known: Mapping[str, Row]) -> Shown:
    """The table of a result.

    Args:
        result: Of `transfer_experiment`.
        known: The rows by name.
    """
    rows: list[tuple[list[str], str]] = []
    for name, figures in result["rows"].items():
        row = known[name]
        figured = [with_ci(figures[key], form) for key, form in FORMATS.items()]
        rows.append(([mark(row.title, result), f"{figures['success']}/{figures['trials']}", *figured], OURS))
        if row.paper is not None:
            rows.append(([f"  paper: {row.paper}", *cells(paper_row(row.paper))], THEIRS))
    return Shown(
        title="Station keeping (T1)",
        headline=f"T1 {where(result, 'setpoints')}",
        heads=["", *COLUMNS.values()],
        rows=rows,
        note=ours(result) + NOTE,
        sentences=result["sentences"],
    )
