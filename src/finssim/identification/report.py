"""Report of a calibration: one self-contained HTML page, the same as Markdown with pictures, and `fit.json`."""

from __future__ import annotations

import io
import json
import math
import os
import shlex
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from finssim.core.files import atomic_directory, atomic_write, refuse_unwritable
from finssim.core.page import RECORD_FILE, Page, Pictures
from finssim.core.palette import BLUE, VERMILION
from finssim.core.provenance import provenance
from finssim.identification.fit import Correlation, Curve, Estimate, Fit
from finssim.identification.vehicle_file import (
    all_findings,
    calibrated,
    file_number,
    number_in,
    retained_values,
    write_ranges,
    write_vehicle,
    yaml_path,
)
from finssim.trials.findings import CalibrationError, Finding, finding, plain, sentences
from finssim.trials.trial import Trial
from finssim.trials.trial_files import load_trials
from finssim.vehicles import AXES, Vehicle

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.gridspec import SubplotSpec

    from finssim.core.optics import Lens

Array = NDArray[np.float64]


def refuse_places(out: Path, report: Path | None, kind: str) -> None:
    """Refuse an output that is not a YAML file, or a path that cannot be written, before anything is computed."""
    refuse_unwritable(atomic_write(yaml_path(out, kind)))
    if report is not None:
        refuse_unwritable(atomic_directory(report, replaces=RECORD_FILE))


def publish(
    record: Mapping[str, Any] | None, show: Callable[[Console], None], written: Iterable[Path | None]
) -> None:
    """Print one JSON object for programs; or, without one, tables for people and the names of the written files."""
    if record is not None:
        print(json.dumps(record, allow_nan=False))
        return
    console = Console() if sys.stdout.isatty() else Console(width=100)
    show(console)
    for path in filter(None, written):
        console.print(f"written: {path}", highlight=False, markup=False, soft_wrap=True)


def command_line(kind: str, inputs: Iterable[Path], options: Mapping[str, Any]) -> str:
    """Return the command line that repeats the calibration, without options that are None, False or empty."""
    tokens = ["finssim", "calibrate", kind, *map(str, inputs)]
    for name, value in options.items():
        option = f"--{name.replace('_', '-')}"
        for item in value if isinstance(value, (list, tuple)) else [value]:
            if item is True:
                tokens.append(option)
            elif item is not None and item is not False and item != "":
                tokens += [option, str(item)]
    return shlex.join(tokens)


GRAY = "0.6"
PER_FIGURE = 6
MAX_CURVES = 48
"""Largest number of drawn curves; the report states how many are omitted."""


def fit_pictures(fit: Fit) -> dict[str, tuple[str, bytes]]:
    """Return file name -> caption of the picture, and the PNG; equal fits result in equal pictures."""
    pictures: dict[str, tuple[str, Figure]] = {}
    for i, figure in enumerate(draw_curves(fit.curves), start=1):
        pictures[f"curves_{i}.png"] = ("Measured and simulated, and the residual", figure)
    if fit.correlation is not None and len(fit.correlation.names) > 1:
        pictures["correlation.png"] = ("Correlation of the errors", draw_correlation(fit.correlation))
    return {name: (text, png(figure)) for name, (text, figure) in pictures.items()}


