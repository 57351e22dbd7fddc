"""From the regression of one axis to estimates, changes of the vehicle file, figures and warnings."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.axis_fit import TERMS, AxisData
from finssim.calibration.fit import Curve, Estimate
from finssim.calibration.plant_terms import Matrices
from finssim.calibration.selection import Selection
from finssim.calibration.uncertainty import intervals
from finssim.vehicles import AXES

__all__ = ["AxisResult", "axis_result", "speed_range"]

Array = NDArray[np.float64]

M, D1, D2, BIAS, DELAY, SMOOTHING, K = range(len(TERMS))

CERTAIN = 0.2
"""Half width of an interval, as a part of the estimate, up to which a parameter counts as identifiable."""

USEFUL = 0.5
"""The same, up to which an inertia or a damping force is written to the vehicle file: better than a guess."""

LARGE_DELAY = 0.02
"""Lag of the motion behind the wrench worth a warning [s]."""

DECADE = 10.0

GAP = np.full(1, np.nan)
"""Between the lines of two trials."""

SET = "hydrodynamics.calibrated"


@dataclass(frozen=True, kw_only=True)
class AxisResult:
    """What the report says of one axis."""

    estimates: dict[str, Estimate]
    changes: dict[str, Any]
    quality: dict[str, float]
    warnings: list[str]
    curves: list[Curve] = field(default_factory=list)


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

    add("m_eff", M, "kg" if linear else "kg m²")
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
    if _damping_known(chosen, high):
        for name, family in (("d1", "linear_damping"), ("d2", "quadratic_damping")):
            changes[f"{SET}.{family}.{i}.{i}"] = max(float(theta[D1 if name == "d1" else D2]), 0.0)
    else:
        warnings.append(f"{axis}: damping is not determined by {speeds}; the vehicle file keeps its numbers")
    if data.restoring:
        add("k", K, "N m/rad", "body.center_of_buoyancy.2")
    bias = add("bias", BIAS, "N" if linear else "N m")
    out[bias.name] = Estimate(
        name=bias.name, estimate=bias.estimate, ci95=bias.ci95, unit=bias.unit,
        identifiable=bool(np.isfinite(bias.ci95).all()), note="on the side of the damping, at no speed",
    )  # fmt: skip

    if 0.0 < low and high < DECADE * low:
        warnings.append(f"{axis} damping rests on {speeds}, less than a decade")
    warnings += _doubts(axis, data, chosen)
    quality = _quality(data, chosen)
    return AxisResult(
        estimates=out, changes=changes, quality=quality, warnings=warnings, curves=_curves(data, chosen)
    )


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


def _damping_known(chosen: Selection, speed: float) -> bool:
    """Whether the damping force at the highest speeds is known to `USEFUL`."""
    fit = chosen.fit
    weights = np.zeros(len(TERMS))
    weights[[D1, D2]] = speed, speed**2
    force = float(weights @ fit.theta)
    w = weights[fit.terms]
    covariance = np.where(fit.covariance.alone.any(), fit.covariance.local, fit.covariance.trials)
    with np.errstate(invalid="ignore"):
        std = np.sqrt(w @ covariance @ w)
    return bool(np.isfinite(std) and force > 0.0 and 2.0 * std < USEFUL * force)


def speed_range(data: AxisData, chosen: Selection) -> tuple[float, float]:
    """5th and 95th percentile of the speeds that damping rests on: rows whose speed stands out of its noise."""
    speed = np.concatenate(
        [np.abs(rows.X[used, 1]) for rows, used in zip(data.rows, chosen.fit.used, strict=True)]
    )
    top = float(np.percentile(speed, 95.0)) if len(speed) else 0.0
    moving = speed[speed > 0.02 * top]
    if len(moving) < 5:
        return 0.0, top
    return float(np.percentile(moving, 5.0)), top


def _doubts(axis: str, data: AxisData, chosen: Selection) -> list[str]:
    fit, out = chosen.fit, []
    lag = intervals(fit.free[fit.terms], fit.covariance)[int(fit.terms[:DELAY].sum())]
    if abs(fit.theta[DELAY]) > LARGE_DELAY and (lag[0] > 0.0 or lag[1] < 0.0):
        out.append(
            f"{axis}: the motion {'lags' if fit.theta[DELAY] > 0 else 'leads'} the recorded wrench by "
            f"{abs(fit.theta[DELAY]) * 1e3:.0f} ms [{lag[0] * 1e3:.0f}, {lag[1] * 1e3:.0f}]; the fit allows for it, "
            "but check the clocks, or the delay and lag of the motors"
        )
    if not fit.instrumental:
        out.append(
            f"{axis}: the estimate could not be simulated, so ordinary least squares was used, which noise of the "
            "velocity biases"
        )
    if fit.evidence.unit == "blocks":
        out.append(
            f"{axis}: {len(data.rows)} trial{'s' if len(data.rows) > 1 else ''}: intervals come from blocks within "
            "them; what differs from trial to trial is not in them"
        )
    level = [s.name for s in data.signals if not np.isfinite(s.up).any()]
    if level:
        out.append(
            f"{axis}: no attitude in {', '.join(level[:3])}{' and others' if len(level) > 3 else ''}: the vehicle was "
            "taken as level, so that weight and buoyancy bend the estimates where it was not"
        )
    unknown = sorted({j for s in data.signals for j in s.unknown})
    if unknown:
        words = ", ".join(AXES[j] for j in unknown)
        out.append(f"{axis}: the velocity of {words} is unknown; couplings with it were taken as zero")
    return out


def _quality(data: AxisData, chosen: Selection) -> dict[str, float]:
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
        "delay": float(fit.theta[DELAY]),
        **{f"p_{name}": value for name, value in chosen.p_value.items()},
    }


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
