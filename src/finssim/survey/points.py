"""Surveyed points of a pool and their pixels, from tables with varying column names and from images."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import yaml
from numpy.typing import NDArray

from finssim.core.rotations import quat_from_euler, quat_rotate
from finssim.core.text_table import TextTable, read_text, read_text_table, text_table
from finssim.core.text_table import number as _number
from finssim.localization.detection.detections import Frame, best_detections, in_our_order, read_detections
from finssim.localization.detection.families import corners
from finssim.trials.conversion import UNITS
from finssim.trials.findings import CalibrationError, Finding, finding
from finssim.vehicles.part import VehicleError
from finssim.vehicles.tag_layout import read_tag_layout

Array = NDArray[np.float64]

METRES = {**UNITS["length"], "inch": 0.0254}
"""Unit of length -> metres."""

LENGTHS, ANGLES = ("x", "y", "z", "sigma", "edge"), ("yaw", "roll", "pitch")

WIDEST = 300.0
"""Spread of coordinates above which the file must state the unit [m]."""

_BY_WORD = {
    word: name
    for name, words in yaml.safe_load(
        Path(__file__).with_name("columns.yaml").read_text(encoding="utf-8")
    ).items()
    for word in words.split()
}
"""Alternative column name (`columns.yaml`) -> standard name."""

COMMENT = ("#", "%", "//")

_UNIT_AT_END = re.compile(r"[\s_]*[\[(]\s*([^\])]*?)\s*[\])]\s*$|_(m|cm|mm|in|inch|ft|deg|rad|px)$")
_UNIT_COMMENT = re.compile(
    r"#.*\bunits?\b\s*[:=]?\s*(?:in\s+)?\[?(m|cm|mm|in|inch|ft|metres?|meters?)\b", re.IGNORECASE
)


@dataclass(frozen=True)
class TableRow:
    """One line of a table."""

    line: int
    """Line number in the file, from 1."""
    words: dict[str, str]
    """Standard column name -> text of each cell that is not empty."""
    numbers: dict[str, float]
    """Standard column name -> number: lengths in metres, angles in radians, pixels."""

    def missing(self, *names: str) -> list[str]:
        """Return the given columns that have no number in the row."""
        return [name for name in names if name not in self.numbers]

    def position(self, z: float | None) -> Array:
        """Return x, y and z [m], (3,), with `z` if the table has no such column."""
        return np.array([self.numbers["x"], self.numbers["y"], self.numbers.get("z", z)], float)

    @property
    def pixel(self) -> Array:
        """Return the pixel, (2,)."""
        return np.array([self.numbers["u"], self.numbers["v"]])

    def placed(self, name: str, points: Array) -> SurveyedPoints:
        """Return surveyed points with the row's standard error and flags. Points are in [m]."""
        return SurveyedPoints(
            name,
            points,
            self.numbers.get("sigma", math.nan),
            dry=self.words.get("dry", "").lower() in ("1", "1.0", "true", "yes", "y", "dry", "x"),
            group=self.words.get("group", ""),
        )


@dataclass(frozen=True)
class SurveyTable:
    """A table of rows with standard column names."""

    path: str
    columns: tuple[str, ...]
    rows: tuple[TableRow, ...]
    united: bool
    """True if the file or the caller states the unit of lengths."""

    def refuse_other_units(self, spread: float) -> None:
        """Refuse coordinates without a stated unit that are too large for a pool in metres. The spread is in
        the unit of the table."""
        if spread > WIDEST and not self.united:
            raise CalibrationError(
                f"{self.path}: the points spread over {spread:.0f} m: if they are not in metres, write the unit into "
                "the header (x_mm) or unit: mm into the survey file"
            )

    def refuse(self, row: TableRow, sentence: str) -> CalibrationError:
        """Return the error with a sentence about a row."""
        return CalibrationError(f"{self.path}: line {row.line}: {sentence}")


