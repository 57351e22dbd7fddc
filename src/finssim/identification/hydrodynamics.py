"""The hydrodynamics of a vehicle from its trials: the scale of thrust, the fit, and whether it replays better."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from finssim.core.progress import progress_bar
from finssim.identification.axis_result import CERTAIN
from finssim.identification.fit import Estimate, Fit
from finssim.identification.plant_terms import matrices
from finssim.identification.report import finish, refuse_places, usable_trials
from finssim.identification.vehicle_file import calibrated, scaled_thrust
from finssim.trials.findings import CalibrationError, Finding, finding
from finssim.trials.inputs import drive, require_axes
from finssim.trials.trial import Trial
from finssim.vehicles import AXES, Vehicle, load_vehicle

WORSE = 1.05
"""Factor on the vehicle file's NRMSE above which the fit replays an axis worse than the file."""

CLEARLY = 0.7
"""Factor on the vehicle file's NRMSE of the fitted trials below which other trials are not replayed worse either."""

FEWEST_LEFT, MOST_LEFT_OUT = 2, 8
"""Trials that a fit without one needs, and trials up to which one fit for each is cheap."""

UNKNOWN_VOLTAGE = "no battery voltage: from what batteries have and the inertia that the vehicle file expects; it is in every interval"

Progress = Callable[[float, str], None]


def fit_hydrodynamics(
    trials: Sequence[Trial],
    vehicle: Vehicle,
    *,
    axes: Sequence[str] | None = None,
    estimate: Sequence[str] = (),
    damping: str = "auto",
    known: Mapping[str, float] | None = None,
    horizon: float | None = None,
    held_out: Sequence[Trial] = (),
    progress: Progress | None = None,
) -> Fit:
    """Fit added mass, damping, buoyancy and stiffness.

    Where every driven trial is of pulse widths without a battery voltage, the thrust is unknown: its scale is then
    estimated from the voltages that batteries have and the added mass that the vehicle file expects, goes to the file
    with the rest, and its uncertainty is in every interval.

    Args:
        trials: None of them held out.
        vehicle: Gives the rigid body, the motors and what is not fitted.
        axes: Axes to fit; those that the trials excite if None.
        estimate: Further parameters, of `EXTRAS`, of the vehicle's terms and of its actuators.
        damping: `auto`, `linear`, `quadratic` or `both`.
        known: Effective inertias M_RB + M_A that are known, by axis [kg, kg m²].
        horizon: Longest stretch that is simulated without a restart [s].
        held_out: Further trials that show whether the calibrated vehicle replays worse than the file. Without any, a
            fit that does not replay the fitted trials much better is judged by trials left out in turn.
        progress: Called with the part done and a few words.

    Raises:
        CalibrationError: No trial can be used, or an option is unknown.
    """
    from finssim.identification.simulation_error import fit_by_simulation

    known, show = dict(known or {}), progress or (lambda part, text: None)
    likely = "thrust_scale" not in estimate and _unknown_voltage(trials, vehicle)
    fit = fit_by_simulation(
        trials, vehicle, axes=axes, estimate=estimate, damping=damping, known=known, horizon=horizon, likely=likely,
        progress=lambda part, text: show(0.9 * part, text),
    )  # fmt: skip
    if likely:
        scale = fit.estimates["thrust_scale"]
        found = fit.estimates | {"thrust_scale": replace(scale, identifiable=False, note=UNKNOWN_VOLTAGE)}
        percent = 100.0 * (scale.ci95[1] / scale.estimate - 1.0)
        fit = replace(
            fit, estimates=found, findings=(finding("voltage_unknown", percent=percent), *fit.findings)
        )
    return fit


def _within(progress: Progress, low: float, high: float) -> Progress:
    """Return the progress of a part of the work."""
    return lambda part, text: progress(low + (high - low) * part, text)


def _scores(vehicle: Vehicle, trials: Sequence[Trial]) -> dict[str, float]:
    """NRMSE of the replay by axis, the median over the trials; none where nothing can be replayed."""
    return {axis: float(np.median(found)) for axis, found in _values(vehicle, trials).items()}


def _values(vehicle: Vehicle, trials: Sequence[Trial]) -> dict[str, list[float]]:
    """NRMSE of the replay of each trial by axis."""
    from finssim.identification.prediction import replay

    try:
        rows = replay(trials, vehicle).scores["calibrated"]
    except CalibrationError:
        return {}
    values: dict[str, list[float]] = {}
    for row in rows:
        for axis, score in row.items():
            if score.value is not None:
                values.setdefault(str(axis), []).append(
                    score.value if math.isfinite(score.value) else math.inf
                )
    return values


def _worse(
    fit: Fit,
    vehicle: Vehicle,
    trials: Sequence[Trial],
    held_out: Sequence[Trial],
    without: Callable[[int], Fit],
) -> list[Finding]:
    """Return a finding for each axis that the calibrated vehicle replays worse than the file it came from.

    Args:
        fit: The fit.
        vehicle: The file.
        trials: Trials that were fitted.
        held_out: Trials that were not, which judge alone where there are any.
        without: Fits without one of the trials.
    """
    if not fit.changes:
        return []
    if held_out:
        judged, before = "the held-out trials", _scores(vehicle, held_out)
        after = dict.fromkeys(before, math.inf) | _scores(calibrated(fit), held_out)
    else:
        judged, before = "the fitted trials", _scores(vehicle, trials)
        after = dict.fromkeys(before, math.inf) | _scores(calibrated(fit), trials)
        doubtful = [axis for axis, value in after.items() if value > CLEARLY * before.get(axis, math.inf)]
        if doubtful and FEWEST_LEFT < len(trials) <= MOST_LEFT_OUT:
            judged, after = "trials left out of the fit in turn", _left_out(without, trials, _limits(before))
    limits = _limits(before)
    return [
        finding("replays_worse", axis, judged=judged, after=value, before=before[axis])
        for axis, value in after.items()
        if axis in before and value > limits[axis]
    ]


