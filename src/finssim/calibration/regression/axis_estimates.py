"""From the regression of one axis to estimates, changes of the vehicle file, figures and findings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.findings import Finding, finding
from finssim.calibration.fit import Curve, Estimate
from finssim.calibration.regression.axis_doubts import damping_known, doubts, quality, speed_range, worthless
from finssim.calibration.regression.axis_fit import TERMS, AxisData
from finssim.calibration.regression.plant_terms import Matrices
from finssim.calibration.regression.selection import Selection
from finssim.vehicles import AXES
from finssim.vehicles.terms import unit_of

__all__ = ["BIAS_NOTE", "CERTAIN", "AxisResult", "axis_result", "term_estimate"]

Array = NDArray[np.float64]

M, D1, D2, BIAS, DELAY, SMOOTHING, K = range(len(TERMS))

CERTAIN = 0.2
"""Half width of an interval, as a part of the estimate, up to which a parameter counts as identifiable."""

USEFUL = 0.5
"""The same, up to which an inertia is written to the vehicle file: better than a guess."""

FORMED = 0.01
"""Error of an estimate of a term's parameter by products of measured velocities, as a part of it; intervals hold it."""

DECADE = 10.0

GAP = np.full(1, np.nan)
"""Between the lines of two trials."""

SET = "hydrodynamics.calibrated"

LAG_NOTE = "and not a delay, the inertia may read too high: fit the motors first"

BIAS_NOTE = (
    "a constant force; above zero it opposes motion in the positive direction, as damping does: tether, trim or the "
    "offset of a sensor"
)


@dataclass(frozen=True, kw_only=True)
class AxisResult:
    """What the report says of one axis."""

    estimates: dict[str, Estimate]
    changes: dict[str, Any]
    quality: dict[str, float]
    findings: list[Finding]
    curves: list[Curve] = field(default_factory=list)
    worthless: str = ""
    """Why nothing that was found can be believed; empty where it can."""


def axis_result(data: AxisData, chosen: Selection, file: Matrices) -> AxisResult:
    """Estimates of an axis.

    What the data know well is written, and so is what they know badly where the vehicle file's number lies outside the
    interval: a wide interval is a better answer than a number that it excludes.

    Args:
        data: Its trials.
        chosen: The model and its intervals.
        file: The vehicle as its file has it.
    """
    axis = AXES[data.axis]
    low, high = speed_range(data, chosen)
    speeds = {"low": low, "high": high, "unit": "m/s" if data.axis < 3 else "rad/s"}
    draft = _Draft(data=data, chosen=chosen, file=file)
    draft.inertia()
    draft.added_mass(float(file.M_RB[data.axis, data.axis]))
    draft.damping(speeds)
    if data.restoring:
        draft.add("k", K, "N m/rad", "body.center_of_buoyancy.2")
    draft.bias()
    if 0.0 < low and high < DECADE * low:
        draft.findings.append(finding("few_speeds", axis, **speeds))
    draft.findings += doubts(axis, data, chosen)
    figures = quality(data, chosen)
    reason = worthless(data, figures, chosen)
    if reason:
        draft.believe_nothing(reason)
    return AxisResult(
        estimates=draft.estimates, changes=draft.changes, quality=figures, findings=draft.findings,
        curves=_curves(data, chosen), worthless=reason,
    )  # fmt: skip


