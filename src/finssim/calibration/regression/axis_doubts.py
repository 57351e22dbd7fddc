"""How much the regression of one axis is worth: figures of the fit, whether it explains anything, and findings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.findings import Finding, finding
from finssim.calibration.regression.axis_fit import TERMS, AxisData
from finssim.calibration.regression.selection import Selection
from finssim.vehicles import AXES

__all__ = ["LARGE_DELAY", "damping_known", "doubts", "late_velocity", "quality", "speed_range", "worthless"]

Array = NDArray[np.float64]

M, D1, D2, DELAY = (TERMS.index(name) for name in ("m_eff", "d1", "d2", "delay"))

EXPLAINED = 0.2
"""R² below which the model of an axis explains nothing: at 0 the mean of the wrench does as well."""

SEPARATE = 0.05
"""By how much velocity has to lag the rates to be named [s]."""

MOST_TILTED = 0.4
"""Share of samples at large tilt beyond which what remains is not believed: pitching fast through level."""

USEFUL = 0.5
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


def damping_known(data: AxisData, chosen: Selection, before: tuple[float, float]) -> bool:
    """Whether the drag is known at the speeds of the trials, at their median and near their top: to `USEFUL`, or well
    enough to exclude that of the vehicle file.

    Args:
        data: The trials.
        chosen: The model.
        before: d1 and d2 of the file.
    """
    from scipy.stats import t

    fit = chosen.fit
    found = (
        (fit.covariance.local, fit.covariance.trials)
        if fit.covariance.alone.any()
        else (fit.covariance.trials,)
    )
    dof = fit.covariance.dof[np.isin(np.flatnonzero(fit.terms), (D1, D2))]
    quantile = float(t.ppf(0.975, min(float(np.min(dof, initial=np.inf)), 1e6)))
    for speed in np.percentile(_moving(data, chosen), [50.0, 95.0]):
        weights = np.zeros(len(fit.terms))
        weights[[D1, D2]] = speed, speed**2
        force, w = float(weights @ fit.theta), weights[fit.terms]
        with np.errstate(invalid="ignore"):
            std = np.sqrt(max(w @ covariance @ w for covariance in found))
        if not (np.isfinite(std) and force > 0.0):
            return False
        close = quantile * std < USEFUL * force
        excluded = abs(before[0] * speed + before[1] * speed**2 - force) > quantile * std
        if not close and not excluded:
            return False
    return True


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


def doubts(axis: str, data: AxisData, chosen: Selection) -> list[Finding]:
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


def late_velocity(figures: dict[str, dict[str, float]], *, explained: list[str]) -> list[Finding]:
    """A finding where surge, sway and heave lag the wrench by more than roll, pitch and yaw: two streams, two clocks.

    Args:
        figures: `quality` of every axis.
        explained: Axes whose fit is worth something.
    """
    lags = [[figures[a]["delay"] for a in some if a in explained] for some in (AXES[:3], AXES[3:])]
    if not all(lags):
        return []
    difference = float(np.median(lags[0]) - np.median(lags[1]))
    if difference < SEPARATE:
        return []
    return [finding("velocity_late", late=difference)]
