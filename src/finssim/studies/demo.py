"""`finssim demo`: the complete loop on one machine, from an unmeasured vehicle to a policy in a pool."""

from __future__ import annotations

import json
import math
import shutil
import sys
import tempfile
import time
import webbrowser
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from os import environ
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from finssim.control.axis_model import axis_model
from finssim.control.policy import Policy
from finssim.core.palette import BLUE, VERMILION
from finssim.core.quiet import start_warp
from finssim.evaluation.campaign import Progress, running
from finssim.evaluation.evaluate import T1_COLUMNS
from finssim.evaluation.excitation import PoolRun, record_programmes, trimmed
from finssim.evaluation.figures import clean, legend_below, new_figure, save_figure
from finssim.evaluation.metrics import T1_SETPOINTS
from finssim.evaluation.robot_trials import (
    FIRMWARES,
    OnRobot,
    RobotError,
    RobotJob,
    firmware_of,
    open_results_folder,
    played_trial,
)
from finssim.evaluation.tables import Table, cells, print_tables, write_page
from finssim.identification.fit import Fit
from finssim.identification.prediction import Replay, replay
from finssim.identification.programme import RATE, STEADY, Programme, programmes, which_axes
from finssim.identification.replay_report import draw_response_envelopes
from finssim.identification.report import interval_text, number_text, state_text, write_report
from finssim.identification.simulation_error import fit_by_simulation
from finssim.identification.vehicle_file import all_findings, calibrated, number_in, write_vehicle
from finssim.learning.train import TrainingSettings, train
from finssim.pool import draw_plant
from finssim.pool.drawn_plant import site_of
from finssim.sim import RectangularPool
from finssim.studies.demo_course import demo_course
from finssim.studies.transfer import T1, Spec, TransferSettings, transfer_experiment
from finssim.trials.findings import Finding, sentences
from finssim.trials.trial import Trial
from finssim.trials.trial_files import load_trials
from finssim.vehicles import AXES, Provenance, Vehicle, load_vehicle
from finssim.vehicles.capability import level_speed
from finssim.vehicles.defaults import SITES, room

__all__ = ["demo"]

SHARE = 0.9
"""Greatest excitation level as a fraction of the wrench limit [-]; the rest is for the controller of the
other axes."""


def matched(levels: Mapping[str, Sequence[float]], vehicle: Vehicle) -> dict[str, list[float]]:
    """Scale excitation levels from FinsROV to a vehicle, so that speeds in its own lengths and tilt angles
    are equal.

    A linear axis reaches FinsROV's terminal speed times the vehicle's `room`, yaw FinsROV's rate, roll and
    pitch FinsROV's angle at rest. Surge and sway stay slower if the vehicle's righting moment would not keep
    it level: see `level_speed`. Programmes then have equal durations, and distances that fit a pool `room`
    times as large.

    Args:
        levels: Axis -> levels for FinsROV [N, N m].
        vehicle: Vehicle with damping, stiffness and limits; axes that it does not control are left out.

    Returns:
        Axis -> levels, to three digits and at most `SHARE` of the limit; those of FinsROV unchanged.
    """
    published = load_vehicle("finsrov")
    if vehicle.name == published.name:
        return {axis: list(values) for axis, values in levels.items()}
    ours, theirs, size = axis_model(vehicle), axis_model(published), room(vehicle.body.size)
    scaled = {}
    for axis, values in levels.items():
        i = AXES.index(axis)  # type: ignore[arg-type]
        if axis not in vehicle.controlled_axes or not vehicle.wrench_limits[i] > 0.0:
            continue
        level = np.asarray(values, float)
        scale = size if i < 3 else 1.0
        if i < 2:  # all levels of the axis equally, so that those of different trials stay different
            fastest = size * float(theirs.terminal_speed(published.wrench_limits)[i])
            scale *= min(1.0, STEADY * level_speed(vehicle, axis=i) / fastest)
        if min(ours.stiffness[i], theirs.stiffness[i]) > 0.0:
            level = level * ours.stiffness[i] / theirs.stiffness[i]
        else:
            speed = scale * theirs.terminal_speed(level[:, None])[:, i, None]
            level = (ours.damping(speed) * speed)[:, i]
        limit = SHARE * float(vehicle.wrench_limits[i])
        scaled[axis] = list(dict.fromkeys(float(f"{min(x, limit):.3g}") for x in level))
    return scaled


