"""Sampling of a trial's columns: rates, gaps, jitter, values that stick, hold or clip."""

from __future__ import annotations

import numpy as np

from finssim.calibration.check.report import StreamReport
from finssim.calibration.findings import Finding, finding
from finssim.calibration.trials.columns import COLUMNS, column_of
from finssim.calibration.trials.trial import Array, Trial

__all__ = ["stream_reports"]

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
        for one in _sampling(report):
            of.setdefault(one, []).extend(names)
        for name in names:
            for one in _values(trial, name):
                of.setdefault(one, []).append(name)
    findings += [one.about(_shown(columns)) for one, columns in of.items()]
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
    """What is wrong with the times of a stream."""
    found = []
    much = report.missing > LONGEST_MISSING
    if report.gaps == 1:
        found.append(finding("gap", severity="care" if much else "note", longest=report.longest_gap))
    elif report.gaps:
        severity = "care" if much else None
        found.append(finding("gaps", severity=severity, gaps=report.gaps, longest=report.longest_gap))
    elif much:
        found.append(finding("ends_missing", share=report.missing))
    if report.jitter > 0.5:
        found.append(finding("jitter", share=report.jitter))
    if report.rate < FEW_HERTZ and report.group in ("velocity", "rates"):
        found.append(finding("slow", rate=report.rate))
    return found


def _shown(columns: list[str]) -> str:
    return ", ".join(columns[:4]) + (f" and {len(columns) - 4} more" if len(columns) > 4 else "")


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
    if _coarse(y):
        return []
    found = []
    if name in ("z", "depth") and (above := float(np.percentile(y if name == "z" else -y, 99.0))) > FLYING:
        found.append(
            finding("above_surface", height=above, column=name)
            if name == "z"
            else finding("depth_above_surface", height=above)
        )
    begins = np.flatnonzero(np.concatenate([[True], np.diff(y) != 0.0]))
    lengths = np.diff(np.concatenate([begins, [len(y)]]))
    usual = float(np.median(lengths))
    rate = 1.0 / float(np.median(np.diff(t)))
    if usual >= 2.0:
        found.append(finding("values_held", rows=usual, rate=rate / usual, row_rate=rate))
    longest = int(np.argmax(lengths))
    span = float(t[min(begins[longest] + lengths[longest], len(t) - 1)] - t[begins[longest]])
    if span > STUCK and lengths[longest] > 10.0 * usual:
        at = begins[longest]
        found.append(finding("stuck", value=y[at], span=span, start=t[at]))
    for extreme, highest in ((y.max(), True), (y.min(), False)):
        # A signal that passes through its extreme touches it once.
        runs = lengths[y[begins] == extreme]
        if runs.sum() >= max(10.0, 0.02 * len(y)) and runs.max() >= 4.0 * usual:
            at_limit = {"value": extreme, "samples": runs.sum()}
            found.append(
                finding("clipped_above", **at_limit) if highest else finding("clipped_below", **at_limit)
            )
    return found


def _coarse(y: Array) -> bool:
    """Whether a signal moves over so few steps of its resolution that it repeats values by itself."""
    steps = np.abs(np.diff(np.unique(y)))
    return bool(np.ptp(y) < COARSE * steps.min())
