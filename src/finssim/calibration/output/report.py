"""A calibration's report: one HTML page that loads nothing, the same as Markdown with pictures, and `fit.json`."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from html import escape
from pathlib import Path

from finssim.calibration.findings import Finding, sentences
from finssim.calibration.fit import Fit
from finssim.calibration.output.calibrate import kept
from finssim.calibration.output.fit_figures import MOST_CURVES, fit_pictures
from finssim.calibration.output.fit_output import (
    file_number,
    fit_json,
    interval_text,
    number_text,
    quality_text,
    state_text,
)
from finssim.files import atomic_directory
from finssim.page import html_page, html_picture, html_table
from finssim.vehicles import Vehicle

__all__ = ["FIT_FILE", "REPORT_FILE", "estimate_rows", "write_report"]

REPORT_FILE, MARKDOWN_FILE, FIT_FILE = "report.html", "report.md", "fit.json"
HEADS = ("parameter", "estimate", "95 % interval", "unit", "file had", "state")

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
    with atomic_directory(folder, replaces=FIT_FILE) as temporary:
        pictures = fit_pictures(fit)
        for name, (_, data) in pictures.items():
            (temporary / name).write_bytes(data)
        text = json.dumps(fit_json(fit, vehicle, out=out, findings=findings), indent=2, allow_nan=False)
        (temporary / FIT_FILE).write_text(text + "\n", encoding="utf-8")
        body = _Body(fit, vehicle, command, findings, pictures)
        (temporary / REPORT_FILE).write_text(body.html(), encoding="utf-8")
        (temporary / MARKDOWN_FILE).write_text(body.markdown(), encoding="utf-8")


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


class _Body:
    """The report's parts, as HTML and as Markdown."""

    def __init__(
        self,
        fit: Fit,
        vehicle: Vehicle,
        command: str,
        findings: Sequence[Finding],
        pictures: dict[str, tuple[str, bytes]],
    ) -> None:
        self.fit, self.vehicle, self.command = fit, vehicle, command
        self.sentences, self.pictures = sentences(findings), pictures
        record = vehicle.calibrations[-1]
        self.title = f"Calibration of {fit.vehicle.name}: {record.sentence()}"
        told = sum(e.identifiable for e in fit.estimates.values())
        self.lead = f"{told} of {len(fit.estimates)} parameters are determined by the data."
        if fit.interrupted:
            self.lead += " The fit was interrupted before it converged."
        self.notes: dict[str, list[str]] = {}
        for name, estimate in fit.estimates.items():
            if estimate.note:
                self.notes.setdefault(estimate.note, []).append(name)
        left = len(fit.curves) - MOST_CURVES
        self.undrawn = f"{left} more curves are not drawn." if left > 0 else ""
        self.kept = ", ".join(f"{name} {number_text(value)}" for name, value in kept(fit, vehicle).items())
        revision = record.revision or "not from a checkout"
        self.repeat = [
            *([command] if command else []),
            f"FinsSim {record.finssim}, revision {revision}",
            f"settings: {json.dumps(record.settings)}",
            f"vehicle before: {fit.vehicle.name}, sha256 {fit.vehicle.sha256}",
            f"vehicle after: sha256 {vehicle.sha256}",
        ]

    def html(self) -> str:
        doubts = {n for n, e in self.fit.estimates.items() if not e.identifiable}
        rows = [
            _row(row, "doubt" if row[0] in doubts else "") for row in estimate_rows(self.fit, self.vehicle)
        ]
        parts = [
            f"<h1>{escape(self.title)}</h1>",
            f'<p class="lead">{escape(self.lead)}</p>',
            html_table(HEADS, rows),
            *(
                f'<p class="note">{escape(", ".join(n))}: {escape(note)}</p>'
                for note, n in self.notes.items()
            ),
        ]
        if self.kept:
            parts.append(f'<p class="note">The vehicle file keeps: {escape(self.kept)}.</p>')
        parts.append(f'<p class="note">{escape(READING.replace("`", ""))}</p>')
        if self.sentences:
            items = "".join(f'<li class="warning">{escape(s)}</li>' for s in self.sentences)
            parts += ["<h2>Findings</h2>", f"<ul>{items}</ul>"]
        if self.fit.quality:
            quality = [
                f'<tr><td>{escape(what)}</td><td class="words">{escape(quality_text(figures))}</td></tr>'
                for what, figures in self.fit.quality.items()
            ]
            parts += ["<h2>Quality</h2>", html_table(("", ""), quality)]
        shown = ""
        for text, data in self.pictures.values():
            if text != shown:
                parts.append(f"<h2>{escape(text)}</h2>")
            parts.append(html_picture(data, text))
            shown = text
        if self.undrawn:
            parts.append(f'<p class="note">{escape(self.undrawn)}</p>')
        trials = [
            f'<tr><td>{escape(name)}</td><td class="code">{digest}</td></tr>'
            for name, digest in self.fit.trials.items()
        ]
        parts += ["<h2>Trials</h2>", html_table(("name", "SHA-256 of its numbers"), trials)]
        parts += ["<h2>How to repeat and cite it</h2>", f"<pre>{escape(chr(10).join(self.repeat))}</pre>"]
        return html_page(self.title, parts)

    def markdown(self) -> str:
        lines = [
            f"# {self.title}",
            "",
            self.lead,
            "",
            *_md_table(HEADS, estimate_rows(self.fit, self.vehicle)),
        ]
        lines += [line for note, n in self.notes.items() for line in ("", f"{', '.join(n)}: {note}")]
        if self.kept:
            lines += ["", f"The vehicle file keeps: {self.kept}."]
        lines += ["", READING]
        if self.sentences:
            lines += ["", "## Findings", "", *(f"- {sentence}" for sentence in self.sentences)]
        if self.fit.quality:
            lines += ["", "## Quality", ""]
            lines += [f"- {what}: {quality_text(figures)}" for what, figures in self.fit.quality.items()]
        lines += ["", "## Pictures", ""]
        lines += [f"![{text}]({name})" for name, (text, _) in self.pictures.items()]
        lines += ["", self.undrawn] if self.undrawn else []
        lines += ["", "## Trials", "", *_md_table(("name", "SHA-256"), list(self.fit.trials.items()))]
        lines += ["", "## How to repeat and cite it", "", "```text", *self.repeat, "```"]
        return "\n".join(lines) + "\n"


def _row(cells: Sequence[str], kind: str) -> str:
    return f'<tr class="{kind}">' + "".join(f"<td>{escape(cell)}</td>" for cell in cells) + "</tr>"


def _md_table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    def line(cells: Sequence[str]) -> str:
        return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"

    return [line(heads), line(["---"] * len(heads)), *(line(row) for row in rows)]