PERIODS = {"surge": 4.0, "sway": 4.0, "heave": 2.4, "roll": 2.0, "pitch": 2.0, "yaw": 4.0}
"""Period of the square wave, about five time constants of a small vehicle [s]."""
WAVES = 2.5
"""Number of periods; the wave begins and ends with half a pulse, so that the path is centred on its start."""


def shuttles(levels: Mapping[str, Sequence[float]], vehicle: Vehicle) -> list[Programme]:
    """Return square-wave programmes of two and a half periods each, which begin with half a pulse.

    Steps identify the drag, since most of a step is steady; square waves identify the mass from the
    transients, and the difference of forward and reverse thrust averages out within a trial.

    Args:
        levels: Axis -> magnitudes [N, N m].
        vehicle: Vehicle that must control the axes.

    Raises:
        CalibrationError: The vehicle does not control an axis.
    """
    plan = []
    for axis in which_axes(list(levels), vehicle):
        counts = [round(s * RATE) for s in (1.0, 1.0, WAVES * PERIODS[axis], 2.0, 1.0)]
        phase = np.repeat(np.array(["rest", "baseline", "excitation", "coast", "rest"]), counts)
        turns = (np.arange(counts[2]) / RATE + 1e-6) / PERIODS[axis]
        tau = np.zeros((len(phase), 6))
        # The sign of a cosine: a quarter of the period forward, half of it backward, and so on.
        tau[phase == "excitation", AXES.index(axis)] = np.sign(np.cos(2.0 * math.pi * turns))
        for level in levels[axis]:
            name = f"{axis}_shuttle_{level:.4g}"
            plan.append(Programme(name=name, axes=(axis,), rate=RATE, tau_desired=level * tau, phase=phase))
    return plan


# Identification of an unmeasured vehicle from trials.


TRIALS = "trials"
VEHICLE_FILES = ("{}_rough.yaml", "{}_identified.yaml")
"""Vehicle files before and after the identification."""
SET = "hydrodynamics.calibrated"

HELD_OUT = {"surge": [9.0], "sway": [6.0], "heave": [7.0], "yaw": [1.0]}
"""Levels that are not used in the fit [N, N m]."""

Record = Callable[[Mapping[str, Path], str], Mapping[str, Sequence[Trial]]]
"""Function of folders by role (fit, held-out) and the file of the rough vehicle that records trials and
returns them by role."""


@dataclass(frozen=True)
class Identification:
    """Result of the identification."""

    vehicle: Vehicle
    """Identified vehicle, as read back from its file."""
    fit: Fit
    replay: Replay
    """Replay of the held-out trials with the identified vehicle."""
    truth: Vehicle
    """Catalogue vehicle that was used for the trials, or around which the pool's own vehicle was drawn."""
    findings: tuple[Finding, ...]
    seconds: float
    """Duration of recording and identification [s]."""


def rough_vehicle(truth: Vehicle) -> Vehicle:
    """Return a vehicle with the knowledge before any trial: weight, size, and bench data of the thrusters.

    Its hydrodynamics are guesses: added mass of half the displaced water on every linear axis, damping of the
    order of other small vehicles, forces growing with the square of the length, moments with its fourth power
    and moments of inertia with its fifth. Moments are guessed low, since a controller that relies on missing
    damping oscillates.
    """
    half = 0.5 * truth.water.density * truth.body.displaced_volume
    size = room(truth.body.size)
    force, moment, inertia = size**2, size**4, 0.1 * size**5
    guess = {
        f"{SET}.added_mass": [half, half, half, inertia, inertia, inertia],
        f"{SET}.linear_damping": [20.0 * force] * 3 + [0.5 * moment] * 3,
        f"{SET}.quadratic_damping": [50.0 * force] * 3 + [moment] * 3,
    }
    origin = Provenance("guessed", "", "the order of other small vehicles, before any trial")
    description = "Hydrodynamics are guesses; the rest is the catalogue's."
    return _named(truth.replace(guess, origin), f"{truth.name} before any trial", description)


def _named(vehicle: Vehicle, title: str, description: str) -> Vehicle:
    """Return a copy of the vehicle with another title and description."""
    return vehicle.model_copy(update={"title": title, "description": description})


