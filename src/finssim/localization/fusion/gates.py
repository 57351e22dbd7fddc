"""Outlier gates: decide which measurements are accepted, and when a run of refused ones replaces the state."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

LONGEST_SUPPORT = 200
"""Largest count of accepted measurements in a gate's memory."""

OUTVOTED = 6
"""Ratio of the support of a gyro-propagated state to the length of a run of refused measurements that replaces it."""


@lru_cache(maxsize=64)
def _quantile(dimension: int, probability: float) -> float:
    from scipy.special import chdtri

    return float(chdtri(dimension, 1.0 - probability))


@dataclass(frozen=True)
class OutlierGate:
    """Probability limit of an outlier, and conditions under which a run of refused measurements replaces the state."""

    probability: float = 0.999
    """Probability with which a measurement without gross error passes."""
    reacquire_after: float = 1.0
    """Duration after which refused measurements that agree with one another replace the state [s]; inf: never."""
    reacquire_samples: int = 5
    """Least number of these measurements."""

    def limit(self, dimension: int) -> float:
        """Return the largest squared Mahalanobis distance that passes for a measurement of the given dimension [-]."""
        return _quantile(dimension, self.probability)


@dataclass(frozen=True)
class Suspects:
    """Run of refused measurements that agree with one another."""

    since: float
    """Time of the first [s]."""
    time: float
    """Time of the latest [s]."""
    value: tuple[float, ...]
    """Latest value, in the unit of the measurement."""
    covariance: tuple[tuple[float, ...], ...]
    """Covariance of the latest value, in its unit."""
    hits: int = 1
    """Number of measurements that agree."""
    misses: int = 0
    """Number of refused measurements in between that do not agree with the run."""


def remember(
    suspects: Suspects | None, time: float, value: Array, covariance: Array, drift: float, gate: OutlierGate
) -> Suspects:
    """Return the run extended by one refused measurement.

    The measurement belongs to the run if its distance to the latest is consistent with their covariances and
    the possible change of the quantity in between. A run with more contradicting than supporting measurements
    is replaced by the newest.

    Args:
        suspects: Run so far; None after an accepted measurement.
        time: Time of the measurement [s].
        value: The measurement in its unit, (n,).
        covariance: Its covariance in its unit, (n, n).
        drift: Largest rate of change of the quantity [units/s].
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
    return replace(suspects, misses=suspects.misses + 1)


def due(suspects: Suspects, gate: OutlierGate) -> bool:
    """Return whether the run is long enough, in time and number, to replace the state."""
    if math.isinf(gate.reacquire_after):
        return False
    # A microsecond of slack: stamps are sums of periods.
    long = suspects.time - suspects.since >= gate.reacquire_after - 1e-6
    return long and suspects.hits >= gate.reacquire_samples


@dataclass(frozen=True)
class Rival:
    """State that was replaced, kept in case it was correct."""

    offset: float
    """Difference from the current state [units of the measurement]."""
    held: int
    """Number of measurements that supported it."""
    won: int
    """Number of measurements that support the current state."""


@dataclass(frozen=True)
class GateMemory:
    """Memory of one gate."""

    support: int = 0
    """Number of measurements accepted since the state was started from one, up to `reacquire_samples`; 0: no state."""
    suspects: Suspects | None = None
    accepted: int = 0
    """Number of accepted measurements, up to `LONGEST_SUPPORT`."""
    rival: Rival | None = None

    @property
    def extra_variance(self) -> float:
        """Variance that a rival or a run of refused measurements adds to the state's variance [units²]."""
        if self.rival is not None:
            return self.rival.offset**2 * self.rival.held / (self.rival.held + self.rival.won)
        if self.suspects is not None and self.suspects.hits > 1:
            return self.suspects.value[0] ** 2 * self.suspects.hits / (self.suspects.hits + self.accepted)
        return 0.0


def judge(
    gate: OutlierGate,
    memory: GateMemory,
    time: float,
    value: Array,
    covariance: Array,
    distance: float,
    drift: float,
) -> tuple[str, GateMemory]:
    """Return whether a measurement is accepted or refused as an outlier, and the gate's memory after it.

    A state that was started from one measurement is as uncertain as that measurement: until
    `reacquire_samples` others support it, a run replaces it as soon as the run is longer than its support.

    Args:
        gate: The gate.
        memory: Memory before; support 0 without a state.
        time: Time of the measurement [s].
        value: Quantity compared among refused measurements, in the unit of the measurement, (n,).
        covariance: Covariance of `value` in its unit, (n, n).
        distance: Squared Mahalanobis distance of the measurement from its prediction [-].
        drift: Largest rate of change of `value` [units/s].

    Returns:
        `initialized` for the first measurement, `accepted`, `gate` if it is refused, or `reacquired` if it
        completes a run that replaces the state; and the memory.
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
    gate: OutlierGate,
    memory: GateMemory,
    time: float,
    residual: float,
    variance: float,
    distance: float,
    drift: float,
) -> tuple[str, GateMemory]:
    """Return the verdict, as `judge`, for a state that another sensor propagates, as a gyro propagates yaw.

    Between two measurements such a state is accurate to a fraction of a degree: after a jump, either the
    measurement is wrong or the state was wrong before. A state with long support is replaced only by a run of
    a sixth of its support, and is kept as a rival: a measurement that agrees with a rival of greater support
    restores it at once.

    Args:
        gate: The gate.
        memory: Memory before.
        time: Time of the measurement [s].
        residual: Measurement minus prediction [units].
        variance: Variance of the measurement [units²].
        distance: Squared Mahalanobis distance of the measurement from its prediction [-].
        drift: Largest rate of change of residuals that agree [units/s].
    """
    value, R = np.array([residual]), np.array([[variance]])
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
        if hits * OUTVOTED < memory.accepted:
            suspects = remember(memory.suspects, time, value, R, drift, gate)
            return "gate", GateMemory(memory.support, suspects, memory.accepted, rival)
        return verdict, GateMemory(after.support, None, hits, Rival(-residual, memory.accepted, hits))
    if verdict == "gate":
        return verdict, GateMemory(after.support, after.suspects, memory.accepted, rival)
    accepted = min(memory.accepted + 1, LONGEST_SUPPORT)
    if rival is not None:
        rival = Rival(rival.offset, rival.held, rival.won + 1) if rival.won < 2 * rival.held else None
    return verdict, GateMemory(after.support, None, accepted, rival)
