"""Implementation of `finssim trials check`: the parameters that trials can and cannot identify, with reasons."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.signal import lfilter

from finssim.trials.findings import CalibrationError, Finding, finding, listed
from finssim.trials.free_motion import FEWEST_SPEEDS, compared_columns, free_motion
from finssim.trials.inputs import InputForces, drive, implausible, no_input, widest_step, within_reach
from finssim.trials.motion import Motion, answers, motion, up_in_body
from finssim.trials.significance import Relation, relation
from finssim.trials.trial import COLUMNS, NU, TAU, Array, Trial, column_of
from finssim.trials.trial_files import load_trial, trials_at, vehicle_of
from finssim.vehicles import AXES, Vehicle, VehicleError, load_vehicle

if TYPE_CHECKING:
    pass

from finssim.trials.agreement import AGAINST, LEVEL, frame_findings, unit_findings
from finssim.trials.trial_report import (
    PARAMETERS,
    AxisReport,
    Identifiability,
    StreamReport,
    TrialReport,
    print_reports,
    set_findings,
)

# Sampling of a trial's columns: rates, gaps, jitter, values that stick, are held or clip.

LONGEST_MISSING = 0.2
"""Fraction of a trial without samples of a stream above which a warning is given."""

SHORTEST_TRIAL = 1.0
"""Shortest usable trial [s]."""

STUCK = 1.0
"""Duration of equal values of a moving sensor that is suspicious [s]."""

FLYING = 0.3
"""Implausible height of the vehicle above the surface, which indicates another zero of the log [m]."""

COARSE = 50.0
"""Number of resolution steps that a signal must span for equal values to be meaningful."""

FEW_HERTZ = 4.0
"""Rate below which the motion between samples is not resolved [Hz]."""


def stream_reports(trial: Trial) -> tuple[list[StreamReport], list[Finding]]:
    """Return the columns grouped by their common times, and findings about their sampling."""
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
    longest = widest_step(t)
    within = steps[steps <= longest]  # at least half of them
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
    """Return findings about stuck, held and clipped values of a measurement."""
    column = COLUMNS.get(name)
    if column is None or column.group == "command":
        return []
    t, y = trial.series(name)
    if len(y) < 20:
        return []
    if np.ptp(y) == 0.0:
        return [finding("constant", value=y[0])]
    wild = ~within_reach(name, y)
    findings = []
    if wild.any():
        findings.append(finding("wild", samples=wild.sum(), value=np.abs(y).max(), unit=column.unit))
    if _coarse(y):
        return findings
    if name in ("z", "depth") and (above := float(np.percentile(y if name == "z" else -y, 99.0))) > FLYING:
        findings.append(finding("above_surface" if name == "z" else "depth_above_surface", height=above))
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
        # A signal that passes through its extreme reaches it only once.
        runs = lengths[y[begins] == extreme]
        if runs.sum() >= max(10.0, 0.02 * len(y)) and runs.max() >= 4.0 * usual:
            findings.append(
                finding("clipped_above" if highest else "clipped_below", value=extreme, samples=runs.sum())
            )
    return findings


def _coarse(y: Array) -> bool:
    """Return whether the resolution of a signal is so coarse that it repeats values."""
    steps = np.abs(np.diff(np.unique(y)))
    return bool(np.ptp(y) < COARSE * steps.min())


# Inputs of a trial against the limits of its vehicle.

OFTEN = 0.05
"""Fraction of the driven time at a limit above which a warning is given."""


def input_findings(trial: Trial, vehicle: Vehicle, inputs: InputForces) -> list[Finding]:
    """Return findings about the inputs: assumptions, time at the limits, in the dead zones and above the
    thrusters' capability."""
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
        beyond = float((tau > 1.05 * limit).sum() / max((tau > 0.0).sum(), 1)) if limit != 0.0 else 0.0
        if beyond > OFTEN:
            fields = {"column": inputs.names[i], "limit": float(limit), "unit": "N" if i < 3 else "N m"}
            fields |= {"vehicle": vehicle.name, "share": beyond, "axis": str(axis)}
            findings.append(finding("command_beyond" if inputs.commanded else "wrench_beyond", **fields))
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
        # From measured speeds and pulses, the thrust is known even at low values.
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
    """Return the fraction of the driven time in which a shaft would not turn."""
    driven = np.abs(rpm) > 1.0
    inside = (rpm > 0.95 * lowest) & (rpm < 0.95 * highest) & driven
    return float(inside.sum() / max(1, driven.sum()))