def identify(folder: Path, name: str, *, seed: int, record: Record) -> Identification:
    """Record trials of a vehicle, identify it from some of them, replay the others, and write all results.

    The folder then contains `NAME_rough.yaml` (the vehicle before), `trials/fit` and `trials/held-out`,
    `NAME_identified.yaml`, `calibration` (the report), and `replay.json` with `replay.png`.

    Args:
        folder: Existing directory.
        name: Name or file of a vehicle.
        seed: Seed of initial conditions and noise of the trials.
        record: Function that records the trials.

    Returns:
        Result of the identification.
    """
    began = time.perf_counter()
    truth = load_vehicle(name)
    name = truth.name
    start_file, vehicle_file = (file.format(name) for file in VEHICLE_FILES)
    write_vehicle(rough_vehicle(truth), folder / start_file)
    recorded = record(
        {role: folder / TRIALS / role for role in ("fit", "held-out")}, str(folder / start_file)
    )
    fit = fit_by_simulation(recorded["fit"], load_vehicle(folder / start_file))
    identified = calibrated(fit)
    findings = tuple(all_findings(fit, identified))
    identified = _named(
        identified,
        f"{name} as identified",
        "Hydrodynamics from trials where these determine them, otherwise guesses.",
    )
    write_vehicle(identified, folder / vehicle_file)
    vehicle = load_vehicle(folder / vehicle_file)
    write_report(
        fit,
        folder / "calibration",
        vehicle,
        command=commands(folder, name)[1],
        findings=findings,
        out=folder / vehicle_file,
    )
    scored = replay(recorded["held-out"], vehicle, seed=seed)
    text = json.dumps(scored.as_json(), indent=2, allow_nan=False) + "\n"
    (folder / "replay.json").write_text(text, encoding="utf-8")
    save_figure(draw_response_envelopes(scored.pairs), folder / "replay.png")
    return Identification(vehicle, fit, scored, truth, findings, time.perf_counter() - began)


def commands(folder: Path, name: str) -> list[str]:
    """Return the command lines that repeat identification and replay from the trials."""
    start, vehicle = (folder / file.format(name) for file in VEHICLE_FILES)
    trials = folder / TRIALS
    return [
        f"finssim trials check {trials / 'fit'} --vehicle {start}",
        f"finssim calibrate hydrodynamics {trials / 'fit'} --vehicle {start} --out {vehicle}",
        f"finssim replay {trials / 'held-out'} --vehicle {vehicle}",
    ]


ARROW = 0.18
"""Length of an arrow that shows a heading [m]."""

HEADS = ("parameter", "estimate", "95 % interval", "catalogue", "unit", "state")
UNSURE = (
    "unsure: determined only jointly with another number, such as a part of the drag. file kept: the trials do not "
    "determine the number, and the vehicle keeps its guess."
)
POOL_VEHICLE = (
    " The catalogue's vehicle is the one around which the pool drew its own: the plant's coefficients are known to the "
    "pool alone. Its propellers push up to 15 % more or less than the bench data, so the estimates "
    "are effective masses and dampings: those for the nominal thrust of the vehicle file."
)


def _paths(
    motions: Sequence[NDArray[np.float64]], site: str, goals: NDArray[np.float64] | None = None
) -> Any:
    """Draw the paths of trials from above and from the side.

    Args:
        motions: Positions of each trial in the world [m], (n, 3).
        site: A name in `SITES`.
        goals: Goal position [m] and yaw [rad] of each trial, (trials, 4); None: no goals.
    """
    size = SITES[site]
    pool = (
        RectangularPool() if size is None else RectangularPool(length=size[0], width=size[1], depth=size[2])
    )
    figure = new_figure(7.2, 6.0, layout="compressed")
    above, side = panels = figure.subplots(2, 1, sharex=True, height_ratios=(pool.width, pool.depth))
    spans = ((1, -pool.width / 2, pool.width), (2, -pool.depth, pool.depth))
    for axes, (vertical, low, height) in zip(panels, spans, strict=True):
        axes.fill_between([-pool.length / 2, pool.length / 2], low, low + height, color="#eaf3f8")
        for positions in motions:
            axes.plot(*positions[:, [0, vertical]].T, color=BLUE, linewidth=1.2)
        starts = np.array([positions[0] for positions in motions] if goals is None else motions[0][:1])
        if goals is not None:
            axes.plot(*goals[:, [0, vertical]].T, "o", mfc="none", mec=VERMILION, ms=9, label="goal")
        axes.plot(*starts[:, [0, vertical]].T, "s", color="0.2", ms=5, label="start")
        axes.set(aspect="equal", ylim=(low - 0.05, low + height + 0.05))
        axes.spines[["top", "right"]].set_visible(False)
    for x, y, _, yaw in () if goals is None else goals:
        tip = (x + ARROW * np.cos(yaw), y + ARROW * np.sin(yaw))
        above.annotate("", tip, (x, y), arrowprops={"arrowstyle": "->", "color": VERMILION})
    above.set_ylabel("y, left [m]")
    side.set(ylabel="z, up [m]", xlabel="x, forward [m]")
    legend_below(figure, above, 1 if goals is None else 2)
    return figure


