"""Reports: one HTML file that holds its pictures and loads nothing, and the same as Markdown beside its pictures."""

from __future__ import annotations

import base64
import json
import os
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from finssim.core.files import atomic_directory

__all__ = [
    "RECORD_FILE", "REPORT_FILE", "Page", "Pictures", "html_page", "html_picture", "html_table", "notebook_html",
]  # fmt: skip

REPORT_FILE, MARKDOWN_FILE, RECORD_FILE = "report.html", "report.md", "fit.json"

Pictures = Mapping[str, tuple[str, bytes]]
"""File name -> what the picture shows, and the PNG."""

STYLE = """
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, sans-serif; color: #1c2733; background: #fff; max-width: 52rem; margin: 2rem auto;
  padding: 0 1rem; }
h1 { font-size: 1.6rem; margin-bottom: .2rem; } h2 { font-size: 1.15rem; margin-top: 2.2rem; }
p.lead { font-size: 1.05rem; color: #34495e; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; width: 100%; }
th, td { text-align: right; padding: .3rem .6rem; border-bottom: 1px solid #dde5ec; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; } th { font-weight: 600; }
td.words { text-align: left; white-space: normal; } td.code { font-family: monospace; font-size: .8rem; }
tr.theirs td { color: #6b7a89; } tr.first td { border-top: 2px solid #9fb2c3; } tr.doubt td { color: #9a5b00; }
img { max-width: 100%; height: auto; display: block; margin: .8rem auto; }
p.note { color: #5d6d7c; font-size: .9rem; } li.warning { color: #9a5b00; }
pre { background: #f3f6f9; padding: .8rem; overflow-x: auto; font-size: .85rem; }
"""


def html_page(title: str, sections: Sequence[str]) -> str:
    """Return a complete page.

    Args:
        title: Plain text.
        sections: HTML, already escaped.
    """
    head = f'<meta charset="utf-8"><title>{escape(title)}</title><style>{STYLE}</style>'
    return f'<!doctype html><html lang="en"><head>{head}</head><body>{"".join(sections)}</body></html>\n'


def html_picture(png: bytes, text: str) -> str:
    """Return a picture inside the page, with its alternative text."""
    data = base64.b64encode(png).decode("ascii")
    return f'<img alt="{escape(text)}" src="data:image/png;base64,{data}">'


def html_table(heads: Sequence[str], rows: Sequence[str]) -> str:
    """A table of rows that are HTML already."""
    cells = "".join(f"<th>{escape(head)}</th>" for head in heads)
    return f"<table><thead><tr>{cells}</tr></thead><tbody>{''.join(rows)}</tbody></table>"


def notebook_html(title: str, heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a title and a table as a notebook displays them (`_repr_html_`); plain text in, HTML out."""
    cells = ["<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows]
    return f"<b>{escape(title)}</b>{html_table(heads, cells)}"


class Page:
    """A report that is written once and given out as HTML and as Markdown."""

    def __init__(self, title: str) -> None:
        """Begin with a title, plain text."""
        self.title = title
        self._html = [f"<h1>{escape(title)}</h1>"]
        self._markdown = [f"# {title}"]

    def _add(self, html: str, markdown: str) -> None:
        self._html.append(html)
        self._markdown.append(markdown)

    def heading(self, text: str) -> None:
        """Add the heading of a section."""
        self._add(f"<h2>{escape(text)}</h2>", f"## {text}")

    def lead(self, text: str) -> None:
        """Add a paragraph that states the result."""
        self._add(f'<p class="lead">{escape(text)}</p>', text)

    def note(self, text: str) -> None:
        """A paragraph in small print; nothing for no text."""
        if text:
            self._add(f'<p class="note">{escape(text.replace("`", ""))}</p>', text)

    def items(self, heading: str, sentences: Sequence[str]) -> None:
        """A section of warnings; nothing where there are none."""
        if sentences:
            self.heading(heading)
            items = "".join(f'<li class="warning">{escape(sentence)}</li>' for sentence in sentences)
            self._add(f"<ul>{items}</ul>", "\n".join(f"- {sentence}" for sentence in sentences))

    def table(
        self, heads: Sequence[str], rows: Sequence[Sequence[str]], kinds: Sequence[str] = (), last: str = ""
    ) -> None:
        """A table; `kinds` are classes of the style for its rows, `last` is that of its last cells."""
        html = []
        for k, row in enumerate(rows):
            cells = "".join(f"<td>{escape(cell)}</td>" for cell in row[:-1])
            cells += f'<td class="{last}">{escape(row[-1])}</td>'
            html.append(f'<tr class="{kinds[k] if kinds else ""}">{cells}</tr>')
        lines = [heads, ["---"] * len(heads), *rows]
        markdown = "\n".join(
            "| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines
        )
        self._add(html_table(heads, html), markdown)

    def pictures(self, pictures: Pictures) -> None:
        """Every picture below what it shows."""
        last_text = ""
        for name, (text, data) in pictures.items():
            if text != last_text:
                self.heading(text)
            self._add(html_picture(data, text), f"![{text}]({name})")
            last_text = text

    def code(self, heading: str, lines: Sequence[str]) -> None:
        """A section of lines as they are."""
        self.heading(heading)
        text = "\n".join(lines)
        self._add(f"<pre>{escape(text)}</pre>", f"```text\n{text}\n```")

    def write(self, folder: str | os.PathLike[str], record: Mapping[str, Any], pictures: Pictures) -> None:
        """Write `report.html`, `report.md`, the pictures as PNG and `fit.json`.

        Args:
            folder: Directory to make; an earlier report there is replaced.
            record: What `fit.json` holds.
            pictures: Those that the page names.

        Raises:
            OutputError: The folder holds other files, or cannot be written.
        """
        texts = {
            RECORD_FILE: json.dumps(record, indent=1, allow_nan=False) + "\n",
            REPORT_FILE: html_page(self.title, self._html),
            MARKDOWN_FILE: "\n\n".join(self._markdown) + "\n",
        }
        with atomic_directory(folder, replaces=RECORD_FILE) as temporary:
            for name, (_, data) in pictures.items():
                (temporary / name).write_bytes(data)
            for name, text in texts.items():
                (temporary / name).write_text(text, encoding="utf-8")
