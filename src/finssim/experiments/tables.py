"""A table as a person reads it: on a screen, as Markdown, as HTML. Rows of the paper's own are gray in each."""

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
    "Shown",
    "console_table",
    "figure_text",
    "html_of",
    "html_row",
    "markdown_of",
    "markdown_table",
    "print_shown",
]

Rows = Sequence[Sequence[str] | None]
"""Cells of each row; None: a line between two rows."""

WIDE = 160
"""Columns of a screen that has room for intervals."""


def paper(row: Sequence[str]) -> bool:
    """Whether a row is the paper's own."""
    return row[0].lstrip().startswith("paper")


def console_table(
    heads: Sequence[str], rows: Rows, *, left: Sequence[int] = (0,), whole: Sequence[int] = (), **options: Any
) -> Table:
    """A table for a console, none of whose cells is taken for markup.

    Args:
        heads: Of the columns.
        rows: Cells as text; those of the paper are gray, one named "all" is bold.
        left: Columns that are aligned to the left.
        whole: Columns whose cells are never broken.
        options: Of `rich.table.Table`.
    """
    table = Table(
        **{
            "box": box.SIMPLE_HEAD,
            "padding": (0, 1, 0, 0),
            "pad_edge": False,
            "title_justify": "left",
            **options,
        }
    )
    for k, head in enumerate(heads):
        side: Any = "left" if k in left else "right"
        table.add_column(Text(head), justify=side, overflow="fold", no_wrap=k in whole)
    for row in rows:
        if row is None:
            table.add_section()
        else:
            table.add_row(*map(Text, row), style="dim" if paper(row) else "bold" if row[0] == "all" else None)
    return table


def markdown_table(heads: Sequence[str], rows: Rows, *, left: Sequence[int] = (0,)) -> str:
    """The same on a page."""
    rule = ["---" if k in left else "--:" for k in range(len(heads))]
    return "\n".join("| " + " | ".join(line) + " |" for line in (heads, rule, *rows) if line is not None)


def html_row(cells: Sequence[str], kind: str | None = None) -> str:
    """The same in a report: one row, of a class of its own if it is the paper's."""
    kind = ("theirs" if paper(cells) else "") if kind is None else kind
    attribute = f' class="{kind}"' if kind else ""
    return f"<tr{attribute}>{''.join(f'<td>{escape(cell)}</td>' for cell in cells)}</tr>"


@dataclass(frozen=True, kw_only=True)
class Shown:
    """What a person reads of an experiment."""

    title: str
    headline: str = ""
    """The title says all if empty."""
    heads: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str
    sentences: Sequence[str] = ()


def print_shown(shown: Shown, console: Console, *, intervals: bool = False) -> None:
    """On a screen; one that is narrow shows no intervals of the table, unless they are asked for."""
    console.print(shown.headline or shown.title, highlight=False)
    rows = shown.rows
    if not intervals and console.width < WIDE:
        rows = [[re.sub(r" \[.+\]$", "", cell) for cell in row] for row in rows]
    console.print(console_table(shown.heads, rows))
    console.print(shown.note, highlight=False)
    for sentence in shown.sentences:
        console.print(f"- {sentence}", highlight=False, markup=False)


def markdown_of(shown: Shown) -> str:
    """As a page."""
    sentences = "".join(f"\n- {sentence}" for sentence in shown.sentences)
    table = markdown_table(shown.heads, shown.rows)
    headline = f"{shown.headline}\n\n" if shown.headline else ""
    return f"# {shown.title}\n\n{headline}{table}\n\n{shown.note}\n{sentences}\n"


def html_of(shown: Shown) -> str:
    """As a section of a page."""
    sentences = "".join(f"<li>{escape(sentence)}</li>" for sentence in shown.sentences)
    return (
        f"<h2>{escape(shown.title)}</h2><p>{escape(shown.headline)}</p>"
        f"{html_table(shown.heads, [html_row(row) for row in shown.rows])}"
        f'<p class="note">{escape(shown.note)}</p><ul>{sentences}</ul>'
    )


def figure_text(figure: Mapping[str, Any] | None, form: str, factor: float = 1.0) -> str:
    """A figure and its interval as text; – where there is none."""
    if figure is None or figure["value"] is None:
        return "–"
    value, low, high = (factor * x for x in (figure["value"], *figure["ci95"]))
    return f"{value:{form}} [{low:{form}}, {high:{form}}]"
