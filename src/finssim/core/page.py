"""Reports: one self-contained HTML file with embedded pictures."""

from __future__ import annotations

import base64
import json
import os
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from finssim.core.files import atomic_directory

__all__ = [
    "RECORD_FILE", "REPORT_FILE", "Page", "Pictures", "html_code", "html_page", "html_picture", "html_section",
    "html_table", "notebook_html",
]  # fmt: skip

REPORT_FILE, RECORD_FILE = "report.html", "fit.json"

Pictures = Mapping[str, tuple[str, bytes]]
"""File name -> caption of the picture, and the PNG."""

STYLE = """
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, sans-serif; color: #1c2733; background: #fff; max-width: 60rem; margin: 2rem auto;
  padding: 0 1rem; }
h1 { font-size: 1.6rem; margin-bottom: .2rem; } h2 { font-size: 1.15rem; } summary h2 { display: inline; }
summary { cursor: pointer; margin: 1.8rem 0 .5rem; }
p.lead { font-size: 1.05rem; color: #34495e; }
div.table { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; width: 100%; font-size: .9rem; }
th, td { text-align: right; padding: .3rem .6rem; border-bottom: 1px solid #dde5ec; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; } th { font-weight: 600; white-space: normal; }
td.words { text-align: left; white-space: normal; } td.code { font-family: monospace; font-size: .8rem; }
tr.theirs td { color: #6b7a89; } tr.first td { border-top: 2px solid #9fb2c3; } tr.doubt td { color: #9a5b00; }
figure { margin: 1rem 0; } img { max-width: 100%; height: auto; display: block; margin: 0 auto .3rem; }
figcaption, p.note { color: #5d6d7c; font-size: .9rem; } li.warning { color: #9a5b00; }
pre { background: #f3f6f9; padding: .8rem; overflow-x: auto; font-size: .85rem; }
@media print {
  body { max-width: none; margin: 0; font-size: 10pt; } table { font-size: 7pt; } pre { white-space: pre-wrap; }
  th, td { padding: .1rem .25rem; white-space: normal; } figure, tr { break-inside: avoid; }
  div.table { overflow: visible; } details::details-content { content-visibility: visible; }
}
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
    """Return an embedded picture with its caption, plain text."""
    data = base64.b64encode(png).decode("ascii")
    image = f'<img alt="{escape(text)}" src="data:image/png;base64,{data}">'
    return f"<figure>{image}<figcaption>{escape(text)}</figcaption></figure>"


def html_section(title: str, parts: Sequence[str], *, shown: bool = True) -> str:
    """Return a section that can be folded at its title.

    Args:
        title: Plain text.
        parts: HTML.
        shown: True if it is unfolded initially.
    """
    head = f"<summary><h2>{escape(title)}</h2></summary>"
    return f"<details{' open' if shown else ''}>{head}{''.join(parts)}</details>"


def html_code(lines: Sequence[str]) -> str:
    """Return preformatted lines."""
    return f"<pre>{escape(chr(10).join(lines))}</pre>"


def html_table(heads: Sequence[str], rows: Sequence[str]) -> str:
    """Return a table whose rows are HTML already."""
    cells = "".join(f"<th>{escape(head)}</th>" for head in heads)
    table = f"<table><thead><tr>{cells}</tr></thead><tbody>{''.join(rows)}</tbody></table>"
    return f'<div class="table">{table}</div>'


def notebook_html(title: str, heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a title and a table as a notebook displays them (`_repr_html_`); plain text in, HTML out."""
    cells = ["<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows]
    return f"<b>{escape(title)}</b>{html_table(heads, cells)}"


class Page:
    """Report that is written section by section, as one HTML file with its pictures beside it."""

    def __init__(self, title: str) -> None:
        """Create a page with a title, plain text."""
        self.title = title
        self._html = [f"<h1>{escape(title)}</h1>"]
        self._folded = False

    def _close(self) -> None:
        """End the open section."""
        if self._folded:
            self._html.append("</details>")
        self._folded = False

    def heading(self, text: str) -> None:
        """Begin a section that can be folded at its heading."""
        self._close()
        self._folded = True
        self._html.append(f"<details open><summary><h2>{escape(text)}</h2></summary>")

    def lead(self, text: str) -> None:
        """Add a paragraph that states the result."""
        self._html.append(f'<p class="lead">{escape(text)}</p>')

    def note(self, text: str) -> None:
        """Add a paragraph in small print; nothing if the text is empty."""
        if text:
            self._html.append(f'<p class="note">{escape(text.replace("`", ""))}</p>')

    def items(self, heading: str, sentences: Sequence[str]) -> None:
        """Add a section of warnings; nothing if there are none."""
        if sentences:
            self.heading(heading)
            items = "".join(f'<li class="warning">{escape(sentence)}</li>' for sentence in sentences)
            self._html.append(f"<ul>{items}</ul>")

    def table(
        self, heads: Sequence[str], rows: Sequence[Sequence[str]], kinds: Sequence[str] = (), last: str = ""
    ) -> None:
        """Add a table; `kinds` are CSS classes of its rows, `last` is the class of the last cell of each row."""
        html = []
        for k, row in enumerate(rows):
            cells = "".join(f"<td>{escape(cell)}</td>" for cell in row[:-1])
            cells += f'<td class="{last}">{escape(row[-1])}</td>'
            html.append(f'<tr class="{kinds[k] if kinds else ""}">{cells}</tr>')
        self._html.append(html_table(heads, html))

    def pictures(self, pictures: Pictures) -> None:
        """Add every picture below its caption as a heading."""
        last_text = ""
        for text, data in pictures.values():
            if text != last_text:
                self.heading(text)
            self.picture(text, data)
            last_text = text

    def picture(self, text: str, png: bytes) -> None:
        """Add a picture with its caption, plain text."""
        self._html.append(html_picture(png, text))

    def code(self, heading: str, lines: Sequence[str]) -> None:
        """Add a section of preformatted lines."""
        self.heading(heading)
        self._html.append(html_code(lines))

    def write(self, folder: str | os.PathLike[str], record: Mapping[str, Any], pictures: Pictures) -> None:
        """Write `report.html`, the pictures as PNG and `fit.json`.

        Args:
            folder: Directory to create; an earlier report there is replaced.
            record: Content of `fit.json`.
            pictures: Pictures that the page refers to.

        Raises:
            OutputError: The folder contains other files, or cannot be written.
        """
        self._close()
        with atomic_directory(folder, replaces=RECORD_FILE) as temporary:
            for name, (_, data) in pictures.items():
                (temporary / name).write_bytes(data)
            text = json.dumps(record, indent=1, allow_nan=False) + "\n"
            (temporary / RECORD_FILE).write_text(text, encoding="utf-8")
            (temporary / REPORT_FILE).write_text(html_page(self.title, self._html), encoding="utf-8")
