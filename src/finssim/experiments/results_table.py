"""Results of station keeping as a person reads them, with the paper's own beside them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from finssim.experiments.metrics import summarize
from finssim.experiments.paper_results import paper_row

__all__ = ["COLUMNS", "cells", "paper_name", "print_comparison", "print_plants", "print_results"]

COLUMNS = {
    "success": "success",
    "e_p_m": "e_p [m]",
    "e_y_m": "e_y [m]",
    "e_psi_deg": "e_psi [°]",
    "t_s_s": "t_s [s]",
    "J_p_m": "J_p [m]",
    "J_psi_deg": "J_psi [°]",
}
"""Key of a result -> its heading, with the paper's names: e_y is the vertical error."""

FORMATS = {
    "e_p_m": ".4f",
    "e_y_m": ".4f",
    "e_psi_deg": ".2f",
    "t_s_s": ".1f",
    "J_p_m": ".3f",
    "J_psi_deg": ".2f",
}


CAPTION = (
    "errors: 40-60 s. success: 0.10 m on each axis and 10° for 10 s; t_s: when the first such 10 s begin."
)


def cells(row: Mapping[str, Any]) -> list[str]:
    """A row's figures as text, in the order of `COLUMNS`; – where there is none."""
    figures = [f"{row['success']}/{row['trials']}"]
    return figures + ["–" if row[key] is None else format(row[key], spec) for key, spec in FORMATS.items()]


def paper_name(result: Mapping[str, Any]) -> str:
    """The row of the paper's table that is nearest to what was evaluated."""
    controller = result["controller"]
    if controller["kind"] == "pid":
        return "PID"
    if result["plant"]["name"] == "noise" and controller["hydrodynamics"] == "calibrated":
        return "calibrated, localisation noise"
    return f"{controller['hydrodynamics']}{' + DR' if controller.get('randomization') else ''}"


def print_results(result: Mapping[str, Any], console: Console) -> None:
    """Print the table of one evaluation."""
    plant = result["plant"]
    console.print(
        f"{result['task']} · {result['controller']['name']} · {result['vehicle']['name']}, {result['hydrodynamics']}"
        f" · plant {plant['name']}: {plant.get('title', '')}",
        highlight=False,
    )
    paper = paper_name(result)
    table = _table("setpoint")
    trials = result["per_trial"]
    for name in sorted({trial["setpoint"] for trial in trials}):
        table.add_row(name, *cells(summarize([trial for trial in trials if trial["setpoint"] == name])))
    table.add_section()
    table.add_row("all", *cells(result), style="bold")
    table.add_section()
    table.add_row("paper", *cells(paper_row(paper)), style="dim")
    console.print(table)
    console.print(f"{CAPTION} paper: its vehicle in its pool, {paper}, for orientation.", highlight=False)


def print_plants(results: Sequence[Mapping[str, Any]], console: Console) -> None:
    """Print a row for each plant that one controller was evaluated in, and the paper's rows."""
    first = results[0]
    console.print(
        f"{first['task']} · {first['controller']['name']} · {first['vehicle']['name']}", highlight=False
    )
    print_comparison(results, console, by="plant")


def print_comparison(results: Sequence[Mapping[str, Any]], console: Console, by: str = "controller") -> None:
    """Print a row for each evaluation, named by its controller or plant, and the paper's rows that answer to them."""
    table = _table(by)
    for result in results:
        table.add_row(result[by]["name"], *cells(result))
    table.add_section()
    for name in dict.fromkeys(paper_name(result) for result in results):
        table.add_row(f"paper, {name}", *cells(paper_row(name)), style="dim")
    console.print(table)
    console.print(f"{CAPTION} paper: its real vehicle in its pool.", highlight=False)


def _table(first: str) -> Table:
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    table.add_column(first, no_wrap=True)
    for heading in COLUMNS.values():  # units below: 80 columns of a terminal are enough then
        table.add_column(Text(heading.replace(" [", "\n[")), justify="right", no_wrap=True)
    return table
