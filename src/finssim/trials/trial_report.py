"""Reports of trial checks: as data, across the trials of a set, and as printed tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from rich import box
from rich.markup import escape
from rich.table import Table

from finssim.trials.findings import SEVERITIES, Finding, finding, listed, plain
from finssim.vehicles import AXES

if TYPE_CHECKING:
    from rich.console import Console

Verdict = Literal["usable", "usable with care", "refused"]

PARAMETERS = ("m_eff", "d1", "d2", "k", "buoyancy")
"""Parameters of an axis that a trial may identify; k of roll and pitch, buoyancy of heave."""


@dataclass(frozen=True, kw_only=True)
class StreamReport:
    """Columns that are sampled together."""

    columns: tuple[str, ...]
    group: str
    samples: int
    rate: float
    """Sampling rate outside gaps [Hz]."""
    jitter: float
    """Standard deviation of the interval between samples, without gaps, as a fraction of its mean."""
    gaps: int
    longest_gap: float
    """Longest gap [s]."""
    missing: float
    """Fraction of the trial's duration without this stream."""


@dataclass(frozen=True)
class Identifiability:
    """Identifiability of one parameter in a trial, with the reason."""

    identifiable: bool
    reason: str


@dataclass(frozen=True, kw_only=True)
class AxisReport:
    """Excitation of one axis and the identifiability that results."""

    axis: str
    source: str
    """Source of the velocity: measured, derived from ..., or empty."""
    fastest: float = np.nan
    """95th percentile of the speed [m/s, rad/s]."""
    noise: float = np.nan
    """Noise of one velocity sample [m/s, rad/s]."""
    decades: float = 0.0
    """Logarithm (base 10) of the ratio of the fastest to the slowest speed above the noise."""
    strongest: float = 0.0
    """95th percentile of the wrench [N, N m]."""
    work: float = 0.0
    """Work of the inputs along this axis [J]; 0 for a passive trial."""
    both_directions: bool = False
    driven: float = 0.0
    """Duration of input [s]."""
    coasts: float = 0.0
    """Duration of motion without input [s]."""
    rests: float = 0.0
    """Duration without input and motion [s]."""
    excited: bool = False
    identifiability: dict[str, Identifiability] = field(default_factory=dict)
    """Identifiability by parameter."""


@dataclass(frozen=True, kw_only=True)
class TrialReport:
    """Report of one trial."""

    name: str
    vehicle: str | None = None
    role: str | None = None
    duration: float = 0.0
    """Duration [s]."""
    rows: int = 0
    inputs: str = ""
    """Kind of input: rpm, force, tau, pwm, command, passive, or empty."""
    streams: tuple[StreamReport, ...] = ()
    axes: tuple[AxisReport, ...] = ()
    findings: tuple[Finding, ...] = ()
    sha256: str = ""

    @property
    def verdict(self) -> Verdict:
        """Return the verdict of the worst finding."""
        levels = {finding_.severity for finding_ in self.findings}
        return "refused" if "refused" in levels else "usable with care" if "care" in levels else "usable"

    def as_json(self) -> dict[str, Any]:
        """Return plain values; non-finite numbers become None."""
        record = {key: value for key, value in asdict(self).items() if key != "axes"}
        record |= {"verdict": self.verdict, "findings": [entry.as_json() for entry in self.findings]}
        axes = {axis.axis: {k: v for k, v in asdict(axis).items() if k != "axis"} for axis in self.axes}
        return {**plain(record), "axes": plain(axes)}


# Checks across the trials of a set: vehicles, roles, names, and joint identifiability.


def identified_by(reports: Sequence[TrialReport], axis: str, parameter: str) -> list[str]:
    """Return the names of the trials that identify a parameter of an axis, without held-out and refused trials."""
    return [
        report.name
        for report in reports
        if report.verdict != "refused" and report.role != "held-out"
        for axis_report in report.axes
        if axis_report.axis == axis
        and parameter in axis_report.identifiability
        and axis_report.identifiability[parameter].identifiable
    ]


def set_findings(reports: Sequence[TrialReport]) -> list[Finding]:
    """Return findings about the set."""
    findings = []
    vehicles = {report.vehicle for report in reports if report.vehicle}
    if len(vehicles) > 1:
        findings.append(finding("several_vehicles", vehicles=tuple(sorted(vehicles))))
    names = [report.name for report in reports]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        findings.append(finding("equal_names", names=tuple(twice)))
    good = [report for report in reports if report.verdict != "refused"]
    if reports and not good:
        findings.append(finding("none_usable"))
        return findings
    held_out = [report.name for report in good if report.role == "held-out"]
    if held_out and len(held_out) == len(good):
        findings.append(finding("all_held_out"))
    elif not held_out and len(good) > 1:
        findings.append(finding("none_held_out"))
    fitting = len(good) - len(held_out)
    if 0 < fitting < 5:
        findings.append(finding("few_trials", trials=fitting))
    nothing = [a for a in AXES if not any(identified_by(reports, a, parameter) for parameter in PARAMETERS)]
    if nothing and len(nothing) < len(AXES):
        findings.append(finding("axes_undetermined", axes=tuple(map(str, nothing))))
    return findings