@dataclass(kw_only=True)
class _Draft:
    """What is found of one axis, term by term."""

    data: AxisData
    chosen: Selection
    file: Matrices
    estimates: dict[str, Estimate] = field(default_factory=dict)
    changes: dict[str, Any] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)

    @property
    def axis(self) -> str:
        """By name."""
        return AXES[self.data.axis]

    def unit(self, translation: str, rotation: str) -> str:
        """That of the axis."""
        return translation if self.data.axis < 3 else rotation

    def path(self, family: str) -> str:
        """Of the axis' own entry in a matrix of the vehicle file."""
        return f"{SET}.{family}.{self.data.axis}.{self.data.axis}"

    def add(self, name: str, term: int, unit: str, path: str | None = None) -> Estimate:
        """Take the estimate of a term, and a finding where it rests on its bound."""
        fit = self.chosen.fit
        value, (lower, upper) = fit.theta[term], self.chosen.interval[term]
        note, sure = "", bool(np.isfinite([lower, upper]).all())
        if fit.active[term]:
            note, sure = f"held at its bound 0; free, it would be {fit.free[term]:.3g}", False
            self.findings.append(finding("at_bound", f"{self.axis}.{name}", free=fit.free[term], unit=unit))
        elif sure and 0.5 * (upper - lower) > CERTAIN * abs(value):
            note, sure = f"known to no better than {_percent(upper - lower, value)}", False
        found = Estimate(
            name=f"{self.axis}.{name}", estimate=float(value), ci95=(float(lower), float(upper)), unit=unit,
            identifiable=sure, note=note, path=path,
        )  # fmt: skip
        self.estimates[found.name] = found
        return found

    def inertia(self) -> None:
        """m_eff, and in its note a lag that may be part of it."""
        if self.data.inertia is not None:
            m, name = self.data.inertia, f"{self.axis}.m_eff"
            self.estimates[name] = Estimate(
                name=name,
                estimate=m,
                ci95=(m, m),
                unit=self.unit("kg", "kg m²"),
                identifiable=True,
                note="given",
            )
            return
        whole = self.add("m_eff", M, self.unit("kg", "kg m²"))
        lag = self.data.shift + self.chosen.fit.theta[DELAY]
        if self.data.shift and not self.chosen.fit.active[M]:
            late = (
                f"the motion lags the file's motors by {lag * 1e3:.0f} ms: if that is a lag of first order "
            )
            note = "; ".join(filter(None, [whole.note, late + LAG_NOTE]))
            self.estimates[whole.name] = replace(whole, note=note)

    def added_mass(self, rigid: float) -> None:
        """m_eff less the rigid part."""
        whole = self.estimates[f"{self.axis}.m_eff"]
        value, ends = whole.estimate - rigid, np.array(whole.ci95) - rigid
        unit, path = whole.unit, self.path("added_mass")
        sure, note = whole.identifiable, f"with the file's rigid {rigid:.4g} {unit} as exact"
        if value <= 0.0:
            sure = False
            note = f"m_eff is below the file's rigid {rigid:.4g} {unit}"
            self.findings.append(
                finding("inertia_too_small", self.axis, effective=whole.estimate, rigid=rigid, unit=unit)
            )
        elif ends[0] <= 0.0:
            sure, note = False, "not distinguishable from zero"
        half = 0.5 * (whole.ci95[1] - whole.ci95[0])
        before = float(self.file.M_A[self.data.axis, self.data.axis])
        if value > 0.0 and (half < USEFUL * whole.estimate or outside(before, ends)):
            self.changes[path] = value
        name = f"{self.axis}.added_mass"
        self.estimates[name] = Estimate(
            name=name, estimate=value, ci95=_pair(ends), unit=unit, identifiable=sure, note=note, path=path
        )

    def damping(self, speeds: Mapping[str, Any]) -> None:
        """d1 and d2; both go to the vehicle file or neither."""
        theta = self.chosen.fit.theta
        for name, term, family, unit in (
            ("d1", D1, "linear_damping", self.unit("N s/m", "N m s")),
            ("d2", D2, "quadratic_damping", self.unit("N s²/m²", "N m s²")),
        ):
            if name in self.chosen.dropped:
                whole = f"{self.axis}.{name}"
                self.estimates[whole] = Estimate(
                    name=whole, estimate=0.0, ci95=_pair(self.chosen.interval[term]), unit=unit, identifiable=False,
                    note="not distinguishable from zero at speeds of {low:.2g}-{high:.2g} {unit}".format(**speeds),
                    path=self.path(family),
                )  # fmt: skip
            elif self.chosen.fit.terms[term]:
                self.add(name, term, unit, self.path(family))
        i = self.data.axis
        if damping_known(self.data, self.chosen, (float(self.file.D1[i, i]), float(self.file.D2[i, i]))):
            self.changes[self.path("linear_damping")] = max(float(theta[D1]), 0.0)
            self.changes[self.path("quadratic_damping")] = max(float(theta[D2]), 0.0)
        else:
            self.findings.append(finding("damping_unknown", self.axis, **speeds))

    def bias(self) -> None:
        """b, identifiable wherever it has an interval, for it may well be zero."""
        found = self.add("bias", BIAS, self.unit("N", "N m"))
        sure = bool(np.isfinite(found.ci95).all())
        self.estimates[found.name] = replace(found, identifiable=sure, note=BIAS_NOTE)

    def believe_nothing(self, reason: str) -> None:
        """Leave the numbers as they are, call none of them identifiable and write none."""
        self.estimates = {
            name: replace(e, identifiable=False, note=reason) for name, e in self.estimates.items()
        }
        self.changes = {}
        self.findings.append(finding("axis_refused", self.axis, reason=reason))


