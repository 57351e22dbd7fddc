"""Surge, sway or yaw left to themselves: drag over inertia from the fall of the speed after a push.

    nu_dot + c1 nu + c2 |nu| nu = 0,    c1 = d1/m,  c2 = d2/m

    nu(t) = nu_0 e / (1 + a (1 - e)),    s(t) = s_0 + sign(nu_0) ln(1 + a (1 - e)) / c2

with e = exp(-c1 t) and a = c2 |nu_0| / c1.

m is the effective inertia of the axis, M_RB + M_A. No force is known, so that ratios are all that a coast shows.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.fit import Curve, Estimate
from finssim.calibration.motion.signals import motion
from finssim.calibration.regression.plant_terms import Matrices
from finssim.calibration.trials.trial import NU, Trial
from finssim.calibration.uncertainty import Evidence, correlated_samples, intervals, trial_covariance
from finssim.vehicles import AXES, Vehicle

__all__ = ["COASTING", "Coast", "CoastResult", "coast_of", "coast_result"]

Array = NDArray[np.float64]

COASTING = ("surge", "sway", "yaw")
"""Axes without a restoring force."""

LEAST_SPEED = (0.03, 0.03, 0.0, 0.0, 0.0, 0.05)
"""Speed at the release below which nothing coasts, by axis [m/s, rad/s]."""

FALLS_TO = 0.7
"""Part of its first speed to which a coast has to fall."""

GROWS = 1.15
"""Factor above the lowest speed so far at which something pushes again."""

FEWEST_TRIALS = 4
"""With fewer, trials are cut into blocks to estimate the spread."""

BLOCKS = 6
"""In each of these trials."""

LINEAR, QUADRATIC, BOTH = (True, False), (False, True), (True, True)
"""Which of c1, c2 are fitted."""

SMALL = 1e-9
"""In place of zero where the closed form divides by a ratio."""


@dataclass(frozen=True, kw_only=True)
class Coast:
    """One trial from its release on."""

    trial: str
    axis: str
    rate: tuple[Array, Array]
    """Times since the release [s] and speeds [m/s, rad/s]; empty where an angle is there instead."""
    angle: tuple[Array, Array]
    """Times since the release and headings [s, rad], unwrapped; of yaw alone, without a gyro."""
    speed: float
    """At the release, with its sign [m/s, rad/s]."""
    lowest: float
    """Smallest speed that stands out of the noise [m/s, rad/s]."""

    @property
    def samples(self) -> tuple[Array, Array]:
        """The one of `rate` and `angle` that is fitted."""
        return self.rate if len(self.rate[0]) else self.angle


@dataclass(frozen=True, kw_only=True)
class CoastResult:
    """What the coasts of one axis show."""

    estimates: list[Estimate]
    changes: dict[str, Any]
    """Dotted path -> value, of the vehicle file."""
    quality: dict[str, float]
    curves: list[Curve]


def coast_of(trial: Trial, axis: str, vehicle: Vehicle) -> Coast:
    """The coast of one axis in a trial without thrust: from its largest speed until something pushes again.

    Args:
        trial: Passive; with the velocity of the axis, or for yaw the heading.
        axis: Of `COASTING`.
        vehicle: Gives the places of sensors.

    Raises:
        CalibrationError: Nothing was measured of that axis, or it does not slow down.
    """
    i = AXES.index(axis)
    moved = motion(trial, vehicle)
    nu = moved.nu[:, i]
    known = np.isfinite(nu)
    if known.sum() < 20:
        raise CalibrationError(f"the velocity of {axis} is unknown", trial.name)
    t, speed = moved.t[known], np.abs(nu[known])
    noise = float(np.nan_to_num(moved.noise_std[i]))
    begin = int(np.argmax(speed))
    after = speed[begin:]
    floor = max(3.0 * noise, 0.02 * after[0])
    pushed = np.flatnonzero(after > GROWS * np.minimum.accumulate(after) + floor)
    end = begin + (int(pushed[0]) if len(pushed) else len(after)) - 1
    if (
        speed[begin] < max(LEAST_SPEED[i], 5.0 * noise)
        or speed[end] > FALLS_TO * speed[begin]
        or end - begin < 20
    ):
        raise CalibrationError(f"{axis} does not coast to a lower speed", trial.name)
    start, stop = float(t[begin]), float(t[end])
    nothing = np.empty(0), np.empty(0)
    rate, angle = nothing, nothing
    if trial.has(NU[i]):
        rate = _between(*trial.series(NU[i]), start, stop)
    elif axis == "yaw" and trial.has("yaw"):
        at, heading = trial.series("yaw")
        angle = _between(at, np.unwrap(heading), start, stop)
    else:
        rate = _between(t, nu[known], start, stop)
    return Coast(
        trial=trial.name, axis=axis, rate=rate, angle=angle, speed=float(nu[known][begin]),
        lowest=max(floor, float(speed[begin : end + 1].min())),
    )  # fmt: skip


def _between(t: Array, values: Array, start: float, stop: float) -> tuple[Array, Array]:
    inside = (t >= start) & (t <= stop)
    return t[inside] - start, values[inside]


def coast_result(
    axis: str, coasts: Sequence[Coast], vehicle: Vehicle, plant: Matrices, known: Mapping[str, float]
) -> CoastResult:
    """Drag over inertia of one axis from all its coasts, and the drag itself with a known or the file's inertia.

    Args:
        axis: Of `COASTING`.
        coasts: One or more.
        vehicle: As the file has it.
        plant: Its matrices about the reference point.
        known: Effective inertias that are known, by axis [kg, kg m²]; those of the file for the others.
    """
    fits = [_Fit(coasts, terms) for terms in (LINEAR, QUADRATIC, BOTH)]
    best = min(fits, key=lambda fit: fit.criterion(fits[-1].independent))
    i, linear = AXES.index(axis), axis != "yaw"
    rigid = float(plant.M_RB[i, i])
    m = float(known.get(axis, rigid + plant.M_A[i, i]))
    unit, said = ("kg" if linear else "kg m²"), "given" if axis in known else "the file's"
    top = max(abs(coast.speed) for coast in coasts)
    ends = intervals(best.ratios[best.free], best.covariance)
    estimates, changes = [], {}
    words = {LINEAR: "linear", QUADRATIC: "quadratic", BOTH: "linear and quadratic"}[best.terms]
    low = min(coast.lowest for coast in coasts)
    speeds = f"speeds of {low:.2g}-{top:.2g} {'m/s' if linear else 'rad/s'}"
    drag = best.ratios * [1.0, top]
    share = f", {drag[1] / drag.sum():.0%} of it quadratic at the fastest" if best.terms == BOTH else ""
    set_ = "hydrodynamics.calibrated"
    for j, (name, family) in enumerate((("d1", "linear_damping"), ("d2", "quadratic_damping"))):
        path = f"{set_}.{family}.{i}.{i}"
        ratio_unit = "1/s" if j == 0 else ("1/m" if linear else "1/rad")
        absolute = ("N s/m", "N s²/m²")[j] if linear else ("N m s", "N m s²")[j]
        if best.terms[j]:
            (a, b), value = ends[int(best.terms[0]) * j], float(best.ratios[j])
            a, b = max(float(a), 0.0), float(b)
            sure = 0.5 * (b - a) <= 0.5 * value
            note = f"{words} drag at {speeds}{share}"
        else:
            (a, b), value, sure = fits[-1].interval(j), 0.0, False
            note = f"{words} drag alone explains the coasts at {speeds}"
        changes[path] = m * value
        estimates.append(
            Estimate(
                name=f"{axis}.{name}/m_eff", estimate=value, ci95=(a, b), unit=ratio_unit, identifiable=sure,
                note=note,
            )
        )  # fmt: skip
        estimates.append(
            Estimate(
                name=f"{axis}.{name}", estimate=m * value, ci95=(m * a, m * b), unit=absolute, identifiable=sure,
                note=f"{name}/m_eff times {said} inertia of {m:.4g} {unit}, as exact", path=path,
            )
        )  # fmt: skip
    if axis in known:
        added = m - rigid
        changes[f"{set_}.added_mass.{i}.{i}"] = added
        estimates.insert(
            0, Estimate(name=f"{axis}.m_eff", estimate=m, ci95=(m, m), unit=unit, identifiable=True, note="given")
        )  # fmt: skip
    residual, values = (
        best.residual(best.x),
        np.concatenate([c.samples[1] - c.samples[1].mean() for c in coasts]),
    )
    rmse = {fit.terms: float(np.sqrt(np.mean(fit.residual(fit.x) ** 2))) for fit in fits}
    quality = {
        "r2": 1.0 - float(np.mean(residual**2)) / max(float(np.mean(values**2)), 1e-300),
        "rmse": rmse[best.terms],
        "rmse_linear": rmse[LINEAR],
        "rmse_quadratic": rmse[QUADRATIC],
        "trials": float(len(coasts)),
        "speed_low": low,
        "speed_high": top,
    }
    return CoastResult(estimates=estimates, changes=changes, quality=quality, curves=best.curves())


class _Fit:
    """Least squares of all coasts of an axis; x = the fitted ones of ln c1, ln c2, then nu_0 and s_0 of each."""

    def __init__(self, coasts: Sequence[Coast], terms: tuple[bool, bool]) -> None:
        from scipy.optimize import least_squares

        self.coasts, self.terms = tuple(coasts), terms
        self.free = np.array(terms)
        self.P = int(self.free.sum())
        longest = max(float(c.samples[0][-1]) for c in coasts)
        speed = float(np.median([abs(c.speed) for c in coasts]))
        first = np.log([1.0 / longest, 1.0 / (longest * speed)])[self.free]
        own = [[c.speed, c.samples[1][0]] if len(c.angle[0]) else [c.speed] for c in coasts]
        start = np.concatenate([first + np.log(2.0), *own])
        low, high = np.full(len(start), -np.inf), np.full(len(start), np.inf)
        low[: self.P], high[: self.P] = first - 12.0, first + 8.0
        solved = least_squares(self.residual, start, bounds=(low, high), x_scale="jac", max_nfev=200)
        self.x = solved.x
        self.ratios = self._ratios(solved.x)
        sizes = [len(c.samples[0]) for c in coasts]
        edges = np.cumsum(sizes)[:-1]
        residual = np.asarray(solved.fun)
        correlated = correlated_samples(residual, edges.tolist())
        self.independent = len(residual) / correlated
        self.rss = float(residual @ residual)
        variance = self.rss / max(len(residual) - len(start), 1) * correlated
        # The unknowns of a trial of its own are eliminated: N_g - B C⁻¹ Bᵀ; the score of the rest is unchanged there.
        J = np.asarray(solved.jac).copy()
        J[:, : self.P] /= self.ratios[self.free]  # of the ratios, not of their logarithms
        normal, score = [], []
        group = np.repeat(np.arange(len(sizes)), sizes)
        for g in range(len(coasts)):
            rows = group == g
            shared, mine = J[rows][:, : self.P], J[rows][:, self.P :]
            mine = mine[:, np.any(mine != 0.0, axis=0)]
            clean = shared - mine @ np.linalg.lstsq(mine, shared, rcond=None)[0]
            parts = BLOCKS if len(coasts) < FEWEST_TRIALS else 1
            for block in np.array_split(np.arange(rows.sum()), parts):
                normal.append(clean[block].T @ clean[block] / variance)
                score.append(-clean[block].T @ residual[rows][block] / variance)
        unit = "trials" if len(coasts) >= FEWEST_TRIALS else "blocks"
        names = tuple(name for name, on in zip(("c1", "c2"), terms, strict=True) if on)
        self.covariance = trial_covariance(
            Evidence(names=names, normal=np.array(normal), score=np.array(score), unit=unit)
        )

    def _ratios(self, x: Array) -> Array:
        """c1, c2, zero where not fitted."""
        out = np.zeros(2)
        out[self.free] = np.exp(x[: self.P])
        return out

    def lines(self, x: Array) -> list[Array]:
        """What the samples of every coast would be."""
        c1, c2 = np.maximum(self._ratios(x), SMALL)
        out, at = [], self.P
        for coast in self.coasts:
            t = coast.samples[0]
            nu_0 = x[at]
            fallen = -np.expm1(-c1 * t)
            a = c2 * abs(nu_0) / c1
            if len(coast.angle[0]):
                out.append(x[at + 1] + math.copysign(1.0, nu_0) * np.log1p(a * fallen) / c2)
                at += 2
            else:
                out.append(nu_0 * (1.0 - fallen) / (1.0 + a * fallen))
                at += 1
        return out

    def residual(self, x: Array) -> Array:
        """Predicted minus measured."""
        return np.concatenate(
            [line - coast.samples[1] for line, coast in zip(self.lines(x), self.coasts, strict=True)]
        )

    def criterion(self, independent: float) -> float:
        """Schwarz' criterion, with as many samples as are independent by the fuller model."""
        size = max(self.rss / sum(len(c.samples[0]) for c in self.coasts), 1e-300)
        return independent * math.log(size) + self.P * math.log(max(independent, 2.0))

    def interval(self, j: int) -> tuple[float, float]:
        """Of c1 (0) or c2 (1), 95 %."""
        low, high = intervals(self.ratios[self.free], self.covariance)[int(self.terms[0]) * j]
        return max(float(low), 0.0), float(high)

    def curves(self) -> list[Curve]:
        """Measured and fitted, one for each coast."""
        out = []
        for coast, line in zip(self.coasts, self.lines(self.x), strict=True):
            angle = bool(len(coast.angle[0]))
            speed = "speed [m/s]" if coast.axis != "yaw" else "rate [rad/s]"
            out.append(
                Curve(
                    title=f"{coast.trial}: coast of {coast.axis}", x_label="time since the release [s]",
                    y_label="heading [rad]" if angle else speed, x=coast.samples[0], measured=coast.samples[1],
                    fitted=line,
                )
            )  # fmt: skip
        return out
