"""Tables for terminals, Markdown and HTML. Rows from the paper are gray in each."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from pathlib import Path
from typing import Any

import rich.table
from rich import box
from rich.console import Console
from rich.text import Text

from finssim.core.files import atomic_write
from finssim.core.page import html_code, html_page, html_picture, html_section, html_table

Rows = Sequence[Sequence[str] | None]
"""Cells of each row; None is a separator between two rows."""

WIDE = 160
"""Terminal width from which intervals are shown [columns]."""


def paper(row: Sequence[str]) -> bool:
    """Return whether a row is from the paper."""
    return row[0].lstrip().startswith("paper")


def console_table(
    heads: Sequence[str], rows: Rows, *, left: Sequence[int] = (0,), whole: Sequence[int] = (), **options: Any
) -> rich.table.Table:
    """Return a table for a console, whose cells are not interpreted as markup.

    Args:
        heads: Headings of the columns.
        rows: Cells as text; those from the paper are gray, one named "all" is bold.
        left: Left-aligned columns.
        whole: Columns whose cells are never wrapped.
        options: Options of `rich.table.Table`.
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
    """Table of an experiment with its text, or text alone."""

    title: str
    headline: str = ""
    """Headline; the title is used if empty."""
    heads: Sequence[str] = ()
    rows: Rows = ()
    note: str = ""
    sentences: Sequence[str] = ()
    left: Sequence[int] = (0,)
    """Left-aligned columns."""
    whole: Sequence[int] = ()
    """Columns whose cells are never wrapped on a terminal."""
    intervals: bool = False
    """True if the intervals are also shown on a narrow terminal."""
    pictures: Mapping[str, str] = field(default_factory=dict)
    """Picture file beside the page -> its caption."""

    def __str__(self) -> str:
        return markdown_of([self])

    def _repr_html_(self) -> str:
        return "".join(html_of([self], Path()))


def print_tables(tables: Sequence[Table], console: Console) -> None:
    """Print tables on a terminal; a narrow one omits intervals, unless the table requires them."""
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
    """Return some tables as a Markdown page."""
    parts = []
    for k, table in enumerate(tables):
        parts += [f"{'##' if k else '#'} {table.title[:1].upper()}{table.title[1:]}", table.headline]
        parts.append(markdown_table(table.heads, table.rows, left=table.left) if table.rows else "")
        parts += [table.note, "\n".join(f"- {sentence}" for sentence in table.sentences)]
        parts += [f"![{text}]({file})" for file, text in table.pictures.items()]
    return "\n\n".join(filter(None, parts)) + "\n"


def html_of(tables: Sequence[Table], folder: Path) -> list[str]:
    """Return the sections of a page; pictures in the folder are embedded."""
    sections = []
    for table in tables:
        rows = []
        for row in filter(None, table.rows):
            kind = ' class="theirs"' if paper(row) else ""
            rows.append(f"<tr{kind}>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>")
        items = "".join(f"<li>{escape(sentence)}</li>" for sentence in table.sentences)
        parts = [
            f"<p>{escape(table.headline)}</p>" if table.headline else "",
            html_table(table.heads, rows) if rows else "",
            f'<p class="note">{escape(table.note)}</p>' if table.note else "",
            f"<ul>{items}</ul>" if items else "",
            *_pictures(table.pictures, folder),
        ]
        sections.append(html_section(table.title[:1].upper() + table.title[1:], parts))
    return sections


def _pictures(pictures: Mapping[str, str], folder: Path) -> list[str]:
    return [
        html_picture((folder / file).read_bytes(), text)
        for file, text in pictures.items()
        if (folder / file).is_file()
    ]


def write_page(
    path: Path,
    title: str,
    tables: Sequence[Table],
    *,
    lead: Sequence[str] = (),
    first: Mapping[str, str] | None = None,
    last: Mapping[str, Sequence[str]] | None = None,
) -> None:
    """Write a report as one self-contained HTML file: a picture, its text, and foldable sections.

    Args:
        path: File to write; pictures are beside it.
        title: Title, plain text.
        tables: Sections of the page.
        lead: Paragraphs after the first picture; the headline of the first table if empty.
        first: Picture -> caption; the first picture of the tables if None. It is not repeated in its section.
        last: Title -> lines of code, in sections that are initially folded.
    """
    if first is None:
        first = dict(next((list(t.pictures.items())[:1] for t in tables if t.pictures), []))
    tables = [replace(t, pictures={k: x for k, x in t.pictures.items() if k not in first}) for t in tables]
    if not lead and tables and tables[0].headline:
        lead, tables = [tables[0].headline], [replace(tables[0], headline=""), *tables[1:]]
    sections = [
        f"<h1>{escape(title)}</h1>",
        *_pictures(first, path.parent),
        *(f'<p class="lead">{escape(text)}</p>' for text in lead),
        *html_of(tables, path.parent),
        *(html_section(name, [html_code(lines)], shown=False) for name, lines in (last or {}).items()),
    ]
    with atomic_write(path) as temporary:
        temporary.write_text(html_page(title, sections), encoding="utf-8")


Columns = Mapping[str, tuple[str, str] | tuple[str, str, float]]
"""Key of a result -> heading, format, and a factor if its unit differs; an empty format means a count of trials."""


def figure_text(figure: Mapping[str, Any] | float | None, form: str, factor: float = 1.0) -> str:
    """Return a figure as text, with its interval in brackets if it has one; – if there is none.

    An interval with equal ends, such as that of one plant and one seed, is omitted.

    `factor` converts the unit of the figure to that of the text.
    """
    value = figure["value"] if isinstance(figure, Mapping) else figure
    if value is None:
        return "–"
    bounds = figure["ci95"] if isinstance(figure, Mapping) else ()
    bounds = () if len(set(bounds)) == 1 else bounds
    numbers = ["–" if x is None else format(factor * x, form) for x in (value, *bounds)]
    return f"{numbers[0]} [{numbers[1]}, {numbers[2]}]" if numbers[1:] else numbers[0]


def cells(row: Mapping[str, Any], columns: Columns) -> list[str]:
    """Return a row's figures as text, in the order of the columns.

    A column has a heading with its unit, a format, and a factor.
    """
    return [
        figure_text(row.get(key), *form) if form[0] else f"{row[key]}/{row['trials']}" if key in row else ""
        for key, (_, *form) in columns.items()
    ]
