"""Samples of one source on its own times, and several such streams on one time base."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.findings import Finding, finding
from finssim.calibration.importers.column_map import SplitRule
from finssim.calibration.trials.time_base import SAME_ROW, merged, ordered
from finssim.calibration.trials.trial import Array

__all__ = ["Stream", "Table", "in_order", "merge", "split_table"]

# One table of a long log into several, one for each trial.

Rows = NDArray[np.bool_]


def split_table(name: str, table: Table, rule: SplitRule | None) -> dict[str, Table]:
    """Name of a trial -> its part of the table, with times from 0; one part of that name without a rule.

    Raises:
        CalibrationError: The log has not what the rule goes by, or nothing is left.
    """
    if rule is None:
        return {name: table}
    pieces = {
        "phase": _by_phase,
        "gaps": _by_gaps,
        "arming": _by_arming,
        "column": _by_column,
        "windows": _by_windows,
    }[rule.by](name, table, rule)
    long_enough = {
        piece: rows
        for piece, rows in pieces.items()
        if rows.sum() >= 2 and np.ptp(table.t[rows]) >= rule.shortest
    }
    if not long_enough:
        raise CalibrationError(
            f"{name}: splitting by {rule.by} leaves no piece of {rule.shortest:g} s or more"
        )
    return {piece: _part(table, rows) for piece, rows in long_enough.items()}


def _part(table: Table, rows: Rows) -> Table:
    t = table.t[rows]
    return replace(
        table,
        start=table.start + float(t[0]),
        t=np.round(t - t[0], 6),
        channels={column: values[rows] for column, values in table.channels.items()},
        words={column: spoken[rows] for column, spoken in table.words.items()},
        findings=(*table.findings, finding("log_cut", start=t[0], end=t[-1])),
    )


def _words(name: str, table: Table, which: str, what: str) -> NDArray[np.str_]:
    if which not in table.words:
        raise CalibrationError(f"{name}: cannot be split by {which}: {what}")
    return table.words[which]


def _runs(labels: NDArray[np.str_]) -> list[tuple[str, Rows]]:
    """Stretches of equal labels in their order."""
    number = np.concatenate([[0], np.cumsum(labels[1:] != labels[:-1])])
    return [(str(labels[number == i][0]), number == i) for i in range(int(number[-1]) + 1)]


def _numbered(name: str, pieces: list[Rows]) -> dict[str, Rows]:
    digits = len(str(len(pieces)))
    return {f"{name}_{i + 1:0{digits}d}": rows for i, rows in enumerate(pieces)}


def _by_phase(name: str, table: Table, rule: SplitRule) -> dict[str, Rows]:
    """A trial begins with each baseline; without baselines, with each excitation after something else."""
    phase = _words(name, table, "phase", "no source of the map names a phase column")
    opening = "baseline" if (phase == "baseline").any() else "excitation"
    begins = (phase == opening) & np.concatenate([[True], phase[:-1] != opening])
    number = np.cumsum(begins)
    return _numbered(name, [number == i for i in range(1, int(number[-1]) + 1)] if begins.any() else [])


def _by_gaps(name: str, table: Table, rule: SplitRule) -> dict[str, Rows]:
    number = np.concatenate([[0], np.cumsum(np.diff(table.t) > rule.longest_gap)])
    return _numbered(name, [number == i for i in range(int(number[-1]) + 1)])


def _by_arming(name: str, table: Table, rule: SplitRule) -> dict[str, Rows]:
    arming = _words(name, table, "arming", "the log says nothing about arming")
    return _numbered(name, [rows for word, rows in _runs(arming) if word == "armed"])


def _by_column(name: str, table: Table, rule: SplitRule) -> dict[str, Rows]:
    labels = _words(name, table, "split", "no source of the map names a split column")
    runs = [(word, rows) for word, rows in _runs(labels) if word not in ("", "nan", "None")]
    return _numbered(name, [rows for _, rows in runs])


def _by_windows(name: str, table: Table, rule: SplitRule) -> dict[str, Rows]:
    pieces = {window: (table.t >= low) & (table.t <= high) for window, (low, high) in rule.windows.items()}
    empty = [window for window, rows in pieces.items() if not rows.any()]
    if empty:
        raise CalibrationError(
            f"{name}: window {empty[0]} is {list(rule.windows[empty[0]])} s, the log runs to {table.t[-1]:.3f} s"
        )
    return pieces


Words = NDArray[np.str_]


@dataclass(frozen=True, kw_only=True)
class Stream:
    """What one file, topic or kind of message says, in canonical columns and SI."""

    source: str
    """What messages call it."""
    t: Array
    """On the clock of the log [s], (n,)."""
    channels: dict[str, Array] = field(default_factory=dict)
    """Canonical or extra column -> values, (n,) each."""
    words: dict[str, Words] = field(default_factory=dict)
    """`phase`, `split` or `arming` -> a word for every sample, (n,) each; a word holds until the next."""
    findings: tuple[Finding, ...] = ()
    """What was repaired or left out."""

    def taken(self, rows: NDArray[np.intp] | NDArray[np.bool_], t: Array | None = None) -> Stream:
        """Some of the samples, in that order; at times `t` where given."""
        return replace(
            self,
            t=self.t[rows] if t is None else t,
            channels={name: values[rows] for name, values in self.channels.items()},
            words={name: values[rows] for name, values in self.words.items()},
        )

    def noting(self, *findings: Finding) -> Stream:
        """The same with more findings."""
        return replace(self, findings=(*self.findings, *findings))


@dataclass(frozen=True, kw_only=True)
class Table:
    """Several streams on the union of their times."""

    start: float
    """Of the log's clock at t = 0 [s]."""
    t: Array
    """Strictly increasing from 0 [s], (n,)."""
    channels: dict[str, Array]
    """NaN where a stream has no sample, (n,) each."""
    words: dict[str, Words]
    """(n,) each."""
    findings: tuple[Finding, ...]


