"""From free decays of roll or pitch to estimates, changes of the vehicle file and warnings."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.fit import Estimate
from finssim.calibration.regression.free_decay import Decay
from finssim.calibration.regression.plant_terms import Matrices
from finssim.calibration.regression.pooling import pooled, pooled_positive
from finssim.vehicles import AXES

__all__ = ["DecayResult", "decay_result"]

Array = NDArray[np.float64]

Of = Callable[[Array, Decay], float]
"""A function of x = ln w2, c1, c2 and the decay."""

SET = "hydrodynamics.calibrated"

INERTIA = "kg m²"


@dataclass(frozen=True, kw_only=True)
class DecayResult:
    """What the decays of one axis tell."""

    estimates: list[Estimate]
    changes: dict[str, Any]
    """Dotted path -> value, of the vehicle file."""
    warnings: list[str]


@dataclass(frozen=True, kw_only=True)
class _Known:
    """The number of the vehicle file that makes absolute values of the ratios."""

    axis: str
    assume: Literal["restoring", "inertia"]
    k: float
    """B z_b - W z_g [N m/rad]"""
    m: float
    """M_RB + M_A [kg m²]"""
    rigid: float
    """M_RB [kg m²]"""

    def __post_init__(self) -> None:
        if self.assume == "restoring" and self.k <= 0.0:
            raise CalibrationError(
                f"{self.axis}: the vehicle file has a stiffness of {self.k:.4g} N m/rad, expected one above 0: give "
                "the centres of gravity and buoyancy, or assume the inertia"
            )

    @property
    def said(self) -> str:
        """For notes."""
        if self.assume == "restoring":
            return f"with the file's k = {self.k:.4g} N m/rad"
        return f"with the file's inertia {self.m:.4g} {INERTIA}"

    def inertia(self, x: Array, _: Decay) -> float:
        """[kg m²]"""
        return self.k / math.exp(x[0]) if self.assume == "restoring" else self.m

    def path(self, family: str) -> str:
        """Of the axis' own entry in a matrix of the vehicle file."""
        i = AXES.index(self.axis)
        return f"{SET}.{family}.{i}.{i}"


def decay_result(
    axis: str, decays: Sequence[Decay], plant: Matrices, assume: Literal["restoring", "inertia"]
) -> DecayResult:
    """Estimates of roll or pitch, pooled over its decays.

    Args:
        axis: `roll` or `pitch`.
        decays: One or more.
        plant: Of the vehicle file.
        assume: Which of its numbers is right, as of `passive`.

    Raises:
        CalibrationError: The stiffness is to be right, and is not above 0.
    """
    i = AXES.index(axis)
    rigid = float(plant.M_RB[i, i])
    known = _Known(
        axis=axis, assume=assume, k=float(plant.arm[2]), m=float(plant.M_RB[i, i] + plant.M_A[i, i]), rigid=rigid
    )  # fmt: skip
    swing = _swings(decays)
    frequency = _positive(f"{axis}.natural_frequency", "rad/s", decays, lambda x, _: math.exp(0.5 * x[0]))
    ratio = _positive(f"{axis}.damping_ratio", "-", decays, _damping_ratio, note=f"at {swing}")
    whole = _positive(f"{axis}.m_eff", INERTIA, decays, known.inertia, note=known.said)
    damping = [
        _damping("d1", 1, "N m s", known.path("linear_damping"), decays, known, swing),
        _damping("d2", 2, "N m s²", known.path("quadratic_damping"), decays, known, swing),
    ]
    changes: dict[str, Any] = {}
    if ratio.identifiable and whole.identifiable:
        changes |= {str(e.path): max(e.estimate, 0.0) for e in damping}
    drifts = [
        f"{d.trial}: the equilibrium of {axis} moved during the decay; straight pieces follow it"
        for d in decays
        if d.drift
    ]
    if assume == "inertia":
        k = _stiffness(decays, known)
        taken = replace(whole, identifiable=False)
        return DecayResult(estimates=[frequency, ratio, taken, *damping, k], changes=changes, warnings=drifts)
    added, contradictions = _added_mass(whole, known)
    if added.estimate > 0.0 and whole.identifiable:
        changes[str(added.path)] = added.estimate
    return DecayResult(
        estimates=[frequency, ratio, whole, added, *damping], changes=changes, warnings=contradictions + drifts
    )  # fmt: skip


