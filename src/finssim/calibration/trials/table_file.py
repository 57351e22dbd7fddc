"""Reading one table of a log, CSV or Parquet, as columns of numbers and words; what was repaired is said."""

from __future__ import annotations

import csv
import io
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.findings import Finding, finding

__all__ = ["Table", "read_table", "write_table"]

Array = NDArray[np.float64]

NOTHING = frozenset({"", "nan", "none", "null", "na", "n/a", "-", "--"})
"""Words for "no sample", in lower case."""

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


def read_table(path: Path) -> Table:
    """The columns of a `.csv` (`.txt`, `.tsv`) or `.parquet` file.

    A CSV file needs a line of column names; cells may be separated by commas, semicolons or tabs, lines that begin
    with # are comments. A file that a crash cut short opens up to the cut.

    Raises:
        CalibrationError: Unreadable, empty, without column names, or no table.
    """
    if path.suffix.lower() == ".parquet":
        return _read_parquet(path)
    return _read_csv(path)


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


def _read_csv(path: Path) -> Table:
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be read: {error.strerror or error}") from None
    table = Table()
    whole = raw.split(b"\0", 1)[0]  # a crash leaves zeros where the file system had made room
    text = whole.decode("utf-8-sig", errors="replace")
    if len(whole) < len(raw):
        table.findings.append(finding("zero_bytes"))
    cut = not text.endswith(("\n", "\r"))
    lines = (line for line in io.StringIO(text, newline=None) if line.strip() and not line.startswith("#"))
    first = next(lines, "")
    delimiter = max(",;\t", key=first.count)
    names = [name.strip() for name in next(csv.reader([first], delimiter=delimiter), [])]
    while names and not names[-1]:
        names.pop()
    _check_names(names, path)
    columns: list[list[Any]] = [[] for _ in names]
    ragged: list[int] = []
    rows: list[list[str]] = []
    count, last = 0, []
    for row in csv.reader(lines, delimiter=delimiter):
        count += 1
        last = row
        if len(row) != len(names):
            if len(row) < len(names) or any(cell.strip() for cell in row[len(names) :]):
                ragged.append(count)
                continue
        rows.append(row)
        if len(rows) == CHUNK:
            _append(columns, rows, delimiter)
            rows = []
    if cut and rows and last is rows[-1] and last[-1].strip():
        rows[-1] = [*last[:-1], ""]
        table.findings.append(finding("last_cell_cut"))
    _append(columns, rows, delimiter)
    _tell_ragged(ragged, count, len(names), cut, table, path)
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


def _append(columns: list[list[Any]], rows: list[list[str]], delimiter: str) -> None:
    """Add rows of text to the columns, as numbers where every cell of the chunk is one."""
    for column, cells in zip(columns, zip(*rows, strict=False), strict=False):
        if delimiter != ",":
            cells = tuple(cell.replace(",", ".") for cell in cells)  # decimal commas
        try:
            column.extend([float(cell) if cell else math.nan for cell in cells])
        except ValueError:
            column.extend([_number_or_word(cell) for cell in cells])


def _number_or_word(cell: str) -> float | str:
    cell = cell.strip()
    if cell.lower() in NOTHING:
        return math.nan
    try:
        return float(cell)
    except ValueError:
        return cell


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
            _keep(table, name, [_number_or_word(cell) for cell in cells])
        else:
            table.findings.append(finding("column_kind", column=name, kind=str(kind)))
    return table
