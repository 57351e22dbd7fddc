"""A lens calibration as a table, as JSON, as the record in a camera file, and as a folder to look at."""

from __future__ import annotations

import json
import math
import os
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich import box
from rich.table import Table

from finssim.calibration.fit import Estimate
from finssim.calibration.output.fit_output import interval_text, number_text
from finssim.calibration.vision.camera.camera_fit import CameraFit
from finssim.files import atomic_directory
from finssim.page import html_page, html_picture, html_table
from finssim.provenance import provenance

if TYPE_CHECKING:
    from rich.console import Console

__all__ = [
    "RECORD_FILE",
    "REPORT_FILE",
    "camera_json",
    "camera_record",
    "print_camera",
    "write_camera_report",
]

RECORD_FILE, REPORT_FILE = "fit.json", "report.html"

READING = (
    "The interval holds the true value in 19 of 20 such calibrations: it comes from how much the pictures disagree, "
    "each picture counting once. Coefficients of the distortion go together; judge the lens by the error over the "
    "picture and by the residual of views that it was not fitted to."
)


def camera_record(fit: CameraFit) -> dict[str, Any]:
    """What a camera file remembers: estimates, intervals, residuals and where they come from, as plain values."""
    return {
        "estimates": {
            name: {"estimate": _rounded(e.estimate), "ci95": [_rounded(x) for x in e.ci95], "unit": e.unit}
            for name, e in fit.estimates.items()
        },
        "rms_px": _rounded(fit.rms),
        "held_out_rms_px": _rounded(fit.held_out_rms),
        "views": len(fit.used),
        "left_out": {view.name: view.left_out for view in fit.views if view.left_out},
        "advice": list(fit.advice),
        "settings": fit.settings,
        "interrupted": fit.interrupted,
        "provenance": provenance(),
    }


def camera_json(fit: CameraFit, out: Path | None = None) -> dict[str, Any]:
    """What `--json` prints: the record, the lens, every view, the correlation of the errors and the coverage."""
    return {
        "kind": "camera",
        **camera_record(fit),
        "parameters": {name: estimate.as_json() for name, estimate in fit.estimates.items()},
        "per_view": [
            {
                "name": view.name,
                "rms_px": _rounded(view.rms),
                "tilt_deg": _rounded(math.degrees(view.tilt)),
                "corners": len(view.pixels),
                "left_out": view.left_out or None,
            }
            for view in fit.views
        ],
        "error95_px": {"where_seen": _rounded(fit.reach.inside), "anywhere": _rounded(fit.reach.anywhere)},
        "empty_edges": {side: _rounded(share) for side, share in fit.reach.edges.items()},
        "correlation": {
            "names": list(fit.correlation.names),
            "matrix": [[_rounded(x) for x in row] for row in fit.correlation.matrix],
        },
        "out": None if out is None else str(out),
    }


def print_camera(fit: CameraFit, console: Console) -> None:
    """Print estimates, residuals and advice; fits 100 columns."""
    table = Table(box=box.SIMPLE_HEAD)
    for heading in ("parameter", "estimate", "95 % interval", "unit", "note"):
        table.add_column(heading, justify="right" if heading == "estimate" else "left", overflow="fold")
    for estimate in fit.estimates.values():
        table.add_row(*_cells(estimate), style="" if estimate.identifiable else "yellow")
    console.print(
        f"{fit.settings['model']} lens from {len(fit.used)} of {len(fit.views)} views", highlight=False
    )
    console.print(table)
    for sentence in summary(fit):
        console.print(f"  {sentence}", highlight=False, markup=False)
    for view in fit.views:
        if view.left_out:
            console.print(f"- {view.name} left out: {view.left_out}", highlight=False, markup=False)
    for sentence in fit.advice:
        console.print(f"! {sentence}", highlight=False, markup=False, style="yellow")


def summary(fit: CameraFit) -> list[str]:
    """The figures that say how good the calibration is."""
    worst = max(fit.used, key=lambda view: view.rms)
    held_out = "too few views to hold any out"
    if math.isfinite(fit.held_out_rms):
        held_out = f"views held out: {fit.held_out_rms:.3f} px"
    found = [
        f"residual {fit.rms:.3f} px rms of a corner, worst view {worst.name} {worst.rms:.3f} px; {held_out}"
    ]
    if math.isfinite(fit.reach.anywhere):
        found.append(
            f"a pixel is known to {fit.reach.inside:.2f} px (95 %) where corners were seen, to "
            f"{fit.reach.anywhere:.2f} px anywhere in the picture"
        )
    return found


def write_camera_report(fit: CameraFit, folder: str | os.PathLike[str], *, command: str = "") -> None:
    """Write `report.html`, its pictures as PNG and `fit.json`.

    Raises:
        OutputError: The folder holds other files, or cannot be written.
    """
    from finssim.calibration.vision.camera.camera_figures import camera_pictures

    pictures = camera_pictures(fit)
    with atomic_directory(folder, replaces=RECORD_FILE) as temporary:
        for name, (_, data) in pictures.items():
            (temporary / name).write_bytes(data)
        (temporary / RECORD_FILE).write_text(json.dumps(camera_json(fit), indent=1), encoding="utf-8")
        (temporary / REPORT_FILE).write_text(_page(fit, pictures, command), encoding="utf-8")


def _page(fit: CameraFit, pictures: dict[str, tuple[str, bytes]], command: str) -> str:
    rows = [_row(_cells(e), "" if e.identifiable else "doubt") for e in fit.estimates.values()]
    views = [
        _row(
            (v.name, f"{v.rms:.3f}", f"{math.degrees(v.tilt):.0f}", str(len(v.pixels)), v.left_out or "used"),
            "doubt" if v.left_out else "",
        )
        for v in fit.views
    ]
    said = "".join(f'<li class="warning">{escape(sentence)}</li>' for sentence in fit.advice)
    sections = [
        f'<p class="lead">{escape(" · ".join(summary(fit)))}</p>',
        html_table(("parameter", "estimate", "95 % interval", "unit", "note"), rows),
        f'<p class="note">{escape(READING)}</p>',
        f"<h2>What to photograph next</h2><ul>{said}</ul>" if said else "",
        *(f"<h2>{escape(text)}</h2>{html_picture(data, text)}" for text, data in pictures.values()),
        "<h2>Views</h2>",
        html_table(("view", "rms [px]", "tilt [deg]", "corners", "state"), views),
        f"<pre>{escape(command)}</pre>" if command else "",
    ]
    return html_page("Camera calibration", [section for section in sections if section])


def _row(cells: tuple[str, ...], kind: str) -> str:
    inner = "".join(f"<td>{escape(cell)}</td>" for cell in cells)
    return f'<tr class="{kind}">{inner}</tr>' if kind else f"<tr>{inner}</tr>"


def _cells(estimate: Estimate) -> tuple[str, ...]:
    return (
        estimate.name,
        f"{estimate.estimate:.2f}" if estimate.unit == "px" else number_text(estimate.estimate),
        interval_text(estimate),
        estimate.unit,
        estimate.note,
    )


def _rounded(x: float) -> float | None:
    return float(f"{x:.7g}") if math.isfinite(x) else None