def _limits(before: Mapping[str, float]) -> dict[str, float]:
    """Return the NRMSE of each axis above which a replay is worse than that of the file."""
    return {axis: WORSE * value + 0.01 for axis, value in before.items()}


def _left_out(
    without: Callable[[int], Fit], trials: Sequence[Trial], limits: Mapping[str, float]
) -> dict[str, float]:
    """NRMSE by axis, the median over the trials, each replayed by the fit of the others.

    No more trials are left out once most of them are replayed within the limits: the medians are then too.
    """
    values: dict[str, list[float]] = {}
    for k, trial in enumerate(trials):
        try:
            fit = without(k)
        except CalibrationError:
            continue  # the others excite nothing
        for axis, found in _values(calibrated(fit), [trial]).items():
            values.setdefault(axis, []).extend(found)
        within = (sum(value <= limits[axis] for value in values.get(axis, ())) for axis in limits)
        if all(2 * count > len(trials) for count in within):
            break
    return {axis: float(np.median(found)) for axis, found in values.items()}


# -- the scale of thrust --------------------------------------------------------------------------------------------


def _unknown_voltage(trials: Sequence[Trial], vehicle: Vehicle) -> bool:
    """Return whether only pulse widths are known of the thrust, without the battery's voltage."""
    driven = [trial for trial in trials if not trial.header.passive]
    try:
        sources = {drive(trial, vehicle).source for trial in driven}
    except CalibrationError:
        return False
    silent = all(trial.header.voltage is None and not trial.has("voltage") for trial in driven)
    return sources == {"pwm"} and silent


def calibrate_hydrodynamics(
    trials: Sequence[Path],
    *,
    vehicle: str,
    out: Path,
    axes: str | None = None,
    estimate: str = "",
    damping: str = "auto",
    fix: str = "",
    horizon: float | None = None,
    report: Path | None = None,
    ranges: Path | None = None,
    as_json: bool = False,
) -> Vehicle:
    """Fit added mass [kg, kg m²] and damping [N s/m, N s²/m², ...] to trials, by least simulation error.

    Example: finssim calibrate hydrodynamics trials/fit --vehicle mine.yaml --out fitted.yaml --report report

    Args:
        trials (TRIAL): Trial folders, folders of them, or bare .csv or .parquet tables.
        vehicle (NAME|FILE): Vehicle in the catalogue, or path of a vehicle file.
        out (FILE): Vehicle file to write (.yaml).
        axes (AXES): Axes to fit, of surge,sway,heave,roll,pitch,yaw; the excited ones if not given.
        estimate (NAMES): Further parameters to fit, of thrust_scale,thrust_lag,thrust_delay,buoyancy_excess,k or the
            parameters of the vehicle's terms, such as lift.coefficient.
        damping (KIND): Drag: linear, quadratic, both, or auto to choose.
        fix (AXIS.m=N): Known inertias, including added mass [kg, kg m²]: yaw.m=0.6,surge.m=24.
        horizon: Longest segment simulated without a restart [s].
        report (DIR): Directory for report.html, report.md, figures and fit.json.
        ranges (FILE): Ranges file to write from the 95 % intervals, for `finssim train --randomize`.
        as_json: Print one JSON object instead of tables.

    Returns:
        The calibrated vehicle.

    Raises:
        CalibrationError, VehicleError, OutputError: As they say; nothing is written then.
        KeyboardInterrupt: After Ctrl-C, when the best until then, if there is any, has been written.
    """
    options = dict(locals())
    further = tuple(name for name in (word.strip() for word in estimate.split(",")) if name)
    chosen = _axes(axes)
    known = _known(fix)
    refuse_places(out, report, "vehicle")
    if ranges is not None:
        refuse_places(ranges, None, "ranges")
    body = load_vehicle(vehicle)
    used, held_out = usable_trials(trials)
    with progress_bar("calibrate hydrodynamics") as progress:
        fit = fit_hydrodynamics(
            used,
            body,
            axes=chosen,
            estimate=further,
            damping=damping,
            known=known,
            horizon=horizon,
            held_out=held_out,
            progress=progress,
        )
    return finish("hydrodynamics", fit, options)


def _axes(words: str | None) -> tuple[str, ...] | None:
    if words is None or words == "all":
        return None
    names = [word.strip() for word in words.split(",")]
    require_axes(names)
    return tuple(axis for axis in AXES if axis in names)


def _known(words: str) -> dict[str, float]:
    """Axis -> effective inertia, of `yaw.m=0.6,surge.m=24`."""
    found = {}
    for word in filter(None, (part.strip() for part in words.split(","))):
        name, _, value = word.partition("=")
        axis, _, letter = name.strip().partition(".")
        try:
            size = float(value)
        except ValueError:
            size = math.nan
        if axis not in AXES or letter not in ("m", "m_eff") or not 1e-6 <= size <= 1e9:
            raise CalibrationError(
                f"--fix is '{word}', expected AXIS.m=NUMBER with an axis of {', '.join(AXES)} and the mass with added "
                "mass in kg, or the inertia with added inertia in kg m², as in yaw.m=0.6"
            )
        found[axis] = size
    return found
