"""From the conventions of a log to ours, as the header's `convert` section asks: applied once, when a trial is read."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.findings import Finding, finding
from finssim.calibration.trials.header import Conversion
from finssim.calibration.trials.time_base import merged
from finssim.calibration.trials.trial import COLUMNS, INPUT_PREFIXES, column_of
from finssim.geometry.frames import FROM_FOSSEN
from finssim.geometry.rotations import (
    matrix_to_quat,
    quat_from_euler,
    quat_multiply,
    quat_rotate,
    quat_to_euler,
)
from finssim.vehicles.part import did_you_mean

__all__ = ["factor_and_offset", "in_our_frames", "new_names", "shifted", "tidy_quaternions", "upside_down"]

Array = NDArray[np.float64]
Channels = dict[str, Array]

POLAR = (("u", "v", "w"), ("ax", "ay", "az"), ("tau_x", "tau_y", "tau_z"))
AXIAL = (("p", "q", "r"), ("tau_k", "tau_m", "tau_n"))
EULER = ("roll", "pitch", "yaw")
QUATERNION = ("qx", "qy", "qz", "qw")
WORLD = (("x", "y", "z"),)

GROUPS = tuple(dict.fromkeys(column.group for column in COLUMNS.values()))

LENGTH_TOLERANCE = 1e-6
"""Quaternions within this of unit length are left as they are, so that our own files read back bit for bit."""


def new_names(columns: Iterable[str], convert: Conversion) -> dict[str, str]:
    """Column of the log -> its name in the trial, from `convert.rename`.

    Raises:
        CalibrationError: A renamed column does not exist, a new name is no column of a trial, or two get one name.
    """
    columns = list(columns)
    for old, new in convert.rename.items():
        if old not in columns:
            raise CalibrationError(
                f"the log has no column '{old}'{did_you_mean(old, columns)} it has {_some(columns)}",
                "convert.rename",
            )
        if new not in ("t", "phase") and column_of(new) is None:
            raise CalibrationError(
                f"'{new}' is not a column of a trial{did_you_mean(new, ['t', 'phase', *COLUMNS])} "
                f"columns are t, phase, {', '.join(COLUMNS)} and {', '.join(f'{p}NAME' for p in INPUT_PREFIXES)}",
                "convert.rename",
            )
    names = {name: convert.rename.get(name, name) for name in columns}
    for new in convert.rename.values():
        twice = [old for old, name in names.items() if name == new]
        if len(twice) > 1:
            raise CalibrationError(f"columns {_some(twice)} would all be '{new}'", "convert.rename")
    return names


def factor_and_offset(columns: Iterable[str], convert: Conversion) -> dict[str, tuple[float, float]]:
    """Column -> its factor and what is added afterwards, for the columns that `convert.scale` and `offset` name.

    Raises:
        CalibrationError: They name a column that the log does not have.
    """
    columns = list(columns)
    found: dict[str, tuple[float, float]] = {}
    for key, factor in convert.scale.items():
        for name in _named(key, columns, "scale"):
            found[name] = (factor, 0.0)
    for key, offset in convert.offset.items():
        for name in _named(key, columns, "offset"):
            found[name] = (found.get(name, (1.0, 0.0))[0], offset)
    return found


def in_our_frames(channels: Channels, convert: Conversion) -> Channels:
    """Body axes to x forward, y left, z up and world axes to z up."""
    body, world = convert.body == "FRD", convert.world == "NED"
    result = dict(channels)
    signs: list[tuple[tuple[str, ...], Array]] = []
    if body:
        signs += [(names, FROM_FOSSEN.A.diagonal()) for names in POLAR]
        signs += [(names, FROM_FOSSEN.axial_map.diagonal()) for names in AXIAL]
    if world:
        signs += [(names, FROM_FOSSEN.A.diagonal()) for names in WORLD]
    if body and world:
        signs.append((EULER, FROM_FOSSEN.axial_map.diagonal()))
        signs.append((QUATERNION, FROM_FOSSEN.quaternion(np.ones(4))))
    for names, sign in signs:
        for name, s in zip(names, sign, strict=True):
            if name in result:
                result[name] = s * result[name]
    if body != world:
        result.update(_attitude_of_one_side(channels, body))
    return result


def _attitude_of_one_side(channels: Channels, body: bool) -> Channels:
    """Attitude when only the body axes (or only the world axes) change: half a turn about x from one side."""
    half_turn = matrix_to_quat(FROM_FOSSEN.A)

    def turned(q: Array) -> Array:
        return quat_multiply(q, half_turn) if body else quat_multiply(half_turn, q)

    result: Channels = {}
    if all(name in channels for name in QUATERNION):
        q = turned(np.stack([channels[name] for name in QUATERNION], axis=-1))
        result.update(zip(QUATERNION, np.moveaxis(q, -1, 0), strict=True))
    given = [name for name in EULER if name in channels]
    if given == ["yaw"]:  # the heading of the x axis, which both conventions share
        return result if body else result | {"yaw": FROM_FOSSEN.yaw(channels["yaw"])}
    if given:
        missing = np.zeros(len(channels[given[0]]))
        angles = quat_to_euler(turned(quat_from_euler(*(channels.get(name, missing) for name in EULER))))
        result.update({name: a for name, a in zip(EULER, angles, strict=True) if name in given})
    return result


def tidy_quaternions(channels: Channels) -> list[Finding]:
    """Give quaternions unit length and a continuous sign, in place; findings on what could not be used."""
    given = [name for name in QUATERNION if name in channels]
    if not given:
        return []
    if len(given) < 4:
        for name in given:
            del channels[name]
        return [finding("quaternion_incomplete", columns=tuple(given))]
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
    """Whether the attitude has the vehicle on its back most of the time, as with one axis convention left out."""
    if all(name in channels for name in QUATERNION):
        q = np.stack([channels[name] for name in QUATERNION], axis=-1)
    elif "roll" in channels:
        roll = channels["roll"]
        q = quat_from_euler(roll, channels.get("pitch", np.zeros_like(roll)), 0.0)
    else:
        return False
    q = q[np.isfinite(q).all(axis=-1)]
    return len(q) > 0 and float(np.median(quat_rotate(q, np.array([0.0, 0.0, 1.0]))[:, 2])) < -0.5


def shifted(t: Array, channels: Channels, convert: Conversion) -> tuple[Array, Channels]:
    """Columns moved in time by `convert.time_offset`, on a union time base with NaN where a stream has no sample.

    Raises:
        CalibrationError: It names neither a column of the log nor a group.
    """
    asked = convert.time_offset
    for key in asked:
        if key not in GROUPS and key not in channels:
            raise CalibrationError(
                f"'{key}' is neither a group nor a column of this log"
                f"{did_you_mean(key, [*GROUPS, *channels])} groups are {', '.join(GROUPS)}",
                "convert.time_offset",
            )
    streams, moved = {}, False
    for name, values in channels.items():
        column = column_of(name)
        by = asked.get(name, asked.get(column.group if column else "", 0.0))
        moved |= by != 0.0
        good = np.isfinite(values)
        streams[name] = (t[good] + by, values[good])
    return merged(streams) if moved else (t, channels)


def _named(key: str, columns: list[str], where: str) -> list[str]:
    found = [name for name in columns if name == key or (key.endswith("*") and name.startswith(key[:-1]))]
    if not found:
        raise CalibrationError(
            f"this log has no column '{key}'{did_you_mean(key, columns)} it has {_some(columns)}",
            f"convert.{where}",
        )
    return found


def _some(names: list[str], most: int = 12) -> str:
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
