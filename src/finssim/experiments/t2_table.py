"""Results of trajectory tracking as a person reads them, with the paper's own beside them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from finssim.experiments.paper_results import PAPER_T2, paper_t2_row
from finssim.experiments.t2_metrics import ERRORS, summarize_tracking

__all__ = ["by_trajectory", "print_tracking", "print_tracking_plants"]

COLUMNS = {
    "horizontal_rmse_m": ("horiz. [m]", ".4f"),
    "vertical_rmse_m": ("vert. [m]", ".4f"),
    "p95_m": ("P95 [m]", ".4f"),
    "cross_track_rmse_m": ("across [m]", ".4f"),
    "completion": ("way", ".0%"),
    "max_tilt_deg": ("tilt [°]", ".1f"),
}
"""Key of a result -> its heading and format."""

CAPTION = (
    "horiz., vert.: RMSE against the reference at the same time. P95: its distance is less for 95 % of the time. "
    "across: RMS distance to the way."
)


def by_trajectory(trials: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """A row for each trajectory, in the order in which they were followed first."""
    names = dict.fromkeys(str(trial["trajectory"]) for trial in trials)
    return {name: summarize_tracking([x for x in trials if x["trajectory"] == name]) for name in names}


def paper_kind(result: Mapping[str, Any]) -> str:
    """The rows of the paper's table that are nearest to what was evaluated."""
    controller = result["controller"]
    if controller["kind"] == "pid":
        return "PID"
    return "calibrated + DR" if controller.get("randomization") else "calibrated"


def print_tracking(result: Mapping[str, Any], console: Console) -> None:
    """Print the table of one evaluation: a row for each trajectory, and the paper's."""
    plant = result["plant"]
    console.print(
        f"{result['task']} · {result['controller']['name']} · {result['vehicle']['name']}, {result['hydrodynamics']}"
        f" · plant {plant['name']}: {plant.get('title', '')}",
        highlight=False,
    )
    kind = paper_kind(result)
    table = _table("trajectory")
    for name, row in by_trajectory(result["per_trial"]).items():
        table.add_row(name, *_cells(row))
    table.add_section()
    table.add_row("all", *_cells(result), style="bold")
    table.add_section()
    for name in PAPER_T2[kind]:
        table.add_row(f"paper, {name}", *_cells(paper_t2_row(kind, name)), style="dim")
    console.print(table)
    console.print(f"{CAPTION} paper: its vehicle in its pool, {kind}, for orientation.", highlight=False)


def print_tracking_plants(results: Sequence[Mapping[str, Any]], console: Console) -> None:
    """Print a row for each plant and trajectory."""
    first = results[0]
    console.print(
        f"{first['task']} · {first['controller']['name']} · {first['vehicle']['name']}", highlight=False
    )
    table = _table("plant, trajectory")
    for result in results:
        for name, row in by_trajectory(result["per_trial"]).items():
            table.add_row(f"{result['plant']['name']}, {name}", *_cells(row))
        table.add_section()
    console.print(table)
    console.print(CAPTION, highlight=False)


def _cells(row: Mapping[str, Any]) -> list[str]:
    """A row's figures as text; – where there is none."""
    return ["–" if row.get(key) is None else format(row[key], spec) for key, (_, spec) in COLUMNS.items()]


def _table(first: str) -> Table:
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    table.add_column(first, no_wrap=True)
    for key, (heading, _) in COLUMNS.items():
        style = "bold" if key in ERRORS else ""
        table.add_column(Text(heading), justify="right", style=style, no_wrap=True)
    return table
