"""`finssim trials check`: what trials can and cannot identify, and why."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from rich import box
from rich.markup import escape
from rich.table import Table
from scipy.signal import lfilter

from finssim.core.rotations import quat_rotate, quat_to_euler
from finssim.trials.findings import SEVERITIES, CalibrationError, Finding, finding, listed, plain
from finssim.trials.free_motion import FEWEST_SPEEDS, compared_columns, free_motion
from finssim.trials.inputs import InputForces, drive, implausible, no_input, within_reach
from finssim.trials.motion import (
    AttitudeSignal,
    Motion,
    answers,
    attitude_samples,
    attitude_signal,
    holds_gravity,
    longest_step,
    motion,
    on_grid,
    up_in_body,
    white_noise,
)
from finssim.trials.significance import Relation, relation
from finssim.trials.trial import COLUMNS, NU, TAU, Array, Trial, column_of
from finssim.trials.trial_files import load_trial, trials_at, vehicle_of
from finssim.vehicles import AXES, Vehicle, VehicleError, load_vehicle

if TYPE_CHECKING:
    from rich.console import Console

# Checks between the trials of a set: vehicles, roles, names, and what they determine together.


def identified_by(reports: Sequence[TrialReport], axis: str, parameter: str) -> list[str]:
    """Return the names of the trials that determine a parameter of an axis; held-out and refused ones do not count."""
    return [
        report.name
        for report in reports
        if report.verdict != "refused" and report.role != "held-out"
        for axis_report in report.axes
        if axis_report.axis == axis and parameter in axis_report.tells and axis_report.tells[parameter].can
    ]


def set_findings(reports: Sequence[TrialReport]) -> list[Finding]:
    """Findings about the set."""
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
        findings.append(finding("axes_untold", axes=tuple(map(str, nothing))))
    return findings


# Result of a check of trials, as data.

Verdict = Literal["usable", "usable with care", "refused"]

PARAMETERS = ("m_eff", "d1", "d2", "k", "buoyancy")
"""Parameters that a trial may determine of an axis; k of roll and pitch, buoyancy of heave."""


@dataclass(frozen=True, kw_only=True)
class StreamReport:
    """Columns that are sampled together."""

    columns: tuple[str, ...]
    group: str
    samples: int
    rate: float
    """Samples per second while there are any [Hz]."""
    jitter: float
    """Standard deviation of the time between samples, gaps aside, as a share of its mean."""
    gaps: int
    longest_gap: float
    """[s]"""
    missing: float
    """Part of the trial's time without this stream."""


@dataclass(frozen=True, kw_only=True)
class Identifiability:
    """Result for one parameter: whether a trial determines it, and why."""

    can: bool
    why: str


@dataclass(frozen=True, kw_only=True)
class AxisReport:
    """Excitation of one axis and what follows from it."""

    axis: str
    source: str
    """Source of the velocity: measured, derived from ..., or nothing."""
    fastest: float = np.nan
    """95th percentile of the speed [m/s, rad/s]."""
    noise: float = np.nan
    """Noise of one velocity sample [m/s, rad/s]."""
    decades: float = 0.0
    """Logarithm (base 10) of the ratio of the fastest to the slowest speed above the noise."""
    strongest: float = 0.0
    """95th percentile of the wrench [N, N m]."""
    work: float = 0.0
    """Done by the inputs along this axis [J]; of a passive trial 0."""
    both_directions: bool = False
    driven: float = 0.0
    """Time of input [s]."""
    coasts: float = 0.0
    """Time of motion without input [s]."""
    rests: float = 0.0
    """Time without input and motion [s]."""
    excited: bool = False
    tells: dict[str, Identifiability] = field(default_factory=dict)
    """Identifiability by parameter."""


@dataclass(frozen=True, kw_only=True)
class TrialReport:
    """One trial."""

    name: str
    vehicle: str | None = None
    role: str | None = None
    duration: float = 0.0
    """[s]"""
    rows: int = 0
    inputs: str = ""
    """Kind of input: rpm, force, tau, pwm, command, passive, or nothing."""
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
        """Plain values; numbers that are not finite become None."""
        record = {key: value for key, value in asdict(self).items() if key != "axes"}
        record |= {"verdict": self.verdict, "findings": [entry.as_json() for entry in self.findings]}
        axes = {axis.axis: {k: v for k, v in asdict(axis).items() if k != "axis"} for axis in self.axes}
        return {**plain(record), "axes": plain(axes)}


# Reports of checked trials as tables for people, readable at a hundred columns.

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
        table = _table(("axis", *PARAMETERS), ("axis",), "trials that determine a parameter")
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
    """An empty table of columns, some of them to the left."""
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
    """Return a table of what each axis determines, and the reasons for the rest; reasons that several share are listed
    once."""
    grid = Table.grid(padding=(0, 1))
    for a in axes:
        by_reason: dict[tuple[bool, str], list[str]] = {}
        for name, verdict in a.tells.items():
            by_reason.setdefault((verdict.can, verdict.why), []).append(name)
        if len(by_reason) == 1 and not next(iter(by_reason))[0]:
            grid.add_row("", a.axis, f"[red]nothing[/red]: {escape(next(iter(by_reason))[1])}")
        elif by_reason:
            parts = [
                f"[green]{', '.join(names)}[/green] ({escape(reason)})"
                if can
                else f"not {', '.join(names)} ({escape(reason)})"
                for (can, reason), names in sorted(by_reason.items(), key=lambda item: not item[0][0])
            ]
            grid.add_row("", a.axis, "; ".join(parts))
    return grid


# Sampling of a trial's columns: rates, gaps, jitter, values that stick, hold or clip.

LONGEST_MISSING = 0.2
"""Part of a trial without a stream above which care is needed."""

SHORTEST_TRIAL = 1.0
"""[s]"""

STUCK = 1.0
"""Time of equal values of a moving sensor that is suspicious [s]."""

FLYING = 0.3
"""Height above the surface that no vehicle reaches [m]: the log has another zero."""

