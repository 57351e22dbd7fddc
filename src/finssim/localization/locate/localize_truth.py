"""How far measured positions are from surveyed ones."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path, PurePath
from typing import Any

import numpy as np
import numpy.typing as npt

from finssim.geometry.rotations import wrap_angle
from finssim.localization.errors import LocalizationError
from finssim.localization.locate.localize_output import Row
from finssim.localization.locate.series import Series, series

__all__ = ["Truth", "load_truth"]

Array = npt.NDArray[np.float64]

TIMES = ("t", "time", "time_s", "timestamp")


class Truth:
    """Positions by picture, or by time."""

    def __init__(self, by_image: dict[str, Array], by_time: Series | None) -> None:
        """x, y [m] and yaw (its cosine and sine, NaN where not known), pool frame, (4,) each."""
        self._by_image, self._by_time = by_image, by_time

    def of(self, image: str, exposure: float) -> Array | None:
        """x, y [m] and yaw [rad] (or NaN), (3,); None where they are not known."""
        found: Array | str | None = self._by_image.get(PurePath(image).name) if image else None
        if found is None and self._by_time is not None:
            found = self._by_time.at(exposure)
        if found is None or isinstance(found, str):
            return None
        return np.array([found[0], found[1], math.atan2(found[3], found[2])])

    def figures(self, rows: Sequence[Row], latency: float) -> dict[str, Any] | None:
        """RMSE and 95th percentile of the horizontal distance [m], RMSE of yaw [degrees]; None without any picture.

        Args:
            rows: What was measured.
            latency: Time stamp of a picture minus its exposure [s].
        """
        errors = []
        for frame, found in rows:
            true = self.of(frame.image, frame.time - latency)
            if found.ok and true is not None:
                errors.append([found.x - true[0], found.y - true[1], float(wrap_angle(found.yaw - true[2]))])
        if not errors:
            return None
        e = np.array(errors)
        far = np.hypot(e[:, 0], e[:, 1])
        figures = {
            "compared": len(errors),
            "rmse_m": float(np.sqrt(np.mean(far**2))),
            "p95_m": float(np.percentile(far, 95)),
            "mean_x_m": float(e[:, 0].mean()),
            "mean_y_m": float(e[:, 1].mean()),
        }
        turned = e[np.isfinite(e[:, 2]), 2]
        if len(turned):
            figures["rmse_yaw_deg"] = float(np.degrees(np.sqrt(np.mean(turned**2))))
        return figures


def load_truth(path: str | Path, longest_gap: float = 1.0) -> Truth:
    """Read a table with columns x, y [m], and image or t [s], and yaw [rad] or yaw_deg where it is known; pool frame.

    Raises:
        LocalizationError: Unreadable, without these columns, or with a cell that is no number; names file and line.
    """
    try:
        text = Path(path).read_text(encoding="utf-8-sig", errors="replace")
    except OSError as error:
        raise LocalizationError(f"{path}: cannot be read: {error.strerror or error}") from None
    rows = [[cell.strip() for cell in row] for row in csv.reader(text.splitlines()) if row]
    names = [name.lower() for name in rows[0]] if rows else []
    time = next((name for name in TIMES if name in names), None)
    if not {"x", "y"} <= set(names) or (time is None and "image" not in names):
        raise LocalizationError(
            f"{path}: columns {','.join(names)[:80]}, expected image or t, x, y and perhaps yaw"
        )
    by_image: dict[str, Array] = {}
    times, values = [], []
    for number, row in enumerate(rows[1:], start=2):
        cells = dict(zip(names, row, strict=False))
        value = _value(cells, f"{path}: line {number}")
        if cells.get("image"):
            by_image[PurePath(cells["image"]).name] = value
        if time and cells.get(time):
            times.append(_number(cells[time], time, f"{path}: line {number}"))
            values.append(value)
    by_time = (
        series("truth", np.array(times), np.array(values), longest_gap, where=str(path)) if times else None
    )
    return Truth(by_image, by_time)


def _value(cells: dict[str, str], where: str) -> Array:
    yaw = math.nan
    if cells.get("yaw"):
        yaw = _number(cells["yaw"], "yaw", where)
    elif cells.get("yaw_deg"):
        yaw = math.radians(_number(cells["yaw_deg"], "yaw_deg", where))
    x, y = (_number(cells.get(name, ""), name, where) for name in "xy")
    return np.array([x, y, math.cos(yaw), math.sin(yaw)])


def _number(cell: str, name: str, where: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise LocalizationError(
            f"{where}: {name} is '{cell[:40]}', expected a finite number: correct or remove it"
        )
    return value
