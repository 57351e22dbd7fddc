"""One strictly increasing time base for samples that came in any order, from any number of streams."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.findings import Finding, finding

__all__ = ["SAME_ROW", "merged", "ordered", "sampled"]

Array = NDArray[np.float64]

SAME_ROW = 1.0e-6
"""Samples closer than this share a row [s]."""

PIECE_GAP = 10.0
"""Silence put between the pieces of a log whose clock jumped back [s]; what lay between is not known."""

FEW = 3
"""Rows that may arrive late before a step back counts as a jump of the clock."""


def merged(streams: Mapping[str, tuple[Array, Array]]) -> tuple[Array, dict[str, Array]]:
    """Streams of different times on their union time base.

    Args:
        streams: Column -> times [s], strictly increasing, and values, (k,) each.

    Returns:
        Times (n,), and column -> values with NaN where that stream has no sample, (n,) each. Samples within a
        microsecond share a row.

    Raises:
        CalibrationError: There is no sample at all.
    """
    every = [t for t, _ in streams.values()]
    times = np.unique(np.concatenate(every)) if every else np.empty(0)
    if not len(times):
        raise CalibrationError("no stream holds a sample")
    starts = np.concatenate([[True], np.diff(times) > SAME_ROW])
    row_of = np.cumsum(starts) - 1
    base = times[starts]
    channels = {}
    for name, (t, values) in streams.items():
        channels[name] = np.full(len(base), np.nan)
        channels[name][row_of[np.searchsorted(times, t)]] = values
    return base, channels


def ordered(t: Array, columns: Mapping[str, Array]) -> tuple[Array, NDArray[np.intp], list[Finding]]:
    """Times in order, and the order of the rows.

    Rows that arrived a little late, reversed and shuffled logs are sorted. Where the clock itself jumped back (a long
    piece of rows lies over an earlier one), nobody can know how much time passed: the later piece is moved behind the
    earlier one with a gap of `PIECE_GAP` seconds between, and nothing is interpolated across gaps.

    Args:
        t: Finite times [s], (n,).
        columns: Column -> values, (n,); two pieces that fill different columns do not collide.

    Returns:
        Times not decreasing (n,), row numbers in that order (n,), and findings.
    """
    back = np.flatnonzero(np.diff(t) < 0.0) + 1
    rows = np.arange(len(t))
    if not len(back):
        return t, rows, []
    if len(back) <= max(1.0, 0.01 * len(t)):
        jumps = [int(i) for i in back if _collides(t, columns, int(i))]
        if jumps:
            return _in_pieces(t, jumps)
    rows = np.argsort(t, kind="stable")
    return t[rows], rows, [finding("times_sorted", rows=len(back), total=len(t))]


def _collides(t: Array, columns: Mapping[str, Array], i: int) -> bool:
    """Whether the rows from `i` on retell times that the same columns have had before."""
    earlier = np.flatnonzero(t[:i] >= t[i])
    later = i + np.flatnonzero(t[i:] <= t[:i].max())
    if len(earlier) <= FEW or len(later) <= FEW:
        return False
    return any(
        np.isfinite(v[earlier]).sum() > FEW and np.isfinite(v[later]).sum() > FEW for v in columns.values()
    )


def _in_pieces(t: Array, jumps: list[int]) -> tuple[Array, NDArray[np.intp], list[Finding]]:
    moved, order, findings, end = [], [], [], -np.inf
    for start, stop in zip([0, *jumps], [*jumps, len(t)], strict=True):
        rows = start + np.argsort(t[start:stop], kind="stable")
        times = t[rows]
        if start:
            shift = end + PIECE_GAP - times[0]
            findings.append(
                finding("clock_jump", before=t[start - 1], after=t[start], row=start + 1, shift=shift)
            )
            times = times + shift
        moved.append(times)
        order.append(rows)
        end = times[-1]
    return np.concatenate(moved), np.concatenate(order), findings


def sampled(
    t: Array, columns: Mapping[str, Array]
) -> tuple[Array, dict[str, Array], NDArray[np.intp], list[Finding]]:
    """One row for each time: rows of equal times are laid over one another, the later number where both have one.

    Args:
        t: Not decreasing [s], (n,).
        columns: Column -> values, (n,).

    Returns:
        Times, strictly increasing (m,), columns (m,), the row each came from (m,), and findings.
    """
    starts = np.concatenate([[True], np.diff(t) > 0.0])
    kept = np.flatnonzero(starts)
    if len(kept) == len(t):
        return t, dict(columns), kept, []
    row_of = np.cumsum(starts) - 1
    merged_columns, conflicts = {}, np.zeros(len(kept), bool)
    for name, values in columns.items():
        good = np.flatnonzero(np.isfinite(values))
        merged_columns[name] = np.full(len(kept), np.nan)
        merged_columns[name][row_of[good]] = values[good]  # NumPy keeps the last of equal indices
        conflicts[row_of[good][values[good] != merged_columns[name][row_of[good]]]] = True
    findings = []
    if conflicts.any():
        findings.append(finding("times_conflict", times=conflicts.sum(), first=t[kept][conflicts][0]))
    elif len(columns):
        findings.append(finding("times_repeat", rows=len(t) - len(kept)))
    return t[kept], merged_columns, kept, findings