# Identifiability of each parameter of an axis in a trial, with the reasons.

SEPARATE = 0.6
"""Decades of speed required to distinguish linear and quadratic damping."""

LEAST_TILT = np.radians(1.0)
"""Standard deviation of an angle that is required to identify its restoring moment [rad]."""

SHORT = 0.5
"""Interval over which a change of speed is evaluated [s]."""

LEAST_INERTIA = 0.05
"""Fraction of the largest wrench that must accelerate the vehicle, for the effective mass to be identifiable."""


def with_identifiability(
    report: AxisReport,
    motion: Motion,
    inputs: InputForces,
    vehicle: Vehicle,
    measured: Mapping[str, tuple[Array, Array]],
) -> AxisReport:
    """Return the report with the identifiability of the axis; `measured` contains the trial's columns in its
    units."""
    specific = {"k": ("roll", "pitch"), "buoyancy": ("heave",)}
    names = [name for name in PARAMETERS if report.axis in specific.get(name, AXES)]
    passive = inputs.source == "passive"
    if blocked := _blocked(report, inputs, motion, measured):
        report = replace(report, excited=report.excited and not passive)
        verdicts = dict.fromkeys(names, (False, blocked))
    else:
        verdicts = (
            _passive_identifiability(report) if passive else _driven_identifiability(report, motion, vehicle)
        )
    return replace(report, identifiability={name: Identifiability(*verdicts[name]) for name in names})


def _blocked(
    report: AxisReport, inputs: InputForces, motion: Motion, measured: Mapping[str, tuple[Array, Array]]
) -> str:
    """Return why the axis identifies no parameter, empty if it does; without thrust the reason of the fit."""
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
        return f"driven for {report.driven:.1f} s and moving for {report.coasts:.0f} s without input: another force"
    if report.excited:
        return ""
    if report.strongest < 1e-6:
        return "not driven"
    if report.fastest <= max(3.0 * report.noise, 0.005):
        return f"no motion above the noise: speeds up to {report.fastest:.2g}, noise {report.noise:.2g}"
    return f"moves, but is hardly driven: wrench at most {report.strongest:.2g}"


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
        reason += ": only their sum at that speed; more levels or a coast would separate them"
    elif report.decades < 1.0:
        reason += ", less than one: intervals will be wide"
    return dict.fromkeys(("d1", "d2"), (report.decades >= SEPARATE, reason))


def _passive_identifiability(report: AxisReport) -> dict[str, tuple[bool, str]]:
    """Return for each parameter whether a trial without thrust identifies it, and why."""
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
    """Return for each parameter whether a trial with inputs identifies it, and why."""
    i, q = AXES.index(report.axis), motion.quaternion
    n = max(1, round(SHORT * motion.rate))
    change = np.abs(motion.nu[n:, i] - motion.nu[:-n, i])
    fastest = float(np.nanmax(change)) if np.isfinite(change).any() else 0.0
    impulse = float(vehicle.rigid_body_mass_matrix()[i, i]) * fastest
    turns = impulse >= LEAST_INERTIA * report.strongest * SHORT and fastest >= 3.0 * report.noise
    valid = np.isfinite(q).all(axis=1)
    angle, k = 0.0, "no roll and pitch"
    if valid.sum() >= 10:  # small angles about the mean
        angle = 2.0 * float(np.std(q[valid, 0 if report.axis == "roll" else 1]))
        k = f"{report.axis} angle varies by {np.degrees(angle):.2g}°"
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


# Excitation of every axis of a trial: speeds, wrenches, levels, coasts, work.

STANDS_OUT = 3.0
"""Number of standard deviations of the noise above which a speed counts as motion."""

LEAST_SPEED = 0.005
"""Speed below which the vehicle counts as at rest [m/s, rad/s]."""

QUIET = 0.05
"""Fraction of the largest wrench below which an axis coasts."""

LEAST_WRENCH = 0.01
"""Fraction of the vehicle's capability below which an axis is not driven."""

LONG_PUSH = 3.0
"""Duration of input after which the sign of its work is significant [s]."""

HOLD = 0.5
"""Duration for which a level of input must be held [s]."""

