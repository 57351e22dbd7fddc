"""Positions of an acoustic system: tables with a flag of validity, as from Water Linked's Underwater GPS."""

from __future__ import annotations

from pathlib import Path

from finssim.trials.importers.assemble import SourceMap
from finssim.trials.importers.log import LogImporter, Request, TrialStreams
from finssim.trials.importers.table import TIME_NAMES, names_of, table_stream
from finssim.trials.trial_files import read_table


def read(path: Path, request: Request) -> TrialStreams:
    """Return the positions as one stream, without those that are marked invalid.

    Args:
        path: The table: x forward or north, y right or east, z down [m].
        request: Not used.

    Raises:
        CalibrationError: Unreadable, or no position is valid.
    """
    table = read_table(path)
    time = next(name for name in table.columns if name.lower() in TIME_NAMES)
    source = {
        "time": {"column": time, "unit": "s" if time in table.numbers else "date"},
        "frame": "NED",
        "columns": ["x", "y", "z"],
        "valid": "position_valid",
    }
    return TrialStreams([table_stream(table, SourceMap.model_validate(source), path.name)])


def _recognises(path: Path, head: bytes) -> bool:
    names = names_of(path, head)
    return {"position_valid", "x", "y", "z"} <= names and any(name.lower() in TIME_NAMES for name in names)


ACOUSTIC = LogImporter(title="positions of an acoustic system (.csv)", recognises=_recognises, read=read)