def in_order(stream: Stream, *, alone: bool) -> Stream:
    """The stream with strictly increasing times.

    Samples without a time are left out, late ones are sorted in, of samples with one time the first is kept. Where the
    clock was set back, the rest follows after a gap if the stream is `alone`
    (`finssim.calibration.trials.time_base.ordered`).

    Raises:
        CalibrationError: No samples, or a clock set back in one of several streams, which cannot be aligned again.
    """
    timed = np.isfinite(stream.t)
    untimed = [] if timed.all() else [finding("samples_untimed", samples=(~timed).sum())]
    stream = stream.taken(timed)
    if len(stream.t) < 2:
        raise CalibrationError(f"{stream.source}: {len(stream.t)} samples, expected at least two")
    t, rows, repaired = ordered(stream.t, stream.channels)
    jumps = [one.values for one in repaired if one.code == "clock_jump"]
    if not alone and jumps:
        raise CalibrationError(
            f"the clock jumps back from {jumps[0]['before']:.6g} s to {jumps[0]['after']:.6g} s at row "
            f"{jumps[0]['row']}, so its samples cannot be placed among those of the other sources: import the parts on "
            "their own, or cut the log there",
            stream.source,
        )
    stream = stream.taken(rows, t)
    first = np.concatenate([[True], np.diff(t) > SAME_ROW])
    if not first.all():
        repaired = [*repaired, finding("samples_repeat", samples=(~first).sum())]
        stream = stream.taken(first)
    if len(stream.t) < 2:
        raise CalibrationError(
            f"{stream.source}: the time never increases: name the column that holds the time"
        )
    return stream.noting(*(one.about(stream.source) for one in (*untimed, *repaired)))


def merge(streams: Sequence[Stream]) -> Table:
    """All streams on the union of their times, which start at 0.

    Raises:
        CalibrationError: A column in two streams, or streams that lie apart in time.
    """
    each = [in_order(stream, alone=len(streams) == 1) for stream in streams]
    _refuse_doubles(each)
    _refuse_apart(each)
    start = min(float(stream.t[0]) for stream in each)
    # On whole microseconds, so that a written and read trial has the same times.
    each = [replace(stream, t=np.round(stream.t - start, 6)) for stream in each]
    columns = {name: (stream.t, values) for stream in each for name, values in stream.channels.items()}
    spoken = {name: (stream.t, words) for stream in each for name, words in stream.words.items()}
    t, channels = merged(columns)
    words = {}
    for name, (times, said) in spoken.items():
        held = np.searchsorted(times, t, side="right") - 1
        words[name] = np.where(held >= 0, said[np.maximum(held, 0)], "")
    findings = [one for stream in each for one in stream.findings]
    if start > 1e8:
        findings.append(finding("clock_origin", start=start))
    return Table(start=start, t=t, channels=channels, words=words, findings=tuple(dict.fromkeys(findings)))


def _refuse_doubles(streams: Sequence[Stream]) -> None:
    seen: dict[str, str] = {}
    for stream in streams:
        for name in (*stream.channels, *stream.words):
            if name in seen:
                raise CalibrationError(
                    f"{name} comes from {seen[name]} and from {stream.source}: take it from one of them in the map"
                )
            seen[name] = stream.source


def _refuse_apart(streams: Sequence[Stream]) -> None:
    longest = max(streams, key=lambda stream: stream.t[-1] - stream.t[0])
    for stream in streams:
        if stream.t[0] > longest.t[-1] or stream.t[-1] < longest.t[0]:
            raise CalibrationError(
                f"times of {longest.source} run from {longest.t[0]:.6g} to {longest.t[-1]:.6g} s and those of "
                f"{stream.source} from {stream.t[0]:.6g} to {stream.t[-1]:.6g} s: they do not overlap: give the "
                f"unit of the time, or a time_offset in the map that puts them on one clock"
            )
