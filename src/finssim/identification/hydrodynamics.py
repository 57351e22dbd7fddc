"""Identification of a vehicle's hydrodynamics from trials: the scale of thrust, the fit, and its validation
by replay."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from finssim.core.progress import progress_bar
from finssim.identification.fit import Curve, Fit
from finssim.identification.judgement import SHOWN
from finssim.identification.plant_terms import SET, matrices, with_diagonal
from finssim.identification.replay_metrics import Pair, response_span
from finssim.identification.report import finish, refuse_places, usable_trials
from finssim.identification.vehicle_file import calibrated
from finssim.trials.findings import CalibrationError, finding
from finssim.trials.inputs import drive, require_axes
from finssim.trials.trial import COLUMNS, NU, Trial
from finssim.vehicles import AXES, Vehicle, load_vehicle

if TYPE_CHECKING:
    from finssim.identification.prediction import Replay

UNKNOWN_VOLTAGE = (
    "no battery voltage: estimated from usual batteries and the file's inertia; included in every interval"
)

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
    published: Mapping[str, float] | None = None,
    design: bool = False,
    progress: Progress | None = None,
) -> Fit:
    """Fit added mass, damping, buoyancy and stiffness.

    If every driven trial contains only pulse widths without a battery voltage, the thrust is unknown: its
    scale is then estimated from usual battery voltages and the added mass that the vehicle file implies, is
    written to the file with the other numbers, and its uncertainty is part of every interval.

    Args:
        trials: Trials, none of which is held out.
        vehicle: Vehicle with the rigid body, the motors and all parameters that are not fitted.
        axes: Axes to fit; those that the trials excite if None.
        estimate: Further parameters, from `EXTRAS`, the vehicle's terms and its actuators.
        damping: `auto`, `linear`, `quadratic` or `both`.
        known: Known effective inertias M_RB + M_A, by axis [kg, kg m²].
        horizon: Longest segment that is simulated without a restart [s].
        held_out: Further trials that validate the fit. Without them, it is validated by trials, or segments of them,
            left out in turn. The vehicle file keeps its numbers of each axis that it predicts better.
        published: `top_speed` [m/s] and `bollard_pull` [N] of the vehicle, both ahead, as additional data.
        design: True to design the next dive.
        progress: Function that is called with the completed fraction and a short text.

    Raises:
        CalibrationError: No trial can be used, or an option is unknown.
    """
    from finssim.identification.simulation_error import fit_by_simulation

    known, show = dict(known or {}), progress or (lambda part, text: None)
    likely = "thrust_scale" not in estimate and _unknown_voltage(trials, vehicle)
    fit = fit_by_simulation(
        trials, vehicle, axes=axes, estimate=estimate, damping=damping, known=known, horizon=horizon, likely=likely,
        published=published, design=design,
        progress=lambda part, text: show(0.9 * part, text),
    )  # fmt: skip
    if likely:
        scale = fit.estimates["thrust_scale"]
        found = fit.estimates | {"thrust_scale": replace(scale, identifiable=False, note=UNKNOWN_VOLTAGE)}
        percent = 100.0 * (scale.ci95[1] / scale.estimate - 1.0)
        fit = replace(
            fit, estimates=found, findings=(finding("voltage_unknown", percent=percent), *fit.findings)
        )
    if fit.interrupted or not fit.changes:
        return fit
    show(0.95, "validating with data that was not fitted")
    return judged(fit, held_out)


def _replay(pairs: Sequence[Pair], trials: Sequence[Trial], fit: Fit) -> Replay:
    """Return the replay of the pairs' trials by the calibrated vehicle, on the axes of the pairs."""
    from finssim.identification.prediction import replay

    axes = {pair.name: pair.axes for pair in pairs}
    some = [t for t in trials if t.name in axes]
    named = [replace(t, header=t.header.model_copy(update={"axis": axes[t.name]})) for t in some]
    return replay(named, calibrated(fit))