def read_table(path: str | Path, *, unit: str | None = None) -> SurveyTable:
    """Read a table of points, pixels or tags.

    Column names may be in any case and order; lengths may state their unit in the name (`x_mm`, `x [mm]`, `X
    (cm)`) or in a comment line (`# unit: mm`); else they are in `unit`, by default metres. Angles are
    `yaw_deg` or `yaw_rad`; plain `yaw` is in radians if all of its numbers are below 2 pi, else in degrees.
    Separators: comma, semicolon, tab or blanks.

    Args:
        path: The file.
        unit: Unit of lengths if the file does not state it.

    Raises:
        CalibrationError: The file is unreadable, has no header, or a cell is not a number; the message names
            the line.
    """
    text, _ = read_text(path, CalibrationError)
    table = text_table(text, spaces=None, comment=COMMENT)
    heads = [text_table(line.lstrip("#%/ "), spaces=None).names for line in table.comments]
    if heads and table.names and _recognised(table.names) < 2:  # the header itself may be a comment line
        head = max(heads, key=_recognised)
        if _recognised(head) >= 2:
            table = text_table(text, names=head, spaces=None, comment=COMMENT)
    if not table.names:
        lack = "holds nothing but comments" if table.comments else "is empty"
        raise CalibrationError(
            f"{path}: the file {lack}: expected a line of names, such as id,x,y,z, and rows"
        )
    if all(_number(cell) is not None for cell in table.names):
        raise CalibrationError(
            f"{path}: the first line is no header: name the columns, such as id,x,y,z or u,v,x,y,z"
        )
    stated = next((m[1].lower() for line in table.comments if (m := _UNIT_COMMENT.match(line))), None)
    return _table(str(path), table, "m" if stated and stated.startswith("met") else stated or unit)


def _table(path: str, text: TextTable, default: str | None) -> SurveyTable:
    heads = [_column(word) for word in text.names]
    names = [name for name, _ in heads]
    twice = sorted({name for name in names if name and names.count(name) > 1})
    if twice:
        raise CalibrationError(f"{path}: two columns mean '{twice[0]}': leave one of them")
    united = default is not None or any(unit in METRES for _, unit in heads)
    cells = text.rows
    if text.decimal_comma:
        cells = [[w.replace(",", ".") if text.number(w) is not None else w for w in row] for row in cells]
    factors = [
        _factor(name, unit, default, [c[k] for c in cells if k < len(c)])
        for k, (name, unit) in enumerate(heads)
    ]
    rows = []
    for i, column_cells in zip(text.lines, cells, strict=True):
        columns = [(n, w, f) for n, w, f in zip(names, column_cells, factors, strict=False) if n and w]
        numbers = {n: x * f for n, w, f in columns if (x := _number(w)) is not None and math.isfinite(x)}
        row = TableRow(i, {n: w for n, w, _ in columns}, numbers)
        _check(path, row)
        if columns:
            rows.append(row)
    return SurveyTable(path, tuple(n for n in names if n), tuple(rows), united)


def _check(path: str, row: TableRow) -> None:
    """Refuse texts in number columns; an empty cell or NaN is a missing number, which the caller handles."""
    for name in ("u", "v", *LENGTHS, *ANGLES):
        word = row.words.get(name, "0")
        if _number(word) is None:
            raise CalibrationError(
                f"{path}: line {row.line}: {name} is '{word}', expected a number: the file is refused; correct the "
                "cell, or empty it to have the row left out"
            )


def _column(word: str) -> tuple[str, str]:
    """Return the standard name (empty: ignored) and the unit of a column."""
    word = word.strip().strip("\"'")
    match = _UNIT_AT_END.search(word)
    unit = (match[1] or match[2] or "").lower() if match else ""
    bare = word[: match.start()] if match else word
    plain = re.sub(r"[\s_\-.]", "", bare.lower())
    name = _BY_WORD.get(plain, "")
    if unit == "px" and name in ("x", "y"):
        name = {"x": "u", "y": "v"}[name]
    return name or (plain if re.fullmatch(r"[uv][0-3]", plain) else ""), unit


