"""What `finssim calibrate` runs: read, say what is left out, fit, write the vehicle, report."""

from __future__ import annotations

import json
import math
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console

from finssim.calibration.errors import CalibrationError
from finssim.calibration.findings import Finding, finding, sentences
from finssim.calibration.fit import Fit
from finssim.calibration.output.calibrate import all_findings, calibrated, kept
from finssim.calibration.output.fit_output import fit_json, print_fit
from finssim.calibration.output.vehicle_file import check_vehicle_path, write_vehicle
from finssim.calibration.trials.trial import Trial
from finssim.files import atomic_directory, atomic_write, refuse_unwritable
from finssim.vehicles import AXES, Vehicle, load_vehicle

__all__ = ["calibrate_hydrodynamics", "calibrate_motor", "calibrate_thruster", "usable"]

ONLY_SIMULATION = "needs --method simulation"


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
    places = _Places(out, report)
    options = {"group": group, "voltage": voltage, "pool_voltages": pool_voltages}
    command = _command("thruster", tables, vehicle=vehicle, out=out, report=report, seed=seed, **options)
    body = load_vehicle(vehicle)
    from finssim.calibration.actuators.thruster import fit_thruster

    fit = fit_thruster(
        list(tables), body, group=group, voltage=voltage, pool_voltages=pool_voltages, seed=seed
    )
    return _finish(fit, places, command, as_json)


def calibrate_motor(
    trials: Sequence[Path],
    *,
    vehicle: str,
    out: Path,
    report: Path | None = None,
    seed: int = 0,
    as_json: bool = False,
) -> Vehicle:
    """Fit the motors' response to steps: delay and lag [s], dead zone, and tune the speed loop.

    Example: finssim calibrate motor steps --vehicle mine.yaml --out mine.yaml

    Args:
        trials (TRIAL): Trial folders, folders of them, or bare .csv or .parquet tables.
        vehicle (NAME|FILE): Vehicle of the catalogue, or the path of a vehicle file.
        out (FILE): Vehicle file to write (.yaml).
        report (DIR): Directory for report.html, report.md, pictures and fit.json.
        seed: Seed of every random number; equal seeds give equal results.
        as_json: Print one JSON object instead of tables.
    """
    places = _Places(out, report)
    command = _command("motor", trials, vehicle=vehicle, out=out, report=report, seed=seed)
    body = load_vehicle(vehicle)
    from finssim.calibration.actuators.motor import fit_motor

    fit = fit_motor(_trials(trials), body, seed=seed)
    return _finish(fit, places, command, as_json)


def calibrate_hydrodynamics(
    trials: Sequence[Path],
    *,
    vehicle: str,
    out: Path,
    axes: str | None = None,
    method: str = "auto",
    full: bool = False,
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
        full: Also couplings between axes (simulation method).
        estimate (NAMES): Also fit, of thrust_scale,thrust_lag,thrust_delay,current,buoyancy_excess,k (simulation
            method); or parameters of the vehicle's terms, such as lift.coefficient (either method).
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
    further = tuple(name for name in (word.strip() for word in estimate.split(",")) if name)
    if method == "regression":
        from finssim.calibration.simulation.fit import ESTIMATE

        words = [name for name in further if name in ESTIMATE]
        for given, option in ((full, "--full"), (words, "--estimate"), (horizon is not None, "--horizon")):
            if given:
                raise CalibrationError(
                    f"{option} {ONLY_SIMULATION}: a regression looks at one axis at a time"
                )
    chosen = _axes(axes)
    known = _known(fix)
    places = _Places(out, report, ranges)
    command = _command(
        "hydrodynamics",
        trials,
        vehicle=vehicle,
        axes=axes,
        method=method,
        full=full,
        estimate=estimate or None,
        damping=damping,
        fix=fix or None,
        horizon=horizon,
        out=out,
        report=report,
        ranges=ranges,
        seed=seed,
    )
    body = load_vehicle(vehicle)
    used = _trials(trials)
    from finssim.calibration.hydrodynamics import fit_hydrodynamics

    with _progress() as progress:
        fit = fit_hydrodynamics(
            used,
            body,
            axes=chosen,
            method=method,
            full=full,
            estimate=further,
            damping=damping,
            known=known,
            horizon=horizon,
            seed=seed,
            progress=progress,
        )
    return _finish(fit, places, command, as_json)


class _Places:
    """Where the outputs go; a place that cannot be written is refused before the work, not after it."""

    def __init__(self, out: Path, report: Path | None = None, ranges: Path | None = None) -> None:
        self.out, self.report, self.ranges = Path(out), report, ranges
        refuse_unwritable(atomic_write(check_vehicle_path(out)))
        if ranges is not None:
            if Path(ranges).suffix not in (".yaml", ".yml"):
                raise CalibrationError(f"{ranges} ends in '{Path(ranges).suffix}', expected .yaml")
            refuse_unwritable(atomic_write(ranges))
        if report is not None:
            from finssim.calibration.output.report import FIT_FILE

            refuse_unwritable(atomic_directory(report, replaces=FIT_FILE))


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


@contextmanager
def _progress() -> Iterator[Callable[..., None]]:
    """A bar on standard error, fed with the part done and a few words."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    screen = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=screen, transient=True, disable=not screen.is_terminal) as bars:
        bar = bars.add_task("fit", total=1.0)

        def show(part: float, words: str = "fit") -> None:
            bars.update(bar, completed=part, description=words)

        yield show


def _finish(fit: Fit, places: _Places, command: str, as_json: bool) -> Vehicle:
    """Write and show; ends with KeyboardInterrupt where the fit was interrupted."""
    vehicle = calibrated(fit)
    findings = all_findings(fit, vehicle)
    write_vehicle(vehicle, places.out)
    if places.report is not None:
        from finssim.calibration.output.report import write_report

        write_report(fit, places.report, vehicle, command=command, findings=findings, out=places.out)
    if places.ranges is not None:
        from finssim.calibration.output.calibrated_ranges import write_ranges

        write_ranges(fit, places.ranges, vehicle)
    if as_json:
        document = fit_json(fit, vehicle, out=places.out, findings=findings)
        print(json.dumps(document, allow_nan=False))
    else:
        console = Console() if sys.stdout.isatty() else Console(width=100)
        print_fit(fit, vehicle, console, findings)
        _print_places(fit, vehicle, places, console)
    if fit.interrupted:
        raise KeyboardInterrupt
    return vehicle


def _print_places(fit: Fit, vehicle: Vehicle, places: _Places, console: Console) -> None:
    left = kept(fit, vehicle)
    if left:
        console.print(
            f"not identifiable, so the file keeps its own: {', '.join(left)}", highlight=False, markup=False
        )
    for place in filter(None, (places.out, places.report, places.ranges)):
        console.print(f"written: {place}", highlight=False, markup=False, soft_wrap=True)


def _command(kind: str, inputs: Sequence[Path], **options: Any) -> str:
    """The command line that does this again."""
    words = ["finssim", "calibrate", kind, *map(str, inputs)]
    for name, value in options.items():
        option = f"--{name.replace('_', '-')}"
        if value is True:
            words.append(option)
        elif value is not None and value is not False:
            words += [option, str(value)]
    return shlex.join(words)