def draw_correlation(correlation: Correlation) -> Figure:
    """Draw the matrix, blue for positive and orange for negative correlation."""
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
    """Yield figures of up to six curves each: measured and fitted values, with the residuals below."""
    drawn = list(curves)[:MAX_CURVES]
    for start in range(0, len(drawn), PER_FIGURE):
        part = drawn[start : start + PER_FIGURE]
        columns = min(2, len(part))
        rows = math.ceil(len(part) / columns)
        width, height = (3.9 * columns if columns > 1 else 5.4), 2.9 * rows
        # A fixed layout: optimising it takes longer than drawing.
        figure = new_figure(width, height, constrained=False)
        edges = {"left": 0.85 / width, "right": 1.0 - 0.12 / width, "bottom": 0.5 / height}
        edges |= {"top": 1.0 - 0.3 / height, "hspace": 0.35, "wspace": 0.3}
        grid = figure.add_gridspec(rows, columns, **edges)
        for i, curve in enumerate(part):
            _draw(figure, grid[i // columns, i % columns], curve)
        yield figure


def png(figure: Figure) -> bytes:
    """Return the bytes of a figure, equal for equal figures."""
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
    if curve.band is not None:
        band = curve.band[order]
        above.fill_between(x, fitted - band, fitted + band, color=VERMILION, alpha=0.25, linewidth=0.0)
    above.plot(
        x, fitted, color=VERMILION, linewidth=1.2, label="model" if curve.band is None else "fit, 95 %"
    )
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


def picture_axes(axes: Axes, lens: Lens) -> None:
    """Set up axes of pixels for a lens's picture."""
    axes.set(xlim=(-0.5, lens.width - 0.5), ylim=(lens.height - 0.5, -0.5), aspect="equal")
    axes.set(xlabel="u [px]", ylabel="v [px]")


ARROW = 0.06
"""Length of the 95th percentile of arrows in a figure, relative to the width of the drawing."""


def draw_arrows(
    axes: Axes, at: Array, vectors: Array, used: NDArray[np.bool_], unit: str, per: float
) -> None:
    """Draw points with enlarged arrows, and crosses for unused points; `per` arrow units correspond to one axis unit.

    Args:
        axes: Axes to draw on.
        at: Positions in the unit of the axes, (N, 2).
        vectors: Arrows in `unit`, (N, 2).
        used: Mask of the rows that the calibration used, (N,).
        unit: Unit of the arrows.
        per: Arrow units per unit of the axes.
    """
    good = used & np.isfinite(vectors).all(axis=1)
    size = float(np.percentile(np.linalg.norm(vectors[good], axis=1), 95)) if good.any() else 1.0
    scale = max(size, 1e-12) / max(float(np.ptp(at, axis=0).max()) * ARROW, 1e-12)
    axes.plot(*at[good].T, ".", color=GRAY, markersize=3)
    label = f"longest of 95 %: {size:.2g} {unit}, enlarged {per / scale:.2g} times"
    arrows = {"angles": "xy", "scale_units": "xy", "scale": scale, "width": 0.0022}
    axes.quiver(*at[good].T, *vectors[good].T, color=BLUE, label=label, **arrows)
    if not good.all():
        axes.plot(*at[~good].T, "x", color=VERMILION, markersize=6, label="left out")
    axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(0.0, 1.1), ncols=3, frameon=False)
    axes.grid(True, color="0.93", linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)


def new_figure(width: float, height: float, constrained: bool = True) -> Figure:
    """Return an empty figure.

    Args:
        width: Width [inch].
        height: Height [inch].
        constrained: True if the layout reserves space for labels.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained" if constrained else None)
    FigureCanvasAgg(figure)
    return figure


HEADS = ("parameter", "estimate", "95 % interval", "unit")
"""Headings of every table of estimates; additional ones differ."""

QUALITY = {
    "r2": "R²",
    "nrmse": "NRMSE",
    "rmse": "RMSE",
    "rmse_held_out": "held out",
    "held_out": "NRMSE held out",
    "file": "by the file",
    "trials": "trials",
    "samples": "samples",
    "rejected": "rejected",
    "speed_low": "speeds",
}
"""Figures of a fit in the table on the terminal, in this order; the report contains all."""


def fit_json(
    fit: Fit, vehicle: Vehicle, *, out: Path | None = None, findings: Sequence[Finding] = ()
) -> dict[str, Any]:
    """Return the content of `--json` and of the report's `fit.json`; non-finite numbers are None.

    Args:
        fit: The fit.
        vehicle: `calibrated(fit)`.
        out: File that the vehicle was written to.
        findings: Findings of the fit and about the calibrated vehicle.
    """
    return {
        "kind": fit.kind,
        "method": fit.method,
        "vehicle": {"name": fit.before.name, "sha256": fit.before.sha256},
        "parameters": {name: estimate.as_json() for name, estimate in fit.estimates.items()},
        "kept": retained_values(fit, vehicle),
        "quality": plain(fit.quality),
        "correlation": None if fit.correlation is None else fit.correlation.as_json(),
        "findings": [item.as_json() for item in findings],
        "next_dive": None if fit.next_dive is None else fit.next_dive.as_json(),
        "trials": dict(fit.trials),
        "settings": vehicle.calibrations[-1].settings,
        "interrupted": fit.interrupted,
        "out": None if out is None else str(out),
        "calibrated": {"sha256": vehicle.sha256},
        "provenance": provenance(),
    }


def _cells(e: Estimate, fit: Fit, vehicle: Vehicle) -> tuple[str, ...]:
    """Return the texts of an estimate, in the order of the heads."""
    before = number_text(file_number(e, fit.before))
    return e.name, number_text(e.estimate), interval_text(e), e.unit, before, state_text(e, fit, vehicle)


def number_text(value: float | None) -> str:
    """Return a number with four significant digits, small numbers as 3.71e-4; – if there is none. Any unit."""
    if value is None or not math.isfinite(value):
        return "–"
    mantissa, _, exponent = f"{value:.3e}".partition("e")
    if value != 0.0 and not -4 < int(exponent) < 6:
        return f"{float(mantissa):g}e{int(exponent)}"
    return f"{value:.4g}" if abs(value) < 1e4 else f"{value:.0f}"


def interval_text(estimate: Estimate) -> str:
    """Return an interval such as `37.9 to 40.2`; `unknown` if an end is not finite."""
    low, high = estimate.ci95
    if not (math.isfinite(low) and math.isfinite(high)):
        return "unknown"
    return f"{number_text(low)} to {number_text(high)}"


def state_text(estimate: Estimate, fit: Fit, vehicle: Vehicle) -> str:
    """Return the state of a parameter: `written`, `file kept`, or whether the data determine it if it is not
    in the file.

    `unsure`: written, although the data determine it only in combination with another one, as a part of the drag.
    """
    scales = estimate.name == "thrust_scale" or estimate.name.startswith("gain.")
    if scales and any(path.endswith(".c_plus") for path in fit.changes):
        return "written" if estimate.identifiable else "unsure"
    if estimate.path is None:
        return "" if estimate.identifiable else "undetermined"
    before, after = number_in(fit.before, estimate.path), number_in(vehicle, estimate.path)
    if after != before or (after is not None and estimate.identifiable and after == estimate.estimate):
        return "written" if estimate.identifiable else "unsure"
    return "file kept"


def quality_text(figures: Mapping[str, float], *, every: bool = True) -> str:
    """Return a text such as `R² 0.998, NRMSE 0.021, samples 1204`.

    Args:
        figures: Figures by key, in the units of a fit's quality.
        every: True for all figures, False for those of `QUALITY`.
    """
    keys = [key for key in QUALITY if key in figures]
    keys += [key for key in figures if key not in QUALITY] if every or not keys else []
    texts = {key: number_text(figures[key]) for key in keys}
    if {"speed_low", "speed_high"} <= figures.keys():
        texts["speed_low"] = f"{number_text(figures['speed_low'])} to {number_text(figures['speed_high'])}"
        texts.pop("speed_high", None)
    return ", ".join(f"{QUALITY.get(key, key.replace('_', ' '))} {text}" for key, text in texts.items())


AS_STATED = "as given"
"""Note of a number that was not estimated: the table on the terminal omits it."""

ExtraTable = tuple[Sequence[str], Sequence[Sequence[str]], Sequence[str]]
"""Heads, rows, and a CSS class for each row."""


@dataclass(frozen=True, kw_only=True)
class Report:
    """Report of a calibration, for the terminal and as a page."""

    title: str
    """Title of the page."""
    headline: str
    """Text above the table on the terminal."""
    heads: Sequence[str]
    """Headings of the table of estimates."""
    estimates: Sequence[Estimate]
    cells: Callable[[Estimate], tuple[str, ...]]
    """Function that returns the texts of an estimate, in the order of `heads`."""
    summary: Sequence[str]
    """Figures of the quality of the calibration, one sentence each."""
    findings: Sequence[Finding]
    reading: str
    """Meaning of the intervals."""
    advice_title: str = "Advice"
    remarks: Sequence[str] = ()
    """Remarks on the estimates, below their table."""
    lead: Sequence[str] = ()
    """Sentences at the start of the page, below its first picture; the summary if empty."""

    @property
    def notes(self) -> list[str]:
        """Return remarks and findings for information."""
        return [*self.remarks, *sentences(item for item in self.findings if item.severity == "note")]

    @property
    def advice(self) -> list[str]:
        """Findings that require attention."""
        return sentences(item for item in self.findings if item.severity != "note")

    def show(self, console: Console) -> None:
        """Print estimates, figures and findings in 100 columns."""
        table = Table(box=box.SIMPLE_HEAD)
        for heading in self.heads:
            right = heading in ("estimate", "file had")
            table.add_column(heading, justify="right" if right else "left", overflow="fold")
        for estimate in self.estimates:
            if estimate.note != AS_STATED:
                style = "" if estimate.identifiable else "yellow"
                table.add_row(*map(Text, self.cells(estimate)), style=style)
        console.print(self.headline, highlight=False, markup=False)
        console.print(table)
        lines = [f"  {sentence}" for sentence in (*self.lead, *self.summary)]
        for line in [*lines, *(f"· {note}" for note in self.notes)]:
            console.print(line, highlight=False, markup=False)
        for sentence in self.advice:
            console.print(f"! {sentence}", highlight=False, markup=False, style="yellow")

    def write(
        self,
        folder: str | os.PathLike[str],
        record: Mapping[str, Any],
        pictures: Pictures,
        repeat: Sequence[str],
        tables: Mapping[str, ExtraTable] | None = None,
    ) -> None:
        """Write `report.html`, the pictures as PNG and `fit.json`.

        Args:
            folder: Directory to create; an earlier report there is replaced.
            record: Content of `fit.json`.
            pictures: File name -> caption of the picture, and the PNG.
            repeat: Lines of the section on how to repeat the calibration.
            tables: Additional tables after the pictures, by heading.

        Raises:
            OutputError: The directory contains other files, or cannot be written.
        """
        page = Page(self.title)
        first = next(iter(pictures)) if self.lead and pictures else None
        if first is not None:
            page.picture(*pictures[first])
        for sentence in self.lead or self.summary:
            page.lead(sentence)
        page.items(self.advice_title, self.advice)
        page.heading("Estimates")
        kinds = ["" if e.identifiable or e.note == AS_STATED else "doubt" for e in self.estimates]
        page.table(self.heads, [self.cells(e) for e in self.estimates], kinds, last="words")
        for note in (*self.notes, self.reading):
            page.note(note)
        page.pictures({name: picture for name, picture in pictures.items() if name != first})
        for heading, (heads, rows, kinds) in (tables or {}).items():
            page.heading(heading)
            page.table(heads, rows, kinds, last="words")
        page.code("How to repeat it", repeat)
        page.write(folder, record, pictures)


READING = (
    "The interval contains the true value in 19 of 20 such calibrations, if the model's form is right: it "
    "covers noise and the differences between trials, but not a wrong model. `unsure`: written, "
    "although determined only jointly with another number. `file kept`: the trials do not determine it, and "
    "the vehicle file's value is kept. Score the result on held-out trials with `finssim replay` before relying on it."
)


def fit_report(fit: Fit, vehicle: Vehicle, findings: Sequence[Finding] = ()) -> Report:
    """Return the report of a fit that results in a vehicle file.

    Args:
        fit: The fit.
        vehicle: `calibrated(fit)`.
        findings: Findings of the fit and about the calibrated vehicle.
    """
    notes: dict[str, list[str]] = {}
    for name, estimate in fit.estimates.items():
        if estimate.note:
            notes.setdefault(estimate.note, []).append(name)
    kept = retained_values(fit, vehicle)
    unchanged = ", ".join(f"{name} {number_text(value)}" for name, value in kept.items())
    sentence = vehicle.calibrations[-1].sentence()
    undrawn = len(fit.curves) - MAX_CURVES
    return Report(
        title=f"Calibration of {fit.before.name}: {sentence}",
        headline=f"{fit.before.name}: {sentence}",
        heads=(*HEADS, "file had", "state"),
        estimates=list(fit.estimates.values()),
        cells=lambda e: _cells(e, fit, vehicle),
        lead=_lead(fit),
        summary=[
            f"{subject}: {quality_text(figures, every=False)}" for subject, figures in fit.quality.items()
        ],
        findings=findings,
        reading=READING,
        advice_title="Findings",
        remarks=[
            *(f"{', '.join(names)}: {note}" for note, names in notes.items()),
            *([f"not identifiable, so the vehicle file keeps: {unchanged}"] if unchanged else []),
            *([f"{undrawn} more curves are not drawn"] if undrawn > 0 else []),
        ],
    )


IMPLIED = (".added_mass", ".bias")
"""Suffixes of the names of estimates that follow from others, or may well be zero."""


RATIOS = ("/m_eff", ".terminal_speed")
"""Suffixes of the names of estimates from a motion without thrust, whose inertia is assumed."""


def _lead(fit: Fit) -> list[str]:
    """Return sentences about known and unknown parameters, and about the next dive."""
    known, unknown, given = list[str](), list[str](), list[str]()
    for name, e in fit.estimates.items():
        if e.note.startswith("given") or (not e.identifiable and e.ci95[0] == e.ci95[1]):
            given.append(f"{name} {number_text(e.estimate)} {e.unit}")
        elif not name.endswith(IMPLIED):
            half = 0.5 * (e.ci95[1] - e.ci95[0])
            part = half / max(abs(e.estimate), 1e-12)
            size = f"±{100.0 * part:.{0 if part > 0.0095 else 1}f} %" if part < 1.0 else "hardly"
            size = f"±{half:.2g} m" if e.unit == "m" else size  # zero is an ordinary value of a position
            (known if e.identifiable else unknown).append(f"{name} ({size})")
    free = {name.partition(".")[0] for name in fit.estimates if name.endswith(RATIOS)}
    assumed = [axis for axis in AXES if axis in free and f"{axis}.m_eff" not in fit.estimates]
    unknown += [f"{axis}.m_eff (assumed: give it by --fix {axis}.m=NUMBER)" for axis in assumed]
    determined = f": {', '.join(known)}" if known else ""
    out = [f"{len(known)} of {len(known) + len(unknown)} parameters are determined by the data{determined}."]
    out += [f"Given: {', '.join(given)}."] if given else []
    out += [f"Not determined: {', '.join(unknown)}."] if unknown else []
    out += [f"R{str(fit.next_dive)[1:]}."] if fit.next_dive is not None else []
    return [*out, *(["The fit was interrupted before it converged."] if fit.interrupted else [])]


def write_report(
    fit: Fit,
    folder: str | os.PathLike[str],
    vehicle: Vehicle,
    *,
    command: str = "",
    findings: Sequence[Finding] = (),
    out: Path | None = None,
) -> None:
    """Write `report.html`, its PNG pictures and `fit.json`.

    Args:
        fit: The fit.
        folder: Directory to create; an earlier report there is replaced.
        vehicle: `calibrated(fit)`.
        command: Command line that repeats the fit.
        findings: Findings of the fit and about the calibrated vehicle.
        out: File that the vehicle was written to.

    Raises:
        OutputError: The directory contains other files, or cannot be written.
    """
    record = vehicle.calibrations[-1]
    quality = [(subject, quality_text(figures)) for subject, figures in fit.quality.items()]
    trials = list(fit.trials.items())
    tables: dict[str, ExtraTable] = {"Quality": (("", ""), quality, [""] * len(quality))} if quality else {}
    tables["Trials"] = (("name", "SHA-256 of its numbers"), trials, [""] * len(trials))
    repeat = [
        *([command] if command else []),
        f"FinsSim {record.finssim}, revision {record.revision or 'not from a checkout'}",
        f"settings: {json.dumps(record.settings)}",
        f"vehicle before: {fit.before.name}, sha256 {fit.before.sha256}",
        f"vehicle after: sha256 {vehicle.sha256}",
    ]
    as_object = fit_json(fit, vehicle, out=out, findings=findings)
    fit_report(fit, vehicle, findings).write(folder, as_object, fit_pictures(fit), repeat, tables)


# Common first and last steps of every `finssim calibrate` command that results in a vehicle file.


def usable(trials: Sequence[Trial]) -> tuple[list[Trial], list[Finding]]:
    """Return the trials that a fit may use, and a finding about each of the others.

    Raises:
        CalibrationError: No trial remains.
    """
    used = [trial for trial in trials if trial.header.role != "held-out"]
    excluded = [finding("held_out", trial.name) for trial in trials if trial.header.role == "held-out"]
    if not used:
        raise CalibrationError("every trial is marked held-out: a fit needs trials of role 'fit' or of none")
    return used, excluded


def usable_trials(paths: Sequence[Path]) -> tuple[list[Trial], list[Trial]]:
    """Load trials for a fit, and held-out ones; report omitted trials with reasons on standard error."""
    trials = load_trials(paths)
    used, excluded = usable(trials)
    screen = Console(stderr=True)
    excluded += [item.about(trial.name) for trial in used for item in trial.findings]
    for sentence in sentences(excluded):
        screen.print(sentence, highlight=False, markup=False, soft_wrap=True)
    return used, [trial for trial in trials if trial.header.role == "held-out"]


def finish(kind: str, fit: Fit, options: Mapping[str, Any]) -> Vehicle:
    """Write and print the calibrated vehicle, the report and the ranges.

    Args:
        kind: Kind of the command.
        fit: The fit.
        options: All arguments of the command by name, starting with the inputs.

    Raises:
        KeyboardInterrupt: The fit was interrupted.
    """
    (_, inputs), *rest = options.items()
    out, report, ranges = options["out"], options["report"], options.get("ranges")
    vehicle = calibrated(fit)
    findings = all_findings(fit, vehicle)
    write_vehicle(vehicle, out)
    if report is not None:
        arguments = {name: value for name, value in rest if name != "as_json"}
        command = command_line(kind, [inputs] if isinstance(inputs, Path) else inputs, arguments)
        write_report(fit, report, vehicle, command=command, findings=findings, out=out)
    if ranges is not None:
        write_ranges(fit, ranges, vehicle)
    record = fit_json(fit, vehicle, out=out, findings=findings) if options["as_json"] else None
    publish(record, fit_report(fit, vehicle, findings).show, (out, report, ranges))
    if fit.interrupted:
        raise KeyboardInterrupt
    return vehicle
