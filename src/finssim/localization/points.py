"""Implementation of `finssim project` and `finssim backproject`: tables of points to pixels, and of pixels to
points."""

from __future__ import annotations

import json
import math
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from finssim.core.files import atomic_write, refuse_unwritable
from finssim.core.optics import Status, back_project, count_rejections, plane_jacobian, project
from finssim.core.text_table import csv_text, read_text, text_table, write_csv
from finssim.localization import LocalizationError
from finssim.localization.overhead_camera import load_pool

# Tables of points or pixels, one per row: named columns of numbers; other columns are copied.

_UNIT = re.compile(r"(\[[^\]]{0,80}\]|\([^)]{0,80}\)|_m|_px|_pix|_pixels?|_metres|_meters)$")
_BAD_ROWS_NAMED = 5


@dataclass(frozen=True, eq=False)
class PointTable:
    """Table as it was read."""

    label: str
    """Label of the file in messages."""
    names: list[str]
    """Names of all columns, as in the file."""
    rows: list[list[str]]
    """Texts of all cells, as in the file."""
    numbers: dict[str, Array]
    """Requested columns that are present, in the unit of the table, (n,) each."""

    def with_columns(self, columns: dict[str, Sequence[str]]) -> tuple[list[str], list[list[str]]]:
        """Return names and rows with columns added; a column of the file with the name of an added one
        becomes NAME_given."""
        added = {name.lower() for name in columns}
        names = [f"{name}_given" if _plain(name) in added else name for name in self.names]
        cells = zip(*columns.values(), strict=True)
        return [*names, *columns], [[*row, *more] for row, more in zip(self.rows, cells, strict=True)]


def read_points(path: Path, required: Sequence[str], optional: Sequence[str] = ()) -> PointTable:
    """Read a table of numbers.

    Columns may be in any order, in capitals and with a unit (`x [m]`, `u_px`). Without a header the columns
    are the required ones, then the optional ones. Cells are separated by commas, semicolons (then also with
    decimal commas), tabs or spaces; lines that begin with # are comments.

    Args:
        path: The file; `-` is the standard input.
        required: Names of the required columns.
        optional: Names of optional columns.

    Raises:
        LocalizationError: A column is missing, or cells are not numbers: the message names the lines.
    """
    label = "standard input" if str(path) == "-" else str(path)
    text = sys.stdin.read() if str(path) == "-" else read_text(path, LocalizationError)[0]
    table = text_table(text, names=(), spaces=None)
    if not table.texts:
        raise LocalizationError(f"{label}: holds no rows, expected columns {', '.join(required)}")
    rows = list(zip(table.lines, table.rows, strict=True))
    names = rows[0][1]
    if all(table.number(cell) is not None for cell in names):
        if not len(required) <= len(names) <= len(required) + len(optional):
            raise LocalizationError(
                f"{label}: has {len(names)} columns without a header, expected {', '.join(required)}: name the columns "
                "in the first line"
            )
        names = [*required, *optional][: len(names)]
    else:
        rows = rows[1:]
    plain = [_plain(name) for name in names]
    for name in (*required, *optional):
        if plain.count(name) > 1 or (name in required and name not in plain):
            there = "repeated" if name in plain else "missing"
            raise LocalizationError(
                f"{label}: column {name} is {there} among {', '.join(names)}: name the columns "
                f"{', '.join(required)} in the first line"
            )
    places = {name: plain.index(name) for name in (*required, *optional) if name in plain}
    numbers: dict[str, list[float]] = {name: [] for name in places}
    bad = []
    for line, row in rows:
        if len(row) != len(names):
            bad.append(f"line {line} has {len(row)} cells, expected {len(names)}")
            continue
        values = {name: table.number(row[k]) for name, k in places.items()}
        wrong = next((name for name, x in values.items() if x is None or not math.isfinite(x)), None)
        if wrong is not None:
            bad.append(f"line {line}: {wrong} is '{row[places[wrong]]}', expected a number")
        for name, value in values.items():
            numbers[name].append(math.nan if value is None else value)
    if bad:
        more = f"; and {len(bad) - _BAD_ROWS_NAMED} more lines" if len(bad) > _BAD_ROWS_NAMED else ""
        raise LocalizationError(f"{label}: {'; '.join(bad[:_BAD_ROWS_NAMED])}{more}")
    columns = {name: np.array(values, float) for name, values in numbers.items()}
    return PointTable(label, names, [row for _, row in rows], columns)


def _plain(name: str) -> str:
    return _UNIT.sub("", name.strip().lower()).rstrip()


Array = npt.NDArray[np.float64]

_REASONS = {
    Status.NO_RAY: "beyond what the lens maps one to one",
    Status.PARALLEL: "the ray runs along the plane",
    Status.TOTAL_REFLECTION: "the ray is reflected at the interface",
    Status.AWAY: "the ray heads away from the plane",
    Status.BEHIND_CAMERA: "behind the camera",
    Status.WRONG_SIDE: "not on the far side of the interface",
    Status.OUTSIDE_IMAGE: "outside the image, pixel given",
}


