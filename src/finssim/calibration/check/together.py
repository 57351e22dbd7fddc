"""What holds between the trials of a set: vehicles, roles, names, what all of them tell together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from finssim.calibration.check.report import PARAMETERS, Finding, TrialReport
from finssim.vehicles import AXES

__all__ = ["together", "told_by"]


LATE = 0.03
"""Offset between streams that a fit must know of [s]."""

AGREE = 0.7
"""Correlation of two streams below which their offset is not counted."""


def told_by(reports: Sequence[TrialReport], axis: str, parameter: str) -> list[str]:
    """Names of the trials that tell a parameter of an axis; held-out and refused ones do not count."""
    return [
        report.name
        for report in reports
        if report.verdict != "refused" and report.role != "held-out"
        for found in report.axes
        if found.axis == axis and parameter in found.tells and found.tells[parameter].can
    ]


def together(reports: Sequence[TrialReport]) -> list[Finding]:
    """Findings about the set."""
    found = []
    vehicles = {report.vehicle for report in reports if report.vehicle}
    if len(vehicles) > 1:
        found.append(
            Finding("care", f"trials of several vehicles: {', '.join(sorted(vehicles))}: fit them one by one")
        )
    names = [report.name for report in reports]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        found.append(Finding("note", f"several trials are called {', '.join(twice)}"))
    good = [report for report in reports if report.verdict != "refused"]
    if reports and not good:
        found.append(Finding("refused", "no trial can be used"))
        return found
    held_out = [report.name for report in good if report.role == "held-out"]
    if held_out and len(held_out) == len(good):
        found.append(Finding("refused", "every usable trial is held out: nothing is left to fit"))
    elif not held_out and len(good) > 1:
        found.append(
            Finding("note", "no trial is held out: 'role: held-out' in trial.yaml keeps one for replay")
        )
    fitting = len(good) - len(held_out)
    if 0 < fitting < 5:
        few = f"{fitting} trial{'s' if fitting > 1 else ''} to fit"
        found.append(Finding("note", f"{few}: intervals from so few are wide and rest on assumptions"))
    found += _late(good)
    nothing = [a for a in AXES if not any(told_by(reports, a, parameter) for parameter in PARAMETERS)]
    if nothing and len(nothing) < len(AXES):
        found.append(Finding("note", f"no trial tells anything of {', '.join(nothing)}"))
    return found


def _late(reports: Sequence[TrialReport]) -> list[Finding]:
    """Streams that are late or early by the same time in three trials or more."""
    found = []
    for group in dict.fromkeys(group for report in reports for group in report.offsets):
        offsets = [report.offsets[group] for report in reports if group in report.offsets]
        seconds = np.array([offset["seconds"] for offset in offsets if offset["correlation"] > AGREE])
        if len(seconds) < 3:
            continue
        middle = float(np.median(seconds))
        spread = 1.4826 * float(np.median(np.abs(seconds - middle)))
        if (
            abs(middle) > max(LATE, 3.0 * spread / np.sqrt(len(seconds)))
            and np.mean(seconds * middle > 0.0) > 0.8
        ):
            found.append(
                Finding(
                    "care",
                    f"{group} comes {abs(middle):.3f} s {'early' if middle > 0.0 else 'late'} against "
                    f"{offsets[0]['reference']} in {len(seconds)} trials: "
                    f"give 'convert: {{time_offset: {{{group}: {middle:.3f}}}}}'",
                )
            )
    return found