def _factor(name: str, unit: str, default: str | None, cells: list[str]) -> float:
    if name in LENGTHS:
        unit = unit or default or "m"
        if unit not in METRES:
            raise CalibrationError(f"unknown unit '{unit}'; available: {', '.join(METRES)}")
        return METRES[unit]
    if name in ANGLES:
        if unit == "deg":
            return math.pi / 180.0
        values = [x for word in cells if (x := _number(word)) is not None]
        degrees = unit != "rad" and any(abs(x) > 2.0 * math.pi for x in values)
        return math.pi / 180.0 if degrees else 1.0
    return 1.0


def _recognised(names: Sequence[str]) -> int:
    """Return the number of recognised column names."""
    return sum(bool(_column(word)[0]) for word in names)


@dataclass(frozen=True, eq=False)
class SurveyedPoints:
    """Points that share one survey error because they were surveyed together: a tag's corners, or a single point."""

    name: str
    points: Array
    """Pool frame [m], (K, 3); a tag's corners in the order of `families.corners`."""
    sigma: float
    """Standard error of each coordinate [m]; NaN if the survey does not state it."""
    dry: bool = False
    """True if the points are on the camera's side of the water."""
    group: str = ""
    """Name of the rigid target to which the points belong; empty: none."""

    def arm(self, corner: int) -> Array:
        """Return the displacement of a corner by a rotation of its tag about z [m/rad], (3,)."""
        x, y, _ = self.points[corner] - self.points.mean(axis=0)
        return np.array([-y, x, 0.0])


@dataclass(frozen=True)
class Survey:
    """Surveyed points and tags."""

    path: str
    points: dict[str, SurveyedPoints] = field(default_factory=dict)
    """Single points by id."""
    tags: dict[int, SurveyedPoints] = field(default_factory=dict)
    """Fixed tags by id."""
    locations: dict[str, list[tuple[int | None, SurveyedPoints]]] = field(default_factory=dict)
    """Image -> tags surveyed for it (id, or None for the only one visible)."""
    findings: tuple[Finding, ...] = ()


def read_survey(
    path: str | Path,
    *,
    unit: str | None = None,
    edge: float | None = None,
    edges: Mapping[int, float] | None = None,
    z: float | None = None,
) -> Survey:
    """Read a survey.

    Columns `id,x,y,z` for points; `tag,x,y,z,yaw_deg[,roll_deg,pitch_deg],edge` for fixed tags (centre and attitude
    of the tag frame); `image,x,y,z,yaw_deg[,tag],edge` for one tag that was moved from picture to picture. `sigma`
    is the standard error of a row, `dry` flags points above the water, `group` assigns points to one rigid target.

    A tag file of apriltag_ros (.yaml) provides the tags of its bundle, in the bundle's frame.

    Args:
        path: CSV file, or the YAML file of a bundle.
        unit: Unit of lengths if the file states none.
        edge: Edge of all tags [m] if the table has no such column.
        edges: Edges of tags by id [m], with priority over `edge`.
        z: Height of all points [m] if the table has no such column.

    Raises:
        CalibrationError: A column or number is missing, or an id has two positions; the message names the line.
    """
    if Path(path).suffix.lower() in (".yaml", ".yml"):
        return _bundle(Path(path))
    table = read_table(path, unit=unit)
    for name in ("x", "y"):
        if name not in table.columns:
            raise CalibrationError(
                f"{table.path}: no column '{name}': a survey has id,x,y,z or tag,x,y,z,yaw_deg,edge"
            )
    if "z" not in table.columns and z is None:
        raise CalibrationError(
            f"{table.path}: no column 'z': add it, or give the height of all points as z in the survey file"
        )
    if not {"id", "tag", "image"} & set(table.columns):
        raise CalibrationError(f"{table.path}: no column names the points: add id, tag or image")
    findings: list[Finding] = []
    survey, lines, every = Survey(str(path)), {}, []
    for row in table.rows:
        if missing := row.missing("x", "y", *(["z"] if z is None else [])):
            findings.append(finding("row_incomplete", table.path, line=row.line, missing=tuple(missing)))
            continue
        name, tag, here = _surveyed(table, row, (edge, edges or {}), z)
        every.append(here.points)
        if "image" in row.words:
            survey.locations.setdefault(name, []).append((tag, here))
            continue
        before = survey.points.get(name) if tag is None else survey.tags.get(tag)
        if before is not None and np.abs(before.points - here.points).max() > 1e-6:
            label = f"point '{name}'" if tag is None else name
            raise table.refuse(
                row, f"{label} has another position in line {lines[name]}: keep one of the two"
            )
        lines[name] = row.line
        if tag is None:
            survey.points[name] = here
        else:
            survey.tags[tag] = here
    if not every:
        raise CalibrationError(f"{path}: no surveyed point in it: give rows of id,x,y,z")
    table.refuse_other_units(np.ptp(np.concatenate(every), axis=0).max())
    return replace(survey, findings=tuple(findings))