COARSE = 50.0
"""Steps of resolution that a signal must span for equal values to mean something."""

FEW_HERTZ = 4.0
"""Rate below which the motion between samples is not seen [Hz]."""


def stream_reports(trial: Trial) -> tuple[list[StreamReport], list[Finding]]:
    """Columns by the times they share, and what is wrong with their sampling."""
    shared: dict[bytes, list[str]] = {}
    for name in trial.channels:
        if trial.has(name):
            column = column_of(name)
            group = column.group if column else ""
            kind = f"{group} {name.split('_')[0]}" if group == "command" else group
            key = np.isfinite(trial.channels[name]).tobytes() + kind.encode()
            shared.setdefault(key, []).append(name)
    reports, findings = [], []
    if trial.duration < SHORTEST_TRIAL:
        findings.append(finding("too_short", duration=trial.duration, least=SHORTEST_TRIAL))
    of: dict[Finding, list[str]] = {}
    for names in shared.values():
        report = _report(trial, tuple(names))
        reports.append(report)
        for entry in _sampling(report):
            of.setdefault(entry, []).extend(names)
        for name in names:
            for entry in _values(trial, name):
                of.setdefault(entry, []).append(name)
    findings += [entry.about(listed(columns, 4)) for entry, columns in of.items()]
    few = [name for name in trial.channels if not trial.has(name)]
    if few:
        findings.append(finding("few_samples", columns=tuple(few)))
    findings += trial.findings
    return sorted(reports, key=lambda r: (r.group != "command", r.group)), findings


def _report(trial: Trial, names: tuple[str, ...]) -> StreamReport:
    t, _ = trial.series(names[0])
    steps = np.diff(t)
    usual = float(np.median(steps))
    longest = max(0.5, 4.0 * usual)
    within = steps[steps <= longest]  # half of them at least
    column = column_of(names[0])
    silent = float(steps[steps > longest].sum()) + (t[0] - trial.t[0]) + (trial.t[-1] - t[-1])
    return StreamReport(
        columns=names,
        group=column.group if column else "",
        samples=len(t),
        rate=float(1.0 / within.mean()),
        jitter=float(np.std(within) / within.mean()),
        gaps=int((steps > longest).sum()),
        longest_gap=float(steps.max()),
        missing=float(silent / trial.duration) if trial.duration > 0.0 else 0.0,
    )


def _sampling(report: StreamReport) -> list[Finding]:
    """Return findings about the times of a stream."""
    findings = []
    much = report.missing > LONGEST_MISSING
    if report.gaps == 1:
        findings.append(finding("gap", severity="care" if much else "note", longest=report.longest_gap))
    elif report.gaps:
        severity = "care" if much else None
        findings.append(finding("gaps", severity=severity, gaps=report.gaps, longest=report.longest_gap))
    elif much:
        findings.append(finding("ends_missing", share=report.missing))
    if report.jitter > 0.5:
        findings.append(finding("jitter", share=report.jitter))
    if report.rate < FEW_HERTZ and report.group in ("velocity", "rates"):
        findings.append(finding("slow", rate=report.rate))
    return findings


def _values(trial: Trial, name: str) -> list[Finding]:
    """Stuck, held and clipped values of a measurement."""
    column = COLUMNS.get(name)
    if column is None or column.group == "command":
        return []
    t, y = trial.series(name)
    if len(y) < 20:
        return []
    if np.ptp(y) == 0.0:
        return [finding("constant", value=y[0])]
    wild = ~within_reach(name, y)
    findings = (
        [finding("wild", samples=wild.sum(), value=np.abs(y).max(), unit=column.unit)] if wild.any() else []
    )
    if _coarse(y):
        return findings
    if name in ("z", "depth") and (above := float(np.percentile(y if name == "z" else -y, 99.0))) > FLYING:
        findings.append(
            finding("above_surface", height=above)
            if name == "z"
            else finding("depth_above_surface", height=above)
        )
    begins = np.flatnonzero(np.concatenate([[True], np.diff(y) != 0.0]))
    lengths = np.diff(np.concatenate([begins, [len(y)]]))
    usual = float(np.median(lengths))
    rate = 1.0 / float(np.median(np.diff(t)))
    if usual >= 2.0:
        findings.append(finding("values_held", rows=usual, rate=rate / usual, row_rate=rate))
    longest = int(np.argmax(lengths))
    span = float(t[min(begins[longest] + lengths[longest], len(t) - 1)] - t[begins[longest]])
    if span > STUCK and lengths[longest] > 10.0 * usual:
        at = begins[longest]
        findings.append(finding("stuck", value=y[at], span=span, start=t[at]))
    for extreme, highest in ((y.max(), True), (y.min(), False)):
        # A signal that passes through its extreme touches it once.
        runs = lengths[y[begins] == extreme]
        if runs.sum() >= max(10.0, 0.02 * len(y)) and runs.max() >= 4.0 * usual:
            fields = {"value": extreme, "samples": runs.sum()}
            findings.append(
                finding("clipped_above", **fields) if highest else finding("clipped_below", **fields)
            )
    return findings


def _coarse(y: Array) -> bool:
    """Return whether a signal has so coarse a resolution that it repeats values."""
    steps = np.abs(np.diff(np.unique(y)))
    return bool(np.ptp(y) < COARSE * steps.min())


# Inputs of a trial against the limits of its vehicle.

OFTEN = 0.05
"""Part of the driven time at a limit above which care is needed."""


def input_findings(trial: Trial, vehicle: Vehicle, inputs: InputForces) -> list[Finding]:
    """Return findings about the inputs: assumptions, time at the limits, in the dead zones and beyond the thrusters'
    reach."""
    findings = list(inputs.findings)
    if inputs.source == "passive":
        return findings
    if dead := no_input(inputs):
        return [*findings, *dead]
    findings += (
        _wrench_beyond(vehicle, inputs) if not inputs.thrusters else _thrusters(trial, vehicle, inputs)
    )
    if inputs.end is not None:
        rest = trial.t[-1] - inputs.end
        findings.append(finding("inputs_end", rest=rest, end=inputs.end - trial.t[0]))
    if inputs.source == "pwm" and not trial.has("voltage") and trial.header.voltage is None:
        findings.append(finding("voltage_missing"))
    return findings


