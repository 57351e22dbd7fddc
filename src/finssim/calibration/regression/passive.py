"""Trials with the thrusters off: free decay of roll and pitch, and buoyant rise.

Without a known force a motion shows ratios only: k/m, d1/m, d2/m of a decay, (B - W)/m of a rise. Absolute values
follow from one number of the vehicle file, which every estimate names.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.fit import Curve, Estimate, Fit
from finssim.calibration.regression.buoyant_rise import Rise, buoyant_rise
from finssim.calibration.regression.free_decay import BOTH, Decay, free_decay
from finssim.calibration.regression.plant_terms import Matrices, matrices
from finssim.calibration.regression.pooling import pooled, pooled_positive
from finssim.calibration.trials.trial import Trial
from finssim.vehicles import AXES, Vehicle

__all__ = ["passive"]

Array = NDArray[np.float64]

SET = "hydrodynamics.calibrated"


def passive(
    trials: Sequence[Trial],
    vehicle: Vehicle,
    *,
    axes: Sequence[str] | None = None,
    assume: Literal["restoring", "inertia"] = "restoring",
) -> Fit:
    """What trials without thrust tell.

    Args:
        trials: Each with one release.
        vehicle: Gives the number that is taken as known.
        axes: Of roll, pitch and heave; all if None.
        assume: `restoring`: the stiffness k = B z_b - W z_g of the file is right; `inertia`: its M_RB + M_A is.

    Raises:
        CalibrationError: No trial shows a decay or a rise.
    """
    plant = matrices(vehicle)
    estimates: dict[str, Estimate] = {}
    changes: dict[str, Any] = {}
    quality: dict[str, dict[str, float]] = {}
    warnings, curves, used = list[str](), list[Curve](), set[str]()
    for axis in ("roll", "pitch"):
        if axes is not None and axis not in axes:
            continue
        decays, swinging = [], []
        for trial in trials:
            try:
                decays.append(free_decay(trial, axis))
                swinging.append(trial)
            except CalibrationError as error:
                warnings.append(str(error))
        if not decays:
            continue
        if len({d.terms for d in decays}) > 1:  # one vehicle, one kind of damping
            decays = [free_decay(trial, axis, terms=BOTH) for trial in swinging]
        used |= {d.trial for d in decays}
        estimates |= _decay_estimates(axis, decays, plant, assume, changes, warnings)
        quality[axis] = {
            "r2": float(np.mean([d.r2 for d in decays])),
            "trials": float(len(decays)),
            "seconds": float(sum(d.end - d.begin for d in decays)),
        }
        curves += [_decay_curve(d) for d in decays]
    if axes is None or "heave" in axes:
        rises = []
        for trial in trials:
            try:
                rises.append(buoyant_rise(trial))
            except CalibrationError as error:
                warnings.append(str(error))
        used |= {rise.trial for rise in rises}
        found = _rise_estimates(rises, plant) if rises else {}
        warnings += _contradictions(found, plant)
        estimates |= found
        curves += [_rise_curve(rise) for rise in rises]
    if not estimates:
        raise CalibrationError(f"no trial shows a free decay or a rise: {'; '.join(warnings)}")
    return Fit(
        kind="hydrodynamics",
        method="passive",
        vehicle=vehicle,
        estimates=estimates,
        changes=changes,
        quality=quality,
        warnings=tuple(dict.fromkeys(warnings)),
        curves=tuple(curves),
        trials={trial.name: trial.sha256 for trial in trials if trial.name in used},
        settings={"assume": assume},
    )


def _decay_estimates(
    axis: str,
    decays: list[Decay],
    plant: Matrices,
    assume: str,
    changes: dict[str, Any],
    warnings: list[str],
) -> dict[str, Estimate]:
    i = AXES.index(axis)
    k, m = float(plant.arm[2]), float(plant.M_RB[i, i] + plant.M_A[i, i])
    if assume == "restoring" and k <= 0.0:
        raise CalibrationError(
            f"{axis}: the vehicle file has a stiffness of {k:.4g} N m/rad, expected one above 0: give the centres of "
            "gravity and buoyancy, or assume the inertia"
        )
    said = (
        f"with the file's k = {k:.4g} N m/rad"
        if assume == "restoring"
        else f"with the file's inertia {m:.4g} kg m²"
    )
    swings = sorted(d.swing for d in decays)
    swing = (
        f"swings of {swings[0]:.2g}-{swings[-1]:.2g} rad/s"
        if len(decays) > 1
        else f"a swing of {swings[0]:.2g} rad/s"
    )

    def estimate(name: str, unit: str, of: Any, note: str = "", path: str | None = None) -> Estimate:
        """Pool a function of x = ln w2, c1, c2 over the decays that have it."""
        values, stds, dof = (
            np.array(column) for column in zip(*(_derived(d, of) for d in decays), strict=True)
        )
        value, low, high = pooled_positive(values, stds, dof)
        sure = bool(np.isfinite([low, high]).all() and 0.5 * (high - low) <= 0.5 * abs(value))
        return Estimate(
            name=f"{axis}.{name}", estimate=value, ci95=(low, high), unit=unit, identifiable=sure,
            note=note if sure or note else "not known to half its size", path=path,
        )  # fmt: skip

    def inertia(x: Array, _: Decay) -> float:
        return k / math.exp(x[0]) if assume == "restoring" else m

    def ratio(x: Array, d: Decay) -> float:
        # A quadratic term counts as the linear one that takes the same energy out of the largest swing.
        return float((x[1] + 8.0 / (3.0 * math.pi) * x[2] * d.swing) / (2.0 * math.exp(0.5 * x[0])))

    damping: dict[str, float] = {}
    linear, quadratic = (any(d.terms[j] for d in decays) for j in (0, 1))
    out = [
        estimate("natural_frequency", "rad/s", lambda x, _: math.exp(0.5 * x[0])),
        estimate("damping_ratio", "-", ratio, f"at {swing}"),
        estimate("m_eff", "kg m²", inertia, said),
    ]
    for name, j, family, unit, there in (
        ("d1", 1, "linear_damping", "N m s", linear),
        ("d2", 2, "quadratic_damping", "N m s²", quadratic),
    ):
        path = f"{SET}.{family}.{i}.{i}"
        if there:
            some = [d for d in decays if d.terms[j - 1]]
            found = [_derived(d, lambda x, d, j=j: x[j] * inertia(x, d)) for d in some]
            value, low, high = pooled(*(np.array(column) for column in zip(*found, strict=True)))
            sure = bool(low > 0.0)
            out.append(
                Estimate(
                    name=f"{axis}.{name}", estimate=value, ci95=(low, high), unit=unit, identifiable=sure,
                    note=said, path=path,
                )
            )  # fmt: skip
            damping[path] = max(value, 0.0)
        else:
            out.append(
                Estimate(
                    name=f"{axis}.{name}", estimate=0.0, ci95=(math.nan, math.nan), unit=unit, identifiable=False,
                    note=f"{swing} need it not", path=path,
                )
            )  # fmt: skip
            damping[path] = 0.0
    if out[1].identifiable and out[2].identifiable:
        changes.update(damping)
    if assume == "inertia":
        out[2] = replace(out[2], identifiable=False)
    if assume == "restoring":
        whole = out[2]
        rigid = float(plant.M_RB[i, i])
        positive = whole.estimate > rigid
        out.insert(
            3,
            Estimate(
                name=f"{axis}.added_mass", estimate=whole.estimate - rigid,
                ci95=(whole.ci95[0] - rigid, whole.ci95[1] - rigid), unit="kg m²",
                identifiable=whole.identifiable and whole.ci95[0] > rigid, note=said, path=f"{SET}.added_mass.{i}.{i}",
            ),
        )  # fmt: skip
        if positive and whole.identifiable:
            changes[f"{SET}.added_mass.{i}.{i}"] = whole.estimate - rigid
        elif not positive:
            warnings.append(
                f"{axis}: {said} the inertia is {whole.estimate:.4g} kg m², below the file's rigid {rigid:.4g} kg m²: "
                "check the centres of gravity and buoyancy, or the inertia"
            )
    else:
        out.append(
            estimate("k", "N m/rad", lambda x, _: m * math.exp(x[0]), said, "body.center_of_buoyancy.2")
        )
    for d in decays:
        if d.drift:
            warnings.append(
                f"{d.trial}: the equilibrium of {axis} moved during the decay; straight pieces follow it"
            )
    return {e.name: e for e in out}


def _derived(decay: Decay, of: Any) -> tuple[float, float, float]:
    """A function of x = ln w2, c1, c2 and the decay with its standard error and degrees of freedom."""
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


def _rise_estimates(rises: list[Rise], plant: Matrices) -> dict[str, Estimate]:
    """Pooled over the trials, on logarithms."""
    m = float(plant.M_RB[2, 2] + plant.M_A[2, 2])
    speed = _pooled([(r.terminal_speed, *r.terminal_ci95) for r in rises])
    ratio = _pooled([(r.excess_ratio, *r.excess_ci95) for r in rises])
    drag = ", ".join(f"{r.trial}: {'quadratic' if r.quadratic else 'linear'} drag" for r in rises)
    found = [
        Estimate(
            name="heave.terminal_speed", estimate=speed[0], ci95=speed[1:], unit="m/s",
            identifiable=speed[2] < 3.0 * speed[1], note=f"of a rise; {drag}",
        ),
        Estimate(
            name="buoyancy_excess", estimate=m * ratio[0], ci95=(m * ratio[1], m * ratio[2]), unit="N",
            identifiable=ratio[2] < 3.0 * ratio[1],
            note=f"from the acceleration, with the file's mass and added mass in heave, {m:.4g} kg",
            path="body.displaced_volume",
        ),
    ]  # fmt: skip
    return {e.name: e for e in found}


def _contradictions(found: dict[str, Estimate], plant: Matrices) -> list[str]:
    """A sentence where the file's excess of buoyancy, which a rise does not replace, lies outside the interval."""
    excess = found.get("buoyancy_excess")
    if excess is None or excess.ci95[0] <= plant.excess <= excess.ci95[1]:
        return []
    low, high = excess.ci95
    sign = ": the vehicle rises, the file's sinks" if plant.excess < 0.0 < low else ""
    return [
        f"heave: the vehicle file's buoyancy less weight is {plant.excess:.3g} N, outside the {low:.2g} to "
        f"{high:.2g} N of the rise{sign}: weigh the vehicle in water, or set body.displaced_volume"
    ]


def _pooled(found: list[tuple[float, float, float]]) -> tuple[float, float, float]:
    """Of estimates with 95 % intervals that are symmetric on logarithms."""
    value, low, high = np.array(found).T
    return pooled_positive(value, value * np.log(high / low) / (2.0 * 1.96), np.full(len(found), np.inf))


def _decay_curve(d: Decay) -> Curve:
    t, measured = d.rate_measured if len(d.rate_measured[0]) else d.sine_measured
    line = d.rate if len(d.rate_measured[0]) else d.sine
    return Curve(
        title=f"{d.trial}: free decay of {d.axis}", x_label="time [s]",
        y_label="rate [rad/s]" if line is d.rate else "sine of the angle [-]",
        x=t, measured=measured, fitted=np.interp(t, d.t, line),
    )  # fmt: skip


def _rise_curve(rise: Rise) -> Curve:
    return Curve(
        title=f"{rise.trial}: rise", x_label="time [s]", y_label="height [m]", x=rise.t, measured=rise.measured,
        fitted=rise.z,
    )  # fmt: skip
