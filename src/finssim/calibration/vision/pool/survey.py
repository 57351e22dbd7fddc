"""What was measured in the pool with tape and level: points, tags, or where one tag was put for each picture."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.vision.pool.survey_table import Row, Table, read_table
from finssim.geometry.rotations import quat_from_euler, quat_rotate
from finssim.localization.detection.tags import corners
from finssim.localization.errors import LocalizationError
from finssim.localization.fields import Fields
from finssim.yaml_file import read_mapping

__all__ = ["Placed", "Survey", "corner_name", "read_survey"]

# Tags on one board, surveyed as a whole: a YAML file that says where the first lies and how the others follow.

PRINTED = 0.0005
"""Standard error of a tag on a board where the file gives none [m]: printers and glue do no better."""


def grid_points(path: str | Path) -> tuple[dict[int, np.ndarray], float]:
    """Corners of the tags of a grid.

        grid: {first: 0, columns: 6, rows: 4, spacing: [0.13, 0.13], edge: 0.1, position: [0.2, 0.3, 0], yaw_deg: 90}

    Ids run along a column's x, then from row to row; `spacing` is from centre to centre along the printed x and y (a
    negative second number counts rows downwards); `position` is the centre of the first tag; `yaw_deg`, `pitch_deg`,
    `roll_deg` turn the board.

    Args:
        path: The file.

    Returns:
        Tag id -> corners in the survey's frame [m], (4, 3); and their standard error within the board (`sigma`) [m].

    Raises:
        CalibrationError: A key is missing, unknown or senseless.
    """
    try:
        tree = read_mapping(Path(path), LocalizationError, such_as="grid: {first: 0, columns: 6, rows: 4}")
        top = Fields(tree, str(path))
        fields = top.section("grid")
        top.finish()
        first, columns, rows = (int(fields.number(key)) for key in ("first", "columns", "rows"))
        dx, dy = fields.numbers("spacing", 2)
        edge, position = fields.number("edge"), fields.numbers("position", 3)
        angles = [fields.number(f"{name}_deg", 0.0) for name in ("roll", "pitch", "yaw")]
        sigma = fields.number("sigma", PRINTED)
        fields.finish()
    except LocalizationError as error:
        raise CalibrationError(str(error)) from None
    if columns < 1 or rows < 1 or edge <= 0.0 or min(abs(dx), abs(dy)) < edge:
        raise CalibrationError(
            f"{path}: grid of {columns} x {rows} tags of {edge:g} m every {dx:g}, {dy:g} m: expected at least one tag, "
            "an edge above 0 and a spacing above the edge"
        )
    turn = quat_from_euler(*np.radians(angles))
    found = {}
    for row in range(rows):
        for column in range(columns):
            flat = corners(edge) + np.array([column * dx, row * dy, 0.0])
            found[first + row * columns + column] = np.asarray(position) + quat_rotate(turn, flat)
    return found, sigma


Array = NDArray[np.float64]

WIDEST = 300.0
"""Spread of coordinates beyond which metres are not believed unless the file says so [m]."""


@dataclass(frozen=True, eq=False)
class Placed:
    """Points that were surveyed together, so that one error moves them all: a tag's corners, or a single point."""

    name: str
    points: Array
    """Pool frame [m], (K, 3); a tag's corners in the order of `localization.tags.corners`."""
    sigma: float
    """Standard error of each coordinate [m]; NaN where the survey does not say."""
    is_tag: bool = False
    dry: bool = False
    """On the camera's side of the water."""
    group: str = ""
    """Points of one rigid target; empty: by itself."""


@dataclass(frozen=True)
class Survey:
    """All that was surveyed."""

    path: str
    points: dict[str, Placed] = field(default_factory=dict)
    """Single points by id."""
    tags: dict[int, Placed] = field(default_factory=dict)
    """Fixed tags by id."""
    locations: dict[str, list[tuple[int | None, Placed]]] = field(default_factory=dict)
    """Image -> tags that lay there (id, or None for whichever was seen)."""
    notes: tuple[str, ...] = ()


def corner_name(tag: str, corner: int) -> str:
    """How a report calls a tag's corner."""
    return f"{tag}/{corner}"