def _surveyed(
    table: SurveyTable, row: TableRow, edges: tuple[float | None, Mapping[int, float]], z: float | None
) -> tuple[str, int | None, SurveyedPoints]:
    """Return the name of a row, the id of its tag (None: a point, or any tag), and its points."""
    of_any, of_tags = edges
    named = row.words.get("tag", "").removesuffix(".0")
    edge = row.numbers.get("edge", of_tags.get(int(named), of_any) if named.isdecimal() else of_any)
    word = row.words.get("tag") or (row.words.get("id") if edge is not None else None)
    if "image" not in row.words and word is None:
        name = row.words.get("id", "")
        if not name:
            raise table.refuse(row, "no id")
        return name, None, row.placed(name, row.position(z)[None])
    if edge is None or edge <= 0.0:
        raise table.refuse(
            row, "a tag without its edge: add a column edge [m], or edge to tags of the survey file"
        )
    if word is not None and _number(word) is None:
        raise table.refuse(row, f"tag is '{word}', expected its number")
    tag = None if word is None else int(float(word))
    name = row.words.get("image") or f"tag {tag}"
    turn = quat_from_euler(*(row.numbers.get(n, 0.0) for n in ("roll", "pitch", "yaw")))
    return name, tag, row.placed(name, row.position(z) + quat_rotate(turn, corners(edge)))


def _bundle(path: Path) -> Survey:
    """Return the tags of a bundle of apriltag_ros."""
    try:
        layout = read_tag_layout(path)
    except VehicleError as error:
        raise CalibrationError(str(error)) from None
    if not layout.poses:
        raise CalibrationError(
            f"{path}: gives sizes of tags without poses: give a table of tag,x,y,z,yaw_deg as points, and this file as "
            "sizes of tags"
        )
    placed = {
        tag: SurveyedPoints(
            f"tag {tag}", pose.position + quat_rotate(pose.orientation, corners(layout.sizes[tag])), math.nan
        )
        for tag, pose in layout.poses.items()
    }
    remarks = tuple(finding("as_read", remark=remark) for remark in layout.remarks)
    return Survey(str(path), tags=placed, findings=remarks)


@dataclass(frozen=True, eq=False)
class Observations:
    """Pixels of N surveyed points; points of one location share its survey error."""

    pixels: Array
    """Pixels (u, v), integers at pixel centres, (N, 2)."""
    points: Array
    """Surveyed points, pool frame [m], (N, 3)."""
    location: NDArray[np.intp]
    """Index into `locations`, (N,)."""
    names: tuple[str, ...]
    """Name of each row: the point's id or tag/corner, with its image if there are several."""
    locations: tuple[str, ...]
    sigma: Array
    """Standard error of the survey [m], (N,); NaN if it is not stated."""
    arm: Array
    """Displacement of the point by a rotation of its location about z [m/rad], (N, 3); zero for single points."""
    dry: NDArray[np.bool_]
    """True for points on the camera's side of the plane, (N,)."""
    findings: tuple[Finding, ...] = ()

    def __len__(self) -> int:
        return len(self.points)

    def subset(self, rows: NDArray[np.bool_] | NDArray[np.intp]) -> Observations:
        """Return some of the rows; locations keep their indices."""
        index = np.flatnonzero(rows) if np.asarray(rows).dtype == bool else np.asarray(rows)
        columns = ("pixels", "points", "location", "sigma", "arm", "dry")
        return replace(
            self,
            **{name: getattr(self, name)[index] for name in columns},
            names=tuple(self.names[i] for i in index),
        )