def _by_replay(fit: Fit, trials: Sequence[Trial]) -> tuple[dict[str, tuple[float, float]], Replay | None]:
    """Return the NRMSE by axis of the calibrated vehicle and of the file, medians over the trials [-], and
    the replay by the calibrated vehicle; None if no trial can be replayed.

    Both are scored on the axes that the file's thrusters excite.
    """
    from finssim.identification.prediction import replay

    try:
        before = replay(trials, fit.before)
    except CalibrationError:
        return {}, None
    after = _replay(before.pairs, trials, fit)
    found: dict[str, list[tuple[float, float]]] = {}
    for new, old in zip(*(one.scores["calibrated"] for one in (after, before)), strict=True):
        for axis, score in old.items():
            if score.value is not None:
                value = new[axis].value
                found.setdefault(axis, []).append((math.inf if value is None else value, score.value))
    return {axis: tuple(np.median(pairs, axis=0).tolist()) for axis, pairs in found.items()}, after


def _held_out_curves(after: Replay, fit: Fit) -> tuple[Curve, ...]:
    """Return the curves of a fit, in which the replays of held-out trials replace those of an axis if there
    are any."""
    own = {curve.title.partition(":")[0]: curve for curve in fit.curves}
    for axis in own:
        name = NU[AXES.index(axis)]
        widths = [response_span(p, name).value if axis in p.axes else None for p in after.pairs]
        shown = [
            p
            for width, p in sorted(zip(widths, after.pairs, strict=True), key=lambda r: -(r[0] or 0.0))
            if width
        ]
        if shown:
            own[axis] = Curve.joined(
                f"{axis}: {name} of held-out trials, replayed",
                f"{name} [{COLUMNS[name].unit}]",
                [(p.t, p.measured[name], p.simulated["calibrated"][name]) for p in shown[:SHOWN]],
            )
    return tuple(own.values())


WORSE = 1.02
"""Factor on the vehicle file's NRMSE up to which a fit is not worse: equal vehicles differ by this much by chance."""

JUDGED_TOGETHER = ("roll", "pitch")
"""Axes that share the stiffness and the height of the thrusters: the file's numbers are kept for both or for
neither."""


def judged(fit: Fit, held_out: Sequence[Trial] = ()) -> Fit:
    """Return a fit that keeps the vehicle file's numbers of each axis that it predicts worse than the file
    does, with curves of the validation trials.

    Args:
        fit: The fit, whose quality contains the NRMSE of left-out data, and that of the file.
        held_out: Trials that validate instead, for the axes that they contain.
    """
    quality = {axis: dict(figures) for axis, figures in fit.quality.items()}
    scores, after = _by_replay(fit, held_out) if held_out else ({}, None)
    for axis, pair in scores.items():
        if axis in quality:
            quality[axis] |= dict(zip(("held_out", "file"), pair, strict=True))
    fit = replace(fit, quality=quality)
    rows = {axis: figures for axis, figures in quality.items() if "held_out" in figures}
    lost = {axis for axis, figures in rows.items() if figures["held_out"] > WORSE * figures["file"]}
    tilted = [rows[axis] for axis in JUDGED_TOGETHER if axis in rows]
    if tilted and lost & set(JUDGED_TOGETHER):
        lost -= set(JUDGED_TOGETHER)
        if sum(one["held_out"] for one in tilted) > WORSE * sum(one["file"] for one in tilted):
            lost |= {axis for axis in JUDGED_TOGETHER if axis in rows}
    for axis in AXES:
        fit = _file_kept(fit, axis) if axis in lost else fit
    if after is not None:
        after = _replay(after.pairs, held_out, fit) if lost else after
        fit = replace(fit, curves=_held_out_curves(after, fit))
    return fit


