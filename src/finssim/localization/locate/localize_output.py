"""The table that `finssim localize` writes, and its summary."""

from __future__ import annotations

import csv
import math
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from finssim.files import atomic_write
from finssim.localization.detection.detections import Frame
from finssim.localization.poses.measurement import Measurement

__all__ = ["COLUMNS", "Row", "summary_lines", "summary_of", "write_rows"]

Row = tuple[Frame, Measurement]

COLUMNS = (
    *("time", "image", "x", "y", "z", "yaw", "std_x", "std_y", "std_yaw", "roll", "pitch"),
    *("qx", "qy", "qz", "qw", "cov_xy", "cov_xyaw", "cov_yyaw", "residual_px", "tags", "corners", "medium"),
    *("status", "reason"),
)
"""Metres and radians, pool frame; z of the body origin; q turns body vectors into the pool's. `time` is the stamp of
the picture. A refused picture has empty numbers, status `refused` and a reason."""


def write_rows(rows: Sequence[Row], out: Path) -> None:
    """Write one row for each picture.

    Raises:
        OutputError: The file cannot be written.
    """
    with atomic_write(out) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for frame, found in rows:
            writer.writerow(_cells(frame, found))


def _cells(frame: Frame, found: Measurement) -> list[Any]:
    time = "" if math.isnan(frame.time) else repr(float(frame.time))
    tags = " ".join(map(str, found.tags))
    if not found.ok:
        return [time, frame.image, *[""] * (len(COLUMNS) - 7), tags, "", "", "refused", found.reason]
    C = found.covariance
    numbers = [found.x, found.y, found.z, found.yaw, *found.std, found.roll, found.pitch, *found.quaternion]
    numbers += [C[0, 1], C[0, 2], C[1, 2], found.residual_px]
    words = [f"{float(x):.9g}" for x in numbers]
    return [time, frame.image, *words, tags, found.corners, found.medium, "ok", ""]


def summary_of(rows: Sequence[Row]) -> dict[str, Any]:
    """Figures of a run, as plain values."""
    located = [found for _, found in rows if found.ok]
    reasons = Counter(_short(found.reason) for _, found in rows if not found.ok)
    rejected: Counter[str] = Counter()
    for _, found in rows:
        rejected.update(found.rejected)
    return {
        "frames": len(rows),
        "located": len(located),
        "refused": dict(reasons.most_common()),
        "corners_rejected": dict(rejected.most_common()),
        "median_residual_px": _median([found.residual_px for found in located]),
        "median_std_m": _median([float(np.hypot(*found.std[:2])) for found in located]),
        "median_std_yaw_deg": _median([math.degrees(found.std[2]) for found in located]),
    }


def summary_lines(summary: dict[str, Any]) -> list[str]:
    """The summary for a person."""
    lines = [f"{summary['located']} of {summary['frames']} pictures located with method {summary['method']}"]
    lines += [f"refused {n:5d}: {reason}" for reason, n in summary["refused"].items()]
    if summary["corners_rejected"]:
        words = ", ".join(f"{n} {reason}" for reason, n in summary["corners_rejected"].items())
        lines.append(f"corners not used: {words}")
    if summary["located"]:
        lines.append(
            f"median residual {summary['median_residual_px']:.2f} px; standard deviations "
            f"{100 * summary['median_std_m']:.2f} cm, {summary['median_std_yaw_deg']:.2f} degrees (median)"
        )
    truth = summary.get("truth")
    if truth:
        words = f"against the truth, {truth['compared']} pictures: RMSE {100 * truth['rmse_m']:.2f} cm, "
        words += f"P95 {100 * truth['p95_m']:.2f} cm"
        if "rmse_yaw_deg" in truth:
            words += f"; yaw RMSE {truth['rmse_yaw_deg']:.2f} degrees"
        lines.append(words)
    return lines


def _short(reason: str) -> str:
    """A reason without its particulars, for counting."""
    return re.split(r"[:(]", reason, maxsplit=1)[0].strip()


def _median(values: list[float]) -> float | None:
    return float(np.median(values)) if values else None
