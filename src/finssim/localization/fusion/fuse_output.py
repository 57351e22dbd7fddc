"""The table that the fusion writes, and its summary."""

from __future__ import annotations

import csv
import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from finssim.files import atomic_write
from finssim.geometry.rotations import wrap_angle
from finssim.localization.fusion.fuse_table import StreamTable
from finssim.localization.fusion.health import MODES, Estimate, Health

__all__ = ["COLUMNS", "error_figures", "row_of", "summary_lines", "summary_of", "write_rows"]

Array = npt.NDArray[np.float64]

AXES = ("x", "y", "z", "vx", "vy", "vz")
COLUMNS = (
    *("t", *AXES, "roll", "pitch", "yaw", "r"),
    *(f"std_{name}" for name in (*AXES, "yaw")),
    *("state", "ready", "n_vision", "n_yaw", "n_depth", "n_imu", "n_refused"),
)
"""Metres, m/s, rad, rad/s; pool frame. `n_` count the samples taken in so far."""

USED = ("accepted", "initialized", "reacquired")
GAP = 0.25
"""Truth is not interpolated over longer gaps [s]."""


def row_of(estimate: Estimate, health: Health) -> list[Any]:
    """One row of the table, in the order of `COLUMNS`."""
    numbers = [
        estimate.time,
        *estimate.x,
        estimate.roll,
        estimate.pitch,
        estimate.yaw,
        estimate.yaw_rate,
        *estimate.std(),
    ]
    used = {stream: sum(v.get(word, 0) for word in USED) for stream, v in health.counts.items()}
    counts = [used.get(stream, 0) for stream in ("vision", "yaw", "depth", "imu")]
    refused = sum(
        n for verdicts in health.counts.values() for word, n in verdicts.items() if word not in USED
    )
    return [*map(float, numbers), health.vision_mode, int(health.ready), *counts, refused]


def write_rows(rows: Sequence[Sequence[Any]], out: Path) -> None:
    """Write the table; what is not known is an empty cell.

    Raises:
        OutputError: It cannot be written.
    """
    with atomic_write(out) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for row in rows:
            writer.writerow([_cell(value) for value in row])


def _cell(value: Any) -> Any:
    if isinstance(value, float):
        return "" if math.isnan(value) else f"{value:.9g}" if abs(value) < 1e6 else repr(value)
    return value


def summary_of(
    rows: Sequence[Sequence[Any]],
    health: Health,
    nis: dict[str, tuple[float, int]],
    truth: StreamTable | None,
) -> dict[str, Any]:
    """What can be said of a run, as plain values.

    Args:
        rows: Of the table.
        health: At the end.
        nis: Stream -> sum of squared Mahalanobis distances and of their dimensions.
        truth: Where the vehicle really was, if known.
    """
    modes = Counter(row[COLUMNS.index("state")] for row in rows)
    counts = health.counts
    return {
        "rows": len(rows),
        "states": {mode: modes[mode] / max(len(rows), 1) for mode in MODES},
        "ready": float(np.mean([row[COLUMNS.index("ready")] for row in rows])) if rows else 0.0,
        "accepted": {s: sum(v.get(word, 0) for word in USED) for s, v in counts.items() if s != "clock"},
        "reacquired": {s: v["reacquired"] for s, v in counts.items() if v.get("reacquired")},
        "refused": {
            s: {word: n for word, n in v.items() if word not in USED}
            for s, v in counts.items()
            if set(v) - set(USED)
        },
        "nis_per_dimension": {s: total / n for s, (total, n) in nis.items() if n},
        "health": health.as_json(),
        **({} if truth is None else {"errors": error_figures(rows, truth)}),
    }


def error_figures(rows: Sequence[Sequence[Any]], truth: StreamTable) -> dict[str, Any]:
    """Differences from the truth, by vision state: root mean square and 95th percentile.

    Returns:
        State (and `all`) -> samples, rms_x, rms_y, rms_z, p95_horizontal [m], rms_yaw [rad], for what the truth has.
    """
    values = np.array([[float(cell) for cell in row[:9]] for row in rows])
    t, states = values[:, 0], np.array([row[COLUMNS.index("state")] for row in rows])
    order = np.argsort(truth.t, kind="stable")
    at = truth.t[order]
    k = np.clip(np.searchsorted(at, t), 1, max(len(at) - 1, 1))
    covered = (t >= at[0]) & (t <= at[-1]) & (at[np.minimum(k, len(at) - 1)] - at[k - 1] <= GAP)
    errors = {}
    for name, column in (("x", 1), ("y", 2), ("z", 3), ("yaw", 9)):
        if truth.has(name):
            known = truth.numbers[name][order]
            known = np.interp(t, at, np.unwrap(known) if name == "yaw" else known)
            ours = np.array([float(row[column]) for row in rows])
            e = wrap_angle(ours - known) if name == "yaw" else ours - known
            errors[name] = np.where(covered, e, np.nan)
    figures = {}
    for state in ("all", *MODES[1:]):
        chosen = covered if state == "all" else covered & (states == state)
        if chosen.any():
            figures[state] = {"samples": int(chosen.sum()), **_figures(errors, chosen)}
    return figures


def _figures(errors: dict[str, Array], chosen: npt.NDArray[np.bool_]) -> dict[str, float]:
    found = {}
    for name, e in errors.items():
        known = e[chosen & np.isfinite(e)]
        if len(known):
            found[f"rms_{name}"] = float(np.sqrt(np.mean(known**2)))
    if "x" in errors and "y" in errors:
        far = np.hypot(errors["x"], errors["y"])[chosen]
        far = far[np.isfinite(far)]
        if len(far):
            found["p95_horizontal"] = float(np.percentile(far, 95))
    return found


def summary_lines(summary: dict[str, Any]) -> list[str]:
    """The summary for a person."""
    shares = ", ".join(f"{mode} {share:.1%}" for mode, share in summary["states"].items() if share)
    lines = [f"{summary['rows']} rows: {shares}; ready {summary['ready']:.1%}"]
    for stream, taken in summary["accepted"].items():
        refused = summary["refused"].get(stream, {})
        words = ", ".join(f"{word} {n}" for word, n in sorted(refused.items())) or "none"
        nis = summary["nis_per_dimension"].get(stream)
        lines.append(
            f"{stream:7s} taken in {taken}, refused: {words}"
            + ("" if nis is None else f"; NIS per dimension {nis:.2f} (1 expected)")
        )
    if summary["refused"].get("clock"):
        lines.append(f"the clock started anew {summary['refused']['clock'].get('restart', 0)} times")
    health = summary["health"]
    ages = ", ".join(f"{s} {_age(health[f'age_{s}'])}" for s in ("vision", "depth", "imu"))
    lines.append(f"ages at the end: {ages}")
    for state, figures in summary.get("errors", {}).items():
        words = ", ".join(
            f"{name} {math.degrees(v):.2f}°" if "yaw" in name else f"{name} {100 * v:.2f} cm"
            for name, v in figures.items()
            if name != "samples"
        )
        lines.append(f"against the truth, {state} ({figures['samples']} rows): {words}")
    return lines


def _age(age: float | None) -> str:
    return "never" if age is None else f"{age:.2f} s"