CURVES = {
    "evaluation_success": "success, evaluated",
    "evaluation_return": "return, evaluated",
    "held": "share that held at the end",
    "mean_return": "return in training",
}
"""Columns of a training's `curves.csv` and their titles."""


def _training(curves: NDArray[Any]) -> Any:
    """Draw the first two of `CURVES` that a training recorded, over its control steps."""
    names = [
        name for name in CURVES if name in (curves.dtype.names or ()) and np.isfinite(curves[name]).any()
    ]
    figure = new_figure(7.2, 3.0)
    for axes, name in zip(figure.subplots(1, 2), names, strict=False):
        measured = np.isfinite(curves[name])  # no value before the first episode ended
        axes.plot(curves["steps"][measured] / 1e6, curves[name][measured], color=BLUE)
        axes.set_xlabel("control steps [million]", fontsize=8)
        axes.set_title(CURVES[name], fontsize=10)
        clean(axes)
    return figure


def _hydrodynamic(result: Identification) -> dict[str, Any]:
    """Return the estimates of hydrodynamic parameters by name."""
    return {
        name: e for name, e in result.fit.estimates.items() if str(e.path or "").startswith("hydrodynamics.")
    }


def _identification(result: Identification, hardware: bool) -> list[Table]:
    """Return tables of the identified parameters, and of the replay of held-out trials."""
    score = result.replay.aggregate(result.replay.models[0]).value
    source, same = ("a robot", "on the same robot") if hardware else ("the virtual pool", "in the same pool")
    lead = (
        f"Identified in {result.seconds:.0f} s from {len(result.fit.trials)} trials of {source}, beginning with "
        "guessed hydrodynamics: the robot's own software played each programme, and its record became a trial. "
        f"{len(result.replay.pairs)} other trials, at levels that were not fitted, are replayed with an NRMSE of "
        f"{'unknown' if score is None else f'{score:.3f}'}. Controllers were trained and tuned in the identified "
        f"vehicle, and tested {same}."
    )
    rows = [
        [
            name, number_text(e.estimate), interval_text(e), number_text(number_in(result.truth, str(e.path))), e.unit,
            state_text(e, result.fit, result.vehicle),
        ]
        for name, e in _hydrodynamic(result).items()
    ]  # fmt: skip
    return [
        Table(
            title="Identification",
            headline=lead,
            heads=HEADS,
            rows=rows,
            note=UNSURE + ("" if hardware else POOL_VEHICLE),
            sentences=sentences(result.findings),
            pictures={"replay.png": "Held-out trials, measured and replayed: response [1] in time [s]"},
        )
    ]


def _lead(result: Mapping[str, Any], spec: Spec, seconds: float) -> str:
    rows = result["rows"]
    texts = {
        name: f"{row['success']} of {row['trials']}" for name, row in rows.items() if name != WITH_PICTURES
    }
    errors, policy = "", rows.get(POLICY)
    if policy and policy["e_p_m"]:
        e_p, e_psi = (policy[key]["value"] for key in ("e_p_m", "e_psi_deg"))
        errors = f", with {100.0 * e_p:.1f} cm and {e_psi:.1f}° of error once settled"
    others = "; ".join(f"{spec.rows[name].title}: {text}" for name, text in texts.items() if name != POLICY)
    return (
        f"A policy trained here in {seconds:.0f} s, from nothing to a file that runs "
        f"on the vehicle, holds {texts.get(POLICY, 'none')} published setpoints "
        f"{'on hardware' if result['robot'] else 'in the virtual pool'}{errors}. On the same trials: {others}."
    )


def _known(result: Identification) -> str:
    """Return a sentence that states which hydrodynamic parameters are known after the trials."""
    states = {name: state_text(e, result.fit, result.vehicle) for name, e in _hydrodynamic(result).items()}
    kept = [name for name, state in states.items() if state == "file kept"]
    alone = sum(state == "written" for state in states.values())
    text = f"Its trials determine {alone} of {len(states)} hydrodynamic numbers by themselves"
    text += f" and {len(states) - alone - len(kept)} jointly with others"
    return f"{text}; the guess stays for {', '.join(kept)}." if kept else f"{text}."


