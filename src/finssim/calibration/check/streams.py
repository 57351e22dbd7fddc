"""Sampling of a trial's columns: rates, gaps, jitter, values that stick, hold or clip."""

from __future__ import annotations

import numpy as np

from finssim.calibration.check.report import Finding, Level, StreamReport
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
        findings.append(
            Finding("refused", f"lasts {trial.duration:.2g} s, expected at least {SHORTEST_TRIAL:g} s")
        )
    said: dict[tuple[Level, str], list[str]] = {}
    for names in shared.values():
        report = _report(trial, tuple(names))
        reports.append(report)
        for what in _sampling(report):
            said.setdefault(what, []).extend(names)
        for name in names:
            for what in _values(trial, name):
                said.setdefault(what, []).append(name)
    findings += [Finding(level, f"{_shown(columns)}: {text}") for (level, text), columns in said.items()]
    few = [name for name in trial.channels if not trial.has(name)]
    if few:
        findings.append(Finding("note", f"{', '.join(few)} hold fewer than two samples and are not used"))
    findings += [Finding("care" if "clock jumps" in note else "note", note) for note in trial.notes]
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


def _sampling(report: StreamReport) -> list[tuple[Level, str]]:
    """What is wrong with the times of a stream: what is said after its columns."""
    found: list[tuple[Level, str]] = []
    if report.gaps == 1:
        gaps = f"a gap of {report.longest_gap:.3g} s, which no fit bridges"
    else:
        gaps = f"{report.gaps} gaps, the longest of {report.longest_gap:.3g} s, which no fit bridges"
    if report.gaps:
        found.append(("care" if report.missing > LONGEST_MISSING else "note", gaps))
    elif report.missing > LONGEST_MISSING:
        found.append(("care", f"missing in {report.missing:.0%} of the trial, at its ends"))
    if report.jitter > 0.5:
        found.append(("note", f"the time between samples varies by {report.jitter:.0%}: stamps of receipt?"))
    if report.rate < FEW_HERTZ and report.group in ("velocity", "rates"):
        slow = f"{report.rate:.2g} Hz is slow for a vehicle: only the simulation method can use it"
        found.append(("care", slow))
    return found


def _shown(columns: list[str]) -> str:
    return ", ".join(columns[:4]) + (f" and {len(columns) - 4} more" if len(columns) > 4 else "")


def _values(trial: Trial, name: str) -> list[tuple[Level, str]]:
    """Stuck, held and clipped values of a measurement: what is said after the column's name."""
    column = COLUMNS.get(name)
    if column is None or column.group == "command":
        return []
    t, y = trial.series(name)
    if len(y) < 20:
        return []
    if np.ptp(y) == 0.0:
        return [("note", f"{y[0]:g} throughout")]
    if _coarse(y):
        return []
    found: list[tuple[Level, str]] = []
    if name in ("z", "depth") and (above := float(np.percentile(y if name == "z" else -y, 99.0))) > FLYING:
        sign = "positive up ('convert: {scale: {depth: -1}}'), or " if name == "depth" else ""
        found.append(
            (
                "care",
                f"says {above:.2g} m above the surface: {sign}another zero ('convert: {{offset: {{{name}: ...}}}}')? "
                "Models count the vehicle as submerged",
            )
        )
    begins = np.flatnonzero(np.concatenate([[True], np.diff(y) != 0.0]))
    lengths = np.diff(np.concatenate([begins, [len(y)]]))
    usual = float(np.median(lengths))
    rate = 1.0 / float(np.median(np.diff(t)))
    if usual >= 2.0:
        found.append(
            (
                "note",
                f"each value stays for {usual:g} rows: it comes at {rate / usual:.3g} Hz, not {rate:.3g} Hz",
            )
        )
    longest = int(np.argmax(lengths))
    span = float(t[min(begins[longest] + lengths[longest], len(t) - 1)] - t[begins[longest]])
    if span > STUCK and lengths[longest] > 10.0 * usual:
        at = begins[longest]
        found.append(("care", f"stands at {y[at]:.4g} for {span:.2g} s from {t[at]:.4g} s: stuck?"))
    for extreme, word in ((y.max(), "above"), (y.min(), "below")):
        # A signal that passes through its extreme touches it once.
        runs = lengths[y[begins] == extreme]
        if runs.sum() >= max(10.0, 0.02 * len(y)) and runs.max() >= 4.0 * usual:
            found.append(
                ("care", f"never {word} {extreme:.4g}, where it stays for {runs.sum()} samples: clipped?")
            )
    return found


def _coarse(y: Array) -> bool:
    """Whether a signal moves over so few steps of its resolution that it repeats values by itself."""
    steps = np.abs(np.diff(np.unique(y)))
    return bool(np.ptp(y) < COARSE * steps.min())
