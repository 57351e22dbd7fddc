"""What our own records add to a bag: thrusters by name, phases and arming from events, the vehicle they are of."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from finssim.calibration.errors import CalibrationError
from finssim.calibration.findings import Finding, finding
from finssim.calibration.importers.source_map import ColumnSource, SourceMap
from finssim.calibration.importers.streams import Stream
from finssim.files import plain_name
from finssim.mcap_metadata import mcap_metadata
from finssim.vehicles import VehicleError, catalogue_vehicle

__all__ = ["THRUSTERS", "own_topics", "recorded_header", "spoken_events", "thruster_columns"]

OWN = "finssim_msgs/msg/"
"""Types by which a bag of ours is known, whoever wrote the file."""

TAKEN = ("odom", "imu", "joint_states", "thruster_state", "thruster_cmd", "telemetry", "pressure")
"""Last parts of the topics that a trial is made of; the wanted wrench and the goal say nothing about what happened."""

COMPASS = "/compass/imu"
"""An Imu that tells a heading alone, without rates and specific force."""

ARMING = {"armed": "armed", "disarmed": "disarmed", "fault": "disarmed"}
"""Kind of an event -> whether thrusters may turn from then on; while it holds, an armed bridge stays armed."""

THRUSTERS: dict[str, dict[str, tuple[str, str]]] = {
    "sensor_msgs/msg/JointState": {"rpm_": ("velocity", "rad/s")},
    "finssim_msgs/msg/ThrusterState": {"rpm_": ("shaft_speed", "rad/s"), "command_": ("force", "N")},
    "finssim_msgs/msg/ThrusterCommand": {"command_": ("force", "N")},
}
"""Type -> prefix of a trial's columns -> list of the message and its unit, one number a thruster."""


def own_topics(known: Mapping[str, str]) -> dict[str, SourceMap]:
    """Topics of ours that make a trial; none of a bag without a type of ours.

    Args:
        known: Topic -> type, all that the bag has.
    """
    if not any(kind.startswith(OWN) for kind in known.values()):
        return {}
    return {
        topic: SourceMap()
        for topic in sorted(known)
        if topic.rsplit("/", 1)[-1] in TAKEN and not topic.endswith(COMPASS)
    }


def thruster_columns(kind: str, message: Any) -> dict[str, ColumnSource]:
    """Columns that a message holds by the names of thrusters; lists that it leaves empty hold none."""
    names = _names(message)
    return {
        f"{prefix}{name}": ColumnSource(column=f"{field}[{name}]", unit=unit)
        for prefix, (field, unit) in THRUSTERS.get(kind, {}).items()
        if len(getattr(message, field)) == len(names)
        for name in names
    }


def _names(message: Any) -> list[str]:
    return [str(name) for name in getattr(message, "names", getattr(message, "name", ()))]


def spoken_events(topic: str, said: Iterable[tuple[float, str]], start: float) -> Stream | None:
    """Phases and arming that the events of a record tell; None where they tell neither.

    Args:
        topic: Of the events.
        said: Time [s] and JSON of each, in order.
        start: Of the record [s]; before the first event there is no phase, and the vehicle is disarmed.
    """
    times, phase, arming = [start], [""], ["disarmed"]
    for time, text in said:
        try:
            event = json.loads(text)
            kind, word = str(event["kind"]), str(event.get("text", ""))
        except (ValueError, KeyError, TypeError, AttributeError):
            continue  # somebody else's words
        if kind != "phase" and kind not in ARMING:
            continue
        times.append(time)
        phase.append(word if kind == "phase" else phase[-1])
        arming.append(ARMING.get(kind, arming[-1]))
    words = {"phase": phase, "arming": arming}
    spoken = {name: np.array(list_, dtype=np.str_) for name, list_ in words.items() if len(set(list_)) > 1}
    return Stream(source=topic, t=np.array(times), words=spoken) if spoken else None


def recorded_header(path: Path) -> tuple[dict[str, Any], list[Finding]]:
    """What a record says for `trial.yaml`, and findings about it; nothing of a foreign file.

    Raises:
        CalibrationError: The record's own words for the header are broken.
    """
    about = mcap_metadata(path, "finssim")
    try:
        told = dict(json.loads(about.get("trial", "{}")))
    except (ValueError, TypeError):
        raise CalibrationError(
            f"{path.name}: the record's 'trial' is {about['trial']!r}, expected a mapping"
        ) from None
    name = told.pop("vehicle", about.get("vehicle"))
    if name is None:
        return told, []
    plain_name(str(name), f"{path.name}: vehicle", CalibrationError)
    try:
        vehicle = catalogue_vehicle(str(name), path.name)
    except VehicleError:
        return told, [finding("vehicle_unknown", path.name, vehicle=name)]
    changed = name == about.get("vehicle") and vehicle.sha256 != about.get("vehicle_sha256")
    remarks = [finding("vehicle_changed", path.name, vehicle=name)] if changed else []
    return {"vehicle": name, **told}, remarks
