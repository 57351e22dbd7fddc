"""Trials with the thrusters off: free decay of roll and pitch, coasts of surge, sway and yaw, and buoyant rise.

Without a known force a motion shows ratios only: k/m, d1/m, d2/m of a decay, d1/m, d2/m of a coast, (B - W)/m of a
rise. Absolute values follow from one number that is given or the vehicle file's, which every estimate names.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Literal

import numpy as np

from finssim.calibration.errors import CalibrationError
from finssim.calibration.fit import Curve, Estimate, Fit
from finssim.calibration.regression.buoyant_rise import Rise, buoyant_rise
from finssim.calibration.regression.coast_down import COASTING, coast_of, coast_result
from finssim.calibration.regression.decay_estimates import decay_result
from finssim.calibration.regression.free_decay import BOTH, Decay, free_decay
from finssim.calibration.regression.plant_terms import Matrices, matrices
from finssim.calibration.regression.pooling import pooled_positive
from finssim.calibration.trials.trial import Trial
from finssim.vehicles import Vehicle

__all__ = ["passive"]


def passive(
    trials: Sequence[Trial],
    vehicle: Vehicle,
    *,
    axes: Sequence[str] | None = None,
    assume: Literal["restoring", "inertia"] = "restoring",
    known: Mapping[str, float] | None = None,
) -> Fit:
    """What trials without thrust tell.

    Args:
        trials: Each with one release.
        vehicle: Gives the number that is taken as known.
        axes: All if None.
        assume: `restoring`: the stiffness k = B z_b - W z_g of the file is right; `inertia`: its M_RB + M_A is.
        known: Effective inertias M_RB + M_A that are known, by axis [kg, kg m²], for coasts.

    Raises:
        CalibrationError: No trial shows a decay or a rise.
    """
    plant = matrices(vehicle)
    estimates: dict[str, Estimate] = {}
    changes: dict[str, Any] = {}
    quality: dict[str, dict[str, float]] = {}
    warnings, missing, curves, used = list[str](), list[str](), list[Curve](), set[str]()
    for axis in ("roll", "pitch"):
        decays = _decays(trials, axis, missing) if axes is None or axis in axes else []
        if not decays:
            continue
        found = decay_result(axis, decays, plant, assume)
        estimates |= {e.name: e for e in found.estimates}
        changes |= found.changes
        warnings += found.warnings
        quality[axis] = _decay_quality(decays)
        curves += [_decay_curve(d) for d in decays]
        used |= {d.trial for d in decays}
    rises = _each(trials, buoyant_rise, missing) if axes is None or "heave" in axes else []
    if rises:
        risen = _rise_estimates(rises, plant)
        estimates |= risen
        warnings += _contradictions(risen, plant)
        curves += [_rise_curve(rise) for rise in rises]
        used |= {rise.trial for rise in rises}
    for axis in COASTING:
        wanted = axes is None or axis in axes
        coasts = _each(trials, partial(coast_of, axis=axis, vehicle=vehicle), missing) if wanted else []
        if coasts:
            coasted = coast_result(axis, coasts, vehicle, plant, known or {})
            estimates |= {e.name: e for e in coasted.estimates}
            changes |= coasted.changes
            quality[axis] = coasted.quality
            curves += coasted.curves
            used |= {coast.trial for coast in coasts}
    if not estimates:
        reasons = "; ".join(sentence for sentence in missing if sentence.startswith(f"{trials[0].name}: "))
        others = f"; and {len(trials) - 1} trials more" if len(trials) > 1 else ""
        raise CalibrationError(
            f"no trial shows a free decay, a coast or a rise: {reasons or 'none was given'}{others}"
        )
    # That a trial shows one motion and not the others is no news.
    warnings += [
        sentence for sentence in missing if not sentence.startswith(tuple(f"{name}: " for name in used))
    ]
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


def _decays(trials: Sequence[Trial], axis: str, missing: list[str]) -> list[Decay]:
    """Those of one axis, all with the same kind of damping."""
    decays: list[Decay] = _each(trials, partial(free_decay, axis=axis), missing)
    if len({d.terms for d in decays}) > 1:  # one vehicle, one kind of damping
        swinging = {d.trial for d in decays}
        decays = [free_decay(trial, axis, terms=BOTH) for trial in trials if trial.name in swinging]
    return decays


def _decay_quality(decays: Sequence[Decay]) -> dict[str, float]:
    return {
        "r2": float(np.mean([d.r2 for d in decays])),
        "trials": float(len(decays)),
        "seconds": float(sum(d.end - d.begin for d in decays)),
    }


def _each(trials: Sequence[Trial], find: Callable[[Trial], Any], missing: list[str]) -> list[Any]:
    """What is found in each trial; why one shows nothing goes to `missing`."""
    found = []
    for trial in trials:
        try:
            found.append(find(trial))
        except CalibrationError as error:
            missing.append(str(error))
    return found


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