def read_survey(
    path: str | Path, *, unit: str | None = None, edge: float | None = None, z: float | None = None
) -> Survey:
    """Read a survey.

    Columns `id,x,y,z` for points; `tag,x,y,z,yaw_deg[,roll_deg,pitch_deg],edge` for fixed tags (centre and attitude
    of the tag frame); `image,x,y,z,yaw_deg[,tag],edge` for one tag that was moved from picture to picture. `sigma`
    gives a row its own standard error, `dry` marks what is above the water, `group` ties points to one target.

    Args:
        path: CSV file, or YAML of a grid of tags (`survey_grid.grid_points`).
        unit: Of lengths where the file says none.
        edge: Of all tags [m] where the table has no such column.
        z: Height of all points [m] where the table has no such column.

    Raises:
        CalibrationError: A column or number is missing, or an id has two positions; names the line.
    """
    if Path(path).suffix.lower() in (".yaml", ".yml"):
        tags, sigma = grid_points(path)
        placed = {tag: Placed(f"tag {tag}", at, sigma, is_tag=True) for tag, at in tags.items()}
        return Survey(str(path), tags=placed)
    table = read_table(path, unit=unit)
    _need(table, z)
    notes: list[str] = []
    survey = Survey(str(path))
    placed_where: dict[str, int] = {}
    for row in table.rows:
        missing = [n for n in ("x", "y") if n not in row.numbers]
        if missing or ("z" not in row.numbers and z is None):
            notes.append(f"{table.path}: line {row.line}: left out: {', '.join(missing) or 'z'} is missing")
            continue
        _place(survey, table, row, edge, z, placed_where)
    if not (survey.points or survey.tags or survey.locations):
        raise CalibrationError(f"{path}: no surveyed point in it: give rows of id,x,y,z")
    _plausible(survey, table)
    return Survey(survey.path, survey.points, survey.tags, survey.locations, tuple(notes))


def _need(table: Table, z: float | None) -> None:
    for name in ("x", "y"):
        if name not in table.columns:
            raise CalibrationError(
                f"{table.path}: no column '{name}': a survey has id,x,y,z or tag,x,y,z,yaw_deg,edge"
            )
    if "z" not in table.columns and z is None:
        raise CalibrationError(f"{table.path}: no column 'z': add it, or give the height of all points (--z)")
    if not {"id", "tag", "image"} & set(table.columns):
        raise CalibrationError(f"{table.path}: no column names the points: add id, tag or image")


def _place(
    survey: Survey, table: Table, row: Row, edge: float | None, z: float | None, where: dict[str, int]
) -> None:
    position = np.array([row.numbers["x"], row.numbers["y"], row.numbers.get("z", z)], float)
    sigma = row.numbers.get("sigma", float("nan"))
    dry = row.words.get("dry", "").lower() in ("1", "1.0", "true", "yes", "y", "dry", "x")
    group = row.words.get("group", "")
    edge = row.numbers.get("edge", edge)
    tag = row.words.get("tag") or (row.words.get("id") if edge is not None else None)
    if "image" not in row.words and tag is None:
        name = row.words.get("id", "")
        if not name:
            raise table.refuse(row, "no id")
        here = Placed(name, position[None], sigma, dry=dry, group=group)
        _once(table, row, f"point '{name}'", survey.points.get(name), here, where)
        survey.points[name] = here
        return
    if edge is None or edge <= 0.0:
        raise table.refuse(row, "a tag without its edge: add a column edge [m], or give --edge")
    turn = quat_from_euler(*(row.numbers.get(n, 0.0) for n in ("roll", "pitch", "yaw")))
    number = None if tag is None else _integer(table, row, tag)
    name = row.words.get("image") or f"tag {number}"
    at = position + quat_rotate(turn, corners(edge))
    here = Placed(name, np.asarray(at), sigma, is_tag=True, dry=dry, group=group)
    if "image" in row.words:
        survey.locations.setdefault(name, []).append((number, here))
    else:
        assert number is not None
        _once(table, row, name, survey.tags.get(number), here, where)
        survey.tags[number] = here


def _integer(table: Table, row: Row, word: str) -> int:
    try:
        return int(float(word))
    except ValueError:
        raise table.refuse(row, f"tag is '{word}', expected its number") from None


def _once(
    table: Table, row: Row, name: str, before: Placed | None, here: Placed, where: dict[str, int]
) -> None:
    if before is not None and np.abs(before.points - here.points).max() > 1e-6:
        raise table.refuse(row, f"{name} was at another place in line {where[name]}: keep one of the two")
    where[name] = row.line


def _plausible(survey: Survey, table: Table) -> None:
    here = [
        *survey.points.values(),
        *survey.tags.values(),
        *(p for t in survey.locations.values() for _, p in t),
    ]
    spread = np.ptp(np.concatenate([p.points for p in here]), axis=0).max()
    if spread > WIDEST and not table.united:
        raise CalibrationError(
            f"{table.path}: the points spread over {spread:.0f} m: if they are not in metres, write the unit into the "
            "header (x_mm) or give --unit mm"
        )