def term_estimate(
    path: str, chosen: Mapping[int, tuple[AxisData, Selection]]
) -> tuple[Estimate | None, list[Finding]]:
    """A parameter of the vehicle's terms from all axes on which it acts, weighted by the squares of their intervals.

    Args:
        path: Such as `lift.coefficient`.
        chosen: Data and model of the axes that can be believed.

    Returns:
        None where it acts on none of them; and a finding where axes disagree, or none has an interval.
    """
    values, halves, names = [], [], []
    for i, (data, selection) in chosen.items():
        column = len(TERMS) + data.estimated.index(path)
        low, high = selection.interval[column]
        if selection.fit.terms[column] and np.isfinite([low, high]).all() and high > low:
            values.append(float(selection.fit.theta[column]))
            halves.append(max(high - values[-1], values[-1] - low))
            names.append(AXES[i])
    if not values:
        return None, [finding("term_unfitted", path)]
    weight = np.asarray(halves) ** -2.0
    value = float(weight @ values / weight.sum())
    half = float(np.hypot(weight.sum() ** -0.5, FORMED * value))
    sure, note = half <= CERTAIN * abs(value), f"from {', '.join(names)}"
    if not sure:
        note += f"; known to no better than {_percent(2.0 * half, value)}"
    said = []
    if np.any(np.abs(np.asarray(values) - value) > 2.0 * np.hypot(halves, half)):
        told = tuple(f"{name} {x:.4g} ± {h:.2g}" for name, x, h in zip(names, values, halves, strict=True))
        said = [finding("term_disagrees", path, estimates=told)]
    found = Estimate(
        name=path, estimate=value, ci95=(value - half, value + half), unit=unit_of(path), identifiable=sure, note=note,
        path=f"{SET}.{path}",
    )  # fmt: skip
    return found, said


def trim(found: Mapping[str, Estimate], buoyancy: float, centre: Sequence[float]) -> dict[str, float]:
    """Where the centre of buoyancy sits for the constant moments of roll and pitch, as of a vehicle that lies tilted.

    B r_b - W r_g = (b_pitch, -b_roll, k), of which the centre of gravity stays.

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


def outside(value: float, ends: Array | tuple[float, float]) -> bool:
    """Whether a number lies outside an interval that has two ends."""
    return bool(np.isfinite(ends).all() and not ends[0] <= value <= ends[1])


def _curves(data: AxisData, chosen: Selection) -> list[Curve]:
    axis, linear = AXES[data.axis], data.axis < 3
    lines: list[list[Array]] = [[] for _ in range(6)]
    t, y, p, tv, v, vs = lines
    offset = 0.0
    for g, (s, rows) in enumerate(zip(data.signals, data.rows, strict=True)):
        clock = s.t - s.t[0] + offset
        t += [clock[rows.at], GAP]
        y += [rows.y, GAP]
        p += [chosen.fit.fitted[g], GAP]
        if chosen.fit.simulated:
            inside = np.zeros(len(clock), bool)
            for begin, end in rows.spans:
                inside[begin:end] = True
            tv += [clock, GAP]
            v += [np.where(inside, s.nu[:, data.axis], np.nan), GAP]
            vs += [np.where(inside, chosen.fit.simulated[g], np.nan), GAP]
        offset = clock[-1] + 1.0
    cat = np.concatenate
    out = [
        Curve(
            title=f"{axis}: wrench", x_label="time, trial after trial [s]",
            y_label="force [N]" if linear else "moment [N m]", x=cat(t), measured=cat(y), fitted=cat(p),
        )
    ]  # fmt: skip
    if tv:
        out.append(
            Curve(
                title=f"{axis}: velocity, simulated from the wrench alone", x_label="time, trial after trial [s]",
                y_label="velocity [m/s]" if linear else "rate [rad/s]", x=cat(tv), measured=cat(v), fitted=cat(vs),
            )
        )  # fmt: skip
    return out


def _pair(ends: Array) -> tuple[float, float]:
    return float(ends[0]), float(ends[1])


def _percent(width: float, value: float) -> str:
    if value == 0.0:
        return "its own size"
    return f"±{50.0 * width / abs(value):.0f} %"
