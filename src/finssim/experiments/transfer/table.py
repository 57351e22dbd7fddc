"""A table of ours with the paper's rows beside them: on a screen, as Markdown, as HTML."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from finssim.page import html_table

__all__ = [
    "OURS",
    "THEIRS",
    "Shown",
    "html_of",
    "mark",
    "markdown_of",
    "ours",
    "print_shown",
    "where",
    "with_ci",
]

OURS, THEIRS = "ours", "theirs"
"""Whose a row is: measured in the virtual pool, or the paper's on hardware."""


WIDE = 160
"""Columns of a screen that has room for intervals."""


@dataclass(frozen=True, kw_only=True)
class Shown:
    """What a person reads of an experiment."""

    title: str
    headline: str
    heads: Sequence[str]
    rows: Sequence[tuple[Sequence[str], str]]
    """Cells, and whose they are."""
    note: str
    sentences: Sequence[str] = ()


def print_shown(shown: Shown, console: Console) -> None:
    """On a screen; one that is narrow shows no intervals of the table."""
    console.print(shown.headline, highlight=False)
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    for k, head in enumerate(shown.heads):
        table.add_column(Text(head), justify="right" if k else "left")
    for row, whose in shown.rows:
        cells = row if console.width >= WIDE else [re.sub(r" \[.+\]$", "", cell) for cell in row]
        table.add_row(*map(Text, cells), style="dim" if whose == THEIRS else None)
    console.print(table)
    console.print(shown.note, highlight=False)
    for sentence in shown.sentences:
        console.print(f"- {sentence}", highlight=False)


def markdown_of(shown: Shown) -> str:
    """As a page."""
    lines = [shown.heads, ["---"] + ["--:"] * (len(shown.heads) - 1), *(row for row, _ in shown.rows)]
    table = "\n".join("| " + " | ".join(line) + " |" for line in lines)
    sentences = "".join(f"\n- {sentence}" for sentence in shown.sentences)
    return f"# {shown.title}\n\n{shown.headline}\n\n{table}\n\n{shown.note}\n{sentences}\n"


def html_of(shown: Shown) -> str:
    """As a section of a page."""
    rows = []
    for cells, whose in shown.rows:
        kind = ' class="theirs"' if whose == THEIRS else ""
        rows.append(f"<tr{kind}>{''.join(f'<td>{escape(cell)}</td>' for cell in cells)}</tr>")
    sentences = "".join(f"<li>{escape(sentence)}</li>" for sentence in shown.sentences)
    return (
        f"<h2>{escape(shown.title)}</h2><p>{escape(shown.headline)}</p>{html_table(shown.heads, rows)}"
        f'<p class="note">{escape(shown.note)}</p><ul>{sentences}</ul>'
    )


def where(result: Mapping[str, Any], what: str) -> str:
    """In what an experiment was played, and with which vehicle."""
    plants, seeds = len(result["plants"]), len(result["seeds"])
    of = f"{what}: {len(result['targets'])}; {result['vehicle']['name']} {result['vehicle']['sha256'][:12]}"
    if result.get("robot"):
        return f"on hardware, robot {result['robot']}, by its own estimate; seeds: {seeds}, {of}"
    pool = f"severity {result['severity']}, camera {result['camera']}; plants: {plants}"
    return f"in the virtual pool, {pool}, seeds: {seeds}, {of}"


def ours(result: Mapping[str, Any]) -> str:
    """What our rows are, as a note begins."""
    if result.get("robot"):
        return (
            "ours: hardware, by the robot's own estimate, whose error is not in it; mean, in brackets 95 % from a "
            "bootstrap of seeds"
        )
    return (
        "ours: a virtual pool whose vehicle, water and camera no training has seen; mean, in brackets 95 % from a "
        "bootstrap of plants and seeds"
    )


def mark(title: str, result: Mapping[str, Any]) -> str:
    """The title of a row of ours; on hardware it says so."""
    return f"{title}, hardware" if result.get("robot") else title


def with_ci(figure: Mapping[str, Any] | None, form: str, factor: float = 1.0) -> str:
    """A figure and its interval as text; – where there is none."""
    if figure is None:
        return "–"
    value, low, high = (factor * x for x in (figure["value"], *figure["ci95"]))
    return f"{value:{form}} [{low:{form}}, {high:{form}}]"
