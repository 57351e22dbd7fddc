"""Samples over time, read at times between them and nowhere else."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from finssim.localization.errors import LocalizationError

__all__ = ["Series", "series"]

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Series:
    """Samples in the order of their times."""

    what: str
    """Such as `depth`, as messages call it."""
    t: Array
    """[s], rising, (n,)."""
    values: Array
    """(n, k)"""
    longest_gap: float
    """Nothing is interpolated between samples further apart than this [s]."""

    def at(self, time: float) -> Array | str:
        """The values at a time [s], in a straight line between two samples, (k,); or why they are not known there."""
        if not np.isfinite(time):
            return f"no {self.what} at the exposure: the picture has no time stamp"
        first, last = float(self.t[0]), float(self.t[-1])
        if not first <= time <= last:
            return f"no {self.what} at the exposure: {time:.3f} s is outside the file's {first:.3f} to {last:.3f} s"
        k = int(np.searchsorted(self.t, time))
        if self.t[k] == time:
            return np.asarray(self.values[k])
        gap = float(self.t[k] - self.t[k - 1])
        if gap > self.longest_gap:
            return f"no {self.what} at the exposure: its samples around {time:.3f} s are {gap:.2f} s apart"
        share = (time - self.t[k - 1]) / gap
        return np.asarray((1.0 - share) * self.values[k - 1] + share * self.values[k])


def series(what: str, t: Array, values: Array, longest_gap: float, *, where: str) -> Series:
    """Sort samples by time and leave out those without any number; of equal times the last is taken.

    Raises:
        LocalizationError: None is left.
    """
    order = np.argsort(t, kind="stable")
    t, values = t[order], values[order]
    good = np.isfinite(t) & np.isfinite(values).any(axis=1)
    t, values = t[good], values[good]
    if not len(t):
        raise LocalizationError(f"{where}: no row holds a time and a {what}: expected numbers")
    last = np.append(t[1:] > t[:-1], True)
    return Series(what, t[last], values[last], longest_gap)