def _setpoints(result: Mapping[str, Any], spec: Spec) -> Table:
    """Return the table of every setpoint and controller."""
    rows = [
        [f"{spec.rows[name].title}, {target}", *cells(figures, T1_COLUMNS)]
        for name, row in result["rows"].items()
        for target, figures in row["by_target"].items()
    ]
    return Table(
        title="Every setpoint", heads=["", *(heading for heading, *_ in T1_COLUMNS.values())], rows=rows
    )


PLANT_FILE = "pool.yaml"
"""File of the plant, for `finssim pool --plant`."""
REPORT_FILE = "report.html"
SEVERITY, RANGES = "realistic", "pool"
POLICY, WITH_PICTURES = "calibrated-pool", "with-pictures"
"""Rows of station keeping: the policy that is trained here, and the same with rendered pictures and tag detection."""
COAST = 4.0
"""Longest coast after a dive [s]: the pool is shallow, and this vehicle hardly rises."""


@dataclass(frozen=True, kw_only=True)
class Scope:
    """Extent of a demonstration."""

    levels: dict[str, list[float]]
    """Axis -> levels of the steps and pulses used for the fit, for FinsROV [N, N m]."""
    shuttles: dict[str, list[float]]
    """Levels of the square waves by axis [N, N m]."""
    held_out: dict[str, list[float]]
    """Levels of the replayed trials by axis [N, N m]."""
    setpoints: tuple[str, ...]
    """Setpoints for every controller, with computed tag corners."""
    pictures: tuple[str, ...]
    """Setpoints for the policy with rendered pictures."""
    duration: float = 60.0
    """Duration of a trial [s]."""


FULL = Scope(
    levels={
        "surge": [6.0, 18.0],
        "sway": [4.5, 13.5],
        "heave": [4.5, 13.5],
        "roll": [0.5, 1.0],
        "pitch": [0.5, 1.0],
        "yaw": [0.6, 1.8],
    },
    shuttles={"surge": [12.0, 18.0], "sway": [9.0, 13.5], "heave": [9.0, 13.5]},
    held_out=HELD_OUT,
    setpoints=tuple(T1_SETPOINTS),
    pictures=("P02",),
)
"""Scope of `finssim demo`."""


@dataclass(frozen=True, kw_only=True)
class DemoSettings:
    """Settings of a demonstration: its vehicle, training and extent."""

    vehicle: str = "finsrov"
    """(NAME|FILE) Vehicle in the catalogue, or path of a vehicle file."""
    seed: int = 1
    """Seed of every random number; equal seeds give equal results."""
    steps: Annotated[int | None, (1, None)] = None
    """Control steps of the training, summed over all worlds; default that of the task."""
    firmware: str = "mcu"
    """(NAME) Firmware of the vehicle: mcu (FinsROV's motor controller) or ardusub (an autopilot over
    MAVLink: the policy uses its axes, `pilot6`, in a tank with a DVL and a compass instead of the pool and
    its camera, with setpoints three times as far)."""
    scope: Scope | None = None
    """Extent of the demonstration; None: `FULL`."""
    processes: Annotated[int | None, "python"] = None
    """Number of parallel processes; None: one per processor."""


def demo(
    out: Annotated[Path, "--out"] = Path("demo"),
    *,
    settings: Annotated[DemoSettings, "options"] = DemoSettings(),
    robot: OnRobot | None = None,
    console: Console | None = None,
    as_json: bool = False,
) -> Path:
    """Identify a vehicle in the virtual pool or on a robot, train and deploy a policy, write a report.

    Trials are recorded and controllers deployed through the robot's complete software: camera, localization,
    fusion, controller, allocation, bridge and the motor controller's protocol. For comparison, `pid`, tuned
    from the identified vehicle, runs the same setpoints in the same pool.

    A vehicle that must move to steer, such as remus100, is identified from manoeuvres of its autopilot, and follows
    paths in open water.

    Example: finssim demo --vehicle bluerov2_heavy --out demo

    Example: finssim demo --vehicle bluerov2_heavy --firmware ardusub --out demo

    Example: finssim demo --robot udp://10.0.0.2:58766 --pool-file pool.yaml --arm --out demo

    Args:
        out (DIR): Directory of trials, vehicle, policy, results and report.
        settings: Vehicle, training and extent.
        robot: Robot for trials and setpoints, instead of the virtual pool.
        console: Console for progress; None: standard error.
        as_json: Print one JSON object instead of tables.

    Returns:
        Path of the report.

    Raises:
        RobotError: The folder belongs to another demonstration.
        KeyboardInterrupt: Ctrl-C was pressed; the same command continues.
    """
    console, standing = console or Console(stderr=True), load_vehicle(settings.vehicle)
    settings = replace(settings, firmware=firmware_of(settings.firmware, standing, robot))
    start_warp()
    about = {
        "vehicle": {"name": standing.name, "sha256": standing.sha256}, "seed": settings.seed,
        "steps": settings.steps, "firmware": settings.firmware, "robot": robot is not None,
    }  # fmt: skip
    open_results_folder(Path(out) / "demo.yaml", about)
    if must_move(standing):
        if robot is not None or settings.firmware != "mcu":
            raise RobotError(
                f"{standing.name} must move to steer: its demonstration runs only in the virtual site, without --robot "
                "and --firmware"
            )
        tables, report = demo_course(
            Path(out), standing, seed=settings.seed, steps=settings.steps, console=console
        )
        return _shown(tables, report, as_json)
    demonstration = _Demonstration(
        out=Path(out), settings=settings, standing=standing, console=console, robot=robot
    )
    return _shown(demonstration.run(), Path(out) / REPORT_FILE, as_json)


