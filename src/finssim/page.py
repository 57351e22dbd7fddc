"""The HTML of reports: one file that holds its pictures and loads nothing."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape

__all__ = ["html_page", "html_picture", "html_table"]

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
    """A whole page.

    Args:
        title: Plain text.
        sections: HTML, already escaped.
    """
    head = f'<meta charset="utf-8"><title>{escape(title)}</title><style>{STYLE}</style>'
    return f'<!doctype html><html lang="en"><head>{head}</head><body>{"".join(sections)}</body></html>\n'


def html_picture(png: bytes, text: str) -> str:
    """A picture inside the page, with the words that stand for it."""
    data = base64.b64encode(png).decode("ascii")
    return f'<img alt="{escape(text)}" src="data:image/png;base64,{data}">'


def html_table(heads: Sequence[str], rows: Sequence[str]) -> str:
    """A table of rows that are HTML already."""
    cells = "".join(f"<th>{escape(head)}</th>" for head in heads)
    return f"<table><thead><tr>{cells}</tr></thead><tbody>{''.join(rows)}</tbody></table>"
