"""Reading the tables of a log: columns of numbers by name, empty cells as NaN."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from finssim.localization.errors import LocalizationError
from finssim.text_table import EMPTY, TextTable, read_text_table

__all__ = ["StreamTable", "read_stream_table"]

Array = npt.NDArray[np.float64]

TIME = ("t", "time", "time_s", "timestamp", "stamp", "seconds")
TRUTH = {"true": 1.0, "yes": 1.0, "false": 0.0, "no": 0.0}


@dataclass
class StreamTable:
    """One table of a log."""

    name: str
    """As messages call it."""
    t: Array
    """Times, (n,), as they stand in the file [s]."""
    numbers: dict[str, Array]
    """Column, in lower case -> values, (n,)."""
    words: dict[str, list[str]]
    """Columns that hold words."""
    notes: list[str] = field(default_factory=list)

    def has(self, *names: str) -> bool:
        """Whether all these columns hold a number somewhere."""
        return all(name in self.numbers and np.isfinite(self.numbers[name]).any() for name in names)

    def columns(self, *names: str) -> Array:
        """Columns side by side, (n, len(names))."""
        return np.stack([self.numbers[name] for name in names], axis=-1)


def read_stream_table(path: Path) -> StreamTable:
    """The columns of a CSV file with a line of names; separated by commas, semicolons or tabs; # begins a comment.

    A last line that a crash cut short is left out, and so are others of the wrong length.

    Raises:
        LocalizationError: Unreadable, without names, without a column of times, or without rows.
    """
    text = read_text_table(path, LocalizationError)
    names = [name.lower() for name in text.names]
    time = next((name for name in TIME if name in names), None)
    if time is None or len(set(names)) < len(names):
        raise LocalizationError(
            f"{path}: expected a line of different column names with t, such as t,depth; found "
            f"'{','.join(names)[:60]}'"
        )
    rows = text.rows
    whole = [row for row in rows if len(row) == len(names)]
    table = StreamTable(str(path), np.empty(0), {}, {})
    if len(whole) < len(rows):
        table.notes.append(
            f"{path.name}: {len(rows) - len(whole)} rows do not have {len(names)} cells and were left out"
        )
    if not whole:
        raise LocalizationError(f"{path}: holds no rows: give a table with samples")
    for name, cells in zip(names, zip(*whole, strict=True), strict=True):
        values = [_number(cell, text) for cell in cells]
        if all(math.isnan(v) for v in values) and any(c.lower() not in EMPTY for c in cells):
            table.words[name] = list(cells)
        else:
            table.numbers[name] = np.array(values, float)
    if time not in table.numbers:
        raise LocalizationError(f"{path}: column '{time}' holds no numbers: write times in seconds")
    table.t = table.numbers.pop(time)
    return table


def _number(cell: str, text: TextTable) -> float:
    """The number in a cell; NaN where there is none. Infinities stay: the estimator refuses and counts them."""
    value = text.number(cell)
    return TRUTH.get(cell.lower(), math.nan) if value is None else value