def run_project(
    points: Path,
    *,
    pool: Path,
    out: Path | None = None,
    as_json: bool = False,
) -> None:
    """Project points in the water to pixels [px].

    Example: finssim project points.csv --pool pool.yaml

    Args:
        points (POINTS): Table with columns x, y, z, pool frame [m]; - for standard input.
        pool (FILE): Pool file: camera, water plane and frames (.yaml).
        out (FILE): Table to write; by default standard output.
        as_json: Print one JSON object instead of tables.

    Raises:
        LocalizationError: A file cannot be used; the message names wrong rows.
        OutputError: `out` cannot be written.
    """
    if out is not None:
        refuse_unwritable(atomic_write(out))
    scene = load_pool(pool)
    table = read_points(points, ("x", "y", "z"))
    projection = project(scene.camera, scene.interface, np.stack([table.numbers[c] for c in "xyz"], axis=-1))
    columns = {
        "u": _cells(projection.pixels[:, 0], 6),
        "v": _cells(projection.pixels[:, 1], 6),
        "status": _status_names(projection.status),
    }
    _write_result(
        table, columns, projection.status, "project", "points have a pixel in the image", out, as_json
    )


def run_backproject(
    pixels: Path,
    *,
    pool: Path,
    z: float | None = None,
    plane: str | None = None,
    pixel_std: float | None = None,
    out: Path | None = None,
    as_json: bool = False,
) -> None:
    """Back-project pixels to points [m] on a plane in the water.

    Example: finssim backproject pixels.csv --pool pool.yaml --z 0

    Args:
        pixels (PIXELS): Table with columns u, v [px]; - for standard input.
        pool (FILE): Pool file: camera, water plane and frames (.yaml).
        z: Height of the points, pool frame [m]; a column z has priority.
        plane: Plane of the points, instead of --z: a,b,c,d with a x + b y + c z + d = 0 [m].
        pixel_std: Standard deviation of a pixel [px]; adds columns with the standard deviations of the points [m].
        out (FILE): Table to write; by default standard output.
        as_json: Print one JSON object instead of tables.

    Raises:
        LocalizationError: A file cannot be used (the message names wrong rows), there is no plane or more
            than one, or the plane or standard deviation is invalid.
        OutputError: `out` cannot be written.
    """
    if out is not None:
        refuse_unwritable(atomic_write(out))
    if pixel_std is not None and not (np.isfinite(pixel_std) and pixel_std > 0.0):
        raise LocalizationError(f"the pixel error is {pixel_std}, expected a positive number of pixels")
    scene = load_pool(pool)
    table = read_points(pixels, ("u", "v"), ("z",))
    rays = back_project(scene.camera, scene.interface, np.stack([table.numbers[c] for c in "uv"], axis=-1))
    normal, offset = _plane(table, z, plane)
    if plane is None:
        points, status = rays.at_z(-offset)
    else:
        points, status = rays.at_plane(normal, offset)
    columns = {axis: _cells(points[:, i], 9) for i, axis in enumerate("xyz")}
    columns["status"] = _status_names(status)
    if pixel_std is not None:
        by_pixel = plane_jacobian(scene.camera, scene.interface, points, normal)[..., :2]
        sigma = pixel_std * np.sqrt(np.sum(by_pixel**2, axis=-1))
        columns |= {f"sigma_{axis}": _cells(sigma[:, i], 9) for i, axis in enumerate("xyz")}
    _write_result(table, columns, status, "backproject", "pixels have a point", out, as_json)


def _plane(table: PointTable, z: float | None, plane: str | None) -> tuple[Array, Array | float]:
    """Return normal and offset of the plane, from the option or column that specifies it."""
    up = np.array([0.0, 0.0, 1.0])
    if plane is not None:
        if z is not None:
            raise LocalizationError("both a height z and a plane are given: give one of them")
        try:
            a, b, c, d = (float(word) for word in plane.replace(",", " ").split())
        except ValueError:
            raise LocalizationError(f"plane is '{plane}', expected four numbers a,b,c,d") from None
        if not (np.isfinite([a, b, c, d]).all() and (a, b, c) != (0.0, 0.0, 0.0)):
            raise LocalizationError(f"plane is '{plane}', expected finite numbers, a, b and c not all zero")
        return np.array([a, b, c]), d
    if "z" in table.numbers:
        return up, -table.numbers["z"]
    if z is None:
        raise LocalizationError(
            f"{table.label}: the plane of the points is missing: give a height z, a plane, or a column z"
        )
    if not np.isfinite(z):
        raise LocalizationError(f"z is {z}, expected a finite height in metres")
    return up, -float(z)


def _cells(values: Array, digits: int) -> list[str]:
    """Return numbers as text; those that are not finite are empty."""
    return [f"{x:.{digits}f}" if np.isfinite(x) else "" for x in values.tolist()]


def _status_names(status: npt.NDArray[np.int8]) -> list[str]:
    return [Status(i).name.lower() for i in status.tolist()]


def _write_result(
    table: PointTable,
    columns: dict[str, list[str]],
    status: npt.NDArray[np.int8],
    command: str,
    claim: str,
    out: Path | None,
    as_json: bool,
) -> None:
    """Write the table, and report on standard error how many rows have no result, and why."""
    names, rows = table.with_columns(dict[str, Sequence[str]](columns))
    rejected = count_rejections(status)
    good = len(status) - sum(rejected.values())
    if out is not None or not as_json:
        if out is None:
            sys.stdout.write(csv_text(names, rows))
        else:
            write_csv(out, names, rows)
    if as_json:
        summary: dict[str, Any] = {"command": command, "rows": len(status), "ok": good}
        summary["rejected"] = {name.lower(): n for name, n in rejected.items()}
        if out is not None:
            summary["out"] = str(out)
        else:
            summary["table"] = [dict(zip(names, row, strict=True)) for row in rows]
        print(json.dumps(summary, indent=2))
    print(f"{command}: {good} of {len(status)} {claim}", file=sys.stderr)
    for name, n in rejected.items():
        print(f"  {n} {name.lower()}: {_REASONS[Status[name]]}", file=sys.stderr)
