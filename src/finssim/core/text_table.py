"""Tables in text files: one reader for all layers, which keeps the line number of each row."""

from __future__ import annotations

import codecs
import csv
import io
import math
import os
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from finssim.core.budget import TEXT, read_bytes
from finssim.core.files import atomic_write

EMPTY = re.compile(r"nan|none|null|n/?a|[-.:]*")
"""Tokens that mean "no value", in lower case; ground stations write `--.--`."""

QUOTED_COMMA = re.compile(r'"-?\d+,(?!\d{3}")\d+"')
"""Number with a decimal comma in a comma-separated table; with three decimals it may be a thousands separator."""

COMMENT = ("#",)
"""Prefixes of comment lines."""


@dataclass
class TextTable:
    """Table as text."""

    names: list[str]
    """Names of the columns."""
    texts: list[str]
    """Lines below the header."""
    lines: list[int]
    """Line number of each text in the file, from 1."""
    split: Callable[[str], list[str]]
    """Function that splits a line into stripped cells; there may be fewer or more cells than names."""
    decimal_comma: bool
    """True if a comma in a number is its decimal point, because another character separates the cells."""
    comments: list[str] = field(default_factory=list)
    """Comment lines."""
    zeros: bool = False
    """True if the file ends in zero bytes, as after a crash; they are ignored."""
    unfinished: bool = False
    """True if the last line has no line ending, so that its last cell may be truncated."""

    @property
    def rows(self) -> list[list[str]]:
        """Cells of every line."""
        return [self.split(text) for text in self.texts]

    def number(self, cell: str) -> float | None:
        """Return the number in a cell, in the unit of its column; NaN for a token of `EMPTY`, None for other text."""
        return number(cell, decimal_comma=self.decimal_comma)

    def place(self, names: Sequence[str]) -> int | None:
        """Return the index of the first of several names that is a column, ignoring case."""
        lower = [name.lower() for name in self.names]
        return next((lower.index(name) for name in names if name in lower), None)


def number(cell: str, *, decimal_comma: bool = False) -> float | None:
    """Return the number in a cell, in the unit of its column; NaN for a token of `EMPTY`, None for other text."""
    cell = cell.strip().replace("−", "-")
    try:
        return float(cell.replace(",", ".") if decimal_comma else cell)
    except ValueError:
        return math.nan if EMPTY.fullmatch(cell.lower()) else None


def read_text(path: str | os.PathLike[str], error: type[Exception]) -> tuple[str, bool]:
    """Return the text of a file up to the zero bytes that a crash may leave, and whether there were any.

    Args:
        path: The file.
        error: Class of the error if the file cannot be read.
    """
    return decoded(read_bytes(Path(path), error, limit=TEXT))


def decoded(raw: bytes) -> tuple[str, bool]:
    """Return decoded bytes up to the zero bytes that a crash may leave, and whether there were any."""
    marked = raw.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    if marked or (len(raw) > 8 and not any(raw[1:9:2])):
        text, _, rest = raw.decode("utf-16" if marked else "utf-16-le", errors="replace").partition("\0")
        return text, bool(rest)
    intact = raw.split(b"\0", 1)[0]
    try:
        text = intact.decode("utf-8-sig")
    except UnicodeDecodeError:
        # Spreadsheets write µ and ± as one byte; control bytes indicate that it is not text.
        codec = "utf-8-sig" if re.search(rb"[\x01-\x08\x0e-\x1f\x7f]", intact) else "cp1252"
        text = intact.decode(codec, errors="replace")
    return text, len(intact) < len(raw)


def read_text_table(
    path: str | os.PathLike[str],
    error: type[Exception],
    *,
    skip: int = 0,
    names: Sequence[str] | None = None,
    spaces: bool | None = False,
    comment: tuple[str, ...] = COMMENT,
) -> TextTable:
    """Read a table with a header line; see `text_table`.

    Args:
        path: The file.
        error: Class of the error if the file cannot be read.
        skip: Number of lines before the table.
        names: Names of the columns, if the file has no header line.
        spaces: Whether blanks separate the cells; None: only if no other separator occurs.
        comment: Prefixes of comment lines.
    """
    text, zeros = read_text(path, error)
    table = text_table(text, skip=skip, names=names, spaces=spaces, comment=comment)
    table.zeros = zeros
    return table


def text_table(
    text: str,
    *,
    skip: int = 0,
    names: Sequence[str] | None = None,
    spaces: bool | None = False,
    comment: tuple[str, ...] = COMMENT,
) -> TextTable:
    """Split a text into a table; the separator is the most frequent of comma, semicolon and tab in the first line.

    A line such as `sep=;` before the header sets the separator.

    Args:
        text: Content of the complete file; blank lines are skipped.
        skip: Number of lines before the table.
        names: Names of the columns, if there is no header line.
        spaces: Whether blanks separate the cells; None: only if no other separator occurs.
        comment: Prefixes of comment lines.
    """
    every = [(i, line) for i, line in enumerate(text.splitlines(), start=1) if i > skip and line.strip()]
    held = [(i, line) for i, line in every if not line.lstrip().startswith(comment)]
    named = re.fullmatch(r'"?sep=(.)"?', held[0][1].strip()) if held else None  # a line for Excel
    held = held[1:] if named else held
    first = held[0][1] if held else ""
    mark = named[1] if named else max(",;\t", key=first.count)
    blank = (spaces is None and mark not in first) or bool(spaces)
    split: Callable[[str], list[str]] = str.split
    if not blank:
        # Quoted cells are rare, and the csv module is slow line by line.
        def split(line: str) -> list[str]:
            cells = next(csv.reader([line], delimiter=mark)) if '"' in line else line.split(mark)
            return [cell.strip() for cell in cells]

    head = list(names) if names is not None else split(first)
    while head and not head[-1]:
        head.pop()
    below = held if names is not None else held[1:]
    return TextTable(
        names=head,
        texts=[line for _, line in below],
        lines=[i for i, _ in below],
        split=split,
        decimal_comma=not blank and (mark != "," or any(QUOTED_COMMA.search(line) for _, line in below[:20])),
        comments=[line.strip() for _, line in every if line.lstrip().startswith(comment)],
        unfinished=not text.endswith(("\n", "\r")),
    )


def csv_text(names: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Return a table as CSV with a header line."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([names, *rows])
    return text.getvalue()


def write_csv(path: str | os.PathLike[str], names: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Write a table as CSV with a header line.

    Raises:
        OutputError: The file cannot be written.
    """
    with atomic_write(path) as temporary:
        temporary.write_text(csv_text(names, rows), encoding="utf-8", newline="")
