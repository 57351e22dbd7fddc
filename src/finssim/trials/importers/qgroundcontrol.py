"""Logs of QGroundControl: the CSV of a vehicle's telemetry, one row a second or so."""

from __future__ import annotations

from pathlib import Path

from finssim.trials.importers.assemble import SourceMap
from finssim.trials.importers.log import LogImporter, Request, TrialStreams
from finssim.trials.importers.table import names_of, table_stream
from finssim.trials.trial_files import read_table

COLUMNS = {
    "roll": {"column": "roll", "unit": "deg"},
    "pitch": {"column": "pitch", "unit": "deg"},
    "yaw": {"column": "heading", "unit": "deg"},
    "p": {"column": "rollRate", "unit": "deg/s"},
    "q": {"column": "pitchRate", "unit": "deg/s"},
    "r": {"column": "yawRate", "unit": "deg/s"},
    "depth": {"column": "altitudeRelative", "sign": -1},
    "voltage": {"column": "battery0.voltage"},
    **{name: {"column": f"localPosition.{name}"} for name in ("x", "y", "z", "vx", "vy", "vz")},
}
"""Column of a trial -> that of the log, in its default units and north-east-down axes."""


def read(path: Path, request: Request) -> TrialStreams:
    """Return the table as one stream; it may lack any of the columns.

    Args:
        path: The table.
        request: Not used.

    Raises:
        CalibrationError: Unreadable.
    """
    table = read_table(path)
    # "battery.voltage" before version 4.
    table.numbers = {name.replace("battery.", "battery0."): values for name, values in table.numbers.items()}
    there = {name: spec for name, spec in COLUMNS.items() if spec["column"] in table.columns}
    if not all(name in there for name in ("vx", "vy", "vz", "roll", "pitch", "yaw")):
        there = {name: spec for name, spec in there.items() if not name.startswith("v") or name == "voltage"}
    source = {"time": {"column": "Timestamp", "unit": "date"}, "frame": "NED", "columns": there}
    return TrialStreams([table_stream(table, SourceMap.model_validate(source), path.name)])


QGROUNDCONTROL = LogImporter(
    title="a CSV log of QGroundControl",
    recognises=lambda path, head: {"Timestamp", "heading", "altitudeRelative"} <= names_of(path, head),
    read=read,
)
