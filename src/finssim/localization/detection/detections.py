"""Tags detected in pictures, and the CSV file that stores them.

One row per tag: `time,image,tag,u0,v0,u1,v1,u2,v2,u3,v3,margin,hamming,family`. Time in seconds, corners in
pixels with integers at pixel centres, in the order top-left, top-right, bottom-right, bottom-left of the
printed black border. A picture without tags is a row whose cells after `image` are empty.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from finssim.core.text_table import TextTable, read_text_table, write_csv
from finssim.localization import LocalizationError

Array = npt.NDArray[np.float64]

COLUMNS = (
    "time",
    "image",
    "tag",
    *(f"{axis}{i}" for i in range(4) for axis in "uv"),
    "margin",
    "hamming",
    "family",
)

_OTHER_NAMES = {
    "time": ("t", "time_s", "timestamp", "stamp", "seconds"),
    "image": ("file", "filename", "picture", "frame", "image_name", "img"),
    "tag": ("id", "tag_id", "tagid", "marker", "marker_id"),
    "margin": ("decision_margin", "score"),
    "hamming": ("errors",),
    "family": ("tag_family",),
}
_CORNER = re.compile(r"(?:corner|c|p|pt|point)?_?(?:(\d)_?([uvxy])|([uvxy])_?(\d))(?:_?px)?")


@dataclass(frozen=True, eq=False)
class Detection:
    """One tag in one picture."""

    tag: int
    """Id of the tag within its family."""
    corners: Array
    """Pixels (u, v), integers at pixel centres, (4, 2): top-left, top-right, bottom-right, bottom-left as printed."""
    margin: float = math.nan
    """Decision margin, the contrast with which the bits were read [grey levels]; higher is more certain, NaN
    if unknown."""
    hamming: int = 0
    """Number of corrected bits."""
    family: str = ""
    """Family such as `tag25h9`; empty if unknown."""


@dataclass(frozen=True, eq=False)
class Frame:
    """Tags detected in one picture."""

    time: float
    """Time stamp of the picture [s]; NaN if it has none."""
    image: str
    """Name of the picture; empty if it has none."""
    detections: tuple[Detection, ...]
    """Detections in the order in which they were made; an id may occur twice."""


def best_detections(detections: Iterable[Detection]) -> list[Detection]:
    """Return one detection per family and id: that with the fewest corrected bits, then the greatest margin."""
    best: dict[tuple[str, int], Detection] = {}
    for detection in detections:
        rival = best.setdefault((detection.family, detection.tag), detection)
        if (detection.hamming, -_comparable(detection.margin)) < (rival.hamming, -_comparable(rival.margin)):
            best[detection.family, detection.tag] = detection
    return list(best.values())


def in_our_order(frames: Sequence[Frame], corners: Mapping[int, Array]) -> tuple[list[Frame], str]:
    """Return pictures whose corners are in FinsSim's order, and a sentence if the file had another order.

    Other programs begin at another corner or go round in the other direction. A printed tag is seen from its
    front, which reveals the direction. The first corner is the one for which an affine extrapolation from
    each tag best predicts the positions of the others, so at least two tags must be visible in a picture.

    Args:
        frames: Pictures as they were read.
        corners: Tag id -> its corners in the order of `families.corners` in any common frame [m], (4, 3).
    """
    seen = [
        [(corners[d.tag], np.asarray(d.corners, float)) for d in frame.detections if d.tag in corners]
        for frame in frames
    ]
    tags = [pixels for frame in seen for _, pixels in frame if np.isfinite(pixels).all()]
    backwards = bool(tags) and float(np.median([_area(pixels) for pixels in tags])) < 0.0
    orders = [np.roll(np.arange(4)[:: -1 if backwards else 1], shift) for shift in range(4)]
    misses = [
        [
            miss
            for frame in seen
            for X, x in frame
            for Y, y in frame
            if (miss := _miss(X, x[order], Y, y[order])) is not None
        ]
        for order in orders
    ]
    if not misses[0]:
        return list(frames), ""
    scores = [float(np.median(of_order)) for of_order in misses]
    best = int(np.argmin(scores))
    order = orders[best]
    if (best == 0 and not backwards) or scores[best] > UNCLEAR * min(scores[:best] + scores[best + 1 :]):
        return list(frames), ""
    ordered = [
        replace(f, detections=tuple(replace(d, corners=np.asarray(d.corners)[order]) for d in f.detections))
        for f in frames
    ]
    names = ("top-left", "top-right", "bottom-right", "bottom-left")
    first, second = (names[int(np.flatnonzero(order == i)[0])] for i in (0, 1))
    return (
        ordered,
        f"corners are read as {first}, {second}, ..., the order in which the surveyed tags fit together",
    )


UNCLEAR = 0.5
"""Ratio of the best order's error to that of the second best, above which the best order is not accepted [-]."""


