"""JSON lines of Water Linked's Doppler logs, of all versions of their protocol."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from finssim.core.text_table import read_text
from finssim.trials.findings import CalibrationError, finding
from finssim.trials.importers.assemble import SourceMap, TimeColumn
from finssim.trials.importers.log import LogImporter, Request, TrialStreams
from finssim.trials.importers.table import WORST_FOM, stream_of
from finssim.trials.trial_files import ColumnTable

FIELDS = (
    "vx",
    "vy",
    "vz",
    "velocity_valid",
    "fom",
    "time",
    "time_of_validity",
    "x",
    "y",
    "roll",
    "pitch",
    "yaw",
)

VELOCITY = SourceMap.model_validate(
    {
        "frame": "FRD",
        "columns": {"u": "vx", "v": "vy", "w": "vz"},
        "valid": ["velocity_valid", {"column": "fom", "below": WORST_FOM}],
    }
)
POSITION = SourceMap.model_validate(
    {
        "frame": "NED",
        "columns": {
            "x": "x",
            "y": "y",
            **{name: {"column": name, "unit": "deg"} for name in ("roll", "pitch", "yaw")},
        },
        "valid": {"column": "status", "value": 0},
    }
)
"""Dead reckoning; its z counts from its start, not from the surface."""


def read(path: Path, request: Request) -> TrialStreams:
    """Return the velocities over the floor, and dead reckoning if it has the same clock, as streams.

    Args:
        path: One JSON object a line. Until version 2 of the protocol a report has no clock: its `time` is the period
            since the last report, which is summed up.
        request: Not used.

    Raises:
        CalibrationError: Unreadable, or without a valid velocity.
    """
    text, _ = read_text(path, CalibrationError)
    reports: dict[str, list[dict[str, Any]]] = {"velocity": [], "position_local": []}
    others: Counter[str] = Counter()
    for line in text.splitlines():
        try:
            report = json.loads(line) if line.strip() else None
        except (ValueError, RecursionError):
            report = line
        if not isinstance(report, dict):
            others["lines that are no JSON object"] += report is not None
            continue
        kind = str(report.get("type", "velocity" if "velocity_valid" in report else "reports without a type"))
        if kind == "velocity" and report.get("tracking_mode", "bottom") != "bottom":
            kind = "velocity_water"
        if kind in reports:
            reports[kind].append(report)
        else:
            others[kind] += 1
    velocity, position = reports["velocity"], reports["position_local"]
    if not velocity:
        raise CalibrationError(
            f"{path}: no velocity of a Water Linked log in it, expected one JSON object a line"
        )
    table, unread = _table(velocity)
    clock = table.numbers.get("time_of_validity")
    stamped = clock is not None and bool((clock > 0.0).all())
    time = TimeColumn(column="time", unit="ms", kind="period")
    time = TimeColumn(column="time_of_validity", unit="us") if stamped else time
    if time.column not in table.numbers:
        raise CalibrationError(f"{path}: the velocities have no '{time.column}' with numbers")
    t = time.seconds(table.numbers[time.column])
    notes = [finding("velocity_at_sensor", kind="the Doppler log")]
    if not stamped:
        notes.append(
            finding("periods_summed", name=str(velocity[0].get("format", "this format")), count=len(t))
        )
    streams = [stream_of(table, VELOCITY, t, f"{path.name} velocity").noting(*notes)]
    if position and stamped:
        table, more = _table(position)
        streams.append(stream_of(table, POSITION, table.numbers["ts"], f"{path.name} position_local"))
        unread |= more
    elif position:
        others["position_local, which has another clock"] = len(position)
    unread -= {"type", "format", "ts", "status", "time", "time_of_transmission", "time_of_validity"}
    items = [f"{kind} ({count} lines)" for kind, count in others.items() if count]
    items += [f"fields {', '.join(sorted(unread))}"] if unread else []
    return TrialStreams([streams[0].noting(finding("not_read", items="; ".join(items))), *streams[1:]])


def _table(reports: list[dict[str, Any]]) -> tuple[ColumnTable, set[str]]:
    """Return the numbers of reports as columns, and the names of the fields that are not read."""
    table = ColumnTable()
    names = dict.fromkeys(name for report in reports for name in report)
    for name in names:
        cells = [report.get(name) for report in reports]
        if all(cell is None or isinstance(cell, (int, float)) for cell in cells):
            table.numbers[name] = np.array([np.nan if cell is None else float(cell) for cell in cells])
    return table, {name for name in names if name not in FIELDS}


def _recognises(path: Path, head: bytes) -> bool:
    return head.lstrip().startswith(b"{") and (b'"json_v' in head or b'"velocity_valid"' in head)


WATER_LINKED = LogImporter(
    title="JSON lines of a Water Linked Doppler log", recognises=_recognises, read=read
)
