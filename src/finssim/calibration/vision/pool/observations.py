"""Pixels matched with surveyed points: from detections, from tables of pixels, or from pictures."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.vision.pool.survey import Placed, Survey, corner_name
from finssim.calibration.vision.pool.survey_table import Row, Table, read_table
from finssim.localization.detection.detections import Frame, most_certain, read_detections

__all__ = ["Observations", "observe", "observe_combined"]

Array = NDArray[np.float64]

_DETECTIONS = {"u0", "v0", "u3", "v3"}


@dataclass(frozen=True, eq=False)
class Observations:
    """Pixels of N surveyed points; points of one location share the error of its survey."""

    pixels: Array
    """(N, 2), integers at pixel centres."""
    points: Array
    """Pool frame [m], (N, 3)."""
    location: NDArray[np.intp]
    """Index into `locations`, (N,)."""
    names: tuple[str, ...]
    """What each row is called: the point's id or tag/corner, with its picture where there are several."""
    locations: tuple[str, ...]
    sigma: Array
    """Standard error of the survey [m], (N,); NaN where it does not say."""
    arm: Array
    """Displacement of the point by a turn of its location about z [m/rad], (N, 3); zero for single points."""
    dry: NDArray[np.bool_]
    """On the camera's side of the plane, (N,)."""
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.points)

    def subset(self, rows: NDArray[np.bool_] | NDArray[np.intp]) -> Observations:
        """Some of the rows; locations keep their indices."""
        index = np.flatnonzero(rows) if np.asarray(rows).dtype == bool else np.asarray(rows)
        return replace(
            self,
            pixels=self.pixels[index],
            points=self.points[index],
            location=self.location[index],
            names=tuple(self.names[i] for i in index),
            sigma=self.sigma[index],
            arm=self.arm[index],
            dry=self.dry[index],
        )

    def shifted(self, vector: Array) -> Observations:
        """The same in a frame in which every point lies `vector` further [m]."""
        return replace(self, points=self.points + vector)


def observe(inputs: Sequence[Path], survey: Survey, *, family: str | None = None) -> Observations:
    """Match files of detections or pixels with a survey.

    Args:
        inputs: Detections CSV (`image,tag,u0,v0,...`), pixel CSV (`[image,]id,u,v`), or pictures, in which tags of
            `family` are looked for.
        survey: Where everything lay.
        family: Of the tags in pictures.

    Raises:
        CalibrationError: Nothing of it is in the survey, or a file cannot be read; names ids and lines.
    """
    rows = _Rows()
    tables, pictures = [], []
    for path in map(Path, inputs):
        is_table = path.suffix.lower() in (".csv", ".txt", ".tsv", ".dat")
        (tables if is_table else pictures).append(path)
    for path in tables:
        if _is_detections(path):
            _match_frames(rows, read_detections(path, rows.notes), survey)
        else:
            _match_table(rows, read_table(path), survey)
    if pictures:
        _match_frames(rows, _detect(pictures, family), survey)
    return rows.observations(", ".join(str(path) for path in inputs), survey)


def observe_combined(
    paths: Sequence[Path], *, unit: str | None = None, z: float | None = None
) -> Observations:
    """Read tables that hold pixel and point in one row: `u,v,x,y,z`, with `id`, `group`, `sigma`, `dry` where given.

    Raises:
        CalibrationError: A column or number is missing.
    """
    rows = _Rows()
    for path in paths:
        table = read_table(path, unit=unit)
        needed = ["u", "v", "x", "y", *(["z"] if z is None else [])]
        missing = [name for name in needed if name not in table.columns]
        if missing:
            raise CalibrationError(
                f"{path}: no column '{missing[0]}': name the columns u,v,x,y,z, or give a survey (--surveyed)"
                + ("; points of one height may leave z out and give --z" if missing == ["z"] else "")
            )
        spread = max((abs(row.numbers.get(n, 0.0)) for row in table.rows for n in "xyz"), default=0.0)
        if spread > 300.0 and not table.united:
            raise CalibrationError(
                f"{path}: coordinates reach {spread:.0f} m: if they are not in metres, write the unit into the header "
                "(x_mm) or give --unit mm"
            )
        for row in table.rows:
            if all(name in row.numbers for name in needed):
                rows.add_combined(row, row.numbers.get("z", z))
            else:
                rows.notes.append(f"{path}: line {row.line}: left out: a number is missing")
    return rows.observations(", ".join(map(str, paths)), None)


