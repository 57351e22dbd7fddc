"""What `finssim calibrate` runs: read, say what is left out, fit, write the vehicle, report."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from finssim.calibration.errors import CalibrationError
from finssim.calibration.findings import Finding, finding, sentences
from finssim.calibration.fit import Fit
from finssim.calibration.output.report import (
    command_line,
    fit_json,
    fit_report,
    progress_bar,
    publish,
    refuse_places,
    write_report,
)
from finssim.calibration.output.vehicle_file import all_findings, calibrated, write_vehicle
from finssim.calibration.trials.trial import Trial
from finssim.vehicles import AXES, Vehicle, load_vehicle


def calibrate_thruster(
    tables: Sequence[Path],
    *,
    vehicle: str,
    out: Path,
    group: str | None = None,
    voltage: float | None = None,
    pool_voltages: bool = False,
    report: Path | None = None,
    seed: int = 0,
    as_json: bool = False,
) -> Vehicle:
    """Fit thrust curves: c+ and c- [N s²/rad²], dead zones [rpm], limits [N], pulse width to speed.

    Example: finssim calibrate thruster T200-16V.csv --vehicle bluerov2 --out mine.yaml

    Args:
        tables (TABLE): Tables of force against rpm or pulse width (.csv), or trials.
        vehicle (NAME|FILE): Vehicle of the catalogue, or the path of a vehicle file.
        out (FILE): Vehicle file to write (.yaml).
        group (NAME): Propeller group that all tables speak about.
        voltage: Battery voltage at which the numbers shall hold [V], where tables have several.
        pool_voltages: Fit all voltages together instead of checking one on the others.
        report (DIR): Directory for report.html, report.md, pictures and fit.json.
        seed: Seed of every random number; equal seeds give equal results.
        as_json: Print one JSON object instead of tables.
    """
    options = dict(locals())
    refuse_places(out, report, "vehicle")
    body = load_vehicle(vehicle)
    from finssim.calibration.actuators.thruster import fit_thruster

    fit = fit_thruster(
        list(tables), body, group=group, voltage=voltage, pool_voltages=pool_voltages, seed=seed
    )
    return finish("thruster", fit, options)


def calibrate_motor(
    trials: Sequence[Path],
    *,
    vehicle: str,
    out: Path,
    report: Path | None = None,
    seed: int = 0,
    as_json: bool = False,
) -> Vehicle:
    """Fit the motors' response to steps: delay and lag [s], dead zone.

    Example: finssim calibrate motor steps --vehicle mine.yaml --out mine.yaml

    Args:
        trials (TRIAL): Trial folders, folders of them, or bare .csv or .parquet tables.
        vehicle (NAME|FILE): Vehicle of the catalogue, or the path of a vehicle file.
        out (FILE): Vehicle file to write (.yaml).
        report (DIR): Directory for report.html, report.md, pictures and fit.json.
        seed: Seed of every random number; equal seeds give equal results.
        as_json: Print one JSON object instead of tables.
    """
    options = dict(locals())
    refuse_places(out, report, "vehicle")
    body = load_vehicle(vehicle)
    from finssim.calibration.actuators.motor import fit_motor

    fit = fit_motor(_trials(trials), body, seed=seed)
    return finish("motor", fit, options)


def calibrate_hydrodynamics(
    trials: Sequence[Path],
    *,
    vehicle: str,
    out: Path,
    axes: str | None = None,
    method: str = "auto",
    estimate: str = "",
    damping: str = "auto",
    fix: str = "",
    horizon: float | None = None,
    report: Path | None = None,
    ranges: Path | None = None,
    seed: int = 0,
    as_json: bool = False,
) -> Vehicle:
    """Fit added mass [kg, kg m²] and damping [N s/m, N s²/m², ...] to trials, axis by axis or by simulation.

    Example: finssim calibrate hydrodynamics trials/fit --vehicle mine.yaml --out fitted.yaml --report report

    Args:
        trials (TRIAL): Trial folders, folders of them, or bare .csv or .parquet tables.
        vehicle (NAME|FILE): Vehicle of the catalogue, or the path of a vehicle file.
        out (FILE): Vehicle file to write (.yaml).
        axes (AXES): Axes to fit, of surge,sway,heave,roll,pitch,yaw; those that the trials excite if not given.
        method (METHOD): regression: each axis by its equation of motion; simulation: what simulates the trials best;
            auto: the regression where it replays the trials very well, else the simulation unless that replays them
            worse.
        estimate (NAMES): Also fit, of thrust_scale,thrust_lag,thrust_delay,current,buoyancy_excess,k or the parameters
            of the vehicle's terms, such as lift.coefficient (simulation method).
        damping (KIND): Drag: linear, quadratic, both, or auto to choose.
        fix (AXIS.m=N): Inertias that are known, added mass included [kg, kg m²]: yaw.m=0.6,surge.m=24 (regression).
        horizon: Longest stretch simulated without a restart [s] (simulation method).
        report (DIR): Directory for report.html, report.md, pictures and fit.json.
        ranges (FILE): Ranges file to write from the 95 % intervals, for `finssim train --randomize`.
        seed: Seed of every random number; equal seeds give equal results.
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
    used = _trials(trials)
    from finssim.calibration.hydrodynamics import fit_hydrodynamics

    with progress_bar() as progress:
        fit = fit_hydrodynamics(
            used,
            body,
            axes=chosen,
            method=method,
            estimate=further,
            damping=damping,
            known=known,
            horizon=horizon,
            seed=seed,
            progress=progress,
        )
    return finish("hydrodynamics", fit, options)


