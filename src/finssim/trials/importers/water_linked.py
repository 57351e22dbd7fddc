"""Importer of JSON lines of Water Linked's Doppler logs, for all versions of their protocol."""

from __future__ import annotations

import json
import math
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from finssim.core.importer import Importer
from finssim.core.text_table import read_text
from finssim.trials.findings import CalibrationError, finding
from finssim.trials.importers.column_map import TimeColumn, shipped_maps
from finssim.trials.importers.log import Request, TrialStreams
from finssim.trials.importers.table import used_columns
from finssim.trials.importers.topics import LogTopic, log_of

REPORTS = shipped_maps("water_linked.yaml")["reports"]
"""Type of a report -> map of its fields."""

LABELS = {"type", "format", "ts", "status", "time", "time_of_transmission", "time_of_validity"}
"""Fields that identify a report."""


def read(path: Path, request: Request) -> TrialStreams:
    """Return the velocities over ground, and dead reckoning if it uses the same clock, as streams.

    Args:
        path: File with one JSON object per line. Up to version 2 of the protocol a report has no clock: its
            `time` is the period since the last report, which is summed.
        request: Not used.

    Raises:
        CalibrationError: The file is unreadable, or contains no valid velocity.
    """
    text, _ = read_text(path, CalibrationError)
    reports: dict[str, list[dict[str, Any]]] = {kind: [] for kind in REPORTS}
    others: Counter[str] = Counter()
    for line in filter(str.strip, text.splitlines()):
        try:
            report = json.loads(line)
            kind = str(
                report.get("type", "velocity" if "velocity_valid" in report else "reports without a type")
            )
        except (ValueError, RecursionError, AttributeError):
            others["lines that are no JSON object"] += 1
            continue
        if kind == "velocity" and report.get("tracking_mode", "bottom") != "bottom":
            kind = "velocity_water"
        if kind in reports:
            reports[kind].append(report)
        else:
            others[kind] += 1
    velocity, position = reports["velocity"], reports["position_local"]
    if not velocity:
        raise CalibrationError(
            f"{path}: contains no velocity of a Water Linked log, expected one JSON object per line"
        )
    stamped = all(_number(report.get("time_of_validity")) > 0.0 for report in velocity)
    time = TimeColumn(column="time", unit="ms", kind="period")
    time = TimeColumn(column="time_of_validity", unit="us") if stamped else time
    t = time.seconds(np.array([_number(report.get(time.column)) for report in velocity]))
    if not np.isfinite(t).any():
        raise CalibrationError(f"{path}: the velocities have no '{time.column}' with numbers")
    findings = [finding("velocity_at_sensor", kind="the Doppler log")]
    topics, times = {"velocity": _topic("velocity", velocity)}, {"velocity": t}
    if not stamped:
        version = str(velocity[0].get("format", "this format"))
        findings.append(finding("periods_summed", name=version, count=len(t)))
    elif position:
        times["position_local"] = np.array([_number(report.get("ts")) for report in position])
        if np.nanmin(t) <= np.nanmedian(times["position_local"]) <= np.nanmax(t):
            topics["position_local"] = _topic("position_local", position)
    if "position_local" not in topics:
        others["position_local, which has another clock"] = len(position)
    used = {field for topic in topics.values() for field in topic.cells} | LABELS
    fields = {field for kind in topics for report in reports[kind] for field in report} - used
    unread = [f"{kind} ({count} lines)" for kind, count in others.items() if count]
    unread += [f"fields {', '.join(sorted(fields))}"] if fields else []
    return log_of(path.name, topics, times, findings, unread)


def _topic(kind: str, reports: list[dict[str, Any]]) -> LogTopic:
    """Return reports as a topic; a number that is missing in a report is NaN."""
    names = [name for name in used_columns(REPORTS[kind]) if any(name in report for report in reports)]
    return LogTopic(
        REPORTS[kind], cells={name: [_number(report.get(name)) for report in reports] for name in names}
    )


def _number(value: Any) -> float:
    return float(value) if isinstance(value, (int, float)) else math.nan


def _recognises(path: Path, head: bytes) -> bool:
    return head.lstrip().startswith(b"{") and (b'"json_v' in head or b'"velocity_valid"' in head)


WATER_LINKED = Importer(
    "trial", title="JSON lines of a Water Linked Doppler log", recognises=_recognises, read=read
)