def _swings(decays: Sequence[Decay]) -> str:
    """The largest rates, for notes."""
    swings = sorted(d.swing for d in decays)
    if len(swings) > 1:
        return f"swings of {swings[0]:.2g}-{swings[-1]:.2g} rad/s"
    return f"a swing of {swings[0]:.2g} rad/s"


def _damping_ratio(x: Array, d: Decay) -> float:
    # A quadratic term counts as the linear one that takes the same energy out of the largest swing.
    return float((x[1] + 8.0 / (3.0 * math.pi) * x[2] * d.swing) / (2.0 * math.exp(0.5 * x[0])))


def _positive(
    name: str, unit: str, decays: Sequence[Decay], of: Of, *, note: str = "", path: str | None = None
) -> Estimate:
    """A number that cannot be negative, pooled over the decays."""
    value, low, high = pooled_positive(*_derived(decays, of))
    sure = bool(np.isfinite([low, high]).all() and 0.5 * (high - low) <= 0.5 * abs(value))
    return Estimate(
        name=name, estimate=value, ci95=(low, high), unit=unit, identifiable=sure,
        note=note if sure or note else "not known to half its size", path=path,
    )  # fmt: skip


def _damping(
    name: str, j: int, unit: str, path: str, decays: Sequence[Decay], known: _Known, swing: str
) -> Estimate:
    """m c_j, pooled over the decays in which c_j was fitted."""
    some = [d for d in decays if d.terms[j - 1]]
    value, low, high, note = 0.0, math.nan, math.nan, f"{swing} need it not"
    if some:
        value, low, high = pooled(*_derived(some, lambda x, d: float(x[j]) * known.inertia(x, d)))
        note = known.said
    return Estimate(
        name=f"{known.axis}.{name}", estimate=value, ci95=(low, high), unit=unit, identifiable=low > 0.0, note=note,
        path=path,
    )  # fmt: skip


def _stiffness(decays: Sequence[Decay], known: _Known) -> Estimate:
    """k = m w2 of a known inertia."""
    return _positive(
        f"{known.axis}.k", "N m/rad", decays, lambda x, _: known.m * math.exp(x[0]), note=known.said,
        path="body.center_of_buoyancy.2",
    )  # fmt: skip


def _added_mass(whole: Estimate, known: _Known) -> tuple[Estimate, list[str]]:
    """The inertia less the file's rigid one, and what to say where that is negative."""
    rigid, (low, high) = known.rigid, whole.ci95
    added = Estimate(
        name=f"{known.axis}.added_mass", estimate=whole.estimate - rigid, ci95=(low - rigid, high - rigid),
        unit=INERTIA, identifiable=whole.identifiable and low > rigid, note=known.said,
        path=known.path("added_mass"),
    )  # fmt: skip
    if added.estimate > 0.0:
        return added, []
    return added, [
        f"{known.axis}: {known.said} the inertia is {whole.estimate:.4g} {INERTIA}, below the file's rigid "
        f"{rigid:.4g} {INERTIA}: check the centres of gravity and buoyancy, or the inertia"
    ]


def _derived(decays: Sequence[Decay], of: Of) -> tuple[Array, Array, Array]:
    """A function of every decay: its values, their standard errors and degrees of freedom, (n,) each."""
    found = np.array([_of_one(d, of) for d in decays]).reshape(len(decays), 3)
    return found[:, 0], found[:, 1], found[:, 2]


def _of_one(decay: Decay, of: Of) -> tuple[float, float, float]:
    x = np.array([math.log(decay.theta[0]), decay.theta[1], decay.theta[2]])
    free = np.array([True, *decay.terms])
    slope = np.zeros(3)
    for j in np.flatnonzero(free):
        h = 1e-6 * max(1.0, abs(x[j]))
        step = np.zeros(3)
        step[j] = h
        slope[j] = (of(x + step, decay) - of(x - step, decay)) / (2.0 * h)
    C = decay.covariance
    matrix = np.where(C.alone.any(), C.local, C.trials)
    variance = float(slope[free] @ matrix @ slope[free])
    dof = float(np.min(C.dof[np.isfinite(C.dof)], initial=np.inf))
    return float(of(x, decay)), math.sqrt(max(variance, 0.0)), dof
