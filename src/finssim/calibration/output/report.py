"""A calibration's report: one HTML page that loads nothing, the same as Markdown with pictures, and `fit.json`."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path

from finssim.calibration.findings import Finding, sentences
from finssim.calibration.fit import Fit
from finssim.calibration.output.calibrate import kept
from finssim.calibration.output.fit_figures import MOST_CURVES, fit_pictures
from finssim.calibration.output.fit_output import HEADS, estimate_rows, fit_json, number_text, quality_text
from finssim.page import Page
from finssim.vehicles import Vehicle

__all__ = ["write_report"]

READING = (
    "The interval holds the true value in 19 of 20 such calibrations, if the model's form is right: it knows of noise "
    "and of how much trials differ, not of a wrong model. `unsure`: written, though told together with another number "
    "and not alone. `file kept`: the trials do not determine it, and the vehicle file keeps its own. Score the result "
    "on trials that the fit has not seen with `finssim replay` before relying on it."
)


def write_report(
    fit: Fit,
    folder: str | os.PathLike[str],
    vehicle: Vehicle,
    *,
    command: str = "",
    findings: Sequence[Finding] = (),
    out: Path | None = None,
) -> None:
    """Write `report.html`, `report.md`, its PNG pictures and `fit.json`.

    Args:
        fit: The fit.
        folder: Directory to make; an earlier report there is replaced.
        vehicle: `calibrated(fit)`.
        command: The command line that makes the fit again.
        findings: The fit's and those about the calibrated vehicle.
        out: File that the vehicle was written to.

    Raises:
        OutputError: The directory holds other files, or cannot be written.
    """
    record, pictures = vehicle.calibrations[-1], fit_pictures(fit)
    page = Page(f"Calibration of {fit.vehicle.name}: {record.sentence()}")
    told = sum(e.identifiable for e in fit.estimates.values())
    interrupted = " The fit was interrupted before it converged." if fit.interrupted else ""
    page.lead(f"{told} of {len(fit.estimates)} parameters are determined by the data.{interrupted}")
    kinds = ["" if e.identifiable else "doubt" for e in fit.estimates.values()]
    page.table(HEADS, estimate_rows(fit, vehicle), kinds)
    notes: dict[str, list[str]] = {}
    for name, estimate in fit.estimates.items():
        notes.setdefault(estimate.note, []).append(name)
    for note, names in notes.items():
        page.note(f"{', '.join(names)}: {note}" if note else "")
    unchanged = ", ".join(f"{name} {number_text(value)}" for name, value in kept(fit, vehicle).items())
    page.note(f"The vehicle file keeps: {unchanged}." if unchanged else "")
    page.note(READING)
    page.items("Findings", sentences(findings))
    if fit.quality:
        page.heading("Quality")
        page.table(("", ""), [(what, quality_text(f)) for what, f in fit.quality.items()], last="words")
    page.pictures(pictures)
    undrawn = len(fit.curves) - MOST_CURVES
    page.note(f"{undrawn} more curves are not drawn." if undrawn > 0 else "")
    page.heading("Trials")
    page.table(("name", "SHA-256 of its numbers"), list(fit.trials.items()), last="code")
    repeat = [
        *([command] if command else []),
        f"FinsSim {record.finssim}, revision {record.revision or 'not from a checkout'}",
        f"settings: {json.dumps(record.settings)}",
        f"vehicle before: {fit.vehicle.name}, sha256 {fit.vehicle.sha256}",
        f"vehicle after: sha256 {vehicle.sha256}",
    ]
    page.code("How to repeat and cite it", repeat)
    page.write(folder, fit_json(fit, vehicle, out=out, findings=findings), pictures)
