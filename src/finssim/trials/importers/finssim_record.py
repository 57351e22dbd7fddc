"""FinsSim records within bags: thrusters by name, phases and arming from events, and the vehicle."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from finssim.core.files import plain_name
from finssim.core.mcap_files import mcap_metadata
from finssim.core.yaml_file import json_value
from finssim.trials.findings import CalibrationError, Finding, finding
from finssim.trials.importers.assemble import Stream
from finssim.trials.importers.column_map import ColumnSource, SourceMap
from finssim.vehicles import VehicleError, catalogue_vehicle

NATIVE = "finssim_msgs/msg/"
"""Prefix of the message types in our own bags."""

ACTUATORS = "actuator_states"
"""Last component of the topic with the values of non-thruster actuators, as joint positions."""

TRIAL_TOPICS = (
    "odom",
    "imu",
    "joint_states",
    ACTUATORS,
    "thruster_state",
    "thruster_cmd",
    "telemetry",
    "pressure",
)
"""Last components of the topics of a trial; the requested wrench and the goal do not describe the actual motion."""

COMPASS = "/compass/imu"
"""Topic of an Imu message that contains only a heading, without rates and specific force."""

ARMING = {"armed": "armed", "disarmed": "disarmed", "fault": "disarmed"}
"""Kind of an event -> arming state from then on, until the next such event."""

THRUSTERS: dict[str, dict[str, tuple[str, str]]] = {
    "sensor_msgs/msg/JointState": {"rpm_": ("velocity", "rad/s")},
    "finssim_msgs/msg/ThrusterState": {"rpm_": ("shaft_speed", "rad/s"), "command_": ("force", "N")},
    "finssim_msgs/msg/ThrusterCommand": {"command_": ("force", "N")},
}
"""Type -> prefix of a trial's columns -> list in the message and its unit, one number per thruster."""


def native_topics(types: Mapping[str, str]) -> dict[str, SourceMap]:
    """Return FinsSim's own topics that form a trial; none for a bag without message types of FinsSim.

    Args:
        types: Topic -> type, for all topics of the bag.
    """
    if not any(kind.startswith(NATIVE) for kind in types.values()):
        return {}
    return {
        topic: SourceMap()
        for topic in sorted(types)
        if topic.rsplit("/", 1)[-1] in TRIAL_TOPICS and not topic.endswith(COMPASS)
    }


def thruster_columns(topic: str, kind: str, message: Any) -> dict[str, ColumnSource]:
    """Return the columns of a message, named by thrusters or other actuators; empty lists yield none."""
    names = names_of(message)
    lists = THRUSTERS.get(kind, {})
    if topic.rsplit("/", 1)[-1] == ACTUATORS:
        lists = {"actuator_": ("position", "-")}
    return {
        f"{prefix}{name}": ColumnSource(column=f"{field}[{name}]", unit=unit)
        for prefix, (field, unit) in lists.items()
        if len(getattr(message, field)) == len(names)
        for name in names
    }


def names_of(message: Any) -> list[str]:
    return [str(name) for name in getattr(message, "names", getattr(message, "name", ()))]


def spoken_events(topic: str, events: Iterable[tuple[float, str]], start: float) -> Stream | None:
    """Return phases and arming from the events of a record; None if they contain neither.

    Args:
        topic: Topic of the events.
        events: Time [s] and JSON of each event, in order.
        start: Start of the record [s]; before the first event there is no phase, and the vehicle is disarmed.
    """
    times, phase, arming = [start], [""], ["disarmed"]
    for time, text in events:
        try:
            event = json_value(text, CalibrationError, topic)
            kind, word = str(event["kind"]), str(event.get("text", ""))
        except (ValueError, KeyError, TypeError, AttributeError):
            continue  # text of other programs
        if kind != "phase" and kind not in ARMING:
            continue
        times.append(time)
        phase.append(word if kind == "phase" else phase[-1])
        arming.append(ARMING.get(kind, arming[-1]))
    labels = {"phase": phase, "arming": arming}
    spoken = {name: np.array(list_, dtype=np.str_) for name, list_ in labels.items() if len(set(list_)) > 1}
    return Stream(source=topic, t=np.array(times), words=spoken) if spoken else None


def recorded_header(path: Path) -> tuple[dict[str, Any], list[Finding]]:
    """Return the keys of a record for `trial.yaml`, and findings about it; nothing for a foreign file.

    Raises:
        CalibrationError: The header in the record is invalid.
    """
    about = mcap_metadata(path, "finssim")
    try:
        header = dict(json_value(about.get("trial", "{}"), CalibrationError, path.name))
    except (ValueError, TypeError):
        raise CalibrationError(
            f"{path.name}: the record's 'trial' is {about['trial']!r}, expected a mapping"
        ) from None
    name = header.pop("vehicle", about.get("vehicle"))
    if name is None:
        return header, []
    plain_name(str(name), f"{path.name}: vehicle", CalibrationError)
    try:
        vehicle = catalogue_vehicle(str(name), path.name)
    except VehicleError:
        return header, [finding("vehicle_unknown", path.name, vehicle=name)]
    changed = name == about.get("vehicle") and vehicle.sha256 != about.get("vehicle_sha256")
    remarks = [finding("vehicle_changed", path.name, vehicle=name)] if changed else []
    return {"vehicle": name, **header}, remarks
