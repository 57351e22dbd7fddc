"""A table as a person reads it: on a screen, as Markdown, as HTML. Rows of the paper's own are gray in each."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

import rich.table
from rich import box
from rich.console import Console
from rich.text import Text

from finssim.core.page import html_picture, html_table

Rows = Sequence[Sequence[str] | None]
"""Cells of each row; None: a line between two rows."""

WIDE = 160
"""Columns of a screen that has room for intervals."""


def paper(row: Sequence[str]) -> bool:
    """Return whether a row is the paper's own."""
    return row[0].lstrip().startswith("paper")


def console_table(
    heads: Sequence[str], rows: Rows, *, left: Sequence[int] = (0,), whole: Sequence[int] = (), **options: Any
) -> rich.table.Table:
    """A table for a console, none of whose cells is taken for markup.

    Args:
        heads: Of the columns.
        rows: Cells as text; those of the paper are gray, one named "all" is bold.
        left: Columns that are aligned to the left.
        whole: Columns whose cells are never broken.
        options: Of `rich.table.Table`.
    """
    table = rich.table.Table(
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
    """Return the table as Markdown."""
    rule = ["---" if k in left else "--:" for k in range(len(heads))]
    lines = ([head.replace("\n", " ") for head in heads], rule, *rows)
    return "\n".join("| " + " | ".join(line) + " |" for line in lines if line is not None)


@dataclass(frozen=True, kw_only=True)
class Table:
    """Table of an experiment with its text, or the text alone."""

    title: str
    headline: str = ""
    """Headline; the title is used if empty."""
    heads: Sequence[str] = ()
    rows: Rows = ()
    note: str = ""
    sentences: Sequence[str] = ()
    left: Sequence[int] = (0,)
    """Columns that are aligned to the left."""
    whole: Sequence[int] = ()
    """Columns whose cells are never broken on a screen."""
    intervals: bool = False
    """True if a narrow screen shows the intervals of cells too."""
    pictures: Mapping[str, str] = field(default_factory=dict)
    """File beside the page -> what it shows."""

    def __str__(self) -> str:
        return markdown_of([self])

    def _repr_html_(self) -> str:
        return "".join(html_of([self], Path()))


def print_tables(tables: Sequence[Table], console: Console) -> None:
    """Print tables on a screen; one that is narrow shows no intervals, unless the table asks for them."""
    for table in tables:
        if text := table.headline or table.title:
            console.print(Text(text, style="" if table.headline or len(tables) == 1 else "bold"))
        rows: Rows = table.rows
        if not table.intervals and console.width < WIDE:
            rows = [row and [re.sub(r" \[.+\]$", "", cell) for cell in row] for row in rows]
        if rows:
            console.print(console_table(table.heads, rows, left=table.left, whole=table.whole))
        if table.note:
            console.print(Text(table.note))
        for sentence in table.sentences:
            console.print(Text(f"- {sentence}"))


def markdown_of(tables: Sequence[Table]) -> str:
    """The page of some tables."""
    parts = []
    for k, table in enumerate(tables):
        parts += [f"{'##' if k else '#'} {table.title[:1].upper()}{table.title[1:]}", table.headline]
        parts.append(markdown_table(table.heads, table.rows, left=table.left) if table.rows else "")
        parts += [table.note, "\n".join(f"- {sentence}" for sentence in table.sentences)]
        parts += [f"![{text}]({file})" for file, text in table.pictures.items()]
    return "\n\n".join(filter(None, parts)) + "\n"


def html_of(tables: Sequence[Table], folder: Path) -> list[str]:
    """Sections of a page; pictures that are in the folder are inside them."""
    parts = []
    for table in tables:
        parts += [f"<h2>{escape(table.title)}</h2>", f"<p>{escape(table.headline)}</p>"]
        rows = []
        for row in filter(None, table.rows):
            kind = ' class="theirs"' if paper(row) else ""
            rows.append(f"<tr{kind}>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>")
        parts.append(html_table(table.heads, rows) if rows else "")
        sentences = "".join(f"<li>{escape(sentence)}</li>" for sentence in table.sentences)
        parts.append(f'<p class="note">{escape(table.note)}</p><ul>{sentences}</ul>')
        parts += [
            html_picture((folder / file).read_bytes(), text)
            for file, text in table.pictures.items()
            if (folder / file).is_file()
        ]
    return parts


Columns = Mapping[str, tuple[str, str] | tuple[str, str, float]]
"""Key of a result -> heading, format, and a factor where its unit is another; without a format it is a count of trials.
"""


def figure_text(figure: Mapping[str, Any] | float | None, form: str, factor: float = 1.0) -> str:
    """A figure as text, with its interval in brackets where it has one; – where there is none.

    `factor` takes the unit of the figure to that of the text.
    """
    value = figure["value"] if isinstance(figure, Mapping) else figure
    if value is None:
        return "–"
    bounds = figure["ci95"] if isinstance(figure, Mapping) else ()
    numbers = ["–" if x is None else format(factor * x, form) for x in (value, *bounds)]
    return f"{numbers[0]} [{numbers[1]}, {numbers[2]}]" if numbers[1:] else numbers[0]


def cells(row: Mapping[str, Any], columns: Columns) -> list[str]:
    """A row's figures as text, in the order of the columns.

    A column has a heading with its unit, a format, and a factor.
    """
    return [
        figure_text(row.get(key), *form) if form[0] else f"{row[key]}/{row['trials']}" if key in row else ""
        for key, (_, *form) in columns.items()
    ]
