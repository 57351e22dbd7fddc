"""Assembly of trials from mapped columns: axes, world velocities, pressure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from finssim.core.frames import FROM_FOSSEN
from finssim.core.rotations import quat_from_euler, quat_inverse_rotate
from finssim.trials.conversion import (
    EULER,
    GRAVITY,
    QUATERNION,
    SAME_ROW,
    constant,
    factor,
    in_our_frames,
    merged,
    ordered,
    pressure_unit,
    refuse_coarse,
    tidy_quaternions,
    upside_down,
    without_dead,
    wrapped,
)
from finssim.trials.findings import CalibrationError, Finding, finding
from finssim.trials.importers.ardusub_outputs import STICKS, mixed_pulses
from finssim.trials.importers.column_map import GROUPS, ArduSubMap, ColumnMap, LogFrame, SplitRule
from finssim.trials.trial import NU, PHASES, Array, Header, Trial, column_of
from finssim.vehicles import load_vehicle
from finssim.vehicles.autopilot import FRAMES
from finssim.vehicles.part import did_you_mean

# Splitting of a long log into several tables, one per trial.

Rows = NDArray[np.bool_]


def split_table(name: str, table: Stream, rule: SplitRule | None) -> dict[str, Stream]:
    """Return name of a trial -> its part of the table, with times from 0; without a rule, the complete table.

    Raises:
        CalibrationError: The log lacks the column that the rule needs, or no piece remains.
    """
    if rule is None:
        return {name: table}
    pieces = (
        _windows(name, table, rule) if rule.by == "windows" else _numbered(name, _labels(name, table, rule))
    )
    long_enough = {
        piece: rows
        for piece, rows in pieces.items()
        if rows.sum() >= 2 and np.ptp(table.t[rows]) >= rule.shortest
    }
    if not long_enough:
        raise CalibrationError(
            f"{name}: splitting by {rule.by} leaves no piece of {rule.shortest:g} s or more"
        )
    return {piece: _part(table, rows) for piece, rows in long_enough.items()}


def _part(table: Stream, rows: Rows) -> Stream:
    t = table.t[rows]
    return table.selected(rows, np.round(t - t[0], 6)).noting(finding("log_cut", start=t[0], end=t[-1]))


WORDED = {
    "phase": ("phase", "no source of the map names a phase column"),
    "arming": ("arming", "the log has no arming messages"),
    "column": ("split", "no source of the map names a split column"),
}
"""Rule -> the word column that it uses, and the message if it is missing."""


def _labels(name: str, table: Stream, rule: SplitRule) -> NDArray[np.int64]:
    """Return the number of the piece of each row, -1 for none, (n,).

    A trial of `phase` starts with each baseline; without baselines, with each excitation that follows another phase.
    """
    if rule.by == "gaps":
        return np.cumsum(np.diff(table.t, prepend=table.t[0]) > rule.longest_gap)
    column, missing = WORDED[rule.by]
    if column not in table.words:
        raise CalibrationError(f"{name}: cannot be split by {column}: {missing}")
    texts = table.words[column]
    changes = np.concatenate([[True], texts[1:] != texts[:-1]])
    if rule.by == "phase":
        opening = "baseline" if (texts == "baseline").any() else "excitation"
        return np.cumsum(changes & (texts == opening)) - 1
    inside = texts == "armed" if rule.by == "arming" else ~np.isin(texts, ("", "nan", "None"))
    return np.where(inside, np.cumsum(changes & inside) - 1, -1)


def _numbered(name: str, labels: NDArray[np.int64]) -> dict[str, Rows]:
    count = int(labels.max(initial=-1)) + 1
    return {f"{name}_{i + 1:0{len(str(count))}d}": labels == i for i in range(count)}


def _windows(name: str, table: Stream, rule: SplitRule) -> dict[str, Rows]:
    pieces = {window: (table.t >= low) & (table.t <= high) for window, (low, high) in rule.windows.items()}
    empty = [window for window, rows in pieces.items() if not rows.any()]
    if empty:
        raise CalibrationError(
            f"{name}: window {empty[0]} is {list(rule.windows[empty[0]])} s, the log runs to {table.t[-1]:.3f} s"
        )
    return pieces


Texts = NDArray[np.str_]


@dataclass(frozen=True, kw_only=True)
class Stream:
    """Content of one file, topic or kind of message, in canonical columns and SI."""

    source: str
    """Name of the source in messages."""
    t: Array
    """Times on the clock of the log [s], (n,)."""
    channels: dict[str, Array] = field(default_factory=dict)
    """Canonical or extra column -> values in the units of a trial, (n,) each."""
    words: dict[str, Texts] = field(default_factory=dict)
    """`phase`, `split` or `arming` -> a word for every sample, (n,) each; a word is valid until the next."""
    findings: tuple[Finding, ...] = ()
    """Repairs, and omitted data."""
    rank: int = -1
    """Priority of the source: of two sources of a column, the one with the lower rank is used; -1 if chosen
    by the user."""

    def selected(self, rows: NDArray[np.intp] | NDArray[np.bool_], t: Array | None = None) -> Stream:
        """Return selected samples, in the given order; at times `t` if given. Times are in [s]."""
        return replace(
            self,
            t=self.t[rows] if t is None else t,
            channels={name: values[rows] for name, values in self.channels.items()},
            words={name: values[rows] for name, values in self.words.items()},
        )

    def noting(self, *findings: Finding) -> Stream:
        """Return the stream with additional findings."""
        return replace(self, findings=(*self.findings, *findings))


def in_order(stream: Stream, *, alone: bool) -> Stream:
    """Return the stream with strictly increasing times.

    Samples without a time are removed, late ones are sorted, and the first of several samples at one time is
    kept. Where the clock was set back, the remainder follows after a gap if the stream is `alone`
    (`finssim.trials.conversion.ordered`).

    Raises:
        CalibrationError: There are no samples, or the clock was set back in one of several streams, which
            cannot be aligned.
    """
    timed = np.isfinite(stream.t)
    untimed = [] if timed.all() else [finding("samples_untimed", samples=(~timed).sum())]
    stream = stream.selected(timed)
    if len(stream.t) < 2:
        raise CalibrationError(f"{stream.source}: {len(stream.t)} samples, expected at least two")
    try:
        t, rows, repaired = ordered(stream.t, stream.channels)
        refuse_coarse(t, {name: values[rows] for name, values in stream.channels.items()})
    except CalibrationError as error:
        raise CalibrationError(str(error), stream.source) from None
    jumps = [item.values for item in repaired if item.code == "clock_jump"]
    if not alone and jumps:
        raise CalibrationError(
            f"the clock jumps back from {jumps[0]['before']:.6g} s to {jumps[0]['after']:.6g} s at row "
            f"{jumps[0]['row']}, so its samples cannot be placed among those of the other sources: import the parts on "
            "their own, or cut the log there",
            stream.source,
        )
    stream = stream.selected(rows, t)
    first = np.concatenate([[True], np.diff(t) > SAME_ROW])
    if not first.all():
        repaired = [*repaired, finding("samples_repeat", samples=(~first).sum())]
        stream = stream.selected(first)
    if len(stream.t) < 2:
        raise CalibrationError(
            f"{stream.source}: the time never increases: name the column that contains the time"
        )
    return stream.noting(*(item.about(stream.source) for item in (*untimed, *repaired)))


def moved_in_time(streams: Sequence[Stream], offsets: Mapping[str, float]) -> list[Stream]:
    """Return the streams with columns, or groups of columns, shifted in time; words are not shifted.

    Args:
        streams: Streams of a trial.
        offsets: Column or group -> offset added to its times [s].

    Raises:
        CalibrationError: A key is neither a group nor a column of these streams.
    """
    movable = [*GROUPS, *(name for stream in streams for name in stream.channels)]
    for key in offsets:
        if key not in movable:
            raise CalibrationError(
                f"time_offsets: '{key}' is neither a group nor a column of this log{did_you_mean(key, movable)} "
                f"groups are {', '.join(GROUPS)}"
            )
    out = []
    for stream in streams:
        groups = {name: column.group if (column := column_of(name)) else "" for name in stream.channels}
        by = {name: offsets.get(name, offsets.get(group, 0.0)) for name, group in groups.items()}
        for seconds in dict.fromkeys(
            [*([] if stream.channels and not stream.words else [0.0]), *by.values()]
        ):
            part = {name: values for name, values in stream.channels.items() if by[name] == seconds}
            texts = stream.words if seconds == 0.0 else {}
            out.append(replace(stream, t=stream.t + seconds, channels=part, words=texts))
    return out


def merge(streams: Sequence[Stream]) -> Stream:
    """Return all streams on their combined times, which start at 0.

    Raises:
        CalibrationError: Two streams contain the same column, or streams do not overlap in time.
    """
    each = [in_order(stream, alone=len(streams) == 1) for stream in without_doubles(streams)]
    _refuse_disjoint(each)
    start = min(float(stream.t[0]) for stream in each)
    # In integer microseconds, so that a trial has the same times after writing and reading.
    each = [replace(stream, t=np.round(stream.t - start, 6)) for stream in each]
    columns = {name: (stream.t, values) for stream in each for name, values in stream.channels.items()}
    spoken = {name: (stream.t, texts) for stream in each for name, texts in stream.words.items()}
    t, channels = merged(columns)
    texts = {}
    for name, (times, labels) in spoken.items():
        held = np.searchsorted(times, t, side="right") - 1
        texts[name] = np.where(held >= 0, labels[np.maximum(held, 0)], "")
    findings = [item for stream in each for item in stream.findings]
    if start > 1e8:
        findings.append(finding("clock_origin", start=start))
    found = tuple(dict.fromkeys(findings))
    return Stream(source="the log", t=t, channels=channels, words=texts, findings=found)


def without_doubles(streams: Sequence[Stream]) -> list[Stream]:
    """Return the streams with one source for each column: one that changes, then the one with the lowest rank.

    Raises:
        CalibrationError: Two sources of equal rank contain the same column or words.
    """
    out = list(streams)
    names_of = [name for stream in out for name in (*stream.channels, *stream.words)]
    groups = {name: group for group in (QUATERNION, ("depth", "pressure")) for name in group}
    for names in dict.fromkeys(groups.get(name, (name,)) for name in names_of):
        holders = [i for i, stream in enumerate(out) if any(name in stream.channels for name in names)]
        holders += [i for i, stream in enumerate(out) if names[0] in stream.words]
        moving = [i for i in holders if not _dead(out[i], names)] or holders
        best = min(moving, key=lambda i: out[i].rank)
        for i in set(holders) - {best}:
            if i in moving and out[i].rank == out[best].rank:
                one, other = (out[k].source for k in sorted((i, best)))
                raise CalibrationError(
                    f"{names[0]} is in {one} and in {other}: choose one of them in the map"
                )
            out[i] = _without(out[i], names, out[best].source, dead=i not in moving)
    return [stream for stream in out if stream.channels or stream.words or stream.findings]


def _dead(stream: Stream, names: tuple[str, ...]) -> bool:
    values = [stream.channels[name] for name in names if name in stream.channels]
    return bool(values) and all(constant(column) for column in values)


def _without(stream: Stream, names: tuple[str, ...], better: str, *, dead: bool) -> Stream:
    """Return the stream without some columns, with one finding for all columns replaced by another stream."""
    gone, findings = tuple(name for name in names if name in stream.channels), []
    for item in stream.findings:
        if item.code in ("stream_dead", "columns_left_out") and item.values["better"] == better:
            gone = (*item.values["columns"], *gone)
            dead &= item.code == "stream_dead"
        else:
            findings.append(item)
    channels = {name: values for name, values in stream.channels.items() if name not in names}
    words = {name: texts for name, texts in stream.words.items() if name not in names}
    about = {"columns": gone, "topic": stream.source, "better": better}
    note = finding("stream_dead" if dead else "columns_left_out", **about)
    return replace(stream, channels=channels, words=words, findings=(*findings, note))


def _refuse_disjoint(streams: Sequence[Stream]) -> None:
    longest = max(streams, key=lambda stream: stream.t[-1] - stream.t[0])
    for stream in streams:
        if stream.t[0] > longest.t[-1] or stream.t[-1] < longest.t[0]:
            raise CalibrationError(
                f"times of {longest.source} run from {longest.t[0]:.6g} to {longest.t[-1]:.6g} s and those of "
                f"{stream.source} from {stream.t[0]:.6g} to {stream.t[-1]:.6g} s: they do not overlap: give the "
                f"unit of the time, or a time_offset in the map that puts them on one clock"
            )


WORLD_VELOCITY = ("vx", "vy", "vz")
STANDARD_ATMOSPHERE = 101325.0
LONGEST_BRIDGE = 0.5
"""Longest interval between two attitudes that are interpolated to rotate a world velocity [s]."""


def in_our_axes(stream: Stream, frame: LogFrame, *, radians: bool = True) -> Stream:
    """Return the stream in axes x forward, y left, z up and a world with z up, with angles in [-pi, pi).

    Args:
        stream: Stream in the log's axes.
        frame: Axes of the log.
        radians: False if the angles may be in degrees; they are then wrapped only within two turns.
    """
    channels = wrapped(in_our_frames(stream.channels, frame.body, frame.world), everything=radians)
    if frame.world == "NED":
        for name, sign in zip(WORLD_VELOCITY, FROM_FOSSEN.A.diagonal(), strict=True):
            if name in channels:
                channels[name] = sign * channels[name]
    return replace(stream, channels=channels)


def trial_of(name: str, table: Stream, header: Header, column_map: ColumnMap) -> Trial:
    """Return the trial of a table, with u v w and depth computed from world velocities and pressure.

    Raises:
        CalibrationError: There are world velocities without an attitude, or in addition to body velocities.
    """
    channels, findings = dict(table.channels), list(table.findings)
    findings += _without_empty(channels)
    world = [c for c in WORLD_VELOCITY if c in channels]
    if 0 < len(world) < len([c for c in WORLD_VELOCITY if c in table.channels]):  # the others are empty
        findings.append(finding("world_velocity_incomplete", columns=tuple(world)))
        channels = {c: v for c, v in channels.items() if c not in WORLD_VELOCITY}
    elif world:
        channels |= _body_velocity(name, table.t, channels)
        channels = {c: v for c, v in channels.items() if c not in WORLD_VELOCITY}
        findings += _without_empty(channels)
    if (
        {"pressure", "depth"} <= set(channels)
        and constant(channels["pressure"])
        and not constant(channels["depth"])
    ):
        del channels["pressure"]
        findings.append(finding("never_changes", columns=("pressure",), moving=("depth",)))
    if "pressure" in channels:
        depth, assumed = _depth(name, channels.pop("pressure"), header, column_map)
        findings += assumed
        channels["depth"] = depth
    if any(c in channels for c in STICKS):
        pulses, mixed = _pulses(name, channels, header, column_map.ardusub)
        channels = {c: v for c, v in channels.items() if c not in STICKS} | pulses
        findings += mixed
    findings += without_dead(table.t, channels)
    findings += tidy_quaternions(channels)
    if upside_down(channels):
        findings.append(finding("upside_down"))
    if not channels:
        raise CalibrationError(f"{name}: no column of a trial contains a number")
    findings.sort(key=lambda item: item.code == "not_read")  # shown last in an import
    return Trial(
        name=name, t=table.t, channels=channels, phase=_phase(table), header=header, findings=tuple(findings)
    )


def _without_empty(channels: dict[str, Array]) -> list[Finding]:
    """Remove columns without any number, in place."""
    empty = [column for column, values in channels.items() if not np.isfinite(values).any()]
    for column in empty:
        del channels[column]
    return [finding("column_empty", column=column) for column in empty]


def _phase(table: Stream) -> np.ndarray | None:
    if "phase" not in table.words:
        return None
    labels = table.words["phase"]
    return np.where(np.isin(labels, PHASES), labels, "").astype(np.str_)


def _body_velocity(name: str, t: Array, channels: dict[str, Array]) -> dict[str, Array]:
    """Return u v w from world velocities and the attitude interpolated to their times."""
    from scipy.spatial.transform import Rotation, Slerp

    missing = [c for c in WORLD_VELOCITY if c not in channels]
    if missing or any(c in channels for c in NU[:3]):
        raise CalibrationError(
            f"{name}: expected all of vx, vy, vz (in the world) or u, v, w (in the body), not both"
            + (f": {', '.join(missing)} missing" if missing else "")
        )
    if all(c in channels for c in QUATERNION):
        q = np.stack([channels[c] for c in QUATERNION], axis=-1)
    elif all(c in channels for c in EULER):
        q = quat_from_euler(*(channels[c] for c in EULER))
    else:
        raise CalibrationError(
            f"{name}: vx, vy, vz are world velocities, which cannot be converted to u, v, w without an attitude: "
            "map roll pitch yaw or qx qy qz qw"
        )
    valid = np.isfinite(q).all(axis=-1) & (np.linalg.norm(np.nan_to_num(q), axis=-1) > 0.5)
    velocity = np.stack([channels[c] for c in WORLD_VELOCITY], axis=-1)
    if valid.sum() < 2:
        raise CalibrationError(f"{name}: the attitude for vx, vy, vz has fewer than two samples")
    times = t[valid]
    after = np.clip(np.searchsorted(times, t), 1, len(times) - 1)
    near = (t >= times[0]) & (t <= times[-1]) & (times[after] - times[after - 1] <= LONGEST_BRIDGE)
    near |= np.isin(t, times)
    usable = near & np.isfinite(velocity).all(axis=-1)
    body = np.full_like(velocity, np.nan)
    if usable.any():
        attitude = Slerp(times, Rotation.from_quat(q[valid]))(t[usable]).as_quat()
        body[usable] = quat_inverse_rotate(attitude, velocity[usable])
    return dict(zip(NU[:3], body.T, strict=True))


def _pulses(
    name: str, channels: dict[str, Array], header: Header, requested: ArduSubMap
) -> tuple[dict[str, Array], list[Finding]]:
    """Pulse widths of the vehicle's thrusters [µs] from the sticks, by ArduSub's mixer; and findings."""
    if requested.frame is None or header.vehicle is None:
        raise CalibrationError(
            f"{name}: stick_* columns go through ArduSub's mixer: give its frame in the map, "
            "'ardusub: {frame: VECTORED_6DOF}' or VECTORED, and the vehicle"
        )
    pulses = [c for c in channels if c.startswith("pwm_")]
    if pulses:
        raise CalibrationError(
            f"{name}: expected stick_* or pwm_* columns, not both: {pulses[0]} is there as well"
        )
    sticks = [channels[c] for c in STICKS if c in channels]
    valid = np.all([np.isfinite(v) for v in sticks], axis=0)
    demands = np.stack([channels.get(c, np.zeros(len(valid))) for c in STICKS], axis=-1)
    beyond = float(np.abs(demands[valid]).max(initial=0.0))
    if beyond > 1.01:
        raise CalibrationError(
            f"{name}: stick_* reach {beyond:g}, expected demands in [-1, 1]: "
            "give scale and offset in the map, scale: 0.0025 and offset: -3.75 for channels of 1100 to 1900 µs"
        )
    vehicle = load_vehicle(header.vehicle)
    config = next(number for number, (frame, _) in FRAMES.items() if frame == requested.frame)
    parameters = {"FRAME_CONFIG": float(config)}
    parameters |= {f"MOT_{motor + 1}_DIRECTION": 1.0 for motor in range(len(FRAMES[config][1]))}
    findings, mapped = mixed_pulses(
        vehicle, requested.gain * demands, parameters, requested.motor_directions, requested.outputs
    )
    return findings, [finding("sticks_mixed", frame=requested.frame, gain=requested.gain), mapped]


def _depth(name: str, pressure: Array, header: Header, column_map: ColumnMap) -> tuple[Array, list[Finding]]:
    """Return the depth of the pressure sensor [m]: (p - p_surface) / (rho g)."""
    vehicle = load_vehicle(header.vehicle) if header.vehicle is not None else None
    density = header.water.density or (vehicle.water.density if vehicle else 1000.0)
    gravity = vehicle.water.gravity if vehicle else GRAVITY
    surface = column_map.surface_pressure
    findings = [finding("depth_of_pressure", density=density)]
    if surface != 0.0:
        unit, finite = pressure_unit(pressure), pressure[np.isfinite(pressure)]
        low, high = float(finite.min()), float(finite.max())
        if unit is None:
            raise CalibrationError(
                f"{name}: pressures of {low:.6g} to {high:.6g} are not absolute pressures in water in Pa, hPa or kPa: "
                "give 'unit:' of the column in a map, and 'surface_pressure: 0' for a gauge"
            )
        if unit != "Pa":
            findings.append(finding("pressure_unit", low=low, high=high, unit=unit))
        pressure = pressure * factor(unit, "pressure")
    if surface is None:
        surface = STANDARD_ATMOSPHERE
        findings.append(finding("surface_pressure_assumed", pressure=surface))
    return (pressure - surface) / (density * gravity), findings
