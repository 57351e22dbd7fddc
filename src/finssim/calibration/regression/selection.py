"""Which damping an axis' trials support: linear, quadratic, or both."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.regression.axis_fit import TERMS, AxisData, AxisFit, fit_axis
from finssim.calibration.uncertainty import intervals

__all__ = ["DAMPING", "Damping", "Selection", "select"]

Array = NDArray[np.float64]

Damping = Literal["auto", "linear", "quadratic", "both"]
DAMPING: tuple[Damping, ...] = ("auto", "linear", "quadratic", "both")

AKAIKE = 0.157
"""Akaike's criterion keeps one more term when it is significant at this level (χ² of one degree above 2)."""

TELLING = 6.0
"""Twice a logarithm of likelihoods below which linear drag is not preferred to quadratic: odds of 20 to 1."""

D1, D2 = TERMS.index("d1"), TERMS.index("d2")


@dataclass(frozen=True, kw_only=True)
class Selection:
    """The model of one axis and the fuller one it was chosen from."""

    fit: AxisFit
    full: AxisFit
    """With both dampings."""
    dropped: tuple[str, ...]
    """Dampings that were left out because the data do not show them."""
    p_value: dict[str, float]
    """For each damping: probability of an estimate as large as that of the fuller model if it were zero."""
    interval: Array
    """95 % intervals of all terms, (7, 2): of a dropped term from the fuller model; of a kept one the hull of both
    models' when another was dropped, for nobody can be sure that it is zero. NaN for terms that were not asked for."""


def select(data: AxisData, damping: str = "auto") -> Selection:
    """Fit an axis with the dampings that the data support.

    `auto` starts from both and leaves out a term that is negative or that Akaike's criterion, with the standard error
    from the disagreement of the trials, does not keep; of two such terms the one with less evidence. One always stays,
    and where the data hardly tell linear from quadratic it is the quadratic one: a bluff body's drag is, and a linear
    one would be far off at higher speeds. The intervals hold both answers.

    Raises:
        CalibrationError: An unknown `damping`.
    """
    if damping not in DAMPING:
        raise CalibrationError(f"unknown damping '{damping}'; available: {', '.join(DAMPING)}")
    terms = data.terms
    if damping in ("linear", "quadratic"):
        terms[D2 if damping == "linear" else D1] = False
        smoothed = fit_axis(data, terms)
        fit = _without_needless_smoothing(data, smoothed)
        return Selection(
            fit=fit, full=fit, dropped=(), p_value={}, interval=_with_lag(data, _interval(fit), smoothed)
        )
    smoothed = fit_axis(data, terms)
    full = _without_needless_smoothing(data, smoothed)
    terms = full.terms.copy()
    p_value = {name: _p_value(full, TERMS.index(name)) for name in ("d1", "d2")}
    weak = [name for name, p in p_value.items() if p > AKAIKE]
    if damping == "both" or not weak:
        interval = _with_lag(data, _interval(full), smoothed)
        return Selection(fit=full, full=full, dropped=(), p_value=p_value, interval=interval)
    dropped = max(weak, key=lambda name: p_value[name])
    fit = fit_axis(data, _without(terms, dropped))
    tried = [full, fit]
    if dropped == "d2":
        other = fit_axis(data, _without(terms, "d1"))
        if _evidence(data, fit, other) < TELLING:
            dropped, fit = "d1", other
            tried.append(other)
    ends = np.stack([_interval(one) for one in tried])
    with np.errstate(all="ignore"):
        hull = np.stack([np.fmin.reduce(ends[..., 0]), np.fmax.reduce(ends[..., 1])], axis=-1)
    interval = _with_lag(data, hull, smoothed)
    return Selection(fit=fit, full=full, dropped=(dropped,), p_value=p_value, interval=interval)


def _without(terms: NDArray[np.bool_], name: str) -> NDArray[np.bool_]:
    out = terms.copy()
    out[TERMS.index(name)] = False
    return out


def _evidence(data: AxisData, one: AxisFit, other: AxisFit) -> float:
    """Twice the logarithm of the likelihood of one fit over another's with as many terms."""
    if not (one.theta[0] > 0.0 and other.theta[0] > 0.0) or other.active[D2]:
        return np.inf
    rss = [
        sum(
            float(np.sum((rows.y - line)[used] ** 2))
            for rows, line, used in zip(data.rows, fit.fitted, fit.used, strict=True)
        )
        for fit in (one, other)
    ]
    return one.independent * float(np.log(max(rss[1], 1e-300) / max(rss[0], 1e-300)))


def _without_needless_smoothing(data: AxisData, fit: AxisFit) -> AxisFit:
    """Once more without `smoothing` where the recording shows none: it costs certainty of the inertia."""
    term = TERMS.index("smoothing")
    if _p_value(fit, term) <= AKAIKE:
        return fit
    terms = fit.terms.copy()
    terms[term] = False
    return fit_axis(data, terms)


def _with_lag(data: AxisData, interval: Array, smoothed: AxisFit) -> Array:
    """Where the motion is late, nobody knows whether by a delay or by a lag of first order, which `smoothing` takes up.

    The inertia's interval then holds both answers.
    """
    inertia = TERMS.index("m_eff")
    if not data.shift or smoothed.active[inertia]:
        return interval
    out, other = interval.copy(), _interval(smoothed)[inertia]
    out[inertia] = np.fmin(out[inertia, 0], other[0]), np.fmax(out[inertia, 1], other[1])
    return out


def _p_value(fit: AxisFit, term: int) -> float:
    """Two-sided for a positive estimate, 1 for one that cannot be."""
    from scipy.stats import norm, t

    place = int(fit.terms[:term].sum())
    std, dof = float(fit.covariance.std[place]), float(fit.covariance.dof[place])
    if fit.free[term] <= 0.0 or not np.isfinite(std):
        return 1.0
    size = fit.free[term] / max(std, 1e-300)
    return float(2.0 * (t.sf(size, dof) if np.isfinite(dof) else norm.sf(size)))


def _interval(fit: AxisFit) -> Array:
    """About the free estimates, and where a bound moved them about the held ones too."""
    out = np.full((len(fit.terms), 2), np.nan)
    free, held = (intervals(x[fit.terms], fit.covariance) for x in (fit.free, fit.theta))
    out[fit.terms, 0] = np.minimum(free[:, 0], held[:, 0])
    out[fit.terms, 1] = np.maximum(free[:, 1], held[:, 1])
    return out
