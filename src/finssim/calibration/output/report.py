"""A calibration's report: one HTML page that loads nothing, the same as Markdown with pictures, and `fit.json`."""

from __future__ import annotations

import io
import json
import math
import os
import shlex
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from finssim.calibration.errors import CalibrationError
from finssim.calibration.findings import Finding, sentences
from finssim.calibration.fit import Correlation, Curve, Estimate, Fit
from finssim.calibration.output.calibrate import kept, number_in
from finssim.files import atomic_directory, atomic_write, refuse_unwritable
from finssim.page import RECORD_FILE, Page
from finssim.provenance import provenance
from finssim.vehicles import Vehicle

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from matplotlib.gridspec import SubplotSpec
    from rich.console import Console

__all__ = [
    "BLUE", "GRAY", "ORANGE", "command_line", "draw_correlation", "fit_json", "interval_text",
    "new_figure", "number_text", "png", "print_fit", "progress_bar", "publish", "refuse_places",
    "state_text", "write_report",
]  # fmt: skip


def refuse_places(out: Path, report: Path | None, kind: str) -> None:
    """Refuse a file that is no YAML, or a place that cannot be written, before anything is computed."""
    if Path(out).suffix not in (".yaml", ".yml"):
        raise CalibrationError(
            f"{out} ends in '{Path(out).suffix}', expected .yaml: name a {kind} file to write"
        )
    refuse_unwritable(atomic_write(out))
    if report is not None:
        refuse_unwritable(atomic_directory(report, replaces=RECORD_FILE))


def publish(
    record: Mapping[str, Any] | None, show: Callable[[Console], None], written: Iterable[Path | None]
) -> None:
    """Print one JSON object for programs; or, without one, for people, and which files were written."""
    if record is not None:
        print(json.dumps(record, allow_nan=False))
        return
    console = Console() if sys.stdout.isatty() else Console(width=100)
    show(console)
    for path in filter(None, written):
        console.print(f"written: {path}", highlight=False, markup=False, soft_wrap=True)


def command_line(kind: str, inputs: Iterable[Path], options: Mapping[str, Any]) -> str:
    """The command line that does this again; options that are None, False or empty are left out."""
    words = ["finssim", "calibrate", kind, *map(str, inputs)]
    for name, value in options.items():
        option = f"--{name.replace('_', '-')}"
        for item in value if isinstance(value, (list, tuple)) else [value]:
            if item is True:
                words.append(option)
            elif item is not None and item is not False:
                words += [option, str(item)]
    return shlex.join(words)