def _wrench_beyond(vehicle: Vehicle, inputs: InputForces) -> list[Finding]:
    findings = []
    for i, (axis, limit) in enumerate(zip(AXES, vehicle.wrench_limits, strict=True)):
        tau = np.abs(inputs.force[:, i])
        if not tau.any() or limit == 0.0:
            continue
        beyond = float((tau > 1.05 * limit).sum() / (tau > 0.0).sum())
        if beyond > OFTEN:
            fields: dict[str, Any] = {
                "column": inputs.names[i],
                "limit": float(limit),
                "unit": "N" if i < 3 else "N m",
                "vehicle": vehicle.name,
                "share": beyond,
                "axis": str(axis),
            }
            findings.append(
                finding("command_beyond", **fields)
                if inputs.commanded
                else finding("wrench_beyond", **fields)
            )
    return findings


def _thrusters(trial: Trial, vehicle: Vehicle, inputs: InputForces) -> list[Finding]:
    findings = []
    at_limit: list[str] = []
    slow: list[str] = []
    still: list[str] = []
    requested = inputs.commanded and inputs.source != "pwm"
    for name, force in zip(inputs.names, inputs.force.T, strict=True):
        thruster = vehicle.thrusters[name]
        driven = np.abs(force) > 0.0
        if not driven.any():
            still.append(name)
            continue
        beyond = (force > 0.99 * thruster.force_max) | (force < 0.99 * thruster.force_min)
        if inputs.source == "rpm":
            _, rpm = trial.series(f"rpm_{name}")
            beyond = (rpm > 0.99 * thruster.rpm_max) | (rpm < 0.99 * thruster.rpm_min)
        if beyond.mean() > OFTEN * driven.mean():
            at_limit.append(name)
        # Of measured speeds and of pulses the thrust is known down to nothing.
        rpm = thruster.speed(force) * 30.0 / np.pi
        if requested and _in_dead_zone(rpm, thruster.dead_rpm_minus, thruster.dead_rpm_plus) > 0.2:
            slow.append(name)
    if at_limit:
        findings.append(finding("saturated", thrusters=tuple(at_limit), share=OFTEN))
    if slow:
        findings.append(finding("in_dead_zone", thrusters=tuple(slow)))
    if still:
        findings.append(finding("never_pushed", thrusters=tuple(still)))
    return findings


def _in_dead_zone(rpm: Array, lowest: float, highest: float) -> float:
    """Return the share of the driven time in which a shaft would not turn."""
    driven = np.abs(rpm) > 1.0
    inside = (rpm > 0.95 * lowest) & (rpm < 0.95 * highest) & driven
    return float(inside.sum() / max(1, driven.sum()))


# Identifiability of each parameter of an axis in a trial, with the reasons.

SEPARATE = 0.6
"""Decades of speed that are needed to distinguish linear and quadratic damping."""

LEAST_TILT = np.radians(1.0)
"""Standard deviation of an angle that its restoring moment needs [rad]."""

SHORT = 0.5
"""Time over which a change of speed is looked for [s]."""

LEAST_INERTIA = 0.05
"""Part of the strongest wrench that went into a change of speed, for the effective mass to be seen."""


def with_identifiability(
    report: AxisReport,
    motion: Motion,
    inputs: InputForces,
    vehicle: Vehicle,
    measured: Mapping[str, tuple[Array, Array]],
) -> AxisReport:
    """Return the report with the identifiability of the axis; `measured` as the trial has it, in its units."""
    specific = {"k": ("roll", "pitch"), "buoyancy": ("heave",)}
    names = [name for name in PARAMETERS if report.axis in specific.get(name, AXES)]
    passive = inputs.source == "passive"
    if blocked := _blocked(report, inputs, motion, measured):
        report = replace(report, excited=report.excited and not passive)
        return replace(report, tells={name: Identifiability(can=False, why=blocked) for name in names})
    verdicts = (
        _passive_identifiability(report) if passive else _driven_identifiability(report, motion, vehicle)
    )
    return replace(
        report, tells={name: Identifiability(can=verdicts[name][0], why=verdicts[name][1]) for name in names}
    )


def _blocked(
    report: AxisReport, inputs: InputForces, motion: Motion, measured: Mapping[str, tuple[Array, Array]]
) -> str:
    """Return why the axis determines nothing at all, or nothing; without thrust the fit's own reason."""
    if not report.source:
        return f"no velocity: {NO_VELOCITY[report.axis]}"
    if inputs.source == "passive":
        try:
            free_motion(motion, measured, report.axis)
        except CalibrationError as error:
            return error.reason
        return ""
    if not np.isfinite(report.fastest):
        return "velocity and input are never known together"
    if report.excited and report.coasts > 10.0 * report.driven and report.axis not in ("roll", "pitch"):
        return f"driven for {report.driven:.1f} s and moving for {report.coasts:.0f} s without: something else moves it"
    if report.excited:
        return ""
    if report.strongest < 1e-6:
        return "not driven"
    if report.fastest <= max(3.0 * report.noise, 0.005):
        return f"no motion above the noise: speeds up to {report.fastest:.2g}, noise {report.noise:.2g}"
    return f"moves, but is hardly driven: wrench up to {report.strongest:.2g}"


NO_VELOCITY = {
    "surge": "neither u nor x, y with a heading",
    "sway": "neither v nor x, y with a heading",
    "heave": "no w, z or depth",
    "roll": "neither p nor an attitude",
    "pitch": "neither q nor an attitude",
    "yaw": "neither r nor a heading",
}


def _damping(report: AxisReport) -> dict[str, tuple[bool, str]]:
    reason = f"{report.decades:.1f} decades of speed up to {report.fastest:.2g}"
    if report.decades < SEPARATE:
        reason += ": only their sum at that speed; more levels or a coast would part them"
    elif report.decades < 1.0:
        reason += ", less than one: intervals will be wide"
    return dict.fromkeys(("d1", "d2"), (report.decades >= SEPARATE, reason))