def observe(inputs: Sequence[Path], survey: Survey, *, family: str | None = None) -> Observations:
    """Match files of detections or pixels with a survey.

    Args:
        inputs: Detections CSV (`image,tag,u0,v0,...`), pixel CSV (`[image,]id,u,v`), or pictures, in which tags of
            `family` are detected.
        survey: Surveyed points and tags.
        family: Family of the tags in pictures.

    Raises:
        CalibrationError: No observation is in the survey, or a file cannot be read; the message names ids and
            lines.
    """
    rows = _Rows()
    tables, pictures = [], []
    for path in map(Path, inputs):
        is_table = path.suffix.lower() in (".csv", ".txt", ".tsv", ".dat")
        (tables if is_table else pictures).append(path)
    for path in tables:
        if _is_detections(path):
            remarks: list[str] = []
            tags = {tag: placed.points for tag, placed in survey.tags.items()}
            frames, remark = in_our_order(read_detections(path, remarks), tags)
            remarks += [f"{path}: {remark}"] if remark else []
            _match_frames(rows, frames, survey)
            rows.findings += [finding("as_read", remark=remark) for remark in remarks]
        else:
            _match_table(rows, read_table(path), survey)
    if pictures:
        _match_frames(rows, _detect(pictures, family), survey)
    return rows.observations(", ".join(str(path) for path in inputs), survey)


def observe_combined(
    paths: Sequence[Path], *, unit: str | None = None, z: float | None = None
) -> Observations:
    """Read tables with pixel and point in one row: `u,v,x,y,z`, and optionally `id`, `group`, `sigma`, `dry`.

    Raises:
        CalibrationError: A column or number is missing.
    """
    rows, points = _Rows(), {}
    for path in paths:
        table = read_table(path, unit=unit)
        needed = ["u", "v", "x", "y", *(["z"] if z is None else [])]
        missing = [name for name in needed if name not in table.columns]
        if missing:
            raise CalibrationError(
                f"{path}: no column '{missing[0]}': name the columns u,v,x,y,z, or give the points of the survey file"
                + (
                    "; points of one height may leave z out if the survey file gives it"
                    if missing == ["z"]
                    else ""
                )
            )
        complete = [row for row in table.rows if not row.missing(*needed)]
        table.refuse_other_units(max((np.abs(row.position(z)).max() for row in complete), default=0.0))
        for row in complete:
            name = row.words.get("id") or row.words.get("tag") or f"line {row.line}"
            new = row.placed(name, row.position(z)[None])
            placed = points.setdefault((name, *new.points[0].tolist()), new)
            rows.add(_Match(row.words.get("image", ""), name, placed, 0, row.pixel))
        rows.findings += [
            finding("row_incomplete", str(path), line=row.line, missing=tuple(missing))
            for row in table.rows
            if (missing := row.missing(*needed))
        ]
    return rows.observations(", ".join(map(str, paths)), None)


class _Match(NamedTuple):
    """Pixel of a surveyed point."""

    image: str
    name: str
    placed: SurveyedPoints
    corner: int
    pixel: Array


