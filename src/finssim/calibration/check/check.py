"""`finssim trials check`: what trials can and cannot identify, and why."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from finssim.calibration.check.axes import axis_reports, work_findings
from finssim.calibration.check.frames import frame_findings, unit_findings
from finssim.calibration.check.inputs import input_findings
from finssim.calibration.check.report import AxisReport, Finding, TrialReport
from finssim.calibration.check.streams import stream_reports
from finssim.calibration.check.tells import with_tells
from finssim.calibration.check.together import together
from finssim.calibration.errors import CalibrationError
from finssim.calibration.motion.signals import motion
from finssim.calibration.motion.synchronisation import Offset, stream_offsets
from finssim.calibration.trials.inputs import drive
from finssim.calibration.trials.trial import Trial
from finssim.calibration.trials.trial_files import load_trial, trials_at
from finssim.vehicles import Vehicle, VehicleError, load_vehicle

__all__ = ["check", "check_trials"]

LATE = 0.03
"""Offset between streams that a fit must know of [s]."""


def check(paths: Sequence[Path], *, vehicle: str | None = None, as_json: bool = False) -> None:
    """Check trials and print what was found.

    Args:
        paths: Each a trial, or a folder that holds trials.
        vehicle: Name or file; before those that the trials name.
        as_json: One JSON object instead of tables.

    Raises:
        CalibrationError: There is no trial at a path.
        VehicleError: No such vehicle.
    """
    given = load_vehicle(vehicle) if vehicle is not None else None
    trials: list[Trial | TrialReport] = []
    for place in [place for path in paths for place in trials_at(Path(path))]:
        try:
            trials.append(load_trial(place))
        except CalibrationError as error:
            if len(paths) == 1 and place == Path(paths[0]):
                raise
            trials.append(_refused(place.name, None, str(error)))
    reports = _checked(trials, given)
    common = together(reports)
    if as_json:
        print(json.dumps(as_object(reports, common), indent=2, ensure_ascii=False))
        return
    from rich.console import Console

    from finssim.calibration.check.tables import print_reports

    print_reports(reports, Console(), common)


def check_trials(trials: Sequence[Trial], vehicle: Vehicle | None = None) -> list[TrialReport]:
    """One report per trial.

    Args:
        trials: In the order of the reports.
        vehicle: That made them; without it each trial's header names its own.
    """
    return _checked(trials, vehicle)


def as_object(reports: Sequence[TrialReport], common: Sequence[Finding]) -> dict[str, Any]:
    """What `--json` prints."""
    return {
        "trials": [report.as_json() for report in reports],
        "together": [{"level": finding.level, "text": finding.text} for finding in common],
    }


def _checked(trials: Sequence[Trial | TrialReport], vehicle: Vehicle | None) -> list[TrialReport]:
    seen: dict[str, str] = {}
    reports = []
    for trial in trials:
        report = trial if isinstance(trial, TrialReport) else _one(trial, vehicle)
        if report.sha256 and report.sha256 in seen:
            twice = f"holds the same numbers as {seen[report.sha256]}, which would count twice: leave one out"
            report = replace(report, findings=(*report.findings, Finding("refused", twice)))
        seen.setdefault(report.sha256, report.name)
        reports.append(report)
    return reports


def _refused(name: str, vehicle: str | None, reason: str) -> TrialReport:
    return TrialReport(
        name=name,
        vehicle=vehicle,
        role=None,
        duration=0.0,
        rows=0,
        inputs="",
        streams=(),
        axes=(),
        offsets={},
        findings=(Finding("refused", reason),),
    )


def _one(trial: Trial, given: Vehicle | None) -> TrialReport:
    streams, findings = stream_reports(trial)
    findings += unit_findings(trial)
    report = TrialReport(
        name=trial.name,
        vehicle=given.name if given is not None else trial.header.vehicle,
        role=trial.header.role,
        duration=trial.duration,
        rows=len(trial.t),
        inputs="",
        streams=tuple(streams),
        axes=(),
        offsets={},
        findings=tuple(findings),
        sha256=trial.sha256,
    )
    vehicle = given or _own_vehicle(trial, findings)
    if vehicle is None:
        return replace(report, findings=tuple(findings))
    inputs, axes = _motion_of(trial, vehicle, findings)
    offsets = stream_offsets(trial, vehicle)
    late = {group: o for group, o in offsets.items() if abs(o.seconds) > max(LATE, 3.0 * o.std)}
    findings += [_offset(group, offset) for group, offset in late.items()]
    findings += frame_findings(trial, vehicle, offsets)
    return replace(
        report,
        inputs=inputs,
        axes=tuple(axes),
        offsets={group: offset._asdict() for group, offset in offsets.items()},
        findings=tuple(dict.fromkeys(findings)),
    )


def _own_vehicle(trial: Trial, findings: list[Finding]) -> Vehicle | None:
    """The vehicle that the header names; findings say why there is none."""
    if trial.header.vehicle is None:
        findings.append(
            Finding(
                "refused",
                "no vehicle: give --vehicle, or 'vehicle: NAME' in trial.yaml; only the sampling was checked",
            )
        )
        return None
    named = trial.header.vehicle
    beside = Path(trial.path or ".") / named
    try:
        return load_vehicle(beside if beside.is_file() else named)
    except VehicleError as error:
        findings.append(Finding("refused", f"trial.yaml: vehicle: {error}"))
        return None


def _motion_of(trial: Trial, vehicle: Vehicle, findings: list[Finding]) -> tuple[str, list[AxisReport]]:
    """What drove the vehicle, and every axis; findings are added."""
    try:
        inputs = drive(trial, vehicle)
    except CalibrationError as error:
        findings.append(Finding("refused", str(error).removeprefix(f"{trial.name}: ")))
        # The motion can be looked at without its cause.
        trial = replace(trial, header=trial.header.model_copy(update={"passive": True}))
        seen = motion(trial, vehicle)
        unknown = [
            replace(axis, excited=False) for axis in axis_reports(seen, drive(trial, vehicle), vehicle)
        ]
        return "", unknown
    findings += input_findings(trial, vehicle, inputs)
    seen = motion(trial, vehicle)
    known = {finding.text for finding in findings}
    findings += [Finding("note", note) for note in seen.notes if note not in known]
    axes = [with_tells(axis, seen, inputs, vehicle) for axis in axis_reports(seen, inputs, vehicle)]
    findings += work_findings(axes, seen, trial.header.axis)
    if not any(told.can for axis in axes for told in axis.tells.values()):
        moved = ", ".join(axis.axis for axis in axes if axis.source)
        findings.append(
            Finding(
                "refused",
                "no axis is excited: nothing can be identified"
                if moved
                else "no velocity, rate, attitude or depth to go by",
            )
        )
    for named in trial.header.axis:
        axis = next(axis for axis in axes if axis.axis == named)
        if not axis.excited:
            findings.append(Finding("care", f"trial.yaml says {named}, and {named} is not excited"))
    return inputs.source, axes


def _offset(group: str, offset: Offset) -> Finding:
    # Slow motion looks alike at several offsets: a single trial is believed if the streams agree very well.
    sure = abs(offset.seconds) > 6.0 * offset.std and offset.correlation > 0.95
    return Finding(
        "care" if sure else "note",
        f"{group} comes {abs(offset.seconds):.3f} s {'early' if offset.seconds > 0.0 else 'late'} against "
        f"{offset.reference} (± {2.0 * offset.std:.3f} s): "
        f"give 'convert: {{time_offset: {{{group}: {offset.seconds:.3f}}}}}'",
    )
