"""From the regression of one axis to estimates, changes of the vehicle file, figures and findings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from finssim.identification.fit import Curve, Estimate
from finssim.identification.regression.axis_fit import TERMS, AxisData, Selection
from finssim.identification.regression.plant_terms import Matrices, matrices
from finssim.trials.findings import Finding, finding
from finssim.vehicles import AXES, Vehicle

Array = NDArray[np.float64]

# How much the regression of one axis is worth: figures of the fit, whether it explains anything, and findings.

EXPLAINED = 0.2
"""R² below which the model of an axis explains nothing: at 0 the mean of the wrench does as well."""

MOST_TILTED = 0.4
"""Share of samples at large tilt beyond which what remains is not believed: pitching fast through level."""

USEFUL_DRAG = 0.5
"""Half width of the interval of a damping force, as a part of it, up to which it is written: better than a guess."""

LARGE_DELAY = 0.02
"""Lag of the motion behind the wrench worth a warning [s]."""


def worthless(data: AxisData, figures: dict[str, float], chosen: Selection) -> str:
    """Why nothing that was found of an axis can be believed; empty where it can.

    Args:
        data: Its trials.
        figures: `quality`.
        chosen: Its model.
    """
    if not figures["r2"] >= EXPLAINED:
        return f"the model explains nothing of this axis' wrench: R² {figures['r2']:.2f}"
    if not chosen.fit.theta[M] > 0.0:
        return f"the fit finds no inertia on this axis: free, it would be {chosen.fit.free[M]:.3g}"
    if data.tilted > MOST_TILTED:
        return (
            f"{100.0 * data.tilted:.0f} % of the samples are at large tilt, where the file's numbers for other axes "
            "decide: fit surge, sway and heave together, or push less"
        )
    return ""


def drag_known(
    d: Array,
    free: NDArray[np.bool_],
    covariances: Sequence[Array],
    quantile: float,
    speeds: Sequence[float],
    before: tuple[float, float],
) -> bool:
    """Whether the drag of an axis is known at some speeds: to `USEFUL_DRAG`, or to exclude that of the vehicle file.

    Args:
        d: d1 [N s/m, N m s] and d2 [N s²/m², N m s²], (2,).
        free: Which of them were fitted, (2,).
        covariances: Of those that were; the widest counts.
        quantile: Half widths of an interval, in standard deviations.
        speeds: At which the drag has to be known [m/s, rad/s].
        before: d1 and d2 of the file.
    """
    for speed in speeds:
        powers = np.array([speed, speed**2])
        force, w = float(powers @ d), powers[free]
        with np.errstate(invalid="ignore"):
            half = quantile * np.sqrt(max(max(w @ C @ w for C in covariances), 0.0))
        if not (np.isfinite(half) and force > 0.0):
            return False
        if not (half < USEFUL_DRAG * force or abs(powers @ before - force) > half):
            return False
    return True


def _damping_known(data: AxisData, chosen: Selection, before: tuple[float, float]) -> bool:
    """`drag_known` at the median and near the top of the speeds of the trials."""
    from scipy.stats import t

    fit, C = chosen.fit, chosen.fit.covariance
    at = np.flatnonzero(np.isin(np.flatnonzero(fit.terms), (D1, D2)))
    covariances = [V[np.ix_(at, at)] for V in ((C.local, C.trials) if C.alone.any() else (C.trials,))]
    quantile = float(t.ppf(0.975, min(float(np.min(C.dof[at], initial=np.inf)), 1e6)))
    speeds = np.percentile(_moving(data, chosen), [50.0, 95.0]).tolist()
    return drag_known(fit.theta[[D1, D2]], fit.terms[[D1, D2]], covariances, quantile, speeds, before)


def _moving(data: AxisData, chosen: Selection) -> Array:
    """Speeds of the rows that stand out of their noise; a zero where none does."""
    speed = np.concatenate(
        [np.abs(rows.X[used, 1]) for rows, used in zip(data.rows, chosen.fit.used, strict=True)]
    )
    top = float(np.percentile(speed, 95.0)) if len(speed) else 0.0
    moving = speed[speed > 0.02 * top]
    return moving if len(moving) else np.zeros(1)


def speed_range(data: AxisData, chosen: Selection) -> tuple[float, float]:
    """5th and 95th percentile of the speeds that damping rests on: rows whose speed stands out of its noise."""
    moving = _moving(data, chosen)
    if len(moving) < 5:
        return 0.0, float(moving.max())
    low, high = np.percentile(moving, [5.0, 95.0])
    return float(low), float(high)


def quality(data: AxisData, chosen: Selection) -> dict[str, float]:
    """Figures of the fit."""
    fit = chosen.fit
    y = np.concatenate([rows.y[used] for rows, used in zip(data.rows, fit.used, strict=True)])
    p = np.concatenate([line[used] for line, used in zip(fit.fitted, fit.used, strict=True)])
    rmse = float(np.sqrt(np.mean((y - p) ** 2)))
    spread = float(np.percentile(y, 95.0) - np.percentile(y, 5.0))
    low, high = speed_range(data, chosen)
    return {
        "r2": 1.0 - rmse**2 / max(float(np.var(y)), 1e-300),
        "rmse": rmse,
        "nrmse": rmse / max(spread, 1e-300),
        "samples": float(sum(rows.samples for rows in data.rows)),
        "rejected": float(sum(rows.rejected for rows in data.rows)),
        "trials": float(len(data.rows)),
        "independent": float(fit.independent),
        "speed_low": low,
        "speed_high": high,
        "delay": float(fit.theta[DELAY] + data.shift),
        **{f"p_{name}": value for name, value in chosen.p_value.items()},
    }


def axis_findings(axis: str, data: AxisData, chosen: Selection) -> list[Finding]:
    """What may be wrong with the fit of an axis."""
    fit, out = chosen.fit, []
    lag, value = chosen.interval[DELAY] + data.shift, fit.theta[DELAY] + data.shift
    if abs(value) > LARGE_DELAY and (lag[0] > 0.0 or lag[1] < 0.0):
        sense = "lags" if value > 0 else "leads"
        out.append(finding("motion_late", axis, sense=sense, lag=abs(value), low=lag[0], high=lag[1]))
    if not fit.instrumental:
        out.append(finding("least_squares", axis))
    if fit.evidence.unit == "blocks":
        out.append(finding("block_intervals", axis, trials=len(data.rows)))
    level = [s.name for s in data.signals if not np.isfinite(s.up).any()]
    if level:
        out.append(finding("attitude_missing", axis, trials=tuple(level)))
    unknown = sorted({j for s in data.signals for j in s.unknown})
    if unknown:
        out.append(finding("velocity_unknown", axis, axes=tuple(str(AXES[j]) for j in unknown)))
    return out


M, D1, D2, BIAS, DELAY, SMOOTHING, K = range(len(TERMS))

CERTAIN = 0.2
"""Half width of an interval, as a part of the estimate, up to which a parameter counts as identifiable."""

USEFUL = 0.5
"""The same, up to which an inertia is written to the vehicle file: better than a guess."""

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
"""Of the numbers of an axis: along it, and about it."""


class Number(NamedTuple):
    """A number of an axis as it was fitted."""

    value: float
    ends: tuple[float, float]
    """95 % interval; not finite where the trials do not determine it."""
    free: float | None = None
    """What it would be without the bound that it rests on; None where it rests on none."""


@dataclass(kw_only=True)
class AxisResult:
    """Estimates, changes of the vehicle file and findings of one axis, from its numbers.

    What the data know well is written, and so is what they know badly where the vehicle file's number lies outside the
    interval: a wide interval is a better answer than a number that it excludes.
    """

    axis: str
    numbers: Mapping[str, Number]
    """Of `UNITS`, what was fitted."""
    file: Matrices
    """The vehicle as its file has it."""
    speeds: tuple[float, float]
    """Lowest and highest that the damping rests on [m/s, rad/s]."""
    drag_known: bool
    """Whether the damping is known well enough to be written; both of its terms are, or neither."""
    dropped: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Damping that was left out, because the data do not show it -> its 95 % interval."""
    retained: Set[str] = frozenset()
    """Of that, what stays the vehicle file's, for the data exclude it as little as zero."""
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
            if name in self.dropped:
                value = self.value(name)
                nor = ", nor from the file's," if value else ""
                note = f"not distinguishable from zero{nor} at speeds of {low:.2g}-{high:.2g} {unit}"
                self.note(name, value, self.dropped[name], False, note, self.path(family))
            elif name in self.numbers:
                self.add(name, self.path(family))
            if self.drag_known and name not in self.retained:
                self.changes[self.path(family)] = max(self.value(name), 0.0)
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
        """Of the axis' own entry in a matrix of the vehicle file."""
        return f"{SET}.{family}.{self.i}.{self.i}"

    def value(self, name: str) -> float:
        """Of a number; where it was not fitted 0, or the vehicle file's."""
        if name in self.retained:
            return float({"d1": self.file.D1, "d2": self.file.D2}[name][self.i, self.i])
        return self.numbers[name].value if name in self.numbers else 0.0

    def note(
        self,
        name: str,
        value: float,
        ends: tuple[float, float],
        sure: bool,
        note: str,
        path: str | None = None,
    ) -> Estimate:
        """Take an estimate."""
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
        """m_eff less the rigid part."""
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