# Printed reports of trial checks, for a terminal of 100 columns.

COLOURS = {"usable": "green", "usable with care": "yellow", "refused": "red"}
MARKS = {"refused": "[red]✗[/red]", "care": "[yellow]![/yellow]", "note": "[dim]·[/dim]"}
MANY = 4
"""Largest number of trials for which the tables of each trial are printed."""


def print_reports(reports: Sequence[TrialReport], console: Console, common: Sequence[Finding] = ()) -> None:
    """Print the reports of checked trials.

    Args:
        reports: Reports by trial.
        console: Console to print on.
        common: Findings about all trials together.
    """
    for report in reports:
        _print_trial(report, console, brief=len(reports) > MANY)
    if len(reports) > 1:
        table = _table(("axis", *PARAMETERS), ("axis",), "trials that identify a parameter")
        for axis in AXES:
            counts = [len(identified_by(reports, axis, parameter)) for parameter in PARAMETERS]
            table.add_row(axis, *(str(count) if count else "[dim]-[/dim]" for count in counts))
        console.print(table)
    for entry in common:
        console.print(f"{MARKS[entry.severity]} {escape(str(entry))}")


def _print_trial(report: TrialReport, console: Console, *, brief: bool) -> None:
    colour = COLOURS[report.verdict]
    driven = f", {report.inputs}" if report.inputs else ""
    role = f", {report.role}" if report.role else ""
    console.print(
        f"[bold]{escape(report.name)}[/bold]  {report.duration:.1f} s, {report.rows} rows{driven}{role}"
        f"{', ' + escape(report.vehicle) if report.vehicle else ''}: [{colour}]{report.verdict}[/{colour}]"
    )
    grid = Table.grid(padding=(0, 1))
    for entry in sorted(report.findings, key=lambda f: SEVERITIES.index(f.severity)):
        if not (brief and entry.severity == "note"):
            grid.add_row("", MARKS[entry.severity], escape(str(entry)))
    if grid.row_count:
        console.print(grid, highlight=False)
    if brief:
        return
    if report.streams:
        heads = ("columns", "samples", "rate", "jitter", "gaps", "longest", "missing")
        table = _table(heads, ("columns",))
        for s in report.streams:
            rates = (
                f"{s.rate:.3g} Hz",
                f"{s.jitter:.0%}",
                str(s.gaps),
                f"{s.longest_gap:.2g} s",
                f"{s.missing:.0%}",
            )
            table.add_row(escape(listed(s.columns, 4)), str(s.samples), *rates)
        console.print(table)
    if report.axes:
        console.print(_axes(report.axes))
        console.print(_identifiability_table(report.axes), highlight=False)
    console.print()


def _table(heads: Sequence[str], left_aligned: Sequence[str], title: str | None = None) -> Table:
    """Return an empty table with columns, some of them left-aligned."""
    table = Table(
        box=box.SIMPLE_HEAD, pad_edge=False, collapse_padding=True, title=title, title_justify="left"
    )
    for name in heads:
        justify: Literal["left", "right"] = "left" if name in left_aligned else "right"
        table.add_column(name, justify=justify, overflow="fold", min_width=max(map(len, name.split())))
    return table


def _axes(axes: Sequence[AxisReport]) -> Table:
    heads = ("axis", "velocity", "up to", "noise", "decades", "input", "both ways", "coast", "rest")
    table = _table(heads, ("axis", "velocity"))
    for a in axes:
        if not a.source or a.fastest != a.fastest:
            table.add_row(a.axis, a.source.removeprefix("derived ") or "[dim]unknown[/dim]", *[""] * 7)
            continue
        force = f"{a.strongest:.3g}" if a.strongest > 1e-3 else "-"
        speeds = (f"{a.fastest:.2g}", f"{a.noise:.1g}", f"{a.decades:.1f}")
        rest = (force, "yes" if a.both_directions else "no", f"{a.coasts:.1f} s", f"{a.rests:.1f} s")
        source = a.source.removeprefix("derived ")
        table.add_row(a.axis, source, *speeds, *rest, style="" if a.excited else "dim")
    return table


def _identifiability_table(axes: Sequence[AxisReport]) -> Table:
    """Return a table of the parameters that each axis identifies, and the reasons for the others; shared
    reasons are listed once."""
    grid = Table.grid(padding=(0, 1))
    for a in axes:
        by_reason: dict[tuple[bool, str], list[str]] = {}
        for name, verdict in a.identifiability.items():
            by_reason.setdefault((verdict.identifiable, verdict.reason), []).append(name)
        if len(by_reason) == 1 and not next(iter(by_reason))[0]:
            grid.add_row("", a.axis, f"[red]nothing[/red]: {escape(next(iter(by_reason))[1])}")
        elif by_reason:
            parts = [
                f"[green]{', '.join(names)}[/green] ({escape(reason)})"
                if identifiable
                else f"not {', '.join(names)} ({escape(reason)})"
                for (identifiable, reason), names in sorted(
                    by_reason.items(), key=lambda item: not item[0][0]
                )
            ]
            grid.add_row("", a.axis, "; ".join(parts))
    return grid