def _passive_identifiability(report: AxisReport) -> dict[str, tuple[bool, str]]:
    """Return for each parameter whether a trial without thrust determines it, and why."""
    force = {"heave": "buoyancy excess", "roll": "restoring moment", "pitch": "restoring moment"}.get(
        report.axis
    )
    unknown = (False, "passive, and no force along this axis is known: d1/m_eff and d2/m_eff alone")
    return {
        "m_eff": (True, f"passive: relative to the vehicle file's {force}") if force else unknown,
        **_damping(report),
        **dict.fromkeys(("k", "buoyancy"), (False, "passive: sets the scale of the others")),
    }


def _driven_identifiability(
    report: AxisReport, motion: Motion, vehicle: Vehicle
) -> dict[str, tuple[bool, str]]:
    """Return for each parameter whether a trial with inputs determines it, and why."""
    i, q = AXES.index(report.axis), motion.quaternion
    n = max(1, round(SHORT * motion.rate))
    change = np.abs(motion.nu[n:, i] - motion.nu[:-n, i])
    fastest = float(np.nanmax(change)) if np.isfinite(change).any() else 0.0
    impulse = float(vehicle.rigid_body_mass_matrix()[i, i]) * fastest
    turns = impulse >= LEAST_INERTIA * report.strongest * SHORT and fastest >= 3.0 * report.noise
    valid = np.isfinite(q).all(axis=1)
    # Small angles about the mean.
    angle = 2.0 * float(np.std(q[valid, 0 if report.axis == "roll" else 1])) if valid.sum() >= 10 else 0.0
    k = (
        f"{report.axis} angle varies by {np.degrees(angle):.2g}°"
        if valid.sum() >= 10
        else "no roll and pitch"
    )
    floats = report.coasts >= 1.0 or report.rests >= 1.0 or report.both_directions
    buoyancy = "one direction and no coast: goes with d1; dive and coast"
    if floats:
        coasts = report.coasts >= 1.0
        buoyancy = f"{report.coasts:.1f} s of coasting" if coasts else "driven both ways or at rest"
    return {
        "m_eff": (
            turns,
            "the speed changes" if turns else "speeds hardly change: steps, pulses or coasts are missing",
        ),
        **_damping(report),
        "k": (angle >= LEAST_TILT, k if angle >= LEAST_TILT or valid.sum() < 10 else f"{k} only"),
        "buoyancy": (floats, buoyancy),
    }


# Whether a trial's numbers agree with each other: units, signs, axes.

RATE = 25.0
"""Rate of the grid on which columns are compared [Hz]."""

AGAINST = -0.5
"""Correlation below which two columns that should agree run against each other."""

NEGATIVE = 4.0
"""Factor by which noise, smoothing and errors of scale change a slope of -1 at most."""

WITH = 0.7
"""Correlation above which their ratio means something."""

FEWEST = 25
"""Points of a grid with motion that a comparison needs."""

DEGREES = 57.3

DRIFTS = 0.2
"""Range of the heading less the integrated gyro and its constant error that is a drift [rad]."""

WALK = 2.5
"""Range of a random walk without its trend, in standard deviations of its end, that chance hardly exceeds."""

WIGGLES = 10.0
"""Independent values that a smoother may leave of pure noise."""

LARGEST_TURN = 1.0
"""Turn between two samples of an attitude above which its rates may be aliases [rad]."""

STEEP = 0.6
"""Cosine of the pitch below which the heading means nothing."""

LEVEL = 0.7
"""Cosine of the tilt below which restoring moments act on yaw and weight on surge and sway."""

GYRO_BIAS = 0.03
"""Steady difference between heading and integrated gyro that no calibrated gyro has [rad/s]."""


def unit_findings(trial: Trial) -> list[Finding]:
    """Return findings about angles in degrees, recognised by values that radians cannot have."""
    findings = []
    for name, limit in (("roll", 1.05 * np.pi), ("pitch", 0.55 * np.pi)):
        _, y = trial.series(name)
        if len(y) and np.abs(y).max() > limit:
            findings.append(_degrees(name, float(np.abs(y).max()), "rad"))
    _, yaw = trial.series("yaw")
    if len(yaw) > 1:
        jumps = np.abs(np.diff(yaw))
        if np.abs(yaw).max() > 2.5 * np.pi and (np.any(np.abs(jumps - 360.0) < 30.0) or not trial.has("r")):
            findings.append(_degrees("yaw", float(np.abs(yaw).max()), "rad"))
    return findings


def _degrees(name: str, value: float, unit: str) -> Finding:
    return finding("degrees", column=name, value=value, unit=unit)


def frame_findings(trial: Trial, vehicle: Vehicle) -> list[Finding]:
    """Gravity against the attitude, rates against its changes, velocity against those of position and depth."""
    t = np.arange(trial.t[0], trial.t[-1], 1.0 / RATE)
    if len(t) < FEWEST:
        return []
    attitude = attitude_signal(trial, t)
    return [
        *_gravity(trial, vehicle.water.gravity, t, attitude),
        *_rates(trial, t, attitude),
        *_heading(trial),
        *_vertical(trial, t, attitude),
        *_horizontal(trial, t, attitude),
    ]


