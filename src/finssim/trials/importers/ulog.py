"""PX4 logs (.ulg) as streams, through pyulog."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from finssim.control.ardusub import NEUTRAL
from finssim.core.budget import TEXT, limited_memory, read_bytes
from finssim.core.frames import FROM_FOSSEN
from finssim.core.importer import Importer
from finssim.trials.findings import CalibrationError, Finding, finding
from finssim.trials.importers.ardusub_outputs import outputs_of, thrusters_of
from finssim.trials.importers.assemble import Stream
from finssim.trials.importers.column_map import present, shipped_maps
from finssim.trials.importers.log import Request, TrialStreams
from finssim.trials.importers.topics import LogTopic, log_of, times_of
from finssim.trials.trial import Array

APART = 0.05
"""Distance between a rotor in the parameters and the thruster in the vehicle file above which a finding is
reported [m]."""
MAGIC = b"ULog\x01\x12\x35"

TOPICS = shipped_maps("ulog.yaml")["topics"]
"""Topic -> map of its fields."""


class _BoundedFile(io.BytesIO):
    """File content with a limited number of reads, since pyulog loops forever on some damaged files."""

    def read(self, size: int | None = -1) -> bytes:
        self.reads = getattr(self, "reads", 0) + 1
        if self.reads > 10_000 + len(self.getbuffer()) // 2:
            raise CalibrationError("it is damaged and cannot be read")
        return super().read(size)


def read(path: Path, request: Request) -> TrialStreams:
    """Return the topics of a PX4 log as streams.

    Args:
        path: The log.
        request: Map and vehicle; a passive trial has no outputs.

    Raises:
        CalibrationError: The file is not a PX4 log, or contains no known topic.
        ModuleNotFoundError: pyulog is not installed.
    """
    from pyulog import ULog

    data = read_bytes(path, CalibrationError, limit=TEXT)
    try:
        with limited_memory(), contextlib.redirect_stdout(io.StringIO()):  # pyulog prints what it skips
            log = ULog(_BoundedFile(data))
    except Exception as error:  # depending on the damage, any layer of pyulog may raise
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise CalibrationError(f"{path}: cannot be read as a PX4 log: {reason}") from None
    topics: dict[str, LogTopic] = {}
    unread, outputs = [], []
    damaged = finding("as_read", remark="the log is damaged: the intact part was read")
    findings = [damaged] if log.file_corruption else []
    for data in sorted(log.data_list, key=lambda data: (data.name, data.multi_id)):
        name, t = data.name + (f" {data.multi_id}" if data.multi_id else ""), 1e-6 * data.data["timestamp"]
        if name in TOPICS:
            source = present(TOPICS[name], list(data.data))  # depends on the version of PX4
            topics[name] = LogTopic(source, list(TOPICS).index(name), received=t, cells=data.data)
        elif name == "actuator_outputs" and not request.passive and len(t) >= 2:
            outputs.append(_outputs(data.data, t, request, log.initial_parameters))
        else:
            unread.append(f"{name} ({len(t)})")
    unread[:1] = [f"topics {topic}" for topic in unread[:1]]
    if not topics:
        raise CalibrationError(f"{path}: contains none of {', '.join(TOPICS)}")
    return log_of(path.name, topics, times_of(topics, findings), findings, unread, outputs)


def _outputs(data: dict[str, Any], t: Array, request: Request, parameters: Mapping[str, float]) -> Stream:
    """Return the pulses of the outputs [µs], assigned to thrusters by a map, by the vehicle's motor_index, or
    by the geometry of the rotors in the log's parameters (in the autopilot's units)."""
    pulses = {i + 1: np.asarray(data[f"output[{i}]"], float) for i in range(16) if f"output[{i}]" in data}
    pulses = {
        i: np.where((values > 800.0) & (values < 2200.0), values, np.nan) for i, values in pulses.items()
    }
    outputs = {i: (f"C{i}", 1) for i, values in pulses.items() if np.isfinite(values).any()}
    vehicle, stated = request.vehicle, request.mapped.ardusub.outputs
    note = finding("pulses_unnamed")
    if vehicle is not None:
        note = finding("outputs_unassigned", vehicle=vehicle.name)
    if vehicle is not None and (stated or all(t.motor_index is not None for t in vehicle.thrusters.values())):
        outputs, note = outputs_of(vehicle, {}, stated)
        notes = [note]
    else:
        outputs, notes = _by_rotors(outputs, note, parameters, request)
    channels = {
        f"pwm_{name}": NEUTRAL + sign * (pulses[i] - NEUTRAL)
        for i, (name, sign) in outputs.items()
        if i in pulses
    }
    return Stream(source="actuator_outputs", t=t, channels=channels, findings=tuple(notes), rank=0)


def _by_rotors(
    outputs: dict[int, tuple[str, int]], note: Finding, parameters: Mapping[str, float], request: Request
) -> tuple[dict[int, tuple[str, int]], list[Finding]]:
    """Return outputs with their thrusters, by the positions and axes of the rotors (CA_ROTOR*), and findings.

    Without a vehicle, or if the rotors do not match its thrusters, the outputs and the note are returned unchanged.
    """
    count = int(parameters.get("CA_ROTOR_COUNT", 0))
    if count == 0:
        return outputs, [note]
    words = {"P": (0.0, 0.0, 0.0), "A": (0.0, 0.0, -1.0)}  # forward-right-down, and the defaults
    places, axes = (
        FROM_FOSSEN.vector([[parameters.get(f"CA_ROTOR{i}_{w}{c}", x) for c, x in zip("XYZ", xyz, strict=True)]
                            for i in range(count)])
        for w, xyz in words.items()
    )  # fmt: skip
    if not np.all(np.linalg.norm(axes, axis=1) > 0.0):
        return outputs, [note]
    thrust = np.array([np.sign(parameters.get(f"CA_ROTOR{i}_CT", 1.0)) for i in range(count)])
    axes *= (thrust / np.linalg.norm(axes, axis=1))[:, None]
    listed = [
        f"M{i + 1}: {{position: {_list(p)}, axis: {_list(a)}}}"
        for i, (p, a) in enumerate(zip(places, axes, strict=True))
    ]
    vehicle = request.vehicle
    if vehicle is None:
        return outputs, [note, finding("rotors_stated", rotors=", ".join(listed))]
    matched = None
    if count == len(vehicle.thrusters):
        matched = thrusters_of(vehicle, np.hstack([axes, np.cross(places, axes).round(3)]))
    if matched is None:
        return outputs, [note, finding("rotors_unlike", vehicle=vehicle.name, rotors=", ".join(listed))]
    driven = {}
    bank = next(
        (x for x in ("MAIN", "AUX") if any(100 < parameters.get(f"PWM_{x}_FUNC{i}", 0) for i in range(17))),
        "",
    )
    turned = int(parameters.get(f"PWM_{bank}_REV", 0))
    for output in outputs:
        motor = int(parameters.get(f"PWM_{bank}_FUNC{output}", 0)) - 100 if bank else output
        if 1 <= motor <= count:
            name, sign = matched[motor - 1]
            sign *= vehicle.thrusters[name].motor_sign or 1
            driven[output] = name, -sign if turned >> (output - 1) & 1 else sign
    pairs = tuple(f"C{i} {'-' if sign < 0 else ''}{name}" for i, (name, sign) in sorted(driven.items()))
    notes = [finding("outputs_mapped", how="by CA_ROTOR* of the log", pairs=pairs, neutral=NEUTRAL)]
    centre, thrusters = vehicle.body.center_of_gravity, vehicle.thrusters
    ours = [thrusters[name].position - centre for name, _ in matched]
    away = np.linalg.norm(np.subtract(ours, places), axis=1).tolist()
    if max(away) > APART:
        name, where = matched[int(np.argmax(away))][0], listed[int(np.argmax(away))]
        notes.append(
            finding("rotors_apart", thruster=name, vehicle=vehicle.name, distance=max(away), rotor=where)
        )
    return driven, notes


def _list(vector: Array) -> str:
    """Return a vector formatted as a list of a vehicle file, in its unit."""
    return f"[{', '.join(f'{x + 0.0:.4g}' for x in vector)}]"


ULOG = Importer(
    "trial", title="a PX4 log (.ulg)", recognises=lambda path, head: head.startswith(MAGIC), read=read
)
