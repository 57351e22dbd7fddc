"""Gates: which measurements are believed, and when a run of disbelieved ones has been right all along."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt
from scipy.special import chdtri

__all__ = ["Gate", "GateMemory", "judge", "judge_carried"]

Array = npt.NDArray[np.float64]


LONGEST_SUPPORT = 200
"""Believed measurements that are counted."""

OUTVOTED = 6
"""A state that a gyro carries gives way to a run of refused measurements with this part of its own support."""


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
class Rival:
    """What a state that was taken over said, kept alive in case that it was right."""

    offset: float
    """From what is believed now [units of the measurement]."""
    held: int
    """Measurements that supported it."""
    won: int
    """Measurements that support what is believed now."""


@dataclass(frozen=True)
class GateMemory:
    """All that a gate remembers."""

    support: int = 0
    """Measurements believed since the state was last started from one; counted up to `reacquire_samples`."""
    suspects: Suspects | None = None
    believed: int = 0
    """The same, counted up to `LONGEST_SUPPORT`."""
    rival: Rival | None = None

    @property
    def doubt(self) -> float:
        """Variance that a rival, or a run of refused measurements, adds to that of the state [units²]."""
        if self.rival is not None:
            return self.rival.offset**2 * self.rival.held / (self.rival.held + self.rival.won)
        if self.suspects is not None and self.suspects.hits > 1:
            return self.suspects.value[0] ** 2 * self.suspects.hits / (self.suspects.hits + self.believed)
        return 0.0


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
        distance: Squared Mahalanobis distance of the measurement from its prediction [-].
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


def judge_carried(
    gate: Gate,
    memory: GateMemory,
    time: float,
    residual: float,
    variance: float,
    distance: float,
    drift: float,
    carried: bool,
) -> tuple[str, GateMemory]:
    """As `judge`, for the distance of a measurement from a state that another sensor carries on, as a gyro does yaw.

    Between two measurements the state is right to a fraction of a degree, so that a jump is the measurement's error, or
    the state was wrong all along. What has been believed for long gives way only to a run of a sixth of its support,
    and is kept as a rival: a measurement that agrees with a rival of more support brings it back at once.

    Args:
        gate: The gate.
        memory: What it remembers.
        time: Of the measurement [s].
        residual: Measurement less prediction [units].
        variance: Of the measurement [units²].
        distance: Squared Mahalanobis distance of the measurement from its prediction [-].
        drift: How fast residuals that agree may change [units/s].
        carried: Whether that other sensor speaks; `judge` has to do where it does not.
    """
    value, R = np.array([residual]), np.array([[variance]])
    if not carried:
        return judge(gate, memory, time, value, R, distance, drift)
    rival = memory.rival
    refused = memory.support > 0 and distance > gate.limit(1)
    if refused and rival is not None and rival.held >= rival.won and math.isfinite(gate.reacquire_after):
        S = max(residual**2 / distance, variance)
        if (residual - rival.offset) ** 2 / S <= gate.limit(1):
            back = Rival(-residual, rival.won, rival.held)
            return "reacquired", GateMemory(gate.reacquire_samples, None, rival.held, back)
    verdict, after = judge(gate, memory, time, value, R, distance, drift)
    if verdict == "reacquired":
        hits = memory.suspects.hits + 1 if memory.suspects is not None else 1
        if hits * OUTVOTED < memory.believed:
            suspects = remember(memory.suspects, time, value, R, drift, gate)
            return "gate", GateMemory(memory.support, suspects, memory.believed, rival)
        return verdict, GateMemory(after.support, None, hits, Rival(-residual, memory.believed, hits))
    if verdict == "gate":
        return verdict, GateMemory(after.support, after.suspects, memory.believed, rival)
    believed = min(memory.believed + 1, LONGEST_SUPPORT)
    if rival is not None:
        rival = Rival(rival.offset, rival.held, rival.won + 1) if rival.won < 2 * rival.held else None
    return verdict, GateMemory(after.support, None, believed, rival)
