"""PX4 logs (.ulg) as streams, through pyulog."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path
from typing import Any

import numpy as np

from finssim.core.budget import limited_memory
from finssim.trials.findings import CalibrationError, Finding, finding
from finssim.trials.importers.ardusub_outputs import outputs_of
from finssim.trials.importers.assemble import SourceMap, Stream
from finssim.trials.importers.log import LogImporter, Request, TrialStreams
from finssim.trials.importers.table import stream_of
from finssim.trials.trial import Array
from finssim.trials.trial_files import ColumnTable

MAGIC = b"ULog\x01\x12\x35"

ARMED = 2
"""vehicle_status.arming_state of an armed vehicle."""


def _map(columns: dict[str, Any], **keys: Any) -> SourceMap:
    return SourceMap.model_validate({"frame": "NED", "valid": False, "columns": columns, **keys})


def _flagged(columns: str, flag: str) -> dict[str, Any]:
    return {name: {"column": name, "valid": flag} for name in columns.split()}


TOPICS: dict[str, SourceMap] = {
    "vehicle_attitude": _map({"qw": "q[0]", "qx": "q[1]", "qy": "q[2]", "qz": "q[3]"}),
    "vehicle_angular_velocity": _map({"p": "xyz[0]", "q": "xyz[1]", "r": "xyz[2]"}),
    "sensor_combined": _map(
        {name: f"gyro_rad[{i}]" for i, name in enumerate("pqr")}
        | {f"a{axis}": f"accelerometer_m_s2[{i}]" for i, axis in enumerate("xyz")}
    ),
    "vehicle_local_position": _map(
        _flagged("x y", "xy_valid")
        | _flagged("z", "z_valid")
        | _flagged("vx vy", "v_xy_valid")
        | _flagged("vz", "v_z_valid")
    ),
    "battery_status": _map(
        {"voltage": {"column": "voltage_v", "valid": {"column": "voltage_v", "above": 1.0}}}
    ),
}
"""Topic -> columns in forward-right-down axes of the body and north-east-down of the world; the preferred first."""


def read(path: Path, request: Request) -> TrialStreams:
    """Return the topics of a PX4 log as streams.

    Args:
        path: The log.
        request: Map and vehicle; a passive trial has no outputs.

    Raises:
        CalibrationError: No such log, or without a usual topic.
        ModuleNotFoundError: pyulog is not installed.
    """
    from pyulog import ULog

    try:
        with limited_memory(), contextlib.redirect_stdout(io.StringIO()):  # pyulog prints what it skips
            log = ULog(str(path))
    except Exception as error:  # what is damaged shows in whatever layer of pyulog meets it
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise CalibrationError(f"{path}: cannot be read as a PX4 log: {reason}") from None
    streams: list[Stream] = []
    findings: list[Finding] = []
    unread: list[str] = []
    if log.file_corruption:
        findings.append(finding("as_read", remark="the log is damaged: the intact part was read"))
    for data in sorted(log.data_list, key=lambda data: data.multi_id):
        name, count = data.name + (f" {data.multi_id}" if data.multi_id else ""), len(data.data["timestamp"])
        label = f"{path.name} {name}"
        t, table = 1e-6 * data.data["timestamp"], _table(data.data)
        try:
            if count < 2 or data.multi_id or data.name not in (*TOPICS, "actuator_outputs", "vehicle_status"):
                unread.append(f"{name} ({count})")
            elif data.name == "vehicle_status":
                labels = np.where(table.numbers["arming_state"] == ARMED, "armed", "disarmed").astype(np.str_)
                streams.append(Stream(source=label, t=t, words={"arming": labels}, rank=0))
            elif data.name == "actuator_outputs":
                if not request.passive:
                    streams.append(_outputs(table, t, label, request))
            else:
                stream = stream_of(table, _present(TOPICS[data.name], table), t, label)
                streams.append(Stream(**{**vars(stream), "rank": list(TOPICS).index(data.name)}))
        except CalibrationError as error:
            findings.append(finding("topic_unusable", topic=name, messages=count, reason=str(error)))
    if not any(stream.channels for stream in streams):
        raise CalibrationError(f"{path}: contains none of {', '.join(TOPICS)} with two messages")
    if unread:
        findings.append(finding("not_read", items=f"topics {', '.join(sorted(unread))}"))
    return TrialStreams([streams[0].noting(*findings), *streams[1:]])


def _table(data: dict[str, Any]) -> ColumnTable:
    return ColumnTable({name: np.asarray(values, dtype=float) for name, values in data.items()})


def _present(source: SourceMap, table: ColumnTable) -> SourceMap:
    """Return the map of those columns that this version of PX4 logs."""
    there = {name: spec for name, spec in source.columns.items() if spec.column in table.columns}
    if not all(name in there for name in ("vx", "vy", "vz")):
        there = {name: spec for name, spec in there.items() if name not in ("vx", "vy", "vz")}
    return source.model_copy(update={"columns": there})


def _outputs(table: ColumnTable, t: Array, label: str, request: Request) -> Stream:
    """Return the pulses of the outputs [µs]; a map or the vehicle's motor_index assigns them to thrusters.

    Raises:
        CalibrationError: The outputs are no pulses.
    """
    used = [i for i in range(16) if np.ptp(table.numbers.get(f"output[{i}]", np.zeros(1))) > 0.0]
    notes = [finding("pulses_unnamed")]
    outputs = {i + 1: (f"C{i + 1}", 1) for i in used}
    vehicle = request.vehicle
    if vehicle is not None and (
        request.mapped.ardusub.outputs or all(t.motor_index is not None for t in vehicle.thrusters.values())
    ):
        outputs, mapped = outputs_of(vehicle, {}, request.mapped.ardusub.outputs)
        notes = [mapped]
    channels = {}
    for number, (name, sign) in outputs.items():
        pulses = table.numbers.get(f"output[{number - 1}]", np.full(len(t), np.nan))
        inside = (pulses > 800.0) & (pulses < 2200.0)
        if np.isfinite(pulses).any() and not inside.any():
            raise CalibrationError(f"output {number} contains no pulses of 800 to 2200 µs")
        channels[f"pwm_{name}"] = np.where(inside, 1500.0 + sign * (pulses - 1500.0), np.nan)
    return Stream(source=label, t=t, channels=channels, findings=tuple(notes))


ULOG = LogImporter(title="a PX4 log (.ulg)", recognises=lambda path, head: head.startswith(MAGIC), read=read)
