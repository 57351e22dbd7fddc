"""Reading one table of a log, CSV or Parquet, as columns of numbers and words; what was repaired is said."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.findings import Finding, finding
from finssim.text_table import TextTable, number, read_text_table

__all__ = ["Table", "read_table", "write_table"]

Array = NDArray[np.float64]

MOST_RAGGED = 0.1
"""Part of the rows that may have a wrong number of cells; a file with more of them is no table."""

CHUNK = 20_000
"""Rows that are held as text at a time."""


@dataclass
class Table:
    """Columns of one file, all of one length."""

    numbers: dict[str, Array] = field(default_factory=dict)
    """Column -> values, NaN for empty cells and cells that hold no number."""
    words: dict[str, list[str]] = field(default_factory=dict)
    """Column -> text, for columns in which no cell is a number (and for `phase`)."""
    findings: list[Finding] = field(default_factory=list)
    """What was left out or repaired."""

    @property
    def columns(self) -> list[str]:
        """Names of all columns."""
        return [*self.numbers, *self.words]


def read_table(
    path: Path, *, skip: int = 0, names: Sequence[str] | None = None, spaces: bool = False
) -> Table:
    """The columns of a `.csv` (`.txt`, `.tsv`) or `.parquet` file.

    A CSV file needs a line of column names; cells may be separated by commas, semicolons or tabs, lines that begin
    with # are comments. A file that a crash cut short opens up to the cut.

    Args:
        path: The file.
        skip: Lines of a text before its table.
        names: Of the columns of a text that has no line of names.
        spaces: Whether blanks separate the cells of a text.

    Raises:
        CalibrationError: Unreadable, empty, without column names, or no table.
    """
    if path.suffix.lower() in (".parquet", ".pq"):
        return _read_parquet(path)
    return _read_csv(path, skip=skip, names=names, spaces=spaces)


def write_table(path: Path, numbers: dict[str, Array], phase: NDArray[np.str_] | None = None) -> None:
    """Write columns as CSV or Parquet, by the path's suffix; every number reads back bit for bit, NaN as an empty cell.

    Args:
        path: Of the file.
        numbers: Column -> values, (n,) each.
        phase: A word for each row, (n,); no such column if None.
    """
    if path.suffix == ".parquet":
        import pyarrow.parquet

        columns: dict[str, Any] = dict(numbers)
        if phase is not None:
            columns["phase"] = pyarrow.array(phase.tolist(), pyarrow.string())
        pyarrow.parquet.write_table(pyarrow.table(columns), path)
        return
    cells = [["" if x != x else repr(x) for x in values.tolist()] for values in numbers.values()]
    names = list(numbers)
    if phase is not None:
        names.append("phase")
        cells.append(phase.tolist())
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(names)
        writer.writerows(zip(*cells, strict=True))


def _read_csv(path: Path, **how: Any) -> Table:
    text = read_text_table(path, CalibrationError, **how)
    table, names = Table(), text.names
    if text.zeros:
        table.findings.append(finding("zero_bytes"))
    _check_names(names, path)
    columns: list[list[Any]] = [[] for _ in names]
    ragged: list[int] = []
    rows: list[list[str]] = []
    for count, line in enumerate(text.texts, start=1):
        row = text.split(line)
        if len(row) < len(names) or any(row[len(names) :]):
            ragged.append(count)
            continue
        if text.unfinished and count == len(text.texts) and row[-1]:
            row[-1] = ""
            table.findings.append(finding("last_cell_cut"))
        rows.append(row)
        if len(rows) == CHUNK:
            _append(columns, rows, text)
            rows = []
    _append(columns, rows, text)
    _tell_ragged(ragged, len(text.texts), len(names), text.unfinished, table, path)
    for name, column in zip(names, columns, strict=True):
        _keep(table, name, column)
    return table


def _check_names(names: list[str], path: Path) -> None:
    if not any(names) or any("\ufffd" in name for name in names):
        raise CalibrationError(f"{path}: no line of column names: expected a CSV file that begins with t,...")
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise CalibrationError(f"{path}: column '{twice[0]}' is there twice: rename or remove one")
    try:
        [float(name) for name in names]
    except ValueError:
        return
    raise CalibrationError(f"{path}: begins with numbers, expected a line of column names such as t,tau_x,u")


def _append(columns: list[list[Any]], rows: list[list[str]], text: TextTable) -> None:
    """Add rows of text to the columns, as numbers where every cell of the chunk is one."""
    for column, cells in zip(columns, zip(*rows, strict=False), strict=False):
        try:
            column.extend([float(cell) if cell else math.nan for cell in cells])
        except ValueError:
            numbers = [text.number(cell) for cell in cells]
            column.extend([cell if x is None else x for cell, x in zip(cells, numbers, strict=True)])


def _tell_ragged(ragged: list[int], count: int, width: int, cut: bool, table: Table, path: Path) -> None:
    if ragged == [count] and cut:
        table.findings.append(finding("last_line_cut"))
    elif len(ragged) > max(1.0, MOST_RAGGED * count):
        raise CalibrationError(
            f"{path}: {len(ragged)} of {count} rows do not have {width} cells, one for each column name "
            f"(first: row {ragged[0]}): is one table in it, with one separator?"
        )
    elif ragged:
        table.findings.append(finding("ragged_rows", rows=len(ragged), expected=width, first=ragged[0]))


def _keep(table: Table, name: str, column: list[Any]) -> None:
    """File a column under numbers or words."""
    if not name:
        return
    words = [i for i, cell in enumerate(column) if isinstance(cell, str)]
    if name == "phase" or (words and all(isinstance(c, str) or math.isnan(c) for c in column)):
        table.words[name] = [cell if isinstance(cell, str) else "" for cell in column]
        return
    if words:
        table.findings.append(
            finding(
                "not_numbers", column=name, cells=len(words), cell=column[words[0]][:40], row=words[0] + 1
            )
        )
        for i in words:
            column[i] = math.nan
    table.numbers[name] = np.array(column, dtype=float)


def _read_parquet(path: Path) -> Table:
    try:
        import pyarrow.parquet
    except ImportError:
        raise CalibrationError(f"{path}: reading Parquet needs pyarrow: pip install pyarrow") from None
    try:
        content = pyarrow.parquet.read_table(path)
    except (OSError, pyarrow.ArrowException) as error:
        raise CalibrationError(
            f"{path}: is not a whole Parquet file: {' '.join(str(error).split())[:120]}"
        ) from None
    table = Table()
    _check_names(content.column_names, path)
    for name in content.column_names:
        kind = content.schema.field(name).type
        column = content.column(name)
        if pyarrow.types.is_timestamp(kind):
            table.words[name] = [str(word) for word in column.to_numpy()]
        elif (
            pyarrow.types.is_integer(kind)
            or pyarrow.types.is_floating(kind)
            or pyarrow.types.is_boolean(kind)
            or pyarrow.types.is_decimal(kind)
        ):
            if name != "phase":
                table.numbers[name] = np.array(column.cast(pyarrow.float64(), safe=False), dtype=np.float64)
        elif (
            pyarrow.types.is_string(kind)
            or pyarrow.types.is_large_string(kind)
            or (pyarrow.types.is_dictionary(kind))
        ):
            cells = ["" if cell is None else str(cell) for cell in column.to_pylist()]
            numbers = [number(cell) for cell in cells]
            _keep(table, name, [c if x is None else x for c, x in zip(cells, numbers, strict=True)])
        else:
            table.findings.append(finding("column_kind", column=name, kind=str(kind)))
    return table