def _gravity(trial: Trial, g: float, t: Array, attitude: AttitudeSignal) -> list[Finding]:
    if not trial.has("az") or trial.header.acceleration == "kinematic":
        return []
    f, _ = on_grid(trial, ("ax", "ay", "az"), t)
    f = np.nan_to_num(f[np.isfinite(f[:, 2])])
    mean = np.linalg.norm(f.mean(axis=0))
    usual = np.median(np.linalg.norm(f, axis=1))  # of a vehicle that turns over, too
    for size, unit, scale in (
        (1.0, "g", 9.80665),
        (1000.0, "milli-g", 9.80665e-3),
        (100.0 * g, "cm/s²", 0.01),
    ):
        if abs(mean / size - 1.0) < 0.15 and abs(usual / size - 1.0) < 0.3:
            return [finding("acceleration_unit", value=mean, unit=unit, factor=scale)]
    if not holds_gravity(trial, g):
        if abs(mean / g - 1.0) < 0.2:
            return [finding("gravity_wrong_way", az=f.mean(axis=0)[2])]
        return [finding("no_gravity")] if mean < 0.3 * g else []
    up = up_in_body(attitude.quaternion) if attitude.tilt else np.tile([0.0, 0.0, 1.0], (len(t), 1))
    f, _ = on_grid(trial, ("ax", "ay", "az"), t)
    good = np.isfinite(f).all(axis=1) & np.isfinite(up).all(axis=1)
    if good.sum() < FEWEST:
        return []
    f, up = f[good], up[good]
    middle, expected = np.median(f, axis=0), np.median(up, axis=0)
    cosine = float(middle @ expected / (np.linalg.norm(middle) * np.linalg.norm(expected)))
    if cosine < -0.5:
        return [finding("gravity_wrong_way", az=middle[2])]
    findings = []
    if cosine < np.cos(np.radians(15.0)):
        against = "the attitude" if attitude.tilt else "level"
        angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
        # Without an attitude a vehicle that is level at any time shows that its accelerometer is.
        cosines = np.sum(f * up, axis=1) / np.linalg.norm(f, axis=1)
        if attitude.tilt or np.percentile(cosines, 98.0) < np.cos(np.radians(15.0)):
            findings.append(finding("accelerometer_turned", angle=angle, reference=against))
    for i, angle_name in ((0, "pitch"), (1, "roll")):
        swing = g * np.std(up[:, i])
        if swing > 0.4 and _against(relation(g * up[:, i], f[:, i], nuisances=np.ones((len(f), 1)))):
            findings.append(finding("acceleration_sign", column=f"a{'xy'[i]}", angle=angle_name))
    return findings


def _rates(trial: Trial, t: Array, attitude: AttitudeSignal) -> list[Finding]:
    findings: list[Finding] = []
    _, q, _ = attitude_samples(trial)
    if len(q) < FEWEST or _too_slow(trial, q):
        return []
    gyro, _ = on_grid(trial, ("p", "q", "r"), t)
    angles = quat_to_euler(q)
    for i, (rate, angle) in enumerate((("p", "roll"), ("q", "pitch"), ("r", "yaw"))):
        derived = attitude.rates[:, i]
        moving = (
            np.isfinite(gyro[:, i]) & np.isfinite(derived) & (np.abs(derived) > 3.0 * attitude.rates_std[i])
        )
        if moving.sum() < FEWEST or not _stands_out(derived, np.unwrap(angles[i])):
            continue
        found = relation(derived, gyro[:, i], nuisances=np.ones((len(t), 1)))  # a gyro may have a bias
        with_it = found.correlation > WITH and found.sure
        if _against(found):
            findings.append(finding("rate_sign", column=rate, other=angle))
        elif with_it and 0.6 * DEGREES < found.slope < 1.6 * DEGREES:
            findings.append(_degrees(rate, float(np.abs(gyro[:, i][moving]).max()), "rad/s"))
        elif with_it and 0.6 < found.slope * DEGREES < 1.6:
            findings.append(
                _degrees(angle, float(np.nanmax(np.abs(trial.channels.get(angle, derived)))), "rad")
            )
    return findings