def _file_kept(fit: Fit, axis: str) -> Fit:
    """Return the fit with the vehicle file's numbers of an axis, multiplied by the estimated scale of thrust."""
    i, plant, figures = AXES.index(axis), matrices(fit.before), fit.quality[axis]
    own = {"added_mass": plant.M_A, "linear_damping": plant.D1, "quadratic_damping": plant.D2}
    changes = {
        path: value
        for path, value in fit.changes.items()
        if not (path.startswith(tuple(f"{SET}.{name}." for name in own)) and str(i) in path.split(".")[-2:])
        and not (axis == "heave" and path == "body.displaced_volume")
    }
    if (
        f"thrusters.{next(iter(fit.before.thrusters))}.c_plus" in fit.changes
        and "thrust_scale" in fit.estimates
    ):
        scale, rigid = fit.estimates["thrust_scale"].estimate, float(plant.M_RB[i, i])
        for name, matrix in own.items():
            value = scale * float(matrix[i, i]) + (scale - 1.0) * rigid * (name == "added_mass")
            changes[f"{SET}.{name}.{i}.{i}"] = max(value, 0.0)
    for name, matrix in own.items():
        path, pairs = f"{SET}.{name}", [pair for j in range(6) if j != i for pair in ((i, j), (j, i))]
        new = with_diagonal(
            matrix, np.array([changes.get(f"{path}.{j}.{j}", matrix[j, j]) for j in range(6)])
        )
        changes |= {f"{path}.{j}.{k}": float(new[j, k]) for j, k in pairs if new[j, k] != matrix[j, k]}
    found = {
        name: replace(e, identifiable=False, note=FILE_BETTER) if name.partition(".")[0] == axis else e
        for name, e in fit.estimates.items()
    }
    worse = finding("replays_worse", axis, after=figures["held_out"], before=figures["file"])
    return replace(fit, changes=changes, estimates=found, findings=(*fit.findings, worse))


FILE_BETTER = "the vehicle file predicts data that was not fitted better"


# -- the scale of thrust --------------------------------------------------------------------------------------------


def _unknown_voltage(trials: Sequence[Trial], vehicle: Vehicle) -> bool:
    """Return whether the thrust is known only as pulse widths, without the battery's voltage."""
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
    top_speed: float | None = None,
    bollard_pull: float | None = None,
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
        estimate (NAMES): Further parameters to fit: thrust_scale,thrust_lag,thrust_delay,buoyancy_excess,k or
            parameters of the vehicle's terms, such as lift.coefficient.
        damping (KIND): Drag: linear, quadratic, both, or auto to choose.
        fix (AXIS.m=N): Known inertias, including added mass [kg, kg m²]: yaw.m=0.6,surge.m=24.
        top_speed: Published or measured top speed ahead at full thrust [m/s], as data on thrust and drag.
        bollard_pull: Published or measured bollard pull ahead at full thrust [N], as data on an unknown thrust.
        horizon: Longest segment simulated without a restart [s].
        report (DIR): Directory for report.html, figures and fit.json.
        ranges (FILE): Ranges file to write from the 95 % intervals, for `finssim train --randomize`.
        as_json: Print one JSON object instead of tables.

    Returns:
        The calibrated vehicle.

    Raises:
        CalibrationError, VehicleError, OutputError: See these classes; nothing is written.
        KeyboardInterrupt: After Ctrl-C; the best result so far, if there is any, has been written.
    """
    options = dict(locals())
    further = tuple(name for name in (word.strip() for word in estimate.split(",")) if name)
    chosen = _axes(axes)
    known = _known(fix)
    refuse_places(out, report, "vehicle")
    if ranges is not None:
        refuse_places(ranges, None, "ranges")
    stated = {"top_speed": top_speed, "bollard_pull": bollard_pull}
    published = {name: value for name, value in stated.items() if value is not None}
    for name, value in published.items():
        if not 0.0 < value < math.inf:
            raise CalibrationError(f"--{name.replace('_', '-')} is {value:g}, expected a number above 0")
    body = load_vehicle(vehicle)
    with progress_bar("calibrate hydrodynamics") as progress:
        progress(0.0, "reading the trials")
        used, held_out = usable_trials(trials)
        fit = fit_hydrodynamics(
            used, body, axes=chosen, estimate=further, damping=damping, known=known, horizon=horizon,
            held_out=held_out, published=published, design=True, progress=progress,
        )  # fmt: skip
    return finish("hydrodynamics", fit, options)


def _axes(words: str | None) -> tuple[str, ...] | None:
    if words is None or words == "all":
        return None
    names = [word.strip() for word in words.split(",")]
    require_axes(names)
    return tuple(axis for axis in AXES if axis in names)


def _known(words: str) -> dict[str, float]:
    """Return axis -> effective inertia, from text such as `yaw.m=0.6,surge.m=24`."""
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