UNLIKELY = 0.01
"""Probability below which a response of the speed to its wrench is significant, if the work agrees."""

ANSWERS = (0.1, 0.3, 1.0, 3.0, 10.0)
"""Time constants that are tried for the response of the speed [s]."""


def axis_reports(
    motion: Motion, inputs: InputForces, vehicle: Vehicle, named: Sequence[str] = ()
) -> list[AxisReport]:
    """Return one report per axis, without identifiability.

    The restoring moment acts on roll and pitch, so that they are excited by any swing, unless the header
    names other axes.
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
    # A trial may consist mostly of rest: percentiles are computed over the remaining samples.
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
    """Return the 95th percentile of the values above `least`; of all values if none is above."""
    above = values[values > least]
    return float(np.percentile(above if len(above) else values, 95.0))


def work_findings(
    reports: list[AxisReport], motion: Motion, named: tuple[str, ...], excess: float = 0.0
) -> list[Finding]:
    """Return findings for axes on which the inputs extracted energy although drag dissipates it: a sign is wrong.

    On roll and pitch the restoring moment returns stored energy. The work of the vehicle file's buoyancy
    excess is added to that of the inputs. Other forces (a tether, trim, a current) do not follow the inputs:
    the speed must respond to changes of the inputs with the wrong sign.

    Args:
        reports: Reports by axis.
        motion: Motion of the trial.
        named: Axes that the header names.
        excess: Buoyancy minus weight [N].
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
            against = sure and work < -0.6 * effort and report.axis != "heave"
            fields = {
                "work": -work / motion.rate,
                "axis": str(report.axis),
                "wrench": TAU[i],
                "velocity": NU[i],
            }
            findings.append(finding("energy_taken", severity="refused" if against else "care", **fields))
    return findings


def _answer(nu: Array, tau: Array, rate: float) -> Relation:
    """Return the relation of a speed to its wrench through a first-order lag, with a constant force and
    initial speed.

    The lag is the one of `ANSWERS` with the best fit; the significance accounts for this selection.
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


def check(paths: Sequence[Path], *, vehicle: str | None = None, as_json: bool = False) -> int:
    """Report the parameters that trials can and cannot identify: rates [Hz], gaps [s], clock jumps,
    saturation, excitation.

    Example: finssim trials check trials --vehicle bluerov2

    Args:
        paths (TRIAL): Trial folders, folders of them, or bare .csv or .parquet tables.
        vehicle (NAME|FILE): Vehicle of the trials, if their headers do not name one.
        as_json: Print one JSON object instead of tables.

    Returns:
        Exit status: 0 if a trial can be used, 3 if every trial is refused.

    Raises:
        CalibrationError: There is no trial at a path.
        VehicleError: There is no such vehicle.
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
    """Return one report per trial; a trial that could not be read already has its report.

    Args:
        trials: Trials, in the order of the reports.
        vehicle: Vehicle of the trials; if None, each trial's header names it.
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
    return replace(report, inputs=inputs, axes=tuple(axes), findings=tuple(dict.fromkeys(findings)))


def _header_vehicle(trial: Trial, findings: list[Finding]) -> Vehicle | None:
    """Return the vehicle that the header names; a finding states why there is none."""
    if trial.header.vehicle is None:
        findings.append(finding("no_vehicle"))
        return None
    try:
        return vehicle_of(trial)
    except VehicleError as error:
        findings.append(finding("vehicle_refused", reason=str(error)))
        return None


def _motion_of(trial: Trial, vehicle: Vehicle, findings: list[Finding]) -> tuple[str, list[AxisReport]]:
    """Return the kind of input and the report of every axis; findings are appended."""
    try:
        inputs = drive(trial, vehicle)
    except CalibrationError as error:
        findings.append(finding("unusable", reason=error.reason))
        # The motion can be analysed without the inputs.
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
    if not any(
        axis.excited or any(one.identifiable for one in axis.identifiability.values()) for axis in axes
    ):
        moved = any(axis.source for axis in axes)
        findings.append(finding("nothing_excited" if moved else "nothing_measured"))
    for named in trial.header.axis:
        axis = next(axis for axis in axes if axis.axis == named)
        if not axis.excited:
            findings.append(finding("axis_still", axis=str(named)))
    return inputs.source, axes