def _area(pixels: Array) -> float:
    """Return the signed area of a ring of corners [px²]; positive if it runs clockwise on the screen."""
    x, y = pixels.T
    return 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


def _miss(X: Array, x: Array, Y: Array, y: Array) -> float | None:
    """Return the error with which a tag predicts the picture position of another, as a fraction of their distance.

    Args:
        X: Corners of the tag [m], (4, 3).
        x: Its corners in the picture [px], (4, 2).
        Y: Corners of the other tag [m].
        y: Its corners in the picture [px].
    """
    there, seen = Y.mean(axis=0) - X.mean(axis=0), y.mean(axis=0) - x.mean(axis=0)
    flat = X - X.mean(axis=0)
    _, _, axes = np.linalg.svd(flat)
    distance, along = float(np.linalg.norm(there)), float(np.linalg.norm(axes[:2] @ there))
    if not np.isfinite(seen).all() or along < 0.7 * distance or distance == 0.0:
        return None
    linear = np.linalg.lstsq(flat, x - x.mean(axis=0), rcond=None)[0]
    miss, length = float(np.linalg.norm(there @ linear - seen)), float(np.linalg.norm(seen))
    return miss / max(length, 1e-9)


def write_detections(frames: Iterable[Frame], path: str | Path) -> None:
    """Write a detections file; every number is restored exactly when it is read.

    Args:
        frames: Pictures in the order in which they are written.
        path: The file (.csv).

    Raises:
        OutputError: The file cannot be written.
    """
    rows: list[list[object]] = []
    for frame in frames:
        head: list[object] = [_cell(frame.time), frame.image]
        for detection in frame.detections:
            pixels = [_cell(x) for x in np.asarray(detection.corners, float).ravel().tolist()]
            rows.append(
                [*head, detection.tag, *pixels, _cell(detection.margin), detection.hamming, detection.family]
            )
        if not frame.detections:
            rows.append(head + [""] * (len(COLUMNS) - 2))
    write_csv(path, COLUMNS, rows)