def must_move(vehicle: Vehicle) -> bool:
    """Return whether a vehicle steers with fins, that is, does not control yaw by thrusters."""
    fins = any(actuator.kind == "fin" for actuator in vehicle.actuators.values())
    return fins and "yaw" not in vehicle.controlled_axes


def _shown(tables: list[Table], report: Path, as_json: bool) -> Path:
    """Print the tables, or one JSON object, and open the report if there is a screen."""
    if as_json:
        rows = [
            {"title": t.title, "heads": list(t.heads), "rows": [list(r) for r in t.rows if r]} for t in tables
        ]
        print(json.dumps({"report": str(report), "tables": rows}))
        return report
    print_tables(tables, Console())
    print(f"report: {report}")
    display = environ.get("DISPLAY") or environ.get("WAYLAND_DISPLAY") or sys.platform in ("darwin", "win32")
    if sys.stdout.isatty() and display:
        webbrowser.open(report.resolve().as_uri())
    return report


def _compile_training(vehicle: str, action: str | None) -> None:
    """Train for one rollout, to compile the training's kernels."""
    settings = TrainingSettings(vehicle=vehicle, action=action, randomize=RANGES, steps=1)
    with tempfile.TemporaryDirectory() as folder:
        train(T1.name, settings, out=Path(folder) / "policy", console=Console(stderr=True, quiet=True))


