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

LIKELY_SCALE, SCALE_STD = 0.88, 0.17
"""Thrust of a battery on its way from full to empty, to that at the voltage of the thruster's table, and the standard
deviation of its logarithm: thrust goes with the square of a voltage of 3.3 to 4.2 V a cell (0.14), and propellers of
one make differ by a tenth."""

ADDED_MASS_STD = 0.7
"""Standard deviation of the logarithm of a catalogue's added mass, a factor of two: published sets of one vehicle
differ by as much."""

INERTIA_STD = 0.5
"""Standard deviation of the logarithm of a catalogue's effective moment of inertia."""

GIVEN_STD = 0.03
"""Standard deviation of the logarithm of a given inertia."""

MULTIPLIED = ("m_eff", "added_mass", "d1", "d2", "bias", "k")
"""Estimates of an axis that a thrust scale multiplies."""

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
    options: dict[str, Any] = {"axes": axes, "estimate": estimate, "horizon": horizon}
    body, scale, std, begin, part = vehicle, 1.0, 0.0, None, 0.0
    if "thrust_scale" not in estimate and _unknown_voltage(trials, vehicle):
        likely = vehicle.replace(scaled_thrust(vehicle, LIKELY_SCALE))
        both = "both" if damping == "auto" else damping
        begin = fit_by_simulation(trials, likely, damping=both, progress=_within(show, 0.0, 0.5), **options)
        scale, std = _thrust_scale(begin, vehicle, known)
        body, part = vehicle.replace(scaled_thrust(vehicle, scale)), 0.5
    fit = fit_by_simulation(
        trials, body, damping=damping, known=known, begin=begin, progress=_within(show, part, 0.9), **options
    )
    whole = fit
    if std:
        fit = _with_scale(fit, vehicle, scale, std, known)
    if fit.interrupted:
        return fit
    show(0.9, "replay by the calibrated vehicle")

    def without(k: int) -> Fit:
        part, others = 0.9 + 0.1 * k / len(trials), [*trials[:k], *trials[k + 1 :]]
        own = options | {"axes": whole.settings["axes"], "damping": whole.settings["drag"], "begin": whole}
        return fit_by_simulation(others, body, known=known, progress=_within(show, part, part), **own)

    return replace(fit, findings=(*fit.findings, *_worse(fit, vehicle, trials, held_out, without)))


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


def _thrust_scale(fit: Fit, vehicle: Vehicle, known: Mapping[str, float]) -> tuple[float, float]:
    """Return thrust over that of the file, and the standard deviation of its logarithm.

    Motion shows inertia over thrust; the vehicle file expects an inertia, and batteries have a voltage:
    ln s is the mean of ln(s_fit m_file / m_fit) over the axes and of ln `LIKELY_SCALE`, weighted by their certainty.

    Args:
        fit: Fit with thrust of `LIKELY_SCALE`, and no inertia given.
        vehicle: Vehicle as its file has it.
        known: Effective inertias that are known, by axis [kg, kg m²].
    """
    plant = matrices(vehicle)
    logs, weight = [math.log(LIKELY_SCALE)], [SCALE_STD**-2]
    for i, axis in enumerate(AXES):
        found = fit.estimates.get(f"{axis}.m_eff")
        if found is None or not found.estimate > 0.0 or (axis in ("roll", "pitch") and axis not in known):
            continue  # an unknown stiffness is confounded with the inertia of roll and pitch
        expected = known.get(axis, float(plant.M_RB[i, i] + plant.M_A[i, i]))
        std = INERTIA_STD if i > 2 else ADDED_MASS_STD * float(plant.M_A[i, i]) / expected
        std = GIVEN_STD if axis in known else std
        half = 0.5 * (found.ci95[1] - found.ci95[0]) / found.estimate
        if math.isfinite(half) and half < 0.5:
            logs.append(math.log(LIKELY_SCALE * expected / found.estimate))
            weight.append(1.0 / (std**2 + (0.5 * half) ** 2 + 1e-4))
    total = sum(weight)
    return math.exp(sum(w * x for w, x in zip(weight, logs, strict=True)) / total), total**-0.5


def _with_scale(fit: Fit, vehicle: Vehicle, scale: float, std: float, known: Mapping[str, float]) -> Fit:
    """The fit with the scale among its estimates and in its intervals."""
    low, high = math.exp(-1.96 * std), math.exp(1.96 * std)
    fitted = fit.settings.get("axes", ())
    found = dict(fit.estimates)
    for name, e in fit.estimates.items():
        axis, _, kind = name.partition(".")
        if axis in known and kind in ("m_eff", "added_mass"):
            continue
        in_term = e.path == f"hydrodynamics.calibrated.{name}"
        if name == "buoyancy_excess" or in_term or (axis in fitted and kind in MULTIPLIED):
            rigid = found[f"{axis}.m_eff"].estimate - e.estimate if kind == "added_mass" else 0.0
            found[name] = _widened(e, rigid, low, high)
    found["thrust_scale"] = Estimate(
        name="thrust_scale", estimate=scale, ci95=(scale * low, scale * high), unit="-", identifiable=False,
        note="no battery voltage: from what batteries have and the added mass that the vehicle file expects; it is in "
        "every interval",
    )  # fmt: skip
    return replace(
        fit,
        before=vehicle,
        estimates=found,
        changes={**scaled_thrust(vehicle, scale), **fit.changes},
        findings=(finding("voltage_unknown", percent=100.0 * (high - 1.0)), *fit.findings),
    )


def _widened(e: Estimate, rigid: float, low: float, high: float) -> Estimate:
    """An estimate whose interval also holds a factor between `low` and `high` on estimate + rigid."""
    whole, (a, b) = e.estimate + rigid, e.ci95
    if not (math.isfinite(a) and math.isfinite(b)):
        return e
    down, up = (1.0 - low, high - 1.0) if whole >= 0.0 else (high - 1.0, 1.0 - low)
    a = whole - math.hypot(e.estimate - a, down * abs(whole)) - rigid
    b = whole + math.hypot(b - e.estimate, up * abs(whole)) - rigid
    kind = e.name.partition(".")[2]
    if kind in ("d1", "d2", "k"):
        a = max(a, 0.0)
    sure = e.identifiable and (kind in ("bias", "") or 0.5 * (b - a) <= CERTAIN * abs(e.estimate))
    return replace(e, ci95=(a, b), identifiable=sure)


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
