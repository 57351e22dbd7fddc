"""A sweep as a person reads it: a row for every run and plant."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from finssim.experiments.compare.scores import MEASURES

__all__ = ["print_sweep", "rows_of", "table_of"]


def rows_of(result: Mapping[str, Any]) -> list[list[str]]:
    """The heads, then a row for each run and plant: its measures, or what went wrong."""
    done = [row for row in result["rows"] if "error" not in row]
    first = next(iter(done[0]["plants"].values())) if done else {}
    measures = _measures(first)
    rows = [["run", "seed", "plant", "time [s]", *measures]]
    for row in result["rows"]:
        if "error" in row:
            rows.append(
                [
                    row["name"],
                    str(row["seed"]),
                    "–",
                    "–",
                    *([row["error"]] if measures else []),
                    *[""] * (len(measures) - 1),
                ]
            )
            continue
        for plant, found in row["plants"].items():
            cells = [_cell(found, measure) for measure in measures]
            rows.append([row["name"], str(row["seed"]), plant, f"{row['training_s']:.0f}", *cells])
    return rows


def _measures(result: Mapping[str, Any]) -> list[str]:
    if "metrics" in result:
        return list(result["metrics"])
    return [name for name in MEASURES.get(str(result.get("task")), ()) if name in result]


def _cell(result: Mapping[str, Any], measure: str) -> str:
    if "metrics" in result:
        value = result["metrics"][measure]["value"]
    elif measure == "success":
        return f"{result['success']}/{result['trials']}"
    else:
        value = result[measure]
    return "–" if value is None else f"{value:.4g}"


def print_sweep(result: Mapping[str, Any], console: Console) -> None:
    """Print the table."""
    heads, *rows = rows_of(result)
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    for k, head in enumerate(heads):
        table.add_column(Text(head), justify="left" if k in (0, 2) else "right", overflow="fold")
    for row in rows:
        table.add_row(*map(Text, row))
    console.print(table)


def table_of(result: Mapping[str, Any]) -> str:
    """The table as Markdown."""
    heads, *rows = rows_of(result)
    lines = [heads, ["---"] * len(heads), *rows]
    return "# Sweep\n\n" + "\n".join("| " + " | ".join(line) + " |" for line in lines)
