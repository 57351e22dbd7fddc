"""A fit as a table for people and as one JSON object for programs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich import box
from rich.markup import escape
from rich.table import Table

from finssim.calibration.findings import Finding, sentences
from finssim.calibration.fit import Estimate, Fit
from finssim.calibration.output.calibrate import kept, number_in
from finssim.provenance import provenance
from finssim.vehicles import Vehicle

if TYPE_CHECKING:
    from rich.console import Console

__all__ = [
    "HEADS",
    "estimate_rows",
    "file_number",
    "fit_json",
    "interval_text",
    "number_text",
    "print_fit",
    "quality_text",
    "state_text",
]

HEADS = ("parameter", "estimate", "95 % interval", "unit", "file had", "state")

QUALITY = {
    "r2": "R²",
    "nrmse": "NRMSE",
    "rmse": "RMSE",
    "rmse_held_out": "held out",
    "trials": "trials",
    "samples": "samples",
    "rejected": "rejected",
    "speed_low": "speeds from",
    "speed_high": "to",
}
"""Figures of a fit that the table on the terminal shows, in this order; the report has all."""


def fit_json(
    fit: Fit, vehicle: Vehicle, *, out: Path | None = None, findings: Sequence[Finding] = ()
) -> dict[str, Any]:
    """What `--json` prints and the report's `fit.json` holds; numbers that are not finite are None.

    Args:
        fit: The fit.
        vehicle: `calibrated(fit)`.
        out: File it was written to.
        findings: The fit's and those about the calibrated vehicle.
    """
    return {
        "kind": fit.kind,
        "method": fit.method,
        "vehicle": {"name": fit.vehicle.name, "sha256": fit.vehicle.sha256},
        "parameters": {name: estimate.as_json() for name, estimate in fit.estimates.items()},
        "kept": kept(fit, vehicle),
        "quality": {
            what: {key: _finite(value) for key, value in figures.items()}
            for what, figures in fit.quality.items()
        },
        "correlation": None
        if fit.correlation is None
        else {
            "names": list(fit.correlation.names),
            "matrix": [[_finite(x) for x in row] for row in fit.correlation.matrix],
        },
        "findings": [one.as_json() for one in findings],
        "trials": dict(fit.trials),
        "settings": vehicle.calibrations[-1].settings,
        "interrupted": fit.interrupted,
        "out": None if out is None else str(out),
        "calibrated": {"sha256": vehicle.sha256},
        "provenance": provenance(),
    }


def print_fit(fit: Fit, vehicle: Vehicle, console: Console, findings: Sequence[Finding] = ()) -> None:
    """Print estimates, figures of the fit and findings; fits 100 columns.

    Args:
        fit: The fit.
        vehicle: `calibrated(fit)`.
        console: Where to print.
        findings: The fit's and those about the calibrated vehicle.
    """
    console.print(f"{fit.vehicle.name}: {vehicle.calibrations[-1].sentence()}", highlight=False, markup=False)
    table = Table(box=box.SIMPLE_HEAD)
    for heading in HEADS:
        right = heading in ("estimate", "file had")
        table.add_column(heading, justify="right" if right else "left", overflow="fold")
    notes: dict[str, list[str]] = {}
    for row, estimate in zip(estimate_rows(fit, vehicle), fit.estimates.values(), strict=True):
        table.add_row(*map(escape, row), style="" if estimate.identifiable else "yellow")
        if estimate.note:
            notes.setdefault(estimate.note, []).append(row[0])
    console.print(table)
    for what, figures in fit.quality.items():
        console.print(f"  {what}: {quality_text(figures, whole=False)}", highlight=False, markup=False)
    for note, names in notes.items():
        console.print(f"· {', '.join(names)}: {note}", highlight=False, markup=False)
    for sentence in sentences(findings):
        console.print(f"! {sentence}", highlight=False, markup=False, style="yellow")


def estimate_rows(fit: Fit, vehicle: Vehicle) -> list[tuple[str, ...]]:
    """Texts of the table of estimates, in the order of `HEADS`."""
    return [
        (
            name,
            number_text(e.estimate),
            interval_text(e),
            e.unit,
            number_text(file_number(e, fit.vehicle)),
            state_text(e, fit, vehicle),
        )
        for name, e in fit.estimates.items()
    ]


def number_text(value: float | None) -> str:
    """Four significant digits, small numbers as 3.71e-4; – where there is none."""
    if value is None or not math.isfinite(value):
        return "–"
    mantissa, _, exponent = f"{value:.3e}".partition("e")
    if value != 0.0 and not -4 < int(exponent) < 6:
        return f"{float(mantissa):g}e{int(exponent)}"
    return f"{value:.4g}" if abs(value) < 1e4 else f"{value:.0f}"


def interval_text(estimate: Estimate) -> str:
    """`37.9 to 40.2`; `unknown` where an end is not finite."""
    low, high = estimate.ci95
    if not (math.isfinite(low) and math.isfinite(high)):
        return "unknown"
    return f"{number_text(low)} to {number_text(high)}"


def file_number(estimate: Estimate, vehicle: Vehicle) -> float | None:
    """The vehicle's own number for an estimate; None where the file holds something else that follows from it."""
    if estimate.path is None or estimate.path.startswith("body."):
        return None
    return number_in(vehicle, estimate.path)


def state_text(estimate: Estimate, fit: Fit, vehicle: Vehicle) -> str:
    """What became of a parameter: `written`, `file kept`, or whether the data tell it where the file has no place.

    `unsure`: written, though the data tell it together with another, as a part of the drag, and not alone.
    """
    if estimate.name == "thrust_scale" and any(path.startswith("thrusters.") for path in fit.changes):
        return "written"
    if estimate.path is None:
        return "" if estimate.identifiable else "not told"
    before, after = number_in(fit.vehicle, estimate.path), number_in(vehicle, estimate.path)
    if after != before or (after is not None and estimate.identifiable and after == estimate.estimate):
        return "written" if estimate.identifiable else "unsure"
    return "file kept"


def quality_text(figures: Mapping[str, float], *, whole: bool = True) -> str:
    """`R² 0.998, NRMSE 0.021, samples 1204`.

    Args:
        figures: By key.
        whole: All of them, or those of `QUALITY` alone.
    """
    keys = [key for key in QUALITY if key in figures]
    keys += [key for key in figures if key not in QUALITY] if whole or not keys else []
    return ", ".join(f"{QUALITY.get(key, key.replace('_', ' '))} {number_text(figures[key])}" for key in keys)


def _finite(value: Any) -> float | None:
    return float(value) if math.isfinite(value) else None