class _Rows:
    """Rows as they are gathered."""

    def __init__(self) -> None:
        self.notes: list[str] = []
        self.unknown: dict[str, int] = {}
        self._pixels: list[Array] = []
        self._placed: list[tuple[Placed, int]] = []
        self._names: list[str] = []
        self._images: list[str] = []
        self._seen: set[tuple[object, ...]] = set()
        self._points: dict[tuple[object, ...], Placed] = {}

    def add(self, image: str, name: str, placed: Placed, corner: int, pixel: Array) -> None:
        key = (image, id(placed), corner, float(pixel[0]), float(pixel[1]))
        if key in self._seen:
            self.notes.append(f"{name} is there twice with the same pixel: counted once")
            return
        self._seen.add(key)
        self._pixels.append(np.asarray(pixel, float))
        self._placed.append((placed, corner))
        self._names.append(name)
        self._images.append(image)

    def add_combined(self, row: Row, z: float | None) -> None:
        point = np.array([row.numbers["x"], row.numbers["y"], z], float)
        name = row.words.get("id") or row.words.get("tag") or f"line {row.line}"
        dry = row.words.get("dry", "").lower() in ("1", "1.0", "true", "yes", "y", "dry")
        sigma = row.numbers.get("sigma", float("nan"))
        new = Placed(name, point[None], sigma, dry=dry, group=row.words.get("group", ""))
        placed = self._points.setdefault((name, *point.tolist()), new)
        pixel = np.array([row.numbers["u"], row.numbers["v"]])
        self.add(row.words.get("image", ""), name, placed, 0, pixel)

    def observations(self, source: str, survey: Survey | None) -> Observations:
        if self.unknown:
            shown = ", ".join(list(self.unknown)[:8]) + (", ..." if len(self.unknown) > 8 else "")
            self.notes.append(f"not in the survey, so left out: {shown}")
        if not self._pixels:
            known = [] if survey is None else [*survey.points, *map(str, survey.tags), *survey.locations]
            what = f"; observed: {', '.join(list(self.unknown)[:5])}" if self.unknown else ""
            raise CalibrationError(
                f"{source}: no observation belongs to a surveyed point "
                f"(surveyed: {', '.join(known[:5]) or 'none'}{what})"
            )
        order: dict[object, int] = {}
        location = np.array([order.setdefault(p.group or id(p), len(order)) for p, _ in self._placed])
        labels: dict[int, str] = {}
        for i, (placed, _) in zip(location, self._placed, strict=True):
            labels.setdefault(int(i), placed.group or placed.name)
        several = len(set(self._images)) > 1
        return Observations(
            pixels=np.stack(self._pixels),
            points=np.stack([p.points[k] for p, k in self._placed]),
            location=location,
            names=tuple(
                f"{image}: {name}" if several and image and not name.startswith(image) else name
                for image, name in zip(self._images, self._names, strict=True)
            ),
            locations=tuple(labels[i] for i in range(len(labels))),
            sigma=np.array([p.sigma for p, _ in self._placed]),
            arm=np.stack([_arm(p, k) for p, k in self._placed]),
            dry=np.array([p.dry for p, _ in self._placed]),
            notes=(*(survey.notes if survey else ()), *self.notes),
        )


def _arm(placed: Placed, corner: int) -> Array:
    if not placed.is_tag:
        return np.zeros(3)
    x, y, _ = placed.points[corner] - placed.points.mean(axis=0)
    return np.array([-y, x, 0.0])


def _is_detections(path: Path) -> bool:
    try:
        text = path.read_text(encoding="utf-8-sig", errors="replace")
    except OSError as error:
        raise CalibrationError(f"cannot read {path}: {error.strerror or error}") from error
    head = next(
        (line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")), ""
    )
    plain = {re.sub(r"[\s\"']", "", cell).lower() for cell in re.split(r"[,;\t]", head)}
    numbered = [cell for cell in plain if re.search(r"\d", cell) and re.search(r"[uvxy]", cell)]
    return plain >= _DETECTIONS or len(numbered) >= 8


def _match_frames(rows: _Rows, frames: Sequence[Frame], survey: Survey) -> None:
    for frame in frames:
        lay = survey.locations.get(frame.image) or survey.locations.get(Path(frame.image).name, [])
        if survey.locations and not lay and not survey.tags:
            rows.unknown.setdefault(frame.image or "a picture without a name", 0)
            continue
        found = most_certain(frame.detections)
        for detection in found:
            placed = survey.tags.get(detection.tag)
            for tag, here in lay:
                if tag == detection.tag or (tag is None and len(found) == 1):
                    placed = here
            if placed is None:
                rows.unknown.setdefault(f"tag {detection.tag}", 0)
                continue
            for corner, pixel in enumerate(np.asarray(detection.corners, float)):
                if np.isfinite(pixel).all():
                    rows.add(frame.image, corner_name(placed.name, corner), placed, corner, pixel)


def _match_table(rows: _Rows, table: Table, survey: Survey) -> None:
    missing = [name for name in ("u", "v") if name not in table.columns]
    if missing or not {"id", "tag"} & set(table.columns):
        raise CalibrationError(
            f"{table.path}: no column '{missing[0] if missing else 'id'}': pixels are a table of id,u,v"
        )
    for row in table.rows:
        name = row.words.get("id") or row.words.get("tag") or ""
        placed, corner = _find(survey, name)
        if placed is None:
            rows.unknown.setdefault(name or f"line {row.line}", 0)
        elif "u" not in row.numbers or "v" not in row.numbers:
            rows.notes.append(f"{table.path}: line {row.line}: left out: {name} has no pixel")
        else:
            pixel = np.array([row.numbers["u"], row.numbers["v"]])
            rows.add(row.words.get("image", ""), name, placed, corner, pixel)


def _find(survey: Survey, name: str) -> tuple[Placed | None, int]:
    """A point by its id, also where one file writes 7 and the other 7.0, or a corner `tag/0`."""
    if name in survey.points:
        return survey.points[name], 0
    tag, _, corner = name.partition("/")
    if corner in ("0", "1", "2", "3") and tag.isdigit() and int(tag) in survey.tags:
        return survey.tags[int(tag)], int(corner)
    try:
        value = float(name)
    except ValueError:
        return None, 0
    return next((p for key, p in survey.points.items() if _same_number(key, value)), None), 0


def _same_number(key: str, value: float) -> bool:
    try:
        return float(key) == value
    except ValueError:
        return False


def _detect(paths: Sequence[Path], family: str | None) -> list[Frame]:
    from finssim.localization.detection.detector import detector
    from finssim.localization.detection.pictures import pictures

    if family is None:
        raise CalibrationError("pictures need the family of the tags in them: give --family, such as tag25h9")
    find = detector(family)
    return [Frame(time, name, tuple(find.detect(image))) for time, name, image in pictures(paths)]
