"""Tables of points or pixels, one per row: named columns of numbers, and others that are carried along."""

from __future__ import annotations

import csv
import io
import math
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from finssim.files import atomic_write
from finssim.localization.errors import LocalizationError

__all__ = ["PointTable", "read_points", "table_text", "write_table"]

Array = npt.NDArray[np.float64]

_UNIT = re.compile(r"\s*(\[[^\]]*\]|\([^)]*\)|_m|_px|_pix|_pixels?|_metres|_meters)$")
_BAD_ROWS_NAMED = 5


@dataclass(frozen=True, eq=False)
class PointTable:
    """A table as it was read."""

    where: str
    """The file, as messages call it."""
    names: list[str]
    """All columns, as the file calls them."""
    rows: list[list[str]]
    """All cells, as the file writes them."""
    numbers: dict[str, Array]
    """The columns that were asked for and are there, (n,) each."""

    def with_columns(self, columns: dict[str, Sequence[str]]) -> tuple[list[str], list[list[str]]]:
        """Names and rows with columns added; one of the file that has the name of an added one becomes NAME_given."""
        added = {name.lower() for name in columns}
        names = [f"{name}_given" if _plain(name) in added else name for name in self.names]
        cells = zip(*columns.values(), strict=True)
        return [*names, *columns], [[*row, *more] for row, more in zip(self.rows, cells, strict=True)]


def read_points(path: Path, wanted: Sequence[str], optional: Sequence[str] = ()) -> PointTable:
    """Read a table of numbers.

    Columns may stand in any order, in capitals, with a unit (`x [m]`, `u_px`). Without a header the columns are those
    wanted, then the optional ones. Cells are separated by commas, semicolons (then with decimal commas too), tabs or
    spaces; lines that begin with # are comments.

    Args:
        path: The file; `-` is the standard input.
        wanted: Columns that must be there.
        optional: Columns that may be there.

    Raises:
        LocalizationError: A column is missing, or cells are not numbers: the lines are named.
    """
    where = "standard input" if str(path) == "-" else str(path)
    lines = [(i, line) for i, line in enumerate(_text(path, where).splitlines(), 1) if _counts(line)]
    if not lines:
        raise LocalizationError(f"{where}: holds no rows, expected columns {', '.join(wanted)}")
    split = _splitter(lines[0][1])
    rows = [(i, split(line)) for i, line in lines]
    first = rows[0][1]
    if all(_number(cell) is not None for cell in first):
        names = _bare(first, wanted, optional, where)
    else:
        names, rows = first, rows[1:]
    plain = [_plain(name) for name in names]
    for name in (*wanted, *optional):
        if plain.count(name) > 1 or (name in wanted and name not in plain):
            there = "twice" if name in plain else "not"
            raise LocalizationError(
                f"{where}: column {name} is {there} there among {', '.join(names)}: name the columns "
                f"{', '.join(wanted)} in the first line"
            )
    places = {name: plain.index(name) for name in (*wanted, *optional) if name in plain}
    _refuse_bad_rows(rows, names, places, where)
    numbers = {name: np.array([_number(row[k]) for _, row in rows], float) for name, k in places.items()}
    return PointTable(where, names, [row for _, row in rows], numbers)


def table_text(names: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table as CSV."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([names, *rows])
    return text.getvalue()


def write_table(path: Path | None, text: str) -> None:
    """Write text to a file, or to the standard output if there is none.

    Raises:
        OutputError: The file cannot be written.
    """
    if path is None:
        sys.stdout.write(text)
        return
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _text(path: Path, where: str) -> str:
    if str(path) == "-":
        return sys.stdin.read()
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise LocalizationError(f"{where}: is not text, expected a CSV table") from None


def _counts(line: str) -> bool:
    return bool(line.strip()) and not line.lstrip().startswith("#")


def _splitter(line: str) -> Callable[[str], list[str]]:
    """How to split lines that are written as this one."""
    delimiter = next((c for c in ";\t," if c in line), None)
    if delimiter is None:
        return str.split
    return lambda text: [cell.strip() for cell in next(csv.reader([text], delimiter=delimiter))]


def _number(cell: str) -> float | None:
    try:
        value = float(cell if "." in cell else cell.replace(",", "."))
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def _plain(name: str) -> str:
    return _UNIT.sub("", name.strip().lower())


def _bare(first: list[str], wanted: Sequence[str], optional: Sequence[str], where: str) -> list[str]:
    if not len(wanted) <= len(first) <= len(wanted) + len(optional):
        raise LocalizationError(
            f"{where}: has {len(first)} columns without a header, expected {', '.join(wanted)}: name the columns "
            "in the first line"
        )
    return [*wanted, *optional][: len(first)]


def _refuse_bad_rows(
    rows: Sequence[tuple[int, list[str]]], names: list[str], places: dict[str, int], where: str
) -> None:
    bad = []
    for line, row in rows:
        if len(row) != len(names):
            bad.append(f"line {line} has {len(row)} cells, expected {len(names)}")
            continue
        for name, k in places.items():
            if _number(row[k]) is None:
                bad.append(f"line {line}: {name} is '{row[k]}', expected a number")
                break
    if bad:
        more = f"; and {len(bad) - _BAD_ROWS_NAMED} more lines" if len(bad) > _BAD_ROWS_NAMED else ""
        raise LocalizationError(f"{where}: {'; '.join(bad[:_BAD_ROWS_NAMED])}{more}")
