"""From the regression of one axis to estimates, changes of the vehicle file, figures and warnings."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.fit import Curve, Estimate
from finssim.calibration.regression.axis_doubts import damping_known, doubts, quality, speed_range, worthless
from finssim.calibration.regression.axis_fit import TERMS, AxisData
from finssim.calibration.regression.plant_terms import Matrices
from finssim.calibration.regression.selection import Selection
from finssim.vehicles import AXES

__all__ = ["AxisResult", "axis_result"]

Array = NDArray[np.float64]

M, D1, D2, BIAS, DELAY, SMOOTHING, K = range(len(TERMS))

CERTAIN = 0.2
"""Half width of an interval, as a part of the estimate, up to which a parameter counts as identifiable."""

USEFUL = 0.5
"""The same, up to which an inertia is written to the vehicle file: better than a guess."""

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
    warnings: list[str]
    curves: list[Curve] = field(default_factory=list)
    worthless: str = ""
    """Why nothing that was found can be believed; empty where it can."""


def axis_result(data: AxisData, chosen: Selection, plant: Matrices) -> AxisResult:
    """Estimates of an axis.

    Args:
        data: Its trials.
        chosen: The model and its intervals.
        plant: For the rigid part of the inertia.
    """
    i, axis, fit = data.axis, AXES[data.axis], chosen.fit
    linear = i < 3
    low, high = speed_range(data, chosen)
    unit = "m/s" if linear else "rad/s"
    speeds = f"speeds of {low:.2g}-{high:.2g} {unit}"
    rigid = float(plant.M_RB[i, i])
    theta, ends = fit.theta, chosen.interval
    out: dict[str, Estimate] = {}
    changes: dict[str, Any] = {}
    warnings = []

    def add(name: str, term: int, unit: str, path: str | None = None, *, shift: float = 0.0) -> Estimate:
        value, (lower, upper) = theta[term] - shift, ends[term] - shift
        note, sure = "", bool(np.isfinite([lower, upper]).all())
        if fit.active[term]:
            note, sure = f"held at its bound 0; free, it would be {fit.free[term]:.3g}", False
            warnings.append(
                f"{axis}.{name} rests on its bound: free, it would be {fit.free[term]:.3g} {unit}"
            )
        elif sure and 0.5 * (upper - lower) > CERTAIN * abs(theta[term]):
            note, sure = f"known to no better than {_percent(upper - lower, theta[term])}", False
        found = Estimate(
            name=f"{axis}.{name}", estimate=float(value), ci95=(float(lower), float(upper)), unit=unit,
            identifiable=sure, note=note, path=path,
        )  # fmt: skip
        out[found.name] = found
        return found

    whole = add("m_eff", M, "kg" if linear else "kg m²")
    lag = data.shift + theta[DELAY]
    if data.shift and not fit.active[M]:
        late = f"the motion lags the file's motors by {lag * 1e3:.0f} ms: if that is a lag of first order "
        out[whole.name] = replace(whole, note="; ".join(filter(None, [whole.note, late + LAG_NOTE])))
    _added_mass(out, changes, warnings, axis, i, theta[M] - rigid, ends[M] - rigid, rigid)
    for name, term, family, unit_d in (
        ("d1", D1, "linear_damping", "N s/m" if linear else "N m s"),
        ("d2", D2, "quadratic_damping", "N s²/m²" if linear else "N m s²"),
    ):
        path = f"{SET}.{family}.{i}.{i}"
        if name in chosen.dropped:
            out[f"{axis}.{name}"] = Estimate(
                name=f"{axis}.{name}", estimate=0.0, ci95=_pair(ends[term]), unit=unit_d, identifiable=False,
                note=f"not distinguishable from zero at {speeds}", path=path,
            )  # fmt: skip
        elif fit.terms[term]:
            add(name, term, unit_d, path)
    if damping_known(data, chosen):
        for name, family in (("d1", "linear_damping"), ("d2", "quadratic_damping")):
            changes[f"{SET}.{family}.{i}.{i}"] = max(float(theta[D1 if name == "d1" else D2]), 0.0)
    else:
        warnings.append(f"{axis}: damping is not determined by {speeds}; the vehicle file keeps its numbers")
    if data.restoring:
        add("k", K, "N m/rad", "body.center_of_buoyancy.2")
    bias = add("bias", BIAS, "N" if linear else "N m")
    out[bias.name] = Estimate(
        name=bias.name, estimate=bias.estimate, ci95=bias.ci95, unit=bias.unit,
        identifiable=bool(np.isfinite(bias.ci95).all()), note=BIAS_NOTE,
    )  # fmt: skip

    if 0.0 < low and high < DECADE * low:
        warnings.append(f"{axis} damping rests on {speeds}, less than a decade")
    warnings += doubts(axis, data, chosen)
    figures = quality(data, chosen)
    reason = worthless(data, figures, chosen)
    if reason:
        out = {n: replace(e, identifiable=False, note=reason) for n, e in out.items()}
        changes = {}
        warnings.append(f"{axis}: {reason}; the vehicle file keeps its numbers")
    return AxisResult(
        estimates=out, changes=changes, quality=figures, warnings=warnings, curves=_curves(data, chosen),
        worthless=reason,
    )  # fmt: skip


def _added_mass(
    out: dict[str, Estimate], changes: dict[str, Any], warnings: list[str], axis: str, i: int, value: float,
    ends: Array, rigid: float,
) -> None:  # fmt: skip
    whole = out[f"{axis}.m_eff"]
    unit, path = whole.unit, f"{SET}.added_mass.{i}.{i}"
    sure, note = whole.identifiable, f"with the file's rigid {rigid:.4g} {unit} as exact"
    if value <= 0.0:
        sure = False
        note = f"m_eff is below the file's rigid {rigid:.4g} {unit}"
        warnings.append(
            f"{axis}: an effective inertia of {whole.estimate:.4g} {unit} is below the rigid {rigid:.4g} {unit} of the "
            "vehicle file, so that added mass would be negative: check the thrust and the file's mass or inertia"
        )
    elif ends[0] <= 0.0:
        sure, note = False, "not distinguishable from zero"
    half = 0.5 * (whole.ci95[1] - whole.ci95[0])
    if value > 0.0 and half < USEFUL * whole.estimate:
        changes[path] = float(value)
    out[f"{axis}.added_mass"] = Estimate(
        name=f"{axis}.added_mass", estimate=float(value), ci95=_pair(ends), unit=unit, identifiable=sure,
        note=note, path=path,
    )  # fmt: skip


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