@contextmanager
def progress_bar() -> Iterator[Callable[..., None]]:
    """A bar on standard error, fed with the part done and a few words."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    screen = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=screen, transient=True, disable=not screen.is_terminal) as bars:
        bar = bars.add_task("fit", total=1.0)
        yield lambda part, words="fit": bars.update(bar, completed=part, description=words)


BLUE, ORANGE, GRAY = "#0072B2", "#D55E00", "0.6"
PER_FIGURE = 6
MOST_CURVES = 48
"""More are not drawn; the report says so."""
WIDE = 1.0
"""Half width of the axis of relative intervals."""


def fit_pictures(fit: Fit) -> dict[str, tuple[str, bytes]]:
    """File name -> what the picture shows, and the PNG; equal fits give equal pictures."""
    found: dict[str, tuple[str, Figure]] = {}
    estimates = draw_estimates(list(fit.estimates.values()))
    if estimates is not None:
        found["estimates.png"] = ("95 % intervals relative to the estimates", estimates)
    if fit.correlation is not None and len(fit.correlation.names) > 1:
        found["correlation.png"] = ("Correlation of the errors", draw_correlation(fit.correlation))
    for i, figure in enumerate(draw_curves(fit.curves), start=1):
        found[f"curves_{i}.png"] = ("Measured and fitted, and the residual", figure)
    return {name: (text, png(figure)) for name, (text, figure) in found.items()}


def draw_estimates(estimates: Sequence[Estimate]) -> Figure | None:
    """95 % intervals relative to their estimates, one row each; None where no interval is finite.

    Biases, which should be nothing, have no place in it.
    """
    shown = [
        e
        for e in estimates
        if e.estimate != 0.0
        and not e.name.endswith("bias")
        and all(map(math.isfinite, (e.estimate, *e.ci95)))
    ]
    if not shown:
        return None
    figure = new_figure(7.2, 0.9 + 0.27 * len(shown))
    axes = figure.subplots()
    rows = np.arange(len(shown))[::-1]
    for row, estimate in zip(rows, shown, strict=True):
        low, high = sorted(x / estimate.estimate - 1.0 for x in estimate.ci95)
        color = BLUE if estimate.identifiable else ORANGE
        axes.plot(np.clip([low, high], -WIDE, WIDE), [row, row], color=color, linewidth=3, alpha=0.6)
        axes.plot([0.0], [row], "o" if estimate.identifiable else "x", color=color, markersize=5)
        for end, mark in ((low, "<"), (high, ">")):
            if abs(end) > WIDE:
                axes.plot([math.copysign(WIDE, end)], [row], mark, color=color, markersize=6)
    axes.set_yticks(rows, [f"{e.name}  {e.estimate:.4g} {e.unit}" for e in shown], fontsize=8)
    axes.set_ylim(-0.8, len(shown) - 0.2)
    axes.axvline(0.0, color=GRAY, linewidth=0.8)
    reach = max(abs(x / e.estimate - 1.0) for e in shown for x in e.ci95)
    axes.set_xlim(-1.05 * min(reach, WIDE), 1.05 * min(reach, WIDE))
    axes.xaxis.set_major_formatter(lambda x, _: f"{100 * x:+.3g} %" if x else "0")
    axes.set_xlabel("95 % interval relative to the estimate; crosses: not identified")
    axes.grid(True, axis="x", color="0.9", linewidth=0.6)
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.tick_params(axis="y", length=0)
    return figure


def draw_correlation(correlation: Correlation) -> Figure:
    """The matrix, blue where errors go together, orange where they go against each other."""
    n = len(correlation.names)
    figure = new_figure(max(3.6, 1.9 + 0.36 * n), max(3.0, 1.3 + 0.36 * n))
    axes = figure.subplots()
    image = axes.imshow(correlation.matrix, vmin=-1.0, vmax=1.0, cmap="RdBu")
    axes.set_xticks(range(n), correlation.names, rotation=60, ha="right", fontsize=8)
    axes.set_yticks(range(n), correlation.names, fontsize=8)
    for i in range(n):
        for j in range(n):
            value = correlation.matrix[i, j]
            if i != j and abs(value) >= 0.3:
                color = "white" if abs(value) > 0.7 else "0.2"
                axes.text(j, i, f"{value:.1f}", ha="center", va="center", fontsize=7, color=color)
    axes.spines[:].set_visible(False)
    figure.colorbar(image, ax=axes, shrink=0.8, label="correlation of the errors")
    return figure


def draw_curves(curves: Sequence[Curve]) -> Iterator[Figure]:
    """Figures of up to six curves each: measured and fitted, and below them what is left over."""
    drawn = list(curves)[:MOST_CURVES]
    for start in range(0, len(drawn), PER_FIGURE):
        part = drawn[start : start + PER_FIGURE]
        columns = min(2, len(part))
        rows = math.ceil(len(part) / columns)
        width, height = (3.9 * columns if columns > 1 else 5.4), 2.9 * rows
        # A fixed layout: finding the best one takes longer than drawing.
        figure = new_figure(width, height, constrained=False)
        grid = figure.add_gridspec(
            rows,
            columns,
            left=0.75 / width,
            right=1.0 - 0.12 / width,
            bottom=0.5 / height,
            top=1.0 - 0.3 / height,
            hspace=0.35,
            wspace=0.27,
        )
        for i, curve in enumerate(part):
            _draw(figure, grid[i // columns, i % columns], curve)
        yield figure


def png(figure: Figure) -> bytes:
    """The same bytes for the same figure."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=120, metadata={"Software": None})
    return buffer.getvalue()


def _draw(figure: Figure, cell: SubplotSpec, curve: Curve) -> None:
    inner = cell.subgridspec(2, 1, height_ratios=(3, 1), hspace=0.12)
    above = figure.add_subplot(inner[0])
    below = figure.add_subplot(inner[1], sharex=above)
    above.tick_params(labelbottom=False)
    order = np.argsort(curve.x, kind="stable") if curve.kind == "scatter" else slice(None)
    x, measured, fitted = curve.x[order], curve.measured[order], curve.fitted[order]
    if curve.kind == "scatter":
        above.plot(x, measured, ".", color=GRAY, markersize=2.5, label="measured", rasterized=True)
        below.plot(x, measured - fitted, ".", color=BLUE, markersize=2.0, rasterized=True)
    else:
        above.plot(x, measured, color=GRAY, linewidth=1.6, label="measured")
        below.plot(x, measured - fitted, color=BLUE, linewidth=0.8)
    above.plot(x, fitted, color=ORANGE, linewidth=1.2, label="fitted")
    below.axhline(0.0, color=GRAY, linewidth=0.6)
    above.set_title(curve.title, fontsize=9)
    above.set_ylabel(curve.y_label, fontsize=8)
    below.set_ylabel("residual", fontsize=8)
    below.set_xlabel(curve.x_label, fontsize=8)
    above.legend(fontsize=7, frameon=False)
    for axes in (above, below):
        axes.tick_params(labelsize=7)
        axes.grid(True, color="0.92", linewidth=0.5)
        axes.spines[["top", "right"]].set_visible(False)


def new_figure(width: float, height: float, constrained: bool = True) -> Figure:
    """An empty figure.

    Args:
        width: [inch]
        height: [inch]
        constrained: Whether the layout makes room for labels.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained" if constrained else None)
    FigureCanvasAgg(figure)
    return figure


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
