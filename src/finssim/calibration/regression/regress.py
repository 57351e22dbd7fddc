"""Hydrodynamics axis by axis: the regression of paper, eq. 6, over many trials."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.degeneracy import degeneracy
from finssim.calibration.errors import CalibrationError
from finssim.calibration.fit import Correlation, Estimate, Fit
from finssim.calibration.regression.axis_data import Prepared, axis_data, excited, later, prepare
from finssim.calibration.regression.axis_doubts import LARGE_DELAY, late_velocity, quality, worthless
from finssim.calibration.regression.axis_estimates import AxisResult, axis_result, outside, trim
from finssim.calibration.regression.axis_fit import TERMS, AxisData
from finssim.calibration.regression.dive_and_coast import buoyancy_estimate
from finssim.calibration.regression.plant_terms import Matrices, matrices
from finssim.calibration.regression.selection import DAMPING, Selection, select
from finssim.calibration.trials.fittable import require_axes, require_fittable
from finssim.calibration.trials.trial import Trial
from finssim.vehicles import AXES, Vehicle

__all__ = ["regress"]

Array = NDArray[np.float64]

PASSES = 3
"""Rounds in which the couplings between axes are formed with the latest estimates."""

LARGEST_SHIFT = 0.5
"""Lag beyond which the wrench is not put later, but the trial doubted [s]."""

TILTS_INTO = {0: {1, 2}, 1: {0, 2}, 2: {0, 1}, 5: {0, 1}}
"""Axes whose coefficients decide an axis' motion at large tilt: what surge turns over sways too."""

SETTLED = 2e-3
"""Change of the left side, as a part of it, below which another round is not needed."""


def regress(
    trials: Sequence[Trial],
    vehicle: Vehicle,
    *,
    axes: Sequence[str] | None = None,
    damping: str = "auto",
    known: Mapping[str, float] | None = None,
    seed: int = 0,
) -> Fit:
    """Effective mass, damping, bias and, in roll and pitch, stiffness of every axis that the trials excite.

    m_eff nu_dot + d1 nu + d2 |nu| nu + b (+ k sin eta) = tau                                (paper, eq. 6)

    about the reference point of the vehicle's calibrated coefficients, in the weak form, with velocities simulated from
    the recorded wrench as instruments, Huber weights, and intervals from the disagreement of the trials.

    Args:
        trials: Trials; each names the axes it excites, or they are found from its input.
        vehicle: Gives the rigid body, what is known of couplings, and where the numbers go.
        axes: Axes to fit; all that are excited if None.
        damping: `auto`, `linear`, `quadratic` or `both`.
        known: Effective inertias M_RB + M_A that are known, by axis [kg, kg m²].
        seed: Kept with the fit; nothing here is random.

    Raises:
        CalibrationError: No trial can be used, one is held out, an axis or damping is unknown, or two share a name.
    """
    wanted = _wanted(axes)
    if damping not in DAMPING:
        raise CalibrationError(f"unknown damping '{damping}'; available: {', '.join(DAMPING)}")
    require_fittable(trials)
    driven = [trial for trial in trials if not trial.header.passive]
    prepared, warnings = prepare(driven, vehicle)
    chosen, plant, more = _fit_axes(prepared, vehicle, wanted, axes is not None, damping, known or {})
    warnings += more
    file = matrices(vehicle)
    estimates: dict[str, Estimate] = {}
    changes: dict[str, Any] = {}
    results: dict[str, AxisResult] = {}
    for i, (data, selection) in chosen.items():
        results[AXES[i]] = result = axis_result(data, selection, file)
        estimates |= result.estimates
        changes |= result.changes
        warnings += result.warnings
        if i == 2:
            buoyancy, notes = buoyancy_estimate(data, selection, vehicle)
            if result.worthless:
                buoyancy = replace(buoyancy, identifiable=False, note=result.worthless)
            estimates[buoyancy.name] = buoyancy
            warnings += notes
    used = {s.name for data, _ in chosen.values() for s in data.signals}
    _hydrostatics(estimates, changes, vehicle, plant, warnings)
    figures = {axis: result.quality for axis, result in results.items()}
    curves = [curve for result in results.values() for curve in result.curves]
    told = [axis for axis, result in results.items() if not result.worthless]
    warnings += late_velocity(figures, explained=told)
    quiet = _passive(trials, vehicle, [i for i in wanted if AXES[i] not in told], known or {})
    if quiet is not None:
        estimates, changes, figures = (
            estimates | quiet.estimates,
            changes | quiet.changes,
            figures | quiet.quality,
        )
        warnings += quiet.warnings
        curves += quiet.curves
        used |= set(quiet.trials)
    if not estimates:
        raise CalibrationError(
            f"no axis of {vehicle.name} can be fitted from these trials: "
            f"{'; '.join(warnings) or 'none excites an axis'}"
        )
    correlation, sentences = _correlation(chosen)
    return Fit(
        kind="hydrodynamics",
        method="regression",
        vehicle=vehicle,
        estimates=estimates,
        changes=changes,
        quality=figures,
        correlation=correlation,
        warnings=tuple(dict.fromkeys([*warnings, *sentences])),
        curves=tuple(curves),
        trials={trial.name: trial.sha256 for trial in trials if trial.name in used},
        settings={
            "damping": damping,
            "axes": [AXES[i] for i in chosen],
            **({"fix": {f"{axis}.m": m for axis, m in known.items()}} if known else {}),
            "seed": seed,
        },
    )


def _wanted(axes: Sequence[str] | None) -> list[int]:
    require_axes(axes)
    return [i for i, axis in enumerate(AXES) if axes is None or axis in axes]


