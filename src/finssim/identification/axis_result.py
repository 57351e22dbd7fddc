"""Estimates, changes of the vehicle file and findings of one axis, from its fitted numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from finssim.identification.fit import Estimate
from finssim.identification.plant_terms import Matrices, matrices
from finssim.trials.findings import Finding, finding
from finssim.vehicles import AXES, Vehicle

Array = NDArray[np.float64]

CERTAIN = 0.2
"""Half width of an interval, as a part of the estimate, up to which a parameter counts as identifiable."""

USEFUL = 0.5
"""Half width, as a part of the estimate, up to which an inertia is written to the vehicle file: better than a guess."""

DECADE = 10.0

SET = "hydrodynamics.calibrated"

BIAS_NOTE = (
    "a constant force; above zero it opposes motion in the positive direction, as damping does: tether, trim or the "
    "offset of a sensor"
)

UNITS = {
    "m_eff": ("kg", "kg m²"),
    "d1": ("N s/m", "N m s"),
    "d2": ("N s²/m²", "N m s²"),
    "bias": ("N", "N m"),
    "k": ("N m/rad", "N m/rad"),
}
"""Units of the numbers of an axis, along it and about it."""


class Number(NamedTuple):
    """A number of an axis as it was fitted."""

    value: float
    ends: tuple[float, float]
    """95 % interval in the unit of the number; not finite where the trials do not determine it."""
    free: float | None = None
    """Estimate without the bound that it rests on, in the unit of the number; None where it rests on none."""


@dataclass(kw_only=True)
class AxisResult:
    """Estimates, changes of the vehicle file and findings of one axis, from its numbers.

    What the data know well is written, and so is what they know badly where the vehicle file's number lies outside the
    interval: a wide interval is a better answer than a number that it excludes.
    """

    axis: str
    numbers: Mapping[str, Number]
    """Fitted numbers by name, of `UNITS`."""
    file: Matrices
    """The vehicle as its file has it."""
    speeds: tuple[float, float]
    """Lowest and highest that the damping rests on [m/s, rad/s]."""
    drag_known: bool
    """True if the damping is known well enough to be written; both of its terms are written, or neither."""
    given: float | None = None
    """Effective inertia where it is known [kg, kg m²]."""
    estimates: dict[str, Estimate] = field(default_factory=dict)
    changes: dict[str, Any] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Estimate term by term."""
        self.i = AXES.index(self.axis)
        low, high = self.speeds
        unit = "m/s" if self.i < 3 else "rad/s"
        if self.given is not None:
            self.note("m_eff", self.given, (self.given, self.given), True, "given")
        elif "m_eff" in self.numbers:
            self.add("m_eff")
        if f"{self.axis}.m_eff" in self.estimates:
            self.added_mass(float(self.file.M_RB[self.i, self.i]))
        for name, family in (("d1", "linear_damping"), ("d2", "quadratic_damping")):
            if name in self.numbers:
                own = self.add(name, self.path(family))
                if own.ci95[0] <= 0.0 <= own.ci95[1] < np.inf:
                    note = f"not distinguishable from zero at speeds of {low:.2g}-{high:.2g} {unit}"
                    self.note(name, own.estimate, own.ci95, False, note, own.path)
            if self.drag_known:
                value = max(self.numbers[name].value, 0.0) if name in self.numbers else 0.0
                file = {"d1": self.file.D1, "d2": self.file.D2}[name][self.i, self.i]
                if name not in self.numbers or value != file:
                    self.changes[self.path(family)] = value
        if not self.drag_known:
            self.findings.append(finding("damping_unknown", self.axis, low=low, high=high, unit=unit))
        if "k" in self.numbers:
            self.add("k", "body.center_of_buoyancy.2")
        if "bias" in self.numbers:  # identifiable wherever it has an interval, for it may well be zero
            bias = self.add("bias")
            self.note("bias", bias.estimate, bias.ci95, bool(np.isfinite(bias.ci95).all()), BIAS_NOTE)
        if 0.0 < low and high < DECADE * low:
            self.findings.append(finding("few_speeds", self.axis, low=low, high=high, unit=unit))

    def path(self, family: str) -> str:
        """Return the path of the axis' own entry in a matrix of the vehicle file."""
        return f"{SET}.{family}.{self.i}.{self.i}"

    def note(
        self,
        name: str,
        value: float,
        ends: tuple[float, float],
        sure: bool,
        note: str,
        path: str | None = None,
    ) -> Estimate:
        """Take an estimate. Value and interval are in `unit`."""
        unit = UNITS["m_eff" if name == "added_mass" else name][self.i > 2]
        name, ends = f"{self.axis}.{name}", (float(ends[0]), float(ends[1]))
        self.estimates[name] = Estimate(
            name=name, estimate=float(value), ci95=ends, unit=unit, identifiable=sure, note=note, path=path
        )
        return self.estimates[name]

    def add(self, name: str, path: str | None = None) -> Estimate:
        """Take the estimate of a number, and a finding where it rests on its bound."""
        value, (low, high), free = self.numbers[name]
        unit, note, sure = UNITS[name][self.i > 2], "", False
        if free is not None:
            note = "held at its bound" + (
                f"; free, it would be {free:.3g} {unit}" if np.isfinite(free) else ""
            )
            self.findings.append(finding("at_bound", f"{self.axis}.{name}", free=free, unit=unit))
        elif not np.isfinite([low, high]).all():
            note = "the trials do not determine it"
        elif 0.5 * (high - low) > CERTAIN * abs(value):
            size = f"±{min(50.0 * (high - low) / abs(value), 9999.0):.0f} %" if value else "its own size"
            note = f"uncertain by {size}"
        else:
            sure = True
        return self.note(name, value, (low, high), sure, note, path)

    def added_mass(self, rigid: float) -> None:
        """m_eff less the rigid part. The rigid part is in [kg] or [kg m²]."""
        whole = self.estimates[f"{self.axis}.m_eff"]
        value, ends = whole.estimate - rigid, (whole.ci95[0] - rigid, whole.ci95[1] - rigid)
        sure, note = whole.identifiable, f"with the file's rigid {rigid:.4g} {whole.unit} as exact"
        if value <= 0.0:
            sure, note = False, f"m_eff is below the file's rigid {rigid:.4g} {whole.unit}"
            fields = {"effective": whole.estimate, "rigid": rigid, "unit": whole.unit}
            self.findings.append(finding("inertia_too_small", self.axis, **fields))
        elif ends[0] <= 0.0:
            sure, note = False, "not distinguishable from zero"
        half = 0.5 * (whole.ci95[1] - whole.ci95[0])
        before, path = float(self.file.M_A[self.i, self.i]), self.path("added_mass")
        if value > 0.0 and (half < USEFUL * whole.estimate or outside(before, ends)):
            self.changes[path] = value
        self.note("added_mass", value, ends, sure, note, path)

    def believe_nothing(self, reason: str) -> None:
        """Leave the numbers as they are, call none of them identifiable and write none."""
        self.estimates = {
            name: replace(e, identifiable=False, note=reason) for name, e in self.estimates.items()
        }
        self.changes = {}
        self.findings.append(finding("axis_refused", self.axis, reason=reason))