def regression_result(data: AxisData, chosen: Selection, file: Matrices) -> tuple[AxisResult, str]:
    """The result of an axis from its regression, and why nothing of it can be believed; empty where it can.

    Args:
        data: Its trials.
        chosen: Its model.
        file: The vehicle as its file has it.
    """
    fit, i, axis = chosen.fit, data.axis, AXES[data.axis]
    numbers = {}
    for term, name in enumerate(TERMS):
        if name in UNITS and fit.terms[term]:
            ends = (float(chosen.interval[term, 0]), float(chosen.interval[term, 1]))
            free = float(fit.free[term]) if fit.active[term] else None
            numbers[name] = Number(float(fit.theta[term]), ends, free)
    dropped = {name: tuple(chosen.interval[TERMS.index(name)]) for name in chosen.dropped}
    before = (float(file.D1[i, i]), float(file.D2[i, i]))
    result = AxisResult(
        axis=axis, numbers=numbers, file=file, speeds=speed_range(data, chosen), dropped=dropped,
        drag_known=_damping_known(data, chosen, before), given=data.inertia,
    )  # fmt: skip
    if data.shift and data.inertia is None and not fit.active[M]:
        lag = 1e3 * (data.shift + fit.theta[DELAY])
        late = (
            f"the motion lags the file's motors by {lag:.0f} ms: if that is a lag of first order and not a delay, the "
            "inertia may read too high: fit the motors first"
        )
        whole = result.estimates[f"{axis}.m_eff"]
        note = "; ".join(filter(None, [whole.note, late]))
        result.estimates[whole.name] = replace(whole, note=note)
    result.findings += axis_findings(axis, data, chosen)
    reason = worthless(data, quality(data, chosen), chosen)
    if reason:
        result.believe_nothing(reason)
    return result, reason


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