class _Rows:
    """Accumulator of matches."""

    def __init__(self) -> None:
        self.findings: list[Finding] = []
        self.unknown: dict[str, None] = {}
        self._matches: dict[tuple[object, ...], _Match] = {}

    def add(self, match: _Match) -> None:
        key = (match.image, id(match.placed), match.corner, *match.pixel.tolist())
        if key in self._matches:
            self.findings.append(finding("counted_twice", match.name))
        self._matches.setdefault(key, match)

    def observations(self, source: str, survey: Survey | None) -> Observations:
        if self.unknown:
            self.findings.append(finding("not_surveyed", names=tuple(self.unknown)))
        matches = list(self._matches.values())
        if not matches:
            surveyed = [] if survey is None else [*survey.points, *map(str, survey.tags), *survey.locations]
            observed = f"; observed: {', '.join(list(self.unknown)[:5])}" if self.unknown else ""
            raise CalibrationError(
                f"{source}: no observation belongs to a surveyed point "
                f"(surveyed: {', '.join(surveyed[:5]) or 'none'}{observed})"
            )
        labels = {m.placed.group or id(m.placed): m.placed.group or m.placed.name for m in reversed(matches)}
        order = {
            key: i for i, key in enumerate(dict.fromkeys(m.placed.group or id(m.placed) for m in matches))
        }
        several = len({m.image for m in matches}) > 1
        return Observations(
            pixels=np.stack([m.pixel for m in matches]),
            points=np.stack([m.placed.points[m.corner] for m in matches]),
            location=np.array([order[m.placed.group or id(m.placed)] for m in matches]),
            names=tuple(
                f"{m.image}: {m.name}" if several and m.image and not m.name.startswith(m.image) else m.name
                for m in matches
            ),
            locations=tuple(labels[key] for key in order),
            sigma=np.array([m.placed.sigma for m in matches]),
            arm=np.stack([m.placed.arm(m.corner) for m in matches]),
            dry=np.array([m.placed.dry for m in matches]),
            findings=(*(survey.findings if survey else ()), *self.findings),
        )


def _is_detections(path: Path) -> bool:
    names = read_text_table(path, CalibrationError).names
    plain = {re.sub(r"[\s\"']", "", name).lower() for name in names}
    numbered = [cell for cell in plain if re.search(r"\d", cell) and re.search(r"[uvxy]", cell)]
    return plain >= {"u0", "v0", "u3", "v3"} or len(numbered) >= 8


def _match_frames(rows: _Rows, frames: Sequence[Frame], survey: Survey) -> None:
    for frame in frames:
        lay = survey.locations.get(frame.image) or survey.locations.get(Path(frame.image).name, [])
        if survey.locations and not lay and not survey.tags:
            rows.unknown[frame.image or "a picture without a name"] = None
            continue
        detections = best_detections(frame.detections)
        for detection in detections:
            placed = survey.tags.get(detection.tag)
            for tag, here in lay:
                if tag == detection.tag or (tag is None and len(detections) == 1):
                    placed = here
            if placed is None:
                rows.unknown[f"tag {detection.tag}"] = None
                continue
            for corner, pixel in enumerate(np.asarray(detection.corners, float)):
                if np.isfinite(pixel).all():
                    rows.add(_Match(frame.image, f"{placed.name}/{corner}", placed, corner, pixel))


def _match_table(rows: _Rows, table: SurveyTable, survey: Survey) -> None:
    missing = [name for name in ("u", "v") if name not in table.columns]
    if missing or not {"id", "tag"} & set(table.columns):
        raise CalibrationError(
            f"{table.path}: no column '{missing[0] if missing else 'id'}': pixels are a table of id,u,v"
        )
    for row in table.rows:
        name = row.words.get("id") or row.words.get("tag") or ""
        placed, corner = _find(survey, name)
        if placed is None:
            rows.unknown[name or f"line {row.line}"] = None
        elif row.missing("u", "v"):
            rows.findings.append(finding("pixel_missing", table.path, line=row.line, point=name))
        else:
            rows.add(_Match(row.words.get("image", ""), name, placed, corner, row.pixel))


def _find(survey: Survey, name: str) -> tuple[SurveyedPoints | None, int]:
    """Return a point by its id, even if one file writes 7 and the other 7.0, or a tag's corner by `tag/0`."""
    if name in survey.points:
        return survey.points[name], 0
    tag, _, corner = name.partition("/")
    if corner in ("0", "1", "2", "3") and tag.isdigit() and int(tag) in survey.tags:
        return survey.tags[int(tag)], int(corner)
    value = _number(name)
    same = (placed for key, placed in survey.points.items() if value is not None and _number(key) == value)
    return next(same, None), 0


def _detect(paths: Sequence[Path], family: str | None) -> list[Frame]:
    from finssim.localization.detection.detector import detector
    from finssim.localization.detection.pictures import pictures

    if family is None:
        raise CalibrationError(
            "images need the family of their tags: give tags: {family: tag25h9} in the survey file"
        )
    find = detector(family)
    return [Frame(time, name, tuple(find.detect(image))) for time, name, image in pictures(paths)]
