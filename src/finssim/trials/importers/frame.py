"""Trials from tables in memory."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from pydantic import ValidationError

from finssim.core.files import plain_name
from finssim.trials.findings import CalibrationError
from finssim.trials.importers.assemble import merge, trial_of
from finssim.trials.importers.column_map import ColumnMap, SourceMap
from finssim.trials.importers.table import memory_table, table_stream
from finssim.trials.trial import Trial, column_of
from finssim.trials.trial_files import ColumnTable
from finssim.vehicles.part import did_you_mean, sentence_of


def trial_from_frame(
    frame: Any,
    columns: Mapping[str, str] | None,
    units: Mapping[str, str] | None,
    time: str,
    axes: str,
    name: str,
    surface_pressure: float | None,
    header: Mapping[str, Any],
) -> Trial:
    """Return the trial of a table in memory; the arguments and errors are those of `Trial.from_frame`.

    Args:
        frame: A pandas DataFrame, or a mapping of names to columns.
        columns: Column of a trial -> name of the column in `frame`.
        units: Column of a trial, or `t` -> its unit in `frame`.
        time: Name of the column of times.
        axes: FLU or FRD.
        name: Name of the trial.
        surface_pressure: Reading of the pressure sensor at the surface [Pa].
        header: Additional keys of `trial.yaml`.
    """
    plain_name(name, "name of the trial", CalibrationError)
    table = _table(frame, time, name)
    if columns is None:
        columns = {column: column for column in table.columns if column_of(column) is not None}
    for column, given in columns.items():
        if column_of(column) is None and column in table.columns and column_of(str(given)) is not None:
            raise CalibrationError(
                f"{name}: columns maps '{column}' to '{given}', expected a trial's column first and the frame's "
                f"second: write {{'{given}': '{column}'}}"
            )
    units = dict(units or {})
    unit_of_time = units.pop("t", "s")
    for column in units:
        if column not in columns:
            known = ["t", *columns]
            own = next(
                (c for c, given in (("t", time), *columns.items()) if given == column and c != column), None
            )
            hint = f", the frame's name of '{own}': write '{own}';" if own else did_you_mean(column, known)
            raise CalibrationError(
                f"{name}: units names '{column}'{hint} expected some of {', '.join(known)}"
            )
    if time not in table.columns:
        raise CalibrationError(
            f"{name}: no column '{time}' with the times; its columns are {', '.join(table.columns[:12])}: name the "
            "column with time=, or use it as the index"
        )
    try:
        source = SourceMap.model_validate(
            {
                "time": {"column": time, "unit": unit_of_time},
                "frame": axes,
                "columns": {
                    column: {"column": given, "unit": units.get(column)} for column, given in columns.items()
                },
                "phase": "phase" if "phase" in table.words else None,
            }
        )
        mapped = ColumnMap.model_validate({"header": dict(header), "surface_pressure": surface_pressure})
    except ValidationError as error:
        raise CalibrationError(sentence_of(error.errors()[0], name, "add it")) from None
    return trial_of(name, merge([table_stream(table, source, name)]), mapped.header_of(name, None), mapped)


def _table(frame: Any, time: str, name: str) -> ColumnTable:
    """Return the columns of a DataFrame, including a time index, or of a mapping."""
    if hasattr(frame, "columns") and hasattr(frame, "index"):
        index = frame.index
        held = index.name == time or np.issubdtype(np.asarray(index).dtype, np.datetime64)
        if held and time not in frame.columns:
            frame = frame.assign(**{time: np.asarray(index)})
        columns = {str(column): frame[column] for column in frame.columns}
        if len(columns) < len(frame.columns):
            names = [str(column) for column in frame.columns]
            twice = next(column for column in columns if names.count(column) > 1)
            raise CalibrationError(f"{name}: column '{twice}' occurs twice: rename one")
    elif isinstance(frame, Mapping):
        columns = {str(column): values for column, values in frame.items()}
    else:
        raise CalibrationError(
            f"{name}: a {type(frame).__name__}, expected a pandas DataFrame or a mapping of names to columns"
        )
    arrays = {column: np.asarray(values) for column, values in columns.items()}
    shapes = {array.shape for array in arrays.values()}
    if len(shapes) != 1 or len(next(iter(shapes))) != 1:
        listed = ", ".join(f"{column} {array.shape}" for column, array in arrays.items())
        raise CalibrationError(
            f"{name}: columns {listed or 'none'}, expected one-dimensional ones of equal length"
        )
    return memory_table(arrays)
