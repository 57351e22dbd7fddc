"""The trajectory-tracking table: ours with intervals, the paper's beside them, trajectory by trajectory."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from finssim.experiments.paper_results import PAPER_T2
from finssim.experiments.transfer.spec import Row
from finssim.experiments.transfer.table import OURS, THEIRS, Shown, mark, ours, where, with_ci

__all__ = ["t2_table"]

COLUMNS = {
    "horizontal_rmse_m": "horizontal RMSE [m]",
    "vertical_rmse_m": "vertical RMSE [m]",
    "p95_m": "3-D P95 [m]",
}

NOTE = "; done: trials that reached the end. paper: its vehicle in its pool."


def t2_table(result: Mapping[str, Any], known: Mapping[str, Row]) -> Shown:
    """The table of a result.

    Args:
        result: Of `transfer_experiment`.
        known: The rows by name.
    """
    rows: list[tuple[list[str], str]] = []
    for name, figures in result["rows"].items():
        for target, one in figures["by_target"].items():
            figured = [with_ci(one[key], ".3f") for key in COLUMNS]
            rows.append(
                (
                    [mark(known[name].title, result), target, f"{one['success']}/{one['trials']}", *figured],
                    OURS,
                )
            )
            paper = PAPER_T2.get(known[name].paper or "", {}).get(target)
            if paper is not None:
                theirs = [f"{value:.3f}" for value in paper]
                rows.append(([f"  paper: {known[name].paper}", target, "", *theirs], THEIRS))
    return Shown(
        title="Trajectory tracking (T2)",
        headline=f"T2 {where(result, 'trajectories')}",
        heads=["", "trajectory", "done", *COLUMNS.values()],
        rows=rows,
        note=ours(result) + NOTE,
        sentences=result["sentences"],
    )