def _fit_axes(
    prepared: list[Prepared],
    vehicle: Vehicle,
    wanted: list[int],
    asked: bool,
    damping: str,
    known: Mapping[str, float],
) -> tuple[dict[int, tuple[AxisData, Selection]], Matrices, list[str]]:
    """Data and model of every axis that can be fitted; couplings between axes use the estimates of the round before."""
    plant, warnings = matrices(vehicle), list[str]()
    waters = [matrices(vehicle, one.trial.header.water.density) for one in prepared]
    active = excited(prepared, vehicle) if prepared else np.zeros((0, 6), bool)
    fitted = {i for i in wanted if active[:, i].any()}
    chosen: dict[int, tuple[AxisData, Selection]] = {}
    for round_ in range(PASSES):
        settled, former = True, chosen
        chosen, warnings = {}, []
        for i in wanted:
            those = np.flatnonzero(active[:, i])
            keep = TILTS_INTO.get(i, set()) <= fitted
            data, said = axis_data(
                i, [prepared[g] for g in those], [waters[g] for g in those], keep_tilted=keep
            )
            warnings += [f"{AXES[i]}: {sentence}" for sentence in said]
            if data is None:
                if asked and not len(those):
                    warnings.append(f"{AXES[i]}: no trial excites it; the vehicle file keeps its numbers")
                continue
            data = replace(data, inertia=known.get(AXES[i]))
            if i in former and former[i][0].shift:
                data = later(data, former[i][0].shift)
            if round_ and i in former and _same(former[i][0], data):
                chosen[i] = (data, former[i][1])
                continue
            settled = False
            chosen[i] = (data, select(data, damping))
            lag = float(chosen[i][1].fit.theta[TERMS.index("delay")])
            if not data.shift and LARGE_DELAY < abs(lag) < LARGEST_SHIFT:
                data = later(data, lag)
                chosen[i] = (data, select(data, damping))
        if settled:
            break
        for i, (data, selection) in chosen.items():
            m, d1, d2 = selection.fit.theta[:3]
            if not worthless(data, quality(data, selection), selection):
                plant = plant.with_axis(i, m - plant.M_RB[i, i], max(d1, 0.0), max(d2, 0.0))
                waters = [w.with_axis(i, m - w.M_RB[i, i], max(d1, 0.0), max(d2, 0.0)) for w in waters]
    return chosen, plant, warnings


def _same(before: AxisData, now: AxisData) -> bool:
    """Whether the left sides differ so little that the estimates need not be formed anew."""
    if [s.name for s in before.signals] != [s.name for s in now.signals]:
        return False
    old = np.concatenate([rows.y for rows in before.rows])
    new = np.concatenate([rows.y for rows in now.rows])
    return len(old) == len(new) and float(np.std(new - old)) <= SETTLED * float(np.std(new))


def _hydrostatics(
    estimates: dict[str, Estimate],
    changes: dict[str, Any],
    vehicle: Vehicle,
    plant: Matrices,
    warnings: list[str],
) -> None:
    """Buoyancy excess and stiffness as changes of volume and centre of buoyancy; weight and centre of gravity stay."""
    volume = vehicle.body.displaced_volume
    excess = estimates.get("buoyancy_excess")
    if excess is not None and excess.identifiable:
        volume = (vehicle.weight + excess.estimate) / (vehicle.water.density * vehicle.water.gravity)
        changes["body.displaced_volume"] = float(volume)
    buoyancy = vehicle.water.density * vehicle.water.gravity * volume
    changes |= trim(estimates, buoyancy, vehicle.body.center_of_buoyancy)
    found = [estimates[name] for name in ("roll.k", "pitch.k") if name in estimates]
    stiffness = float(matrices(vehicle).arm[2])
    found = [e for e in found if e.identifiable or (e.estimate > 0.0 and outside(stiffness, e.ci95))]
    if not found:
        return
    half = np.array([0.5 * (e.ci95[1] - e.ci95[0]) for e in found])
    value = np.array([e.estimate for e in found])
    if len(found) == 2 and abs(value[0] - value[1]) > float(np.hypot(*half)):
        warnings.append(
            f"roll and pitch disagree on the stiffness ({value[0]:.4g} and {value[1]:.4g} N m/rad), which one height "
            "of the centre of buoyancy cannot give; their weighted mean was taken"
        )
    k = float(np.sum(value / half**2) / np.sum(1.0 / half**2))
    reference = float(vehicle.hydrodynamic_set("calibrated").reference_point[2])
    gravity_part = vehicle.weight * (float(vehicle.body.center_of_gravity[2]) - reference)
    changes["body.center_of_buoyancy.2"] = reference + (k + gravity_part) / buoyancy


def _correlation(chosen: dict[int, tuple[AxisData, Selection]]) -> tuple[Correlation | None, list[str]]:
    """Of all axes together, block by block, with a sentence for every trade-off."""
    names, blocks, sentences = list[str](), list[Array](), list[str]()
    for i, (_, selection) in chosen.items():
        fit = selection.fit
        own = [f"{AXES[i]}.{name}" for name, on in zip(TERMS, fit.terms, strict=True) if on]
        found, said = degeneracy(own, fit.covariance.local, fit.free[fit.terms])
        names += own
        blocks.append(found.matrix)
        sentences += said
    if not names:
        return None, []
    from scipy.linalg import block_diag

    return Correlation(names=tuple(names), matrix=block_diag(*blocks)), sentences


def _passive(
    trials: Sequence[Trial], vehicle: Vehicle, wanted: list[int], known: Mapping[str, float]
) -> Fit | None:
    """What trials without thrust show of axes that no driven trial did; None without such trials."""
    quiet = [trial for trial in trials if trial.header.passive]
    if not quiet or not wanted:
        return None
    from finssim.calibration.regression.passive import passive

    return passive(quiet, vehicle, axes=[AXES[i] for i in wanted], known=known)
