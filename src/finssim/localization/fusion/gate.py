"""Gates: which measurements are believed, and when a run of disbelieved ones has been right all along."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt
from scipy.special import chdtri

__all__ = ["Gate", "GateMemory", "Suspects", "due", "judge", "remember"]

Array = npt.NDArray[np.float64]


@lru_cache(maxsize=64)
def _quantile(dimension: int, probability: float) -> float:
    return float(chdtri(dimension, 1.0 - probability))


@dataclass(frozen=True)
class Gate:
    """What a squared Mahalanobis distance may be, and when a run of refused measurements takes over."""

    probability: float = 0.999
    """Share of honest measurements that pass."""
    fixed: float | None = None
    """One limit for every dimension, in place of the chi-square quantile; the published software has 9."""
    reacquire_after: float = 1.0
    """A run of refused measurements that agree with one another takes over after this long [s]; inf: never."""
    reacquire_samples: int = 5
    """And after this many of them."""

    def limit(self, dimension: int) -> float:
        """Largest squared Mahalanobis distance that passes, for a measurement of that many numbers."""
        return self.fixed if self.fixed is not None else _quantile(dimension, self.probability)


@dataclass(frozen=True)
class Suspects:
    """Memory of a gate: refused measurements that agree with one another."""

    since: float
    """Time of the first [s]."""
    time: float
    """Time of the latest [s]."""
    value: tuple[float, ...]
    """The latest."""
    covariance: tuple[tuple[float, ...], ...]
    """Its covariance."""
    hits: int = 1
    """How many agree."""
    misses: int = 0
    """Refused measurements in between that agree with none of them."""


def remember(
    suspects: Suspects | None, time: float, value: Array, covariance: Array, drift: float, gate: Gate
) -> Suspects:
    """The memory with one more refused measurement.

    It belongs to the run if its distance to the run's latest is within their covariances and what the quantity may
    have moved meanwhile. A run that more measurements contradict than support is given up for the newest.

    Args:
        suspects: The memory so far; None after a measurement that was believed.
        time: Of the measurement [s].
        value: The measurement, (n,).
        covariance: Its covariance, (n, n).
        drift: How fast the quantity may change [units/s].
        gate: The gate.
    """
    rows = tuple(tuple(float(c) for c in row) for row in covariance)
    fresh = Suspects(time, time, tuple(float(v) for v in value), rows)
    if suspects is None:
        return fresh
    difference = value - np.array(suspects.value)
    moved = (drift * (time - suspects.time)) ** 2
    S = covariance + np.array(suspects.covariance) + moved * np.eye(len(value))
    if float(difference @ np.linalg.solve(S, difference)) <= gate.limit(len(value)):
        return Suspects(suspects.since, time, fresh.value, rows, suspects.hits + 1, suspects.misses)
    if suspects.misses + 1 > suspects.hits:
        return fresh
    return Suspects(
        suspects.since,
        suspects.time,
        suspects.value,
        suspects.covariance,
        suspects.hits,
        suspects.misses + 1,
    )


def due(suspects: Suspects, gate: Gate) -> bool:
    """Whether the run has lasted long enough, and is numerous enough, to take over."""
    if math.isinf(gate.reacquire_after):
        return False
    # A microsecond of slack: stamps are sums of periods.
    long = suspects.time - suspects.since >= gate.reacquire_after - 1e-6
    return long and suspects.hits >= gate.reacquire_samples


@dataclass(frozen=True)
class GateMemory:
    """All that a gate remembers."""

    support: int = 0
    """Measurements believed since the state was last started from one; counted up to `reacquire_samples`."""
    suspects: Suspects | None = None


def judge(
    gate: Gate,
    memory: GateMemory,
    time: float,
    value: Array,
    covariance: Array,
    distance: float,
    drift: float,
) -> tuple[str, GateMemory]:
    """Whether a measurement is believed, and the gate's memory after it.

    A state that was started from one measurement is no surer than that one: until `reacquire_samples` others have
    supported it, a run takes over as soon as it outnumbers its support.

    Args:
        gate: The gate.
        memory: What it remembers; support 0 where there is no state yet.
        time: Of the measurement [s].
        value: What is compared among refused measurements, (n,).
        covariance: Of `value`, (n, n).
        distance: Squared Mahalanobis distance of the measurement from its prediction.
        drift: How fast `value` may change [units/s].

    Returns:
        `initialized` for the first, `accepted`, `gate` where it is refused, or `reacquired` where it ends a run that
        takes over; and the memory.
    """
    if memory.support == 0:
        return "initialized", GateMemory(1)
    if distance <= gate.limit(len(value)):
        return "accepted", GateMemory(min(memory.support + 1, gate.reacquire_samples))
    suspects = remember(memory.suspects, time, value, covariance, drift, gate)
    outvoted = memory.support < gate.reacquire_samples and suspects.hits > memory.support
    if due(suspects, gate) or (outvoted and math.isfinite(gate.reacquire_after)):
        return "reacquired", GateMemory(min(suspects.hits, gate.reacquire_samples))
    return "gate", GateMemory(memory.support, suspects)
