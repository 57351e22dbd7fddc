"""Tables of surveyed points and of pixels as people write them: any case, units in the header, any separator."""

from __future__ import annotations

import csv
import math
import re
from dataclasses import dataclass
from pathlib import Path

from finssim.calibration.errors import CalibrationError

__all__ = ["Row", "Table", "read_table", "unit_factor"]

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "inch": 0.0254, "ft": 0.3048}
"""Metres in one of each."""

LENGTHS = ("x", "y", "z", "sigma", "edge")

_ALIASES = {
    "u": (
        "u",
        "px",
        "pxx",
        "col",
        "column",
        "ximg",
        "ximage",
        "imagex",
        "imgx",
        "xpx",
        "upx",
        "pixelx",
        "xpixel",
    )
    + ("pixelu", "upixel", "xpix", "pixx", "imgu", "imageu", "uimg"),
    "v": ("v", "py", "pxy", "row", "yimg", "yimage", "imagey", "imgy", "ypx", "vpx", "pixely", "ypixel")
    + ("pixelv", "vpixel", "ypix", "pixy", "imgv", "imagev", "vimg"),
    "x": (
        "x",
        "worldx",
        "floorx",
        "xworld",
        "xfloor",
        "objx",
        "objectx",
        "xobj",
        "xw",
        "wx",
        "poolx",
        "xpool",
    )
    + ("xp", "tankx", "xtank", "realx", "xreal", "easting"),
    "y": (
        "y",
        "worldy",
        "floory",
        "yworld",
        "yfloor",
        "objy",
        "objecty",
        "yobj",
        "yw",
        "wy",
        "pooly",
        "ypool",
    )
    + ("yp", "tanky", "ytank", "realy", "yreal", "northing"),
    "z": (
        "z",
        "worldz",
        "floorz",
        "zworld",
        "zfloor",
        "objz",
        "objectz",
        "zobj",
        "zw",
        "wz",
        "poolz",
        "zpool",
    )
    + ("zp", "tankz", "ztank", "realz", "zreal", "elevation"),
    "id": (
        "id",
        "point",
        "pointid",
        "pt",
        "ptid",
        "name",
        "marker",
        "markerid",
        "label",
        "n",
        "no",
        "nr",
        "index",
    ),
    "tag": ("tag", "tagid"),
    "image": ("image", "img", "file", "filename", "imagename", "picture", "photo", "frame"),
    "sigma": ("sigma", "std", "error", "uncertainty", "survey_sigma", "surveysigma"),
    "edge": ("edge", "size", "tagsize", "tagedge", "side"),
    "yaw": ("yaw", "heading", "psi"),
    "roll": ("roll", "phi"),
    "pitch": ("pitch", "theta"),
    "group": ("group", "location", "board", "target"),
    "dry": ("dry", "above", "abovewater", "inair", "air"),
}
_BY_WORD = {word: name for name, words in _ALIASES.items() for word in words}

_UNIT_AT_END = re.compile(r"[\s_]*[\[(]\s*([^\])]*?)\s*[\])]\s*$|_(m|cm|mm|in|inch|ft|deg|rad|px)$")
_UNIT_COMMENT = re.compile(
    r"#.*\bunits?\b\s*[:=]?\s*(?:in\s+)?\[?(m|cm|mm|in|inch|ft|metres?|meters?)\b", re.IGNORECASE
)


@dataclass(frozen=True)
class Row:
    """One line of a table."""

    line: int
    """Of the file, from 1."""
    words: dict[str, str]
    """Cells that are not empty, by the standard name of their column."""
    numbers: dict[str, float]
    """Those that are numbers: lengths in metres, angles in radians, pixels."""


@dataclass(frozen=True)
class Table:
    """A table of rows with standard column names."""

    path: str
    columns: tuple[str, ...]
    rows: tuple[Row, ...]
    united: bool
    """Whether the file, or its reader, says the unit of lengths."""
    notes: tuple[str, ...] = ()

    def refuse(self, row: Row, sentence: str) -> CalibrationError:
        """The error that says so of a row."""
        return CalibrationError(f"{self.path}: line {row.line}: {sentence}")


def unit_factor(unit: str) -> float:
    """Metres in one of a unit.

    Raises:
        CalibrationError: It is unknown.
    """
    try:
        return UNITS[unit]
    except KeyError:
        raise CalibrationError(f"unknown unit '{unit}'; available: {', '.join(UNITS)}") from None


