"""Conversion of units, clocks and axes of logs to those of trials."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from finssim.core.frames import FROM_FOSSEN
from finssim.core.rotations import (
    matrix_to_quat,
    quat_from_euler,
    quat_multiply,
    quat_rotate,
    quat_to_euler,
    wrap_angle,
)
from finssim.trials.findings import CalibrationError, Finding, finding
from finssim.trials.trial import column_of
from finssim.vehicles.autopilot import DEMANDS
from finssim.vehicles.part import did_you_mean

Array = NDArray[np.float64]

GRAVITY = 9.80665
"""Standard gravity, for the units g and kgf [m/s²]."""

POUND = 0.45359237
"""Mass of a pound, for the unit lbf; an ounce (ozf) is a sixteenth [kg]."""

TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}
"""Unit of time -> seconds."""

EXTRA_COLUMNS = {
    **dict.fromkeys(("vx", "vy", "vz"), "m/s"),
    "pressure": "Pa",
    **dict.fromkeys((f"stick_{name}" for name in DEMANDS), "-"),
}
"""Names that a map may use besides the canonical columns -> units: they are converted to u v w, depth and
pulse widths in the trial."""

UNITS: dict[str, dict[str, float]] = {
    "angle": {"rad": 1.0, "deg": math.pi / 180.0, "mrad": 1e-3, "cdeg": math.pi / 18000.0},
    "rate": {
        "rad/s": 1.0, "deg/s": math.pi / 180.0, "mrad/s": 1e-3, "rpm": math.pi / 30.0, "rps": 2.0 * math.pi,
        "Hz": 2.0 * math.pi,
    },
    "length": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "ft": 0.3048, "in": 0.0254},
    "speed": {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3, "km/h": 1.0 / 3.6, "kn": 1852.0 / 3600.0},
    "acceleration": {"m/s²": 1.0, "m/s^2": 1.0, "m/s2": 1.0, "g": GRAVITY, "mg": 1e-3 * GRAVITY},
    "force": {
        "N": 1.0, "mN": 1e-3, "kN": 1e3, "kgf": GRAVITY, "gf": 1e-3 * GRAVITY, "lbf": POUND * GRAVITY,
        "ozf": POUND / 16.0 * GRAVITY,
    },
    "moment": {
        "N m": 1.0, "Nm": 1.0, "N mm": 1e-3, "kgf m": GRAVITY, "kgf cm": 1e-2 * GRAVITY,
        "lbf ft": POUND * GRAVITY * 0.3048,
    },
    "voltage": {"V": 1.0, "mV": 1e-3, "cV": 1e-2},
    "pulse": {"µs": 1.0, "us": 1.0, "ms": 1e3, "s": 1e6, "ns": 1e-3},
    "pressure": {
        "Pa": 1.0, "hPa": 1e2, "mbar": 1e2, "kPa": 1e3, "bar": 1e5, "dbar": 1e4, "atm": 101325.0, "psi": 6894.757293168,
    },
    "number": {"-": 1.0},
}  # fmt: skip
"""Dimension -> unit -> value of the unit in SI."""

_DIMENSION = {unit: dimension for dimension, units in UNITS.items() for unit in units}


def unit_of(canonical: str) -> str:
    """Return the unit of a canonical or extra column."""
    if canonical in EXTRA_COLUMNS:
        return EXTRA_COLUMNS[canonical]
    column = column_of(canonical)
    if column is None:
        raise CalibrationError(f"'{canonical}' is not a column of a trial")
    return column.unit


def factor(unit: str | None, canonical: str) -> float:
    """Return the factor from `unit` to the unit of the canonical column; 1 if no unit is given.

    Raises:
        CalibrationError: The unit is unknown, or has another dimension.
    """
    if unit is None:
        return 1.0
    target = unit_of(canonical)
    if unit not in _DIMENSION:
        raise CalibrationError(
            f"unit of {canonical} is '{unit}'{did_you_mean(unit, list(_DIMENSION))} "
            f"expected {_like(target)}: or give a scale to {target}"
        )
    dimension, target_dimension = _DIMENSION[unit], _DIMENSION[target]
    if dimension != target_dimension:
        article = "an" if dimension[0] == "a" else "a"
        raise CalibrationError(
            f"unit of {canonical} is '{unit}', {article} {dimension}, expected {_like(target)}"
        )
    return UNITS[target_dimension][unit] / UNITS[target_dimension][target]


def _like(target: str) -> str:
    return f"one of {', '.join(UNITS[_DIMENSION[target]])}"


SAME_ROW = 1.0e-6
"""Samples within this interval share a row [s]."""

PIECE_GAP = 10.0
"""Gap inserted between the pieces of a log whose clock jumped back [s]; the true duration is unknown."""

FEW = 3
"""Number of late rows above which a backward step counts as a jump of the clock."""

LATE = 0.01
"""Fraction of the rows that may arrive late."""

REPEATED = 0.4
"""Fraction of the samples that may repeat the previous time with other values."""

DEAD_AT_ZERO = (("u", "v"), ("w",))
"""Velocities, which may be constant although their sensor works."""

DEAD = (
    (("qx", "qy", "qz", "qw"), ("roll", "pitch", "yaw"), 0.02),
    (("roll", "pitch", "yaw"), ("qx", "qy", "qz", "qw"), 0.02),
    (("u", "v"), ("x", "y"), 0.2),
    (("w",), ("z", "depth"), 0.2),
    (("x", "y"), ("u", "v"), 0.05),
    (("z",), ("depth",), 0.1),
    (("depth",), ("z",), 0.1),
)
"""Columns of a sensor, other columns that measure the same motion, and their least motion in the unit of a trial."""

ALIVE = 10
"""Number of samples from which a column that never changes counts as dead."""


def merged(streams: Mapping[str, tuple[Array, Array]]) -> tuple[Array, dict[str, Array]]:
    """Return streams with different times on their combined time base.

    Args:
        streams: Column -> times [s], strictly increasing, and values, (k,) each.

    Returns:
        Times (n,), and column -> values with NaN where that stream has no sample, (n,) each. Samples within a
        microsecond share a row.

    Raises:
        CalibrationError: There are no samples.
    """
    every = [t for t, _ in streams.values()]
    times = np.unique(np.concatenate(every)) if every else np.empty(0)
    if not len(times):
        raise CalibrationError("no stream contains a sample")
    starts = np.concatenate([[True], np.diff(times) > SAME_ROW])
    row_of = np.cumsum(starts) - 1
    base = times[starts]
    channels = {}
    for name, (t, values) in streams.items():
        channels[name] = np.full(len(base), np.nan)
        channels[name][row_of[np.searchsorted(times, t)]] = values
    return base, channels


def ordered(t: Array, columns: Mapping[str, Array]) -> tuple[Array, NDArray[np.intp], list[Finding]]:
    """Return sorted times, and the order of the rows.

    Logs with a few late rows, or with the newest row first, are sorted. Where the clock jumped back (many
    rows overlap an earlier piece), the elapsed time is unknown: the later piece is appended after the earlier
    one with a gap of `PIECE_GAP` seconds, and nothing is interpolated across gaps.

    Args:
        t: Finite times [s], (n,).
        columns: Column -> values in any unit, (n,); two pieces with values in different columns may overlap.

    Returns:
        Non-decreasing times [s], (n,), row numbers in that order (n,), and findings.

    Raises:
        CalibrationError: The times step back at more than a few rows.
    """
    back = np.flatnonzero(np.diff(t) < 0.0) + 1
    rows = np.arange(len(t))
    if not len(back):
        return t, rows, []
    newest_first = not (np.diff(t) > 0.0).any()
    wraps = _wraps(t, back)
    if not newest_first and (wraps or len(back) > max(FEW, LATE * len(t))):
        raise CalibrationError(
            f"the time steps back at {len(back)} of {len(t)} rows, first from {t[back[0] - 1]:.6g} to "
            f"{t[back[0]]:.6g} s at row {back[0] + 1}: {wraps or _cause(t)}"
        )
    jumps = [int(i) for i in back if not newest_first and _collides(t, columns, int(i))]
    if jumps:
        return _in_pieces(t, jumps)
    rows = np.argsort(t[::-1] if newest_first else t, kind="stable")
    rows = len(t) - 1 - rows if newest_first else rows
    return t[rows], rows, [finding("times_sorted", rows=len(back), total=len(t))]


def _wraps(t: Array, back: NDArray[np.intp]) -> str:
    """Return the cause if every backward step is an overflow of a counter; otherwise an empty text."""
    step = 3.0 * float(np.median(np.abs(np.diff(t))))
    ranges = [2.0**bits * unit for bits in (16, 24, 32) for unit in (1e-6, 1e-3, 1e-2, 1.0)]
    if len(back) > 1:
        ranges.append(float(t[back - 1].max()))
    for full in ranges:
        if full > 20.0 * step and (full - t[back - 1] <= step).all() and (np.abs(t[back]) <= step).all():
            advice = "give 'time: {column: NAME, kind: counter}' in a map"
            return f"probably a counter that overflows after {full:.6g} s: {advice}"
    return ""


def _cause(t: Array) -> str:
    """Return the probable cause of frequent backward steps, and the remedy."""
    trend = abs(float(np.median(t[len(t) // 2 :]) - np.median(t[: len(t) // 2])))
    if (t >= 0.0).all() and trend < 0.2 * t.max() and t.sum() > 10.0 * t.max():
        return (
            "probably the period since the last row, not a clock: give 'time: {column: NAME, kind: period}' in a map, "
            "or name the column of a clock"
        )
    return "rows of several clocks or sensors are probably mixed: write one table for each, or name another column"


def refuse_coarse(t: Array, columns: Mapping[str, Array]) -> None:
    """Refuse a clock so coarse that many samples have the same time, of which all but one would be discarded.

    Args:
        t: Non-decreasing times [s], (n,).
        columns: Column -> values in any unit, (n,).

    Raises:
        CalibrationError: Most samples repeat the previous time with other values.
    """
    same = np.diff(t) <= SAME_ROW
    other = np.zeros(len(same), bool)
    for values in columns.values():
        other |= np.abs(np.diff(values)) > 0.0  # False for NaN
    if len(t) >= 10 and np.sum(same & other) > REPEATED * len(t):
        step = np.median(np.diff(np.unique(t))) if t[-1] > t[0] else math.inf
        raise CalibrationError(
            f"{np.sum(same & other)} of {len(t)} samples repeat the previous time, as the clock counts steps of "
            f"{step:.3g} s: name a finer column, or spread them by 'time: {{column: NAME, kind: coarse}}' in a map"
        )


def spread(t: Array) -> Array:
    """Return the times [s] of a coarse clock with the samples of each step evenly distributed over it.

    The samples of the first step are placed at its end, those of the last step at its beginning, at the
    median period.

    Args:
        t: Times as read, non-decreasing [s], (n,).
    """
    steps, index, counts = np.unique(t, return_inverse=True, return_counts=True)
    if len(steps) < 2:
        return t
    length = np.diff(steps, append=2.0 * steps[-1] - steps[-2])
    inner = slice(1, -1) if len(steps) > 2 else slice(None)  # a log starts and ends within a step
    period = float(np.median((length / counts)[inner]))
    within = np.arange(len(t)) - np.searchsorted(index, np.arange(len(steps)))[index]
    at = np.minimum(length / counts, 1.5 * period)[index] * within
    first, last = index == 0, index == len(steps) - 1
    at[first] = (
        (length[0] - period * (counts[0] - within))[first] if period * counts[0] <= length[0] else at[first]
    )
    at[last] = period * within[last]
    return t + at


def wrapped(channels: Mapping[str, Array], *, everything: bool) -> Channels:
    """Return the columns with their angles in [-pi, pi) [rad].

    Args:
        channels: Columns by canonical name, in the units of a trial.
        everything: False to leave angles beyond two turns unchanged, since they may be in degrees.
    """
    out = dict(channels)
    for name in EULER:
        if name in out:
            largest = float(np.nanmax(np.abs(out[name]), initial=0.0))
            if largest > math.pi and (everything or largest <= 2.0 * math.pi + 0.01):
                out[name] = wrap_angle(out[name])
    return out


ABSOLUTE = (7e4, 6e6)
"""Range of absolute pressures at a vehicle: from the surface of a lake at 3000 m altitude to 600 m depth [Pa]."""


def pressure_unit(values: Array) -> str | None:
    """Return the unit of absolute pressures, Pa, hPa or kPa, inferred from their magnitude; None if no unit fits.

    Args:
        values: Pressures in an unknown unit, (n,).
    """
    finite = values[np.isfinite(values)]
    for unit in ("Pa", "hPa", "kPa"):
        low, high = np.quantile(finite, [0.01, 0.99]) * UNITS["pressure"][unit] if len(finite) else (0.0, 0.0)
        if low >= ABSOLUTE[0] and high <= ABSOLUTE[1]:
            return unit
    return None


def without_dead(t: Array, channels: Channels) -> list[Finding]:
    """Remove columns that never change although another measurement shows the motion, in place.

    Args:
        t: Times [s], (n,).
        channels: Column -> values in the units of a trial, (n,).

    Returns:
        A finding for each group that was removed.
    """
    findings, angles = [], {name: channels[name] for name in EULER if name in channels}
    if not angles and all(name in channels for name in QUATERNION):
        q = np.stack([channels[name] for name in QUATERNION], axis=-1)
        q[np.linalg.norm(q, axis=-1) < 0.5] = np.nan
        angles = dict(zip(EULER, quat_to_euler(q), strict=True))
    rates = [rate for rate in "pqr" if rate in channels and constant(channels[rate])]
    against = []
    for rate, name in zip("pqr", EULER, strict=True):
        if rate in rates and name in angles:
            good = np.isfinite(angles[name])
            angle, turned = np.unwrap(angles[name][good]), np.nanmean(channels[rate]) * t[good]
            against += [name] if 0.05 < _range(angle) < math.inf and _range(angle - turned) > 0.05 else []
    if against:
        for rate in rates:
            del channels[rate]
        findings.append(finding("never_changes", columns=tuple(rates), moving=tuple(against)))
    swinging = {
        name: rate
        for rate, name in zip("pqr", EULER, strict=True)
        if rate in channels and name in angles and constant(angles[name]) and _swing(t, channels[rate]) > 0.2
    }
    dead = tuple(swinging) if any(name in channels for name in EULER) else QUATERNION
    if swinging and all(constant(channels[name]) for name in dead):
        for name in dead:
            del channels[name]
        findings.append(finding("never_changes", columns=dead, moving=tuple(swinging.values())))
    for names, others, least in DEAD:
        present = [name for name in names if name in channels]
        moving = [name for name in others if name in channels and least < _range(channels[name]) < math.inf]
        # The speed may be constant while the position changes.
        at_zero = names not in DEAD_AT_ZERO or not any(
            np.nanmax(np.abs(channels[name]), initial=0.0) for name in present
        )
        if present and moving and at_zero and all(constant(channels[name]) for name in present):
            for name in present:
                del channels[name]
            findings.append(finding("never_changes", columns=tuple(present), moving=tuple(moving)))
    return findings


def _swing(t: Array, rate: Array) -> float:
    """Return the range of the angle [rad] of a rate [rad/s] without its mean, as gyroscopes have a bias, (n,)
    each."""
    good = np.isfinite(rate)
    steps = np.minimum(np.diff(t[good], prepend=t[good][:1]), 0.5)
    return (
        float(np.ptp(np.cumsum((rate[good] - np.mean(rate[good])) * steps))) if good.sum() >= ALIVE else 0.0
    )


def _range(values: Array) -> float:
    """Return the range of the finite values in their unit; infinite for fewer than `ALIVE` values."""
    finite = values[np.isfinite(values)]
    return float(np.ptp(finite)) if len(finite) >= ALIVE else math.inf


def constant(values: Array) -> bool:
    """Return whether a column in any unit, (n,), has enough samples and is constant."""
    return _range(values) == 0.0


def _collides(t: Array, columns: Mapping[str, Array], i: int) -> bool:
    """Return whether the rows from `i` on overlap in time with earlier rows of the same columns."""
    earlier = np.flatnonzero(t[:i] >= t[i])
    later = i + np.flatnonzero(t[i:] <= t[:i].max())
    if len(earlier) <= FEW or len(later) <= FEW:
        return False
    return any(
        np.isfinite(v[earlier]).sum() > FEW and np.isfinite(v[later]).sum() > FEW for v in columns.values()
    )


def _in_pieces(t: Array, jumps: list[int]) -> tuple[Array, NDArray[np.intp], list[Finding]]:
    moved, order, findings, end = [], [], [], -np.inf
    for start, stop in zip([0, *jumps], [*jumps, len(t)], strict=True):
        rows = start + np.argsort(t[start:stop], kind="stable")
        times = t[rows]
        if start:
            shift = end + PIECE_GAP - times[0]
            findings.append(
                finding("clock_jump", before=t[start - 1], after=t[start], row=start + 1, shift=shift)
            )
            times = times + shift
        moved.append(times)
        order.append(rows)
        end = times[-1]
    return np.concatenate(moved), np.concatenate(order), findings


def sampled(
    t: Array, columns: Mapping[str, Array]
) -> tuple[Array, dict[str, Array], NDArray[np.intp], list[Finding]]:
    """Return one row for each time: rows of equal times are merged, with the later value where both have one.

    Args:
        t: Non-decreasing times [s], (n,).
        columns: Column -> values in any unit, (n,).

    Returns:
        Times [s], strictly increasing (m,), columns (m,), the source row of each (m,), and findings.
    """
    refuse_coarse(t, columns)
    starts = np.concatenate([[True], np.diff(t) > 0.0])
    selected = np.flatnonzero(starts)
    if len(selected) == len(t):
        return t, dict(columns), selected, []
    row_of = np.cumsum(starts) - 1
    merged_columns, conflicts = {}, np.zeros(len(selected), bool)
    for name, values in columns.items():
        good = np.flatnonzero(np.isfinite(values))
        merged_columns[name] = np.full(len(selected), np.nan)
        merged_columns[name][row_of[good]] = values[good]  # NumPy keeps the last value for equal indices
        conflicts[row_of[good][values[good] != merged_columns[name][row_of[good]]]] = True
    findings = []
    if conflicts.any():
        findings.append(finding("times_conflict", times=conflicts.sum(), first=t[selected][conflicts][0]))
    elif len(columns):
        findings.append(finding("times_repeat", rows=len(t) - len(selected)))
    return t[selected], merged_columns, selected, findings


Channels = dict[str, Array]

POLAR = (("u", "v", "w"), ("ax", "ay", "az"), ("tau_x", "tau_y", "tau_z"))
AXIAL = (("p", "q", "r"), ("tau_k", "tau_m", "tau_n"))
EULER = ("roll", "pitch", "yaw")
QUATERNION = ("qx", "qy", "qz", "qw")
WORLD = (("x", "y", "z"),)

LENGTH_TOLERANCE = 1e-6
"""Quaternions within this tolerance of unit length are unchanged, so that our own files are read bitwise equal."""


def in_our_frames(channels: Channels, body: str, world: str) -> Channels:
    """Return columns in body axes x forward, y left, z up and a world with z up.

    The units are unchanged.

    Args:
        channels: Columns by canonical name, in the units of a trial.
        body: Body axes of the log, FLU or FRD.
        world: World axes of the log, z_up or NED.
    """
    turned, sunk = body == "FRD", world == "NED"
    result = dict(channels)
    signs: list[tuple[tuple[str, ...], Array]] = []
    if turned:
        signs += [(names, FROM_FOSSEN.A.diagonal()) for names in POLAR]
        signs += [(names, FROM_FOSSEN.axial_map.diagonal()) for names in AXIAL]
    if sunk:
        signs += [(names, FROM_FOSSEN.A.diagonal()) for names in WORLD]
    if turned and sunk:
        signs.append((EULER, FROM_FOSSEN.axial_map.diagonal()))
        signs.append((QUATERNION, FROM_FOSSEN.quaternion(np.ones(4))))
    for names, sign in signs:
        for name, s in zip(names, sign, strict=True):
            if name in result:
                result[name] = s * result[name]
    if turned != sunk:
        result.update(_half_turned_attitude(channels, turned))
    return result


def _half_turned_attitude(channels: Channels, body: bool) -> Channels:
    """Return the attitude when only the body axes (or only the world axes) change: half a turn about x on one
    side."""
    half_turn = matrix_to_quat(FROM_FOSSEN.A)

    def turned(q: Array) -> Array:
        return quat_multiply(q, half_turn) if body else quat_multiply(half_turn, q)

    result: Channels = {}
    if all(name in channels for name in QUATERNION):
        q = turned(np.stack([channels[name] for name in QUATERNION], axis=-1))
        result.update(zip(QUATERNION, np.moveaxis(q, -1, 0), strict=True))
    angles_present = [name for name in EULER if name in channels]
    if angles_present == ["yaw"]:  # the heading of the x axis, which is the same in both conventions
        return result if body else result | {"yaw": FROM_FOSSEN.yaw(channels["yaw"])}
    if angles_present:
        missing = np.zeros(len(channels[angles_present[0]]))
        angles = quat_to_euler(turned(quat_from_euler(*(channels.get(name, missing) for name in EULER))))
        result.update({name: a for name, a in zip(EULER, angles, strict=True) if name in angles_present})
    return result


def tidy_quaternions(channels: Channels) -> list[Finding]:
    """Normalise quaternions to unit length and continuous sign, in place; return findings on unusable ones."""
    present = [name for name in QUATERNION if name in channels]
    if not present:
        return []
    if len(present) < 4:
        for name in present:
            del channels[name]
        return [finding("quaternion_incomplete", columns=tuple(present))]
    q = np.stack([channels[name] for name in QUATERNION], axis=-1)
    length = np.linalg.norm(q, axis=-1)
    useless = np.isfinite(length) & (length < 0.5)
    bad = ~np.isfinite(length) | useless
    q[bad] = np.nan
    stretched = ~bad & (np.abs(length - 1.0) > LENGTH_TOLERANCE)
    q[stretched] /= length[stretched, None]
    good = np.flatnonzero(~bad)
    flips = np.sum(q[good[1:]] * q[good[:-1]], axis=-1) < 0.0
    q[good[1:]] *= np.where(np.cumsum(flips) % 2 == 1, -1.0, 1.0)[:, None]
    for i, name in enumerate(QUATERNION):
        channels[name] = q[:, i]
    return [finding("quaternion_lengths", samples=useless.sum())] if useless.any() else []


def upside_down(channels: Mapping[str, Array]) -> bool:
    """Return whether the vehicle is inverted most of the time, as if one axis convention had been ignored.

    Channels have the units of a trial.
    """
    if all(name in channels for name in QUATERNION):
        q = np.stack([channels[name] for name in QUATERNION], axis=-1)
    elif "roll" in channels:
        roll = channels["roll"]
        q = quat_from_euler(roll, channels.get("pitch", np.zeros_like(roll)), 0.0)
    else:
        return False
    q = q[np.isfinite(q).all(axis=-1)]
    return len(q) > 0 and float(np.median(quat_rotate(q, np.array([0.0, 0.0, 1.0]))[:, 2])) < -0.5
