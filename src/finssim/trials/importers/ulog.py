"""PX4 logs (.ulg) as streams, through pyulog."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path
from typing import Any

import numpy as np

from finssim.control.ardusub import NEUTRAL
from finssim.core.budget import TEXT, limited_memory, read_bytes
from finssim.core.importer import Importer
from finssim.trials.findings import CalibrationError, finding
from finssim.trials.importers.ardusub_outputs import outputs_of
from finssim.trials.importers.assemble import Stream, present, shipped_maps
from finssim.trials.importers.log import Request, TrialStreams
from finssim.trials.importers.topics import LogTopic, log_of, times_of
from finssim.trials.trial import Array

MAGIC = b"ULog\x01\x12\x35"

TOPICS = shipped_maps("ulog.yaml")["topics"]
"""Topic -> map of its fields."""


class _BoundedFile(io.BytesIO):
    """Content of a file that is read a bounded number of times, for pyulog does not leave some damaged files."""

    def read(self, size: int | None = -1) -> bytes:
        self.reads = getattr(self, "reads", 0) + 1
        if self.reads > 10_000 + len(self.getbuffer()) // 2:
            raise CalibrationError("it is damaged, and no part of it can be read")
        return super().read(size)


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

    data = read_bytes(path, CalibrationError, limit=TEXT)
    try:
        with limited_memory(), contextlib.redirect_stdout(io.StringIO()):  # pyulog prints what it skips
            log = ULog(_BoundedFile(data))
    except Exception as error:  # what is damaged shows in whatever layer of pyulog meets it
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise CalibrationError(f"{path}: cannot be read as a PX4 log: {reason}") from None
    topics: dict[str, LogTopic] = {}
    unread, outputs = [], []
    damaged = finding("as_read", remark="the log is damaged: the intact part was read")
    findings = [damaged] if log.file_corruption else []
    for data in sorted(log.data_list, key=lambda data: (data.name, data.multi_id)):
        name, t = data.name + (f" {data.multi_id}" if data.multi_id else ""), 1e-6 * data.data["timestamp"]
        if name in TOPICS:
            source = present(TOPICS[name], list(data.data))  # versions of PX4 differ
            topics[name] = LogTopic(source, list(TOPICS).index(name), received=t, cells=data.data)
        elif name == "actuator_outputs" and not request.passive and len(t) >= 2:
            outputs.append(_outputs(data.data, t, request))
        else:
            unread.append(f"{name} ({len(t)})")
    unread[:1] = [f"topics {topic}" for topic in unread[:1]]
    if not topics:
        raise CalibrationError(f"{path}: contains none of {', '.join(TOPICS)}")
    return log_of(path.name, topics, times_of(topics, findings), findings, unread, outputs)


def _outputs(data: dict[str, Any], t: Array, request: Request) -> Stream:
    """Return the pulses of the outputs [µs]; a map or the vehicle's motor_index assigns them to thrusters."""
    pulses = {i + 1: np.asarray(data[f"output[{i}]"], float) for i in range(16) if f"output[{i}]" in data}
    pulses = {
        i: np.where((values > 800.0) & (values < 2200.0), values, np.nan) for i, values in pulses.items()
    }
    outputs = {i: (f"C{i}", 1) for i, values in pulses.items() if np.isfinite(values).any()}
    vehicle, stated = request.vehicle, request.mapped.ardusub.outputs
    note = (
        finding("outputs_unassigned", vehicle=vehicle.name)
        if vehicle is not None
        else finding("pulses_unnamed")
    )
    if vehicle is not None and (stated or all(t.motor_index is not None for t in vehicle.thrusters.values())):
        outputs, note = outputs_of(vehicle, {}, stated)
    channels = {
        f"pwm_{name}": NEUTRAL + sign * (pulses[i] - NEUTRAL)
        for i, (name, sign) in outputs.items()
        if i in pulses
    }
    return Stream(source="actuator_outputs", t=t, channels=channels, findings=(note,), rank=0)


ULOG = Importer(
    "trial", title="a PX4 log (.ulg)", recognises=lambda path, head: head.startswith(MAGIC), read=read
)