@dataclass(frozen=True, kw_only=True)
class _Demonstration:
    """Steps of a demonstration, with their arguments and paths."""

    out: Path
    """Directory of the results."""
    settings: DemoSettings
    """Settings; the seed is also that of the pool, and the firmware that of the robot."""
    standing: Vehicle
    console: Console
    robot: OnRobot | None

    def run(self) -> list[Table]:
        """Identify, train, deploy and report; return the result tables."""
        identification, spec = self._identified(), self._spec()
        title, held = self._title, self.out / "t1"
        found, known = _identification(identification, self.robot is not None), _known(identification)
        write_page(
            self.out / REPORT_FILE, title, found, lead=[known, "Training and trials are still to come."]
        )
        self.report(f"report so far: {self.out / REPORT_FILE}")
        with self._working("training and holding setpoints") as progress:
            result = transfer_experiment(
                spec, out=held, settings=self._transfer(spec), robot=self.robot, console=self.console,
                progress=progress, show=self._show,
            )  # fmt: skip
        policy, tables = self.out / "policy", spec.tables(result)
        shutil.copytree(held / "policies" / f"{POLICY}-seed{self.settings.seed}", policy, dirs_exist_ok=True)
        curves = np.genfromtxt(policy / "curves.csv", delimiter=",", names=True, ndmin=1)
        save_figure(_training(curves), self.out / "training.png")
        trials = [played_trial(r, held / "trials") for r in result["trials"] if r["job"]["row"] == POLICY]
        learnt = {"training.png": "Success [1] and return [1] over the control steps of the training"}
        drawn = [Table(title="Training", pictures=learnt), _setpoints(result, spec)]
        if trials:
            goals = np.array([trial.goal for trial in trials])
            save_figure(_paths([t.motion.position for t in trials], self.site, goals), self.out / "paths.png")
            paths = {"paths.png": "Paths of the trials from above and from the side [m]"}
            drawn.insert(0, Table(title="Paths of the policy", pictures=paths))
        files = dict(Policy.load(policy).description.files)
        origin = {
            "vehicle": result["vehicle"],
            "seed": self.settings.seed,
            "policy": files,
            **result["provenance"],
        }
        picture, caption = spec.picture
        write_page(
            self.out / REPORT_FILE,
            title,
            [*found, *(replace(table, pictures={}) for table in tables), *drawn],
            first={f"{held.name}/{picture}": caption},
            lead=[_lead(result, spec, float(curves["seconds"][-1])), known],
            last={
                "How to repeat it": self._commands(),
                "Provenance": json.dumps(origin, indent=2).splitlines(),
            },
        )
        return tables

    def _spec(self) -> Spec:
        """Return station keeping by the policy and a PID, with the slow row of rendered pictures first."""
        names = (POLICY, "pid")
        scope, by_camera = self.settings.scope or FULL, self.robot is None and self.settings.firmware == "mcu"
        rows = {name: replace(T1.rows[name], changes={"duration": scope.duration}) for name in names}
        if by_camera and not find_spec("cv2"):
            self.report(
                "OpenCV is not installed (pip install 'finssim[vision]'): tag corners are computed in every trial, "
                "and none is played with pictures"
            )
        elif by_camera:
            title, changes = "The same, by pictures", {"duration": scope.duration, "camera": "pictures"}
            with_pictures = replace(
                rows[POLICY], title=title, changes=changes, targets=scope.pictures,
                training={"name": POLICY, **(rows[POLICY].training or {})},
            )  # fmt: skip
            rows = {WITH_PICTURES: with_pictures, **rows}
        return replace(T1, rows=rows, targets=scope.setpoints, bases=(POLICY,))

    def _transfer(self, spec: Spec) -> TransferSettings:
        """Return the settings of the training and of the policy's trials."""
        settings, vehicle = self.settings, self.out / VEHICLE_FILES[1].format(self.standing.name)
        chosen = TransferSettings(
            seeds=1, seed=settings.seed, rows=list(spec.rows), vehicle=str(vehicle), steps=settings.steps,
            firmware=settings.firmware, processes=settings.processes,
        )  # fmt: skip
        if self.robot is not None:
            return chosen
        return replace(chosen, plants=1, severity=SEVERITY, pool_vehicle=settings.vehicle)

    @property
    def _title(self) -> str:
        """Return the title of the report."""
        return f"Station keeping of {self.standing.name}"

    @property
    def site(self) -> str:
        """Return the site of the trials."""
        return FIRMWARES[self.settings.firmware].site if self.robot is None else self.robot.site

    def report(self, text: str) -> None:
        """Show a line of progress."""
        self.console.print(text, highlight=False, markup=False, soft_wrap=True)

    @contextmanager
    def _working(self, doing: str) -> Iterator[Progress]:
        """Show the current work and its progress; on a robot, the session has its own progress line."""
        text = f"{doing} {'in the virtual pool' if self.robot is None else 'on the robot'}"
        self.report(text)
        with nullcontext() if self.robot is not None else self.console.status(text) as status:
            yield lambda part, detail: status.update(f"{text}: {detail}") if status else None

    def _identified(self) -> Identification:
        """Record trials and identify the vehicle from them."""
        standing, settings, scope = self.standing, self.settings, self.settings.scope or FULL
        levels = {
            role: matched(x, standing) for role, x in (("fit", scope.levels), ("held-out", scope.held_out))
        }
        plans = {
            role: programmes(tuple(of_role), standing, levels=of_role, coast=COAST)
            for role, of_role in levels.items()
        }
        plans["fit"] += shuttles(matched(scope.shuttles, standing), standing) if scope.shuttles else []
        plans = {role: [trimmed(programme, standing) for programme in plan] for role, plan in plans.items()}
        if self.robot is None:
            spec = site_of(self.site, draw_plant(standing, settings.seed, SEVERITY))
            spec.write(self.out / PLANT_FILE)
        with self._working("recording trials") as progress:
            record = partial(
                record_programmes, plans, robot=self.robot, console=self.console, pool_vehicle=settings.vehicle,
                plant=settings.seed, severity=SEVERITY, seed=settings.seed, site=self.site,
                firmware=settings.firmware, processes=settings.processes, progress=progress,
            )  # fmt: skip

            def recorded(folders: Mapping[str, Path], rough: str) -> Mapping[str, Sequence[Trial]]:
                def show(run: PoolRun, result: Mapping[str, Any]) -> None:
                    left_out = "left out: " if result["fault"] else ""
                    self.report(f"  {run.target}: {left_out}{result['fault'] or result['text']}")
                    if not (left_out or (self.out / REPORT_FILE).exists()):
                        self._show_recorded(load_trials([folders[run.row] / run.target]))

                trials = {
                    role: load_trials(paths) for role, paths in record(folders, rough, show=show).items()
                }
                self._show_recorded([trial for of_role in trials.values() for trial in of_role])
                if not (self.out / "t1" / "policies").exists():
                    beside.enter_context(
                        running(_compile_training, rough, FIRMWARES[settings.firmware].action)
                    )
                self.report("identifying the vehicle from these trials")
                progress(1.0, "identifying the vehicle from them")
                return trials

            with ExitStack() as beside:
                result = identify(self.out, settings.vehicle, seed=settings.seed, record=recorded)
        identifiable = sum(e.identifiable for e in result.fit.estimates.values())
        self.report(
            f"identified from {len(result.fit.trials)} trials in {result.seconds:.0f} s: {identifiable} of "
            f"{len(result.fit.estimates)} parameters determined, NRMSE on {len(result.replay.pairs)} other trials "
            f"{result.replay.aggregate('calibrated').value:.3f}"
        )
        return result

    def _show_recorded(self, trials: Sequence[Trial]) -> None:
        """Start the report with the paths of the recorded trials."""
        paths = [
            np.column_stack([t.channels[c] for c in ("x", "y", "z")]) for t in trials if t.has("x", "y", "z")
        ]
        if not paths:
            return
        save_figure(
            _paths([p[np.isfinite(p).all(axis=1)] for p in paths], self.site), self.out / "trials.png"
        )
        write_page(
            self.out / REPORT_FILE,
            self._title,
            [],
            lead=[f"Trials recorded so far: {len(trials)}. Identification and training are still to come."],
            first={"trials.png": "Paths of the recorded trials from above and from the side [m]"},
        )
        self.report(f"report so far: {self.out / REPORT_FILE}")

    def _show(self, job: RobotJob, result: Mapping[str, Any]) -> None:
        held = "held" if result["success"] else result["fault"] or "not held"
        if result["e_p_m"] is not None:
            held += f", {result['e_p_m']:.3f} m and {result['e_psi_deg']:.1f}° off"
        self.report(f"  {job.row} at {job.target}: {held}")

    def _commands(self) -> list[str]:
        """Return command lines that repeat the demonstration's steps manually."""
        out, seed, name = self.out, self.settings.seed, self.standing.name
        drawn_around = self.settings.vehicle
        rough, identified = (out / file.format(name) for file in VEHICLE_FILES)
        steps = Policy.load(out / "policy").description.training["steps"]
        options = f"--randomize {RANGES} --seed {seed} --steps {steps}"
        action = FIRMWARES[self.settings.firmware].action
        options += f" --action {action}" if action else ""
        learn = f"finssim train t1 --vehicle {identified} {options} --out policy"
        drive = f"finssim run --policy policy --vehicle {identified} --goal 1,0.3,-0.5,90"
        excite = f"finssim excite all --vehicle {rough} --coast {COAST:g} --out more-trials"
        middle = [*commands(out, name), learn]
        if self.robot is not None:
            robot = f"{self.robot.options} --arm"
            evaluated = f"finssim evaluate run.mcap --task t1 --vehicle {identified}"
            return [f"{excite} {robot}", *middle, f"{drive} {robot} --record run.mcap", evaluated]
        if self.settings.firmware != "mcu":
            tank = f"finssim pool --vehicle {drawn_around} --plant {out / PLANT_FILE} --firmware ardusub"
            robot = f"--robot mavlink --site {self.site} --pool-file none --let-in 0,0 --arm"
            tank += f" --site {self.site} --truth truth.fst"
            return [tank, f"{excite} {robot}", *middle, f"{drive} {robot}"]
        return [
            f"finssim trials import {out / TRIALS / 'fit' / 'records'}/*.mcap --split phase --out trials",
            f"{excite} --pool {seed} --severity {SEVERITY} --pool-vehicle {drawn_around}",
            *middle,
            f"finssim pool --vehicle {drawn_around} --plant {out / PLANT_FILE} --pool-file site.yaml --truth truth.fst",
            f"{drive} --robot pool --pool-file site.yaml --arm",
        ]
