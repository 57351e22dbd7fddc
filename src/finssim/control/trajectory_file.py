"""Trajectory files: points in time as CSV or YAML, or a shape with its measures as YAML."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from finssim.control.errors import ControlError
from finssim.control.trajectories import Trajectory
from finssim.control.trajectory_shapes import SHAPES, Motion, hermite
from finssim.text_table import read_text_table
from finssim.yaml_file import read_mapping

__all__ = ["read_trajectory", "through_points"]

Array = npt.NDArray[np.float64]

COLUMNS = ("t", "x", "y", "z", "yaw")
"""Of a table of points: time [s], world position [m], and if wanted the heading [rad]."""

KEYS = {"name", "heading", "yaw", "points", "shape"}


def read_trajectory(path: Path) -> Trajectory:
    """A trajectory from a file.

    CSV: a header `t,x,y,z` or `t,x,y,z,yaw`, one row per point. YAML: `points`, a list of such rows, or `shape`, a
    mapping of `kind` (key of `SHAPES`) and its arguments such as radius and duration; with it `name`, `heading` (fixed
    or tangent) and `yaw` [rad].

    Raises:
        ControlError: The file cannot be read, or what it says is no trajectory; one sentence with the file's name.
    """
    try:
        if path.suffix.lower() == ".csv":
            return through_points(path.stem, _rows_of_table(path))
        data = read_mapping(path, ControlError, such_as="points: [[0, 0, 0, -0.5], [10, 1, 0, -0.5]]")
        return _from_mapping(path.stem, data)
    except ControlError as error:
        said = str(error)
        raise ControlError(said if said.startswith(str(path)) else f"{path}: {said}") from None


def through_points(name: str, points: npt.ArrayLike, **options: Any) -> Trajectory:
    """A trajectory through points in time: smooth, and never beyond two neighbours on any axis.

    Piecewise cubic with the slopes of Fritsch and Carlson (1980): a rest between two equal points stays a rest.

    Args:
        name: Of the trajectory.
        points: t [s] from 0 on, x, y, z [m] and if wanted yaw [rad], (n, 4) or (n, 5).
        options: `heading` and `yaw` of `Trajectory`.

    Raises:
        ControlError: Fewer than two points, numbers that are not finite, or times that do not increase from 0.
    """
    table = _checked_points(points)
    t = table[:, 0]
    table[:, 4:] = np.unwrap(table[:, 4:], axis=0)
    slopes = _monotone_slopes(t, table[:, 1:])
    place, drift = table[:, 1:4], slopes[:, :3]

    def motion(time: Array) -> tuple[Array, Array]:
        return hermite(time, t, place, drift)

    if table.shape[1] == 5:
        yaw, rate = table[:, 4], slopes[:, 3]
        options["turning"] = lambda time: hermite(time, t, yaw, rate)[0]
    return Trajectory(name=name, duration=float(t[-1]), motion=motion, **options)


def _from_mapping(name: str, data: Mapping[str, Any]) -> Trajectory:
    unknown = sorted(map(str, data.keys() - KEYS))
    if unknown:
        raise ControlError(f"unknown key '{unknown[0]}'; available: {', '.join(sorted(KEYS))}")
    if ("points" in data) == ("shape" in data):
        raise ControlError("expected either 'points' or 'shape'")
    options: dict[str, Any] = {"heading": data.get("heading", "fixed"), "yaw": _number(data, "yaw", 0.0)}
    name = str(data.get("name", name))
    if "points" in data:
        return through_points(name, data["points"], **options)
    motion, duration = _shape(data["shape"])
    return Trajectory(name=name, duration=duration, motion=motion, **options)


def _shape(data: Any) -> tuple[Motion, float]:
    if not isinstance(data, Mapping) or data.get("kind") not in SHAPES:
        raise ControlError(f"shape: expected a mapping whose 'kind' is one of {', '.join(SHAPES)}")
    arguments = {str(key): value for key, value in data.items() if key != "kind"}
    if data["kind"] == "polyline":
        durations = arguments.get("durations", [])
    else:
        durations = [_number(arguments, "duration", math.nan)]
    try:
        return SHAPES[data["kind"]](**arguments), float(np.sum(np.asarray(durations, float)))
    except (TypeError, ValueError) as error:
        raise ControlError(f"shape: {str(error).replace('()', '')}") from None


def _number(data: Mapping[str, Any], key: str, otherwise: float) -> float:
    value = data.get(key, otherwise)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ControlError(f"{key} is {value!r}, expected a number")
    return float(value)


def _rows_of_table(path: Path) -> list[list[str]]:
    table = read_text_table(path, ControlError)
    if tuple(table.names) not in (COLUMNS, COLUMNS[:4]):
        raise ControlError(f"its header is '{','.join(table.names)}', expected t,x,y,z or t,x,y,z,yaw")
    return table.rows


def _checked_points(points: Any) -> Array:
    try:
        table = np.array(points, dtype=float)
    except (TypeError, ValueError):
        raise ControlError(
            "points: expected rows of 4 or 5 numbers, all of one length: t, x, y, z and yaw"
        ) from None
    if table.ndim != 2 or table.shape[1] not in (4, 5) or len(table) < 2:
        raise ControlError(
            f"points are {table.shape}, expected two or more rows of t, x, y, z and if wanted yaw"
        )
    if not np.isfinite(table).all():
        row = int(np.argwhere(~np.isfinite(table))[0, 0])
        raise ControlError(f"point {row + 1} is {table[row].tolist()}, expected finite numbers")
    if table[0, 0] != 0.0:
        raise ControlError(f"the first time is {table[0, 0]:g} s, expected 0: times count from the start")
    late = np.flatnonzero(np.diff(table[:, 0]) <= 0.0)
    if len(late):
        row = int(late[0]) + 2
        raise ControlError(f"point {row} is at {table[row - 1, 0]:g} s, not after the one before it")
    return table


def _monotone_slopes(t: Array, values: Array) -> Array:
    """Slopes at the points, (n, m): zero at every turn, else a harmonic mean of the neighbours; at rest at the ends."""
    h = np.diff(t)[:, None]
    slope = np.diff(values, axis=0) / h
    slopes = np.zeros_like(values)
    before, after = slope[:-1], slope[1:]
    same = before * after > 0.0
    w1, w2 = 2.0 * h[1:] + h[:-1], h[1:] + 2.0 * h[:-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        slopes[1:-1] = np.where(same, (w1 + w2) / (w1 / before + w2 / after), 0.0)
    return slopes