def read_detections(path: str | Path, notes: list[str] | None = None) -> list[Frame]:
    """Read a detections file.

    Columns may be in any order and have common alternative names (`id`, `tag_id`; `x0`, `corner0_u`, `c0_x`;
    corners may count from 1); other columns are ignored. Cells are separated by commas, semicolons or tabs;
    lines that begin with # are comments. Rows with equal image and time, where present, belong to one
    picture; without either column, the file is one picture. A file that was truncated by a crash is read up
    to the cut.

    Args:
        path: The file.
        notes: List to which one sentence is appended for each thing that was left out.

    Returns:
        Pictures in the order of their first appearance in the file.

    Raises:
        LocalizationError: The file is unreadable, lacks the tag or corner columns, or has a cell that is not
            a number; the message names file and line.
    """
    table = read_text_table(path, LocalizationError)
    header, rows = table.names, list(zip(table.lines, table.rows, strict=True))
    if not header:
        raise LocalizationError(f"{path}: no line of column names: expected one such as {','.join(COLUMNS)}")
    columns = _columns(header, str(path))
    if table.unfinished and rows:
        line, last = rows[-1]
        complete = len(last) >= len(header) and tuple(header) != COLUMNS
        outcome = "may be cut" if complete else "is cut short and was left out"
        _note(notes, f"{path}: line {line}, the last, has no end: it {outcome}")
        rows = rows if complete else rows[:-1]
    pictures: dict[tuple[str, str], tuple[float, str, list[Detection]]] = {}
    for line, cells in rows:
        label = f"{path}: line {line}"
        if len(cells) < len(header) or any(cells[len(header) :]):
            raise LocalizationError(
                f"{label}: {len(cells)} cells, expected the {len(header)} of the column names: correct or "
                "remove the line"
            )
        row = {name: cells[i] for name, i in columns.items()}
        key = row.get("image", ""), row.get("time", "")
        if key not in pictures:
            time = _number(table, row, "time", label) if key[1] else math.nan
            pictures[key] = (time, key[0], [])
        if any(cell for name, cell in row.items() if name not in ("time", "image")):
            pictures[key][2].append(_detection(table, row, label))
    return [Frame(time, image, tuple(frames)) for time, image, frames in pictures.values()]


def _detection(table: TextTable, row: Mapping[str, str], label: str) -> Detection:
    pixels = [_number(table, row, f"{axis}{i}", label) for i in range(4) for axis in "uv"]
    return Detection(
        tag=_integer(table, row, "tag", label),
        corners=np.array(pixels).reshape(4, 2),
        margin=_number(table, row, "margin", label) if row.get("margin") else math.nan,
        hamming=_integer(table, row, "hamming", label) if row.get("hamming") else 0,
        family=row.get("family", ""),
    )


def _number(table: TextTable, row: Mapping[str, str], name: str, label: str) -> float:
    value = table.number(row[name])
    if value is None or not math.isfinite(value):
        raise LocalizationError(
            f"{label}: {name} is '{row[name][:40]}', expected a finite number: correct or remove the line"
        )
    return value


def _integer(table: TextTable, row: Mapping[str, str], name: str, label: str) -> int:
    value = _number(table, row, name, label)
    if value != int(value) or value < 0:
        raise LocalizationError(f"{label}: {name} is {row[name]}, expected an integer from 0")
    return int(value)


def _columns(header: list[str], label: str) -> dict[str, int]:
    """Return our column name -> column index in the file."""
    spoken = [re.sub(r"[\s\-.\[\]()]+", "_", name.lower()).strip("_") for name in header]
    standard_names = {other: name for name, others in _OTHER_NAMES.items() for other in (name, *others)}
    matches = [(standard_names.get(name) or "", _CORNER.fullmatch(name)) for name in spoken]
    numbers = [int(match[1] or match[4]) for _, match in matches if match]
    first = min(numbers, default=0)  # corners may count from 1
    columns: dict[str, int] = {}
    for position, (name, match) in enumerate(matches):
        if match:
            axis = (match[2] or match[3]).translate(str.maketrans("xy", "uv"))
            name = f"{axis}{int(match[1] or match[4]) - first}"
        if name in columns:
            raise LocalizationError(f"{label}: '{header[position]}' is a second column of {name}: remove one")
        if name:
            columns[name] = position
    missing = [name for name in COLUMNS[2:11] if name not in columns]
    if missing:
        raise LocalizationError(
            f"{label}: no column '{missing[0]}' among {', '.join(header)[:200]}: expected {','.join(COLUMNS)}"
        )
    return columns


def _comparable(margin: float) -> float:
    return -math.inf if math.isnan(margin) else margin


def _cell(value: float) -> str:
    return "" if math.isnan(value) else repr(float(value))


def _note(notes: list[str] | None, sentence: str) -> None:
    if notes is not None:
        notes.append(sentence)