def usable(trials: Sequence[Trial]) -> tuple[list[Trial], list[Finding]]:
    """The trials that a fit may use, and a finding on each of the others.

    Raises:
        CalibrationError: None is left.
    """
    used = [trial for trial in trials if trial.header.role != "held-out"]
    left = [finding("held_out", trial.name) for trial in trials if trial.header.role == "held-out"]
    if not used:
        raise CalibrationError("every trial is marked held-out: a fit needs trials of role 'fit' or of none")
    return used, left


def _trials(paths: Sequence[Path]) -> list[Trial]:
    """Load, and say on standard error what is left out of each trial and why."""
    from finssim.calibration.trials.trial_files import load_trials

    used, left = usable(load_trials(paths))
    screen = Console(stderr=True)
    left += [one.about(trial.name) for trial in used for one in trial.findings]
    for sentence in sentences(left):
        screen.print(sentence, highlight=False, markup=False, soft_wrap=True)
    return used


def _axes(words: str | None) -> tuple[str, ...] | None:
    if words is None or words == "all":
        return None
    names = [word.strip() for word in words.split(",")]
    for name in names:
        if name not in AXES:
            raise CalibrationError(f"unknown axis '{name}'; available: {', '.join(AXES)}")
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
        if axis not in AXES or letter not in ("m", "m_eff") or not (math.isfinite(size) and size > 0.0):
            raise CalibrationError(
                f"--fix is '{word}', expected AXIS.m=NUMBER with an axis of {', '.join(AXES)} and the mass with added "
                "mass in kg, or the inertia with added inertia in kg m², as in yaw.m=0.6"
            )
        found[axis] = size
    return found


def finish(kind: str, fit: Fit, options: Mapping[str, Any]) -> Vehicle:
    """Write the calibrated vehicle, the report and the ranges, and show them.

    Args:
        kind: Of the command.
        fit: The fit.
        options: All arguments of the command by name, the inputs first.

    Raises:
        KeyboardInterrupt: The fit was interrupted.
    """
    (_, inputs), *rest = options.items()
    out, report, ranges = options["out"], options["report"], options.get("ranges")
    vehicle = calibrated(fit)
    findings = all_findings(fit, vehicle)
    write_vehicle(vehicle, out)
    if report is not None:
        given = {name: value for name, value in rest if name != "as_json"}
        command = command_line(kind, [inputs] if isinstance(inputs, Path) else inputs, given)
        write_report(fit, report, vehicle, command=command, findings=findings, out=out)
    if ranges is not None:
        from finssim.calibration.output.ranges import write_ranges

        write_ranges(fit, ranges, vehicle)
    record = fit_json(fit, vehicle, out=out, findings=findings) if options["as_json"] else None
    publish(record, fit_report(fit, vehicle, findings).show, (out, report, ranges))
    if fit.interrupted:
        raise KeyboardInterrupt
    return vehicle