def trim(found: Mapping[str, Estimate], buoyancy: float, centre: Sequence[float]) -> dict[str, float]:
    """Return the centre of buoyancy that gives the constant moments of roll and pitch of a vehicle that lies tilted.

    B r_b - W r_g = (b_pitch, -b_roll, k), of which the centre of gravity stays.

    Places are in [m].

    Args:
        found: Estimates, `roll.bias` and `pitch.bias` among them.
        buoyancy: B [N].
        centre: r_b of the vehicle file [m].
    """
    out = {}
    for name, i, sign in (("pitch.bias", 0, 1.0), ("roll.bias", 1, -1.0)):
        bias = found.get(name)
        if bias is not None and bias.identifiable and outside(0.0, bias.ci95):
            out[f"body.center_of_buoyancy.{i}"] = float(centre[i]) + sign * bias.estimate / buoyancy
    return out


def hydrostatics(found: Mapping[str, Estimate], vehicle: Vehicle) -> tuple[dict[str, float], list[Finding]]:
    """Buoyancy excess, stiffness and constant moments as volume and centre of buoyancy; weight and its centre stay.

    Args:
        found: Estimates by name.
        vehicle: As its file has it.

    Returns:
        Changes of the vehicle file in its units, and a finding where roll and pitch disagree.
    """
    body, water, findings = vehicle.body, vehicle.water, list[Finding]()
    changes: dict[str, float] = {}
    volume = float(body.displaced_volume)
    excess = found.get("buoyancy_excess")
    if excess is not None and excess.identifiable:
        volume = (vehicle.weight + excess.estimate) / (water.density * water.gravity)
        changes["body.displaced_volume"] = volume
    buoyancy = water.density * water.gravity * volume
    changes |= trim(found, buoyancy, body.center_of_buoyancy)
    stiffness = float(matrices(vehicle).arm[2])
    some = [found[name] for name in ("roll.k", "pitch.k") if name in found]
    some = [e for e in some if e.estimate > 0.0 and (useful(e) or outside(stiffness, e.ci95))]
    if not some:
        return changes, findings
    half = np.array([0.5 * (e.ci95[1] - e.ci95[0]) for e in some])
    value = np.array([e.estimate for e in some])
    if len(some) == 2 and abs(value[0] - value[1]) > float(np.hypot(*half)):
        findings.append(finding("stiffness_disagrees", roll=value[0], pitch=value[1]))
    k = float(np.sum(value / half**2) / np.sum(1.0 / half**2))
    reference = float(vehicle.hydrodynamic_set("calibrated").reference_point[2])
    gravity_part = vehicle.weight * (float(body.center_of_gravity[2]) - reference)
    changes["body.center_of_buoyancy.2"] = reference + (k + gravity_part) / buoyancy
    return changes, findings


def useful(e: Estimate) -> bool:
    """Return whether an estimate is known to `USEFUL`."""
    return 0.5 * (e.ci95[1] - e.ci95[0]) < USEFUL * e.estimate


def outside(value: float, ends: Array | tuple[float, float]) -> bool:
    """Return whether a number lies outside an interval of the same unit that has two ends."""
    return bool(np.isfinite(ends).all() and not ends[0] <= value <= ends[1])