def read_table(path: str | Path, *, unit: str | None = None) -> Table:
    """Read a table of points, pixels or tags.

    Columns may have any case and order; lengths may carry their unit (`x_mm`, `x [mm]`, `X (cm)`) or a comment line may
    (`# unit: mm`); else they are metres, or of `unit`. Angles are `yaw_deg` or `yaw_rad`; a bare `yaw` is in radians
    if all of its numbers are below 2 pi, else in degrees. Separators: comma, semicolon, tab or blanks.

    Args:
        path: The file.
        unit: Of lengths, where the file does not say.

    Raises:
        CalibrationError: Unreadable, no header, a cell that must be a number is none; names the line.
    """
    try:
        text = Path(path).read_text(encoding="utf-8-sig", errors="replace")
    except OSError as error:
        raise CalibrationError(f"cannot read {path}: {error.strerror or error}") from error
    lines = [(i, line.strip()) for i, line in enumerate(text.splitlines(), start=1) if line.strip()]
    said = next((m[1].lower() for _, line in lines if (m := _UNIT_COMMENT.match(line))), None)
    comments = [line for _, line in lines if line.startswith(("#", "%", "//"))]
    lines = [(i, line) for i, line in lines if not line.startswith(("#", "%", "//"))]
    if lines and comments and _known(lines[0][1]) < 2:  # the header itself may be behind a comment sign
        head = max((line.lstrip("#%/ ") for line in comments), key=_known)
        lines = [(0, head), *lines] if _known(head) >= 2 else lines
    if not lines:
        what = "holds nothing but comments" if comments else "is empty"
        raise CalibrationError(
            f"{path}: the file {what}: expected a line of names, such as id,x,y,z, and rows"
        )
    if _is_numeric(lines[0][1]):
        raise CalibrationError(
            f"{path}: the first line is no header: name the columns, such as id,x,y,z or u,v,x,y,z"
        )
    default = "m" if said and said.startswith("met") else said or unit
    return _table(str(path), lines, default)


def _table(path: str, lines: list[tuple[int, str]], default: str | None) -> Table:
    split = _splitter(lines[0][1])
    heads = [_column(word) for word in split(lines[0][1])]
    names = [name for name, _ in heads]
    twice = sorted({name for name in names if name and names.count(name) > 1})
    if twice:
        raise CalibrationError(f"{path}: two columns mean '{twice[0]}': leave one of them")
    united = default is not None or any(unit in UNITS for _, unit in heads)
    cells = [(i, split(line)) for i, line in lines[1:]]
    factors = [
        _factor(name, unit, default, [c[k] for _, c in cells if k < len(c)])
        for k, (name, unit) in enumerate(heads)
    ]
    rows = []
    for i, words in cells:
        given = {n: w for n, w in zip(names, words, strict=False) if n and w}
        numbers = {
            n: x * f
            for (n, w), f in zip(zip(names, words, strict=False), factors, strict=False)
            if n and (x := _number(w)) is not None and math.isfinite(x)
        }
        row = Row(i, given, numbers)
        _check(path, row)
        if given:
            rows.append(row)
    return Table(path, tuple(n for n in names if n), tuple(rows), united)


def _check(path: str, row: Row) -> None:
    """Refuse words where numbers belong; an empty cell or NaN is a missing number, which is the reader's affair."""
    for name in ("u", "v", "x", "y", "z", "sigma", "edge", "yaw", "roll", "pitch"):
        word = row.words.get(name)
        if (
            word is not None
            and _number(word) is None
            and word.lower() not in ("none", "null", "na", "n/a", "-")
        ):
            raise CalibrationError(
                f"{path}: line {row.line}: {name} is '{word}', expected a number: the whole file is refused; correct "
                "the cell, or empty it to have the row left out"
            )


def _column(word: str) -> tuple[str, str]:
    """Standard name (empty: of no use here) and unit of a column."""
    word = word.strip().strip("\"'")
    found = _UNIT_AT_END.search(word)
    unit = (found[1] or found[2] or "").lower() if found else ""
    bare = word[: found.start()] if found else word
    plain = re.sub(r"[\s_\-.]", "", bare.lower())
    name = _BY_WORD.get(plain, "")
    if unit == "px" and name in ("x", "y"):
        name = {"x": "u", "y": "v"}[name]
    return name or (plain if re.fullmatch(r"[uv][0-3]", plain) else ""), unit


def _factor(name: str, unit: str, default: str | None, words: list[str]) -> float:
    if name in LENGTHS:
        return unit_factor(unit or default or "m")
    if name in ("yaw", "roll", "pitch"):
        if unit == "deg":
            return math.pi / 180.0
        values = [x for word in words if (x := _number(word)) is not None]
        degrees = unit != "rad" and any(abs(x) > 2.0 * math.pi for x in values)
        return math.pi / 180.0 if degrees else 1.0
    return 1.0


def _splitter(head: str):  # type: ignore[no-untyped-def]
    for mark in ("\t", ";", ","):
        if mark in head:
            return lambda line: [cell.strip() for cell in next(csv.reader([line], delimiter=mark))]
    return str.split


def _known(head: str) -> int:
    """How many columns of a line of names mean something here."""
    return sum(bool(_column(word)[0]) for word in _splitter(head)(head))


def _number(word: str) -> float | None:
    try:
        return float(word)
    except ValueError:
        return None


def _is_numeric(line: str) -> bool:
    return all(_number(word) is not None for word in re.split(r"[,;\s]+", line.strip()) if word)