def _heading(trial: Trial) -> list[Finding]:
    """The heading against the integrated gyro, psi_dot = (q sin(roll) + r cos(roll)) / cos(pitch)."""
    t, r = trial.series("r")
    at, q, named = attitude_samples(trial)
    if len(t) < FEWEST or "yaw" not in named or len(at) < FEWEST or _too_slow(trial, q):
        return []
    roll, pitch, yaw = quat_to_euler(q)
    inside = (t >= at[0]) & (t <= at[-1])
    if inside.sum() < FEWEST:
        return []
    t, r = t[inside], r[inside]
    phi, theta = np.interp(t, at, roll), np.interp(t, at, pitch)
    q_at = np.interp(t, *trial.series("q")) if trial.has("q") else np.zeros(len(t))
    if not {"roll", "pitch"} & set(named) and _tilts_unseen(trial):
        return []
    rate = (q_at * np.sin(phi) + r * np.cos(phi)) / np.maximum(np.cos(theta), STEEP)
    # A gap of the gyro hides a turn, and a vehicle on its nose has no heading: each stretch starts again.
    step = np.diff(t)
    wide = (step > longest_step(t)) | (np.cos(theta[1:]) < STEEP) | (np.cos(theta[:-1]) < STEEP)
    turns = np.where(wide, 0.0, 0.5 * (rate[1:] + rate[:-1]) * step)
    turned = np.concatenate([[0.0], np.cumsum(turns)])
    difference = np.interp(t, at, np.unwrap(yaw)) - turned
    for edge in np.flatnonzero(wide):
        difference[edge + 1 :] += difference[edge] - difference[edge + 1]
    bias, _ = np.polyfit(t - t[0], difference, 1) if t[-1] - t[0] > 5.0 else (0.0, 0.0)
    rest = difference - bias * (t - t[0])
    noise = 1.4826 * float(np.median(np.abs(np.diff(difference)))) * 6.0
    # Noise of the gyro adds up to a random walk, and every second sample shows what is lost between samples.
    noise += WALK * white_noise(r) * float(np.sqrt(np.median(step) * (t[-1] - t[0])))
    coarse = np.cumsum(0.5 * (rate[2::2] + rate[:-2:2]) * (step[1::2] + step[: 2 * (len(step) // 2) : 2]))
    noise += float(np.ptp(coarse - np.cumsum(0.5 * (rate[1:] + rate[:-1]) * step)[1::2]))
    wander = float(np.ptp(rest)) - noise
    if wander < DRIFTS and abs(bias) * (t[-1] - t[0]) < GYRO_BIAS * (t[-1] - t[0]) + noise:
        return []
    drift = float(np.ptp(difference)) - noise
    return [finding("heading_drift", drift=drift)]


def _vertical(trial: Trial, t: Array, attitude: AttitudeSignal) -> list[Finding]:
    _, up = on_grid(trial, ("z", "depth"), t, 3)
    moves = [
        np.nanstd(rate) > 0.01 and _stands_out(rate, trial.series(name)[1])
        for name, rate in zip(("z", "depth"), up.T, strict=True)
        if np.isfinite(rate).sum() >= FEWEST
    ]
    if sum(moves) == 2:
        if _against(relation(-up[:, 1], up[:, 0], nuisances=np.ones((len(t), 1)))):
            return [finding("z_down")]
        if wrong_unit := _unit_ratio(-up[:, 1], up[:, 0], "z", "depth"):
            return wrong_unit
    if not attitude.tilt and _tilts_unseen(trial):
        return []
    vertical = "z" if trial.has("z") else "depth"
    rising = np.where(np.isfinite(up[:, 0]), up[:, 0], -up[:, 1])
    through = _through_world(trial, t, attitude)[:, 2]
    good = np.isfinite(rising) & np.isfinite(through)
    if good.sum() < FEWEST or min(np.std(rising[good]), np.std(through[good])) < 0.015:
        return []
    if not _stands_out(np.where(good, rising, np.nan), trial.series(vertical)[1]):
        return []
    found = relation(rising, through, nuisances=np.ones((len(t), 1)))
    if _against(found):
        return [finding("rate_sign", column="w", other=vertical)]
    return _unit_ratio(through, rising, vertical, "w") if attitude.tilt else []


def _unit_ratio(x: Array, y: Array, of: str, over: str) -> list[Finding]:
    """Return a finding if y surely goes with x and is another multiple of it than noise in either explains."""
    one = np.ones((len(x), 1))
    found, back = relation(x, y, nuisances=one), relation(y, x, nuisances=one)
    if found.correlation < WITH or not found.sure:
        return []
    low, high = found.slope, 1.0 / back.slope
    if low > 1.6 or high < 0.6:
        return [finding("speed_ratio", columns=of, ratio=float(np.sqrt(low * high)), velocity=over)]
    return []


def _horizontal(trial: Trial, t: Array, attitude: AttitudeSignal) -> list[Finding]:
    if not (trial.has("x", "y", "u", "v") and attitude.heading):
        return []
    if not attitude.tilt and _tilts_unseen(trial):
        return []
    _, world = on_grid(trial, ("x", "y"), t, 3)
    through = _through_world(trial, t, attitude)[:, :2]
    good = np.isfinite(world).all(axis=1) & np.isfinite(through).all(axis=1)
    if good.sum() < FEWEST or min(np.std(world[good]), np.std(through[good])) < 0.02:
        return []
    if not any(_stands_out(world[good, i], trial.series("xy"[i])[1]) for i in range(2)):
        return []
    a, b = (v[good, 0] + 1j * v[good, 1] for v in (through, world))
    size = np.linalg.norm(a) * np.linalg.norm(b)
    turned, mirrored = np.vdot(a, b) / size, np.vdot(a.conj(), b) / size
    likelier = mirrored if abs(mirrored) > abs(turned) else turned
    expected = through * [1.0, -1.0 if likelier is mirrored else 1.0]
    c, s = likelier.real / abs(likelier), likelier.imag / abs(likelier)
    expected = expected @ np.array([[c, s], [-s, c]])
    if not relation(np.where(good[:, None], expected, np.nan).T.ravel(), world.T.ravel()).sure:
        return []
    if abs(turned) > WITH and abs(np.angle(turned)) > np.radians(15.0):
        angle = float(np.degrees(np.angle(turned)))
        return [finding("heading_disagrees", angle=angle)]
    if abs(mirrored) > WITH > abs(turned) + 0.3:
        return [finding("mirrored")]
    ratio = float(np.linalg.norm(b) / np.linalg.norm(a))
    if abs(turned) > WITH and not 0.6 < ratio < 1.6:
        return [finding("speed_ratio", columns="x, y", ratio=ratio, velocity="u, v")]
    return []


def _through_world(trial: Trial, t: Array, attitude: AttitudeSignal) -> Array:
    nu, _ = on_grid(trial, ("u", "v", "w"), t)
    valid = np.isfinite(attitude.turn).all(axis=1)
    through = quat_rotate(np.where(valid[:, None], attitude.turn, [0.0, 0.0, 0.0, 1.0]), np.nan_to_num(nu))
    if attitude.heading:
        through[~valid] = np.nan
    through[~np.isfinite(nu[:, :2]).all(axis=1), :2] = np.nan
    through[~np.isfinite(nu[:, 2]), 2] = np.nan
    return np.asarray(through)


def _too_slow(trial: Trial, q: Array) -> bool:
    """Return whether a vehicle turns so far between two samples of its attitude that their rates may be aliases.

    The gyro has to say so too: an angle in degrees turns far by itself.
    """
    turns = 2.0 * np.arccos(np.clip(np.abs(np.sum(q[1:] * q[:-1], axis=1)), 0.0, 1.0))
    step = trial.duration / max(len(q) - 1, 1)
    gyro = [float(np.percentile(np.abs(trial.series(name)[1]), 98.0)) for name in "pqr" if trial.has(name)]
    return bool(np.percentile(turns, 98.0) > LARGEST_TURN and max(gyro, default=0.0) * step > LARGEST_TURN)


def _tilts_unseen(trial: Trial) -> bool:
    """Return whether the gyro shows tilts of a vehicle that is taken as level for want of a measured tilt."""
    for t, rate in (trial.series(name) for name in "pq" if trial.has(name)):
        if np.ptp(np.cumsum((rate - np.median(rate))[1:] * np.diff(t))) > LARGEST_TURN:
            return True
    return False


def _stands_out(rates: Array, samples: Array) -> bool:
    """Return whether what changed at these rates on the grid moved by more than a smoother makes of the noise."""
    moved = np.cumsum(np.nan_to_num(rates - np.nanmean(rates))) / RATE
    return not float(np.std(moved)) < white_noise(samples) * np.sqrt(WIGGLES / len(samples))


def _against(found: Relation) -> bool:
    """Return whether a signal is significantly the negative of another that it should equal."""
    return found.correlation < AGAINST and found.sure and -NEGATIVE < found.slope < -1.0 / NEGATIVE


# Excitation of every axis of a trial: speeds, wrenches, levels, coasts, work.

STANDS_OUT = 3.0
"""Speeds above so many standard deviations of a sample are motion."""

LEAST_SPEED = 0.005
"""[m/s, rad/s]; slower is rest."""

QUIET = 0.05
"""Part of the strongest wrench below which an axis coasts."""

LEAST_WRENCH = 0.01
"""Part of what the vehicle can give below which an axis is not driven."""

LONG_PUSH = 3.0
"""Time of input after which its work is significant for its sign [s]."""

HOLD = 0.5
"""[s]"""

UNLIKELY = 0.01
"""Probability below which a speed responds to its wrench, if the work agrees."""

ANSWERS = (0.1, 0.3, 1.0, 3.0, 10.0)
"""Time constants of the speeds of vehicles [s]."""


def axis_reports(
    motion: Motion, inputs: InputForces, vehicle: Vehicle, named: Sequence[str] = ()
) -> list[AxisReport]:
    """Return one report per axis, without identifiability.

    Weight rights roll and pitch, so that a swing excites them whatever started it, unless the header names others.
    """
    passive = inputs.source == "passive"
    swings = bool(np.any(inputs.force)) and not named
    return [
        _axis(i, motion, passive, vehicle, swings and i in (3, 4) and answers(motion, i)) for i in range(6)
    ]


def _axis(i: int, motion: Motion, passive: bool, vehicle: Vehicle, swings: bool) -> AxisReport:
    nu, tau, dt = motion.nu[:, i], motion.tau[:, i], 1.0 / motion.rate
    valid = np.isfinite(nu) & np.isfinite(tau)
    blank = AxisReport(axis=AXES[i], source=motion.nu_source[i])
    if valid.sum() < FEWEST_SPEEDS:
        return blank
    speed, wrench = np.abs(nu[valid]), np.abs(tau[valid])
    noise = float(np.nan_to_num(motion.noise_std[i]))
    floor = max(STANDS_OUT * noise, LEAST_SPEED)
    # Most of a trial may be rest: percentiles are of the times that are not.
    fastest = _strong(speed, floor)
    strongest = _strong(wrench, max(QUIET * float(wrench.max()), 1e-6))
    driven = strongest > LEAST_WRENCH * max(float(vehicle.wrench_limits[i]), 1e-3)
    quiet = np.abs(tau) <= QUIET * strongest if driven else np.ones(len(tau), bool)
    moving = np.abs(nu) > max(floor, QUIET * fastest)
    slowest = float(np.percentile(speed[speed > 0.5 * floor], 5.0)) if (speed > 0.5 * floor).any() else floor
    return replace(
        blank,
        fastest=fastest,
        noise=noise,
        decades=float(max(0.0, np.log10(max(fastest, 1e-9) / max(slowest, noise, 1e-9)))),
        strongest=strongest,
        work=0.0 if passive else float(np.sum((tau * nu)[valid]) * dt),
        both_directions=bool(min((nu[valid] > floor).sum(), (nu[valid] < -floor).sum()) * dt > HOLD),
        driven=float((valid & ~quiet).sum() * dt),
        coasts=float((valid & quiet & moving).sum() * dt),
        rests=float((valid & quiet & ~moving).sum() * dt),
        excited=bool(swings or fastest > floor and (driven or passive)),
    )


def _strong(values: Array, least: float) -> float:
    """95th percentile of the values above `least`; of all where none is."""
    above = values[values > least]
    return float(np.percentile(above if len(above) else values, 95.0))


def work_findings(
    reports: list[AxisReport], motion: Motion, named: tuple[str, ...], excess: float = 0.0
) -> list[Finding]:
    """Return the axes on which the inputs took energy out, where drag should have: a sign is wrong.

    On roll and pitch the restoring moment gives back what it took. The work of the buoyancy that the vehicle file
    states is added to that of the inputs. What else may push (a tether, trim, a current) does not follow the inputs:
    the speed has to answer their changes the wrong way.

    Args:
        reports: By axis.
        motion: Of the trial.
        named: Axes that the header names.
        excess: Buoyancy less weight [N].
    """
    findings = []
    up = up_in_body(np.where(np.isfinite(motion.quaternion), motion.quaternion, [0.0, 0.0, 0.0, 1.0]))
    for i, report in enumerate(reports):
        if not report.excited or report.axis in ("roll", "pitch"):
            continue
        nu = motion.nu[:, i]
        tau = np.where(up[:, 2] > LEVEL, motion.tau[:, i], np.nan)
        power = (tau + (excess * up[:, i] if i < 3 else 0.0)) * nu
        both = np.isfinite(power)
        work, effort = float(np.sum(power[both])), float(np.sum(np.abs(power[both])))
        if effort == 0.0 or work > -0.4 * effort:
            continue
        answer = _answer(nu, tau, motion.rate)
        if answer.chance < UNLIKELY and answer.correlation < AGAINST:
            held = np.abs(tau[both]) > QUIET * report.strongest
            sure = report.axis in named or (not named and held.sum() / motion.rate > LONG_PUSH)
            findings.append(
                finding(
                    "energy_taken",
                    severity="refused"
                    if sure and work < -0.6 * effort and report.axis != "heave"
                    else "care",
                    work=-work / motion.rate,
                    axis=str(report.axis),
                    wrench=TAU[i],
                    velocity=NU[i],
                )
            )
    return findings


def _answer(nu: Array, tau: Array, rate: float) -> Relation:
    """Return how a speed follows its wrench through a first-order lag, besides a constant force and the start.

    The lag is the one of `ANSWERS` that explains most; the significance allows for the choice.
    """
    known = np.isfinite(nu) & np.isfinite(tau)
    relations = []
    for lag in ANSWERS:
        decay = np.exp(-1.0 / (rate * lag))
        followed = lfilter([1.0 - decay], [1.0, -decay], np.nan_to_num(tau))
        others = np.stack([np.ones(len(nu)), decay ** np.arange(len(nu))], axis=-1)
        relations.append(relation(np.where(known, followed, np.nan), nu, nuisances=others))
    best = max(relations, key=lambda found: abs(found.correlation))
    return best._replace(chance=len(ANSWERS) * best.chance)


def check(
    paths: Sequence[Path],
    *,
    vehicle: str | None = None,
    as_json: bool = False,
) -> int:
    """Report what trials can and cannot identify: rates [Hz], gaps [s], clock jumps, saturation, excitation.

    Example: finssim trials check trials --vehicle bluerov2

    Args:
        paths (TRIAL): Trial folders, folders of them, or bare .csv or .parquet tables.
        vehicle (NAME|FILE): Vehicle of the trials, if their headers name none.
        as_json: Print one JSON object instead of tables.

    Returns:
        Exit status: 0 if a trial can be used, 3 if every trial is refused.

    Raises:
        CalibrationError: There is no trial at a path.
        VehicleError: No such vehicle.
    """
    loaded = load_vehicle(vehicle) if vehicle is not None else None
    trials: list[Trial | TrialReport] = []
    for location in [location for path in paths for location in trials_at(Path(path))]:
        try:
            trials.append(load_trial(location))
        except CalibrationError as error:
            if len(paths) == 1 and location == Path(paths[0]):
                raise
            trials.append(TrialReport(name=location.name, findings=(finding("unusable", reason=str(error)),)))
    reports = check_trials(trials, loaded)
    common = set_findings(reports)
    status = 3 if all(report.verdict == "refused" for report in reports) else 0
    if as_json:
        records = [entry.as_json() for entry in reports], [entry.as_json() for entry in common]
        print(
            json.dumps(dict(zip(("trials", "together"), records, strict=True)), indent=2, ensure_ascii=False)
        )
        return status
    from rich.console import Console

    print_reports(reports, Console(), common)
    return status


def check_trials(trials: Sequence[Trial | TrialReport], vehicle: Vehicle | None = None) -> list[TrialReport]:
    """One report per trial; a trial that could not be read has its report already.

    Args:
        trials: In the order of the reports.
        vehicle: That made them; without it each trial's header names its own.
    """
    first_names: dict[str, str] = {}
    reports = []
    for trial in trials:
        report = trial if isinstance(trial, TrialReport) else _report_of(trial, vehicle)
        if report.sha256 and report.sha256 in first_names:
            twice = finding("duplicate", other=first_names[report.sha256])
            report = replace(report, findings=(*report.findings, twice))
        first_names.setdefault(report.sha256, report.name)
        reports.append(report)
    return reports


def _report_of(trial: Trial, user_vehicle: Vehicle | None) -> TrialReport:
    streams, findings = stream_reports(trial)
    findings += unit_findings(trial)
    report = TrialReport(
        name=trial.name,
        vehicle=user_vehicle.name if user_vehicle is not None else trial.header.vehicle,
        role=trial.header.role,
        duration=trial.duration,
        rows=len(trial.t),
        streams=tuple(streams),
        findings=tuple(findings),
        sha256=trial.sha256,
    )
    vehicle = user_vehicle or _header_vehicle(trial, findings)
    findings += implausible(trial, vehicle)
    if vehicle is None:
        return replace(report, findings=tuple(findings))
    inputs, axes = _motion_of(trial, vehicle, findings)
    findings += frame_findings(trial, vehicle)
    return replace(
        report,
        inputs=inputs,
        axes=tuple(axes),
        findings=tuple(dict.fromkeys(findings)),
    )


def _header_vehicle(trial: Trial, findings: list[Finding]) -> Vehicle | None:
    """The vehicle that the header names; findings say why there is none."""
    if trial.header.vehicle is None:
        findings.append(finding("no_vehicle"))
        return None
    try:
        return vehicle_of(trial)
    except VehicleError as error:
        findings.append(finding("vehicle_refused", reason=str(error)))
        return None


def _motion_of(trial: Trial, vehicle: Vehicle, findings: list[Finding]) -> tuple[str, list[AxisReport]]:
    """Return the kind of input and the report of every axis; findings are added."""
    try:
        inputs = drive(trial, vehicle)
    except CalibrationError as error:
        findings.append(finding("unusable", reason=error.reason))
        # The motion can be looked at without its cause.
        trial = replace(trial, header=trial.header.model_copy(update={"passive": True}))
        trial_motion = motion(trial, vehicle)
        unknown = [
            replace(axis, excited=False)
            for axis in axis_reports(trial_motion, drive(trial, vehicle), vehicle)
        ]
        return "", unknown
    findings += input_findings(trial, vehicle, inputs)
    trial_motion = motion(trial, vehicle)
    findings += [entry for entry in trial_motion.findings if entry not in findings]
    measured = compared_columns(trial)
    axes = [
        with_identifiability(axis, trial_motion, inputs, vehicle, measured)
        for axis in axis_reports(trial_motion, inputs, vehicle, trial.header.axis)
    ]
    density = (trial.header.water.density or vehicle.water.density) / vehicle.water.density
    excess = vehicle.buoyancy * density - vehicle.weight
    findings += work_findings(axes, trial_motion, trial.header.axis, excess)
    if not any(axis.excited or any(one.can for one in axis.tells.values()) for axis in axes):
        moved = any(axis.source for axis in axes)
        findings.append(finding("nothing_excited") if moved else finding("nothing_measured"))
    for named in trial.header.axis:
        axis = next(axis for axis in axes if axis.axis == named)
        if not axis.excited:
            findings.append(finding("axis_still", axis=str(named)))
    return inputs.source, axes
