"""Samples of one source on its own times, and several such streams on one time base."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.findings import Finding, finding
from finssim.calibration.trials.time_base import SAME_ROW, merged, ordered
from finssim.calibration.trials.trial import Array

__all__ = ["Stream", "Table", "in_order", "merge"]

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
