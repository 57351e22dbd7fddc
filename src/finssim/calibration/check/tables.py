"""Reports of checked trials as tables for people, readable at a hundred columns."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from rich import box
from rich.markup import escape
from rich.table import Table

from finssim.calibration.check.report import PARAMETERS, THRUST, AxisReport, StreamReport, TrialReport
from finssim.calibration.check.together import told_by
from finssim.calibration.findings import SEVERITIES, Finding
from finssim.vehicles import AXES

if TYPE_CHECKING:
    from rich.console import Console

__all__ = ["print_reports"]

COLOURS = {"usable": "green", "usable with care": "yellow", "refused": "red"}
MARKS = {"refused": "[red]✗[/red]", "care": "[yellow]![/yellow]", "note": "[dim]·[/dim]"}
MANY = 4
"""More trials than this are printed without the tables of each."""


def print_reports(reports: Sequence[TrialReport], console: Console, common: Sequence[Finding] = ()) -> None:
    """Print what was found.

    Args:
        reports: By trial.
        console: Where to.
        common: Findings about all of them together.
    """
    for report in reports:
        _print_trial(report, console, brief=len(reports) > MANY)
    if len(reports) > 1:
        _print_overview(reports, console)
    for finding in common:
        console.print(f"{MARKS[finding.severity]} {escape(str(finding))}")


def _print_trial(report: TrialReport, console: Console, *, brief: bool) -> None:
    colour = COLOURS[report.verdict]
    driven = f", {report.inputs}" if report.inputs else ""
    role = f", {report.role}" if report.role else ""
    console.print(
        f"[bold]{escape(report.name)}[/bold]  {report.duration:.1f} s, {report.rows} rows{driven}{role}"
        f"{', ' + escape(report.vehicle) if report.vehicle else ''}: [{colour}]{report.verdict}[/{colour}]"
    )
    grid = Table.grid(padding=(0, 1))
    for finding in sorted(report.findings, key=lambda f: SEVERITIES.index(f.severity)):
        if not (brief and finding.severity == "note"):
            grid.add_row("", MARKS[finding.severity], escape(str(finding)))
    if grid.row_count:
        console.print(grid, highlight=False)
    if brief:
        return
    if report.streams:
        console.print(_streams(report.streams))
    if report.axes:
        console.print(_axes(report.axes))
        console.print(_tells(report.axes, report.inputs == "passive"), highlight=False)
    console.print()


def _streams(streams: Sequence[StreamReport]) -> Table:
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for name in ("columns", "samples", "rate", "jitter", "gaps", "longest", "missing"):
        table.add_column(name, justify="left" if name == "columns" else "right", overflow="fold")
    for s in streams:
        table.add_row(
            _short(s.columns),
            str(s.samples),
            f"{s.rate:.3g} Hz",
            f"{s.jitter:.0%}",
            str(s.gaps),
            f"{s.longest_gap:.2g} s",
            f"{s.missing:.0%}",
        )
    return table


def _short(columns: Sequence[str]) -> str:
    """Names with what they begin with in common said once: `pwm_T1 T2 T3`."""
    head = columns[0].split("_")[0] + "_"
    if len(columns) > 2 and all(column.startswith(head) for column in columns):
        return " ".join([columns[0], *(column.removeprefix(head) for column in columns[1:])])
    return " ".join(columns)


def _axes(axes: Sequence[AxisReport]) -> Table:
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for name in (
        "axis",
        "velocity",
        "up to",
        "noise",
        "decades",
        "input",
        "levels",
        "both ways",
        "coast",
        "rest",
    ):
        table.add_column(name, justify="left" if name in ("axis", "velocity") else "right")
    for a in axes:
        if not a.source or a.fastest != a.fastest:
            table.add_row(a.axis, a.source.removeprefix("derived ") or "[dim]unknown[/dim]", *[""] * 8)
            continue
        style = "" if a.excited else "dim"
        table.add_row(
            a.axis,
            a.source.removeprefix("derived "),
            f"{a.fastest:.2g}",
            f"{a.noise:.1g}",
            f"{a.decades:.1f}",
            f"{a.strongest:.3g}" if a.strongest > 1e-6 else "-",
            str(len(a.levels)) if a.levels else "-",
            "yes" if a.both_directions else "no",
            f"{a.coasts:.1f} s",
            f"{a.rests:.1f} s",
            style=style,
        )
    return table


def _tells(axes: Sequence[AxisReport], passive: bool) -> Table:
    """What each axis tells, and why not the rest; reasons that several share are said once."""
    grid = Table.grid(padding=(0, 1))
    for a in axes:
        # Of a passive trial it goes without saying that nothing is known of thrust.
        shown = {n: t for n, t in a.tells.items() if t.can or not (passive and n in THRUST)}
        by_reason: dict[tuple[bool, str], list[str]] = {}
        for name, told in shown.items():
            by_reason.setdefault((told.can, told.why), []).append(name)
        if len(by_reason) == 1 and not next(iter(by_reason))[0]:
            grid.add_row("", a.axis, f"[red]nothing[/red]: {escape(next(iter(by_reason))[1])}")
        elif by_reason:
            parts = [
                f"[green]{', '.join(names)}[/green] ({escape(why)})"
                if can
                else f"not {', '.join(names)} ({escape(why)})"
                for (can, why), names in sorted(by_reason.items(), key=lambda item: not item[0][0])
            ]
            grid.add_row("", a.axis, "; ".join(parts))
    return grid


def _print_overview(reports: Sequence[TrialReport], console: Console) -> None:
    """Trials that tell each parameter of each axis, together."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, title="trials that tell", title_justify="left")
    table.add_column("axis")
    for parameter in PARAMETERS:
        table.add_column(parameter, justify="right")
    for axis in AXES:
        counts = [len(told_by(reports, axis, parameter)) for parameter in PARAMETERS]
        table.add_row(axis, *(str(count) if count else "[dim]-[/dim]" for count in counts))
    console.print(table)