def hydrostatics(found: Mapping[str, Estimate], vehicle: Vehicle) -> tuple[dict[str, float], list[Finding]]:
    """Buoyancy excess, stiffness and constant moments as volume and centre of buoyancy; weight and its centre stay.

    Args:
        found: Estimates by name.
        vehicle: As its file has it.

    Returns:
        Changes of the vehicle file, and a finding where roll and pitch disagree.
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
    some = [e for e in some if e.identifiable or (e.estimate > 0.0 and outside(stiffness, e.ci95))]
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


def outside(value: float, ends: Array | tuple[float, float]) -> bool:
    """Whether a number lies outside an interval that has two ends."""
    return bool(np.isfinite(ends).all() and not ends[0] <= value <= ends[1])


def curves_of(data: AxisData, chosen: Selection) -> list[Curve]:
    """Wrench, and velocity simulated from the wrench alone, over all trials of an axis."""
    axis, linear, wrench, velocity = AXES[data.axis], data.axis < 3, [], []
    for g, (s, rows) in enumerate(zip(data.signals, data.rows, strict=True)):
        wrench.append((s.t[rows.at], rows.y, chosen.fit.fitted[g]))
        if chosen.fit.simulated:
            inside = np.zeros(len(s.t), bool)
            for begin, end in rows.spans:
                inside[begin:end] = True
            both = (s.nu[:, data.axis], chosen.fit.simulated[g])
            velocity.append((s.t, *(np.where(inside, line, np.nan) for line in both)))
    out = [Curve.joined(f"{axis}: wrench", "force [N]" if linear else "moment [N m]", wrench)]
    if velocity:
        title = f"{axis}: velocity, simulated from the wrench alone"
        out.append(Curve.joined(title, "velocity [m/s]" if linear else "rate [rad/s]", velocity))
    return out
