"""`finssim demo` of a vehicle that must move to steer: identification, training along a path, dives in open water."""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from finssim.core.palette import COLORS
from finssim.evaluation.campaign import keep_result, load_result
from finssim.evaluation.figures import clean, legend_below, new_figure, save_figure
from finssim.evaluation.tables import Table, write_page
from finssim.identification.fit import Fit
from finssim.identification.hydrodynamics import fit_hydrodynamics
from finssim.identification.manoeuvres import manoeuvres, simulate_manoeuvres
from finssim.identification.prediction import replay
from finssim.identification.report import interval_text, number_text
from finssim.identification.vehicle_file import calibrated, write_vehicle
from finssim.learning.train import TrainingSettings, train
from finssim.pool import draw_plant
from finssim.pool.drawn_plant import site_of
from finssim.pool.task_site import PositionSources, TaskSite
from finssim.pool.virtual_pool import Truth, read_truth
from finssim.robot.pilots import make_pilot
from finssim.tasks.catalogue import task_named
from finssim.trials.trial import Trial
from finssim.trials.trial_files import load_trials, write_trial
from finssim.vehicles import AXES, Provenance, Vehicle, load_vehicle
from finssim.vehicles.defaults import vehicle_at

__all__ = ["demo_course", "drawn_body"]

TASK, BASELINE = "path", "line-of-sight"
FIT, HELD_OUT = ("speeds", "zigzag_fast", "dives_fast"), ("corkscrew",)
"""Manoeuvres used in the fit, and manoeuvres that are replayed."""
AXES_FITTED = ("surge", "sway", "heave", "pitch", "yaw")
SLOPE = "fin.lift_slope"
RATE = 20.0
"""Rows of the trials [Hz]."""
SPREAD = 0.18
"""Standard deviation of the logarithm of a true coefficient relative to the file's [-]."""
HORIZON = 3.0
"""Prediction horizon from a measured state [s]."""
DIVES = 3
"""Number of paths that each controller follows."""
GENTLE: dict[str, Any] = {"offset": 0.3, "yaw": 0.1, "slope": math.radians(6.0)}
"""Fields of `path` in the dives, which start from rest: near the path, roughly along it, with gentle slopes."""
SITE, POSITIONING, SEVERITY, RANGES = "open-water", "usbl", "realistic", "cruise"


def drawn_body(vehicle: Vehicle, seed: int) -> tuple[Vehicle, float]:
    """Return a vehicle whose coefficients are drawn around those of a file, and the factor on its fins' lift.

    Args:
        vehicle: The file.
        seed: Seed of the draw.
    """
    rng, chosen = np.random.default_rng([35, seed]), vehicle.hydrodynamics["calibrated"]
    changes: dict[str, Any] = {}
    for key in ("added_mass", "linear_damping", "quadratic_damping"):
        root = np.exp(0.5 * SPREAD * rng.standard_normal(6))
        matrix = np.asarray(getattr(chosen, key)) * np.outer(root, root)
        changes[f"hydrodynamics.calibrated.{key}"] = matrix.tolist()
    slope = float(np.exp(SPREAD * rng.standard_normal()))
    for name, actuator in vehicle.actuators.items():
        if actuator.kind == "fin":
            changes[f"actuators.{name}.lift_slope"] = slope * float(actuator.lift_slope)
    origin = Provenance("guessed", "", "drawn around the number of the vehicle file")
    return vehicle.replace(changes, origin), slope


def demo_course(
    out: Path, vehicle: Vehicle, *, seed: int, steps: int | None, console: Console
) -> tuple[list[Table], Path]:
    """Identify a vehicle with fins, train `path`, and follow paths in open water by DVL, compass and USBL.

    The vehicle is ballasted to be neutral. The true vehicle has its own coefficients, drawn around those of the
    file. Its autopilot, tuned to the file, runs the manoeuvres in the simulator with sensor noise; the
    paths are followed by the robot's complete software in the virtual site. An interrupted demonstration continues.

    Args:
        out: Existing directory of the results.
        vehicle: Vehicle with a course autopilot.
        seed: Seed of every random number.
        steps: Control steps of the training; None: the task's default.
        console: Console for progress.

    Returns:
        The tables, and the path of the report.
    """

    def report(text: str) -> None:
        console.print(text, highlight=False, markup=False, soft_wrap=True)

    name, ballasted = vehicle.name, out / f"{vehicle.name}_ballasted.yaml"
    # From rest under water, a buoyant torpedo rises before its fins become effective.
    neutral = {"body.displaced_volume": vehicle.body.mass / vehicle.water.density}
    write_vehicle(vehicle.replace(neutral, Provenance("derived", "", "ballasted to be neutral")), ballasted)
    vehicle = load_vehicle(ballasted)
    body, slope = drawn_body(vehicle, seed)
    write_vehicle(body, out / f"{name}_in_water.yaml")
    report("manoeuvres by the autopilot of the vehicle file")
    fitted, held_out = (_trials(out, vehicle, body, names, seed) for names in (FIT, HELD_OUT))
    file, found = out / f"{name}_identified.yaml", out / "identification.json"
    if not (file.is_file() and found.is_file()):
        report("identifying the vehicle")
        began = time.perf_counter()
        fit = fit_hydrodynamics(fitted, vehicle, axes=AXES_FITTED, estimate=(SLOPE,), held_out=held_out)
        write_vehicle(calibrated(fit), file)
        keep_result(found, {"rows": _compared(fit, body, slope)})
        report(f"identified from {len(fitted)} trials in {time.perf_counter() - began:.0f} s")
    identified = load_vehicle(file)
    ahead = {
        kind: replay(held_out, one, horizon=HORIZON, seed=seed).ahead
        for kind, one in (("file", vehicle), ("identified", identified))
    }
    if not (out / "policy").is_dir():
        report("training along paths")
        settings = TrainingSettings(vehicle=str(file), randomize=RANGES, seed=seed, steps=steps)
        train(TASK, out=out / "policy", settings=settings, console=console)
    rows = [
        _dive(out, identified, body, controller, k, seed, report)
        for controller in ("policy", BASELINE)
        for k in range(DIVES)
    ]
    save_figure(_picture(out, rows), out / "dives.png")
    tables = [
        Table(
            title="Identification",
            headline=f"Speed runs, zig-zags and dives by the autopilot of {name}, logged at {RATE:g} Hz.",
            heads=("parameter", "estimate", "95 % interval", "in the water", "unit"),
            rows=load_result(found)["rows"],
            note=f"{SLOPE} is a factor on the slope of the lift of all fins.",
        ),
        Table(
            title=f"Predictions of a manoeuvre that was not fitted, {HORIZON:g} s ahead",
            heads=("axis", "file", "identified"),
            rows=[
                (axis, *(number_text(float(found[axis]["calibrated"].nrmse[-1])) for found in ahead.values()))
                for axis in AXES
                if all(axis in found for found in ahead.values())
            ],
            note="NRMSE. Without autopilot the vehicle does not keep its course, so only short predictions are made.",
        ),
        _dived(rows),
    ]
    page = out / "report.html"
    repeat = {"How to repeat it": _commands(out, name, seed)}
    write_page(
        page, f"Along a path by {name}", tables, first=tables[-1].pictures, lead=_lead(rows), last=repeat
    )
    return tables, page


def _trials(out: Path, vehicle: Vehicle, body: Vehicle, names: Sequence[str], seed: int) -> list[Trial]:
    """Return the trials of some manoeuvres, which are simulated if the folder lacks them."""
    folders = [out / "trials" / name for name in names]
    if not all((folder / "trial.yaml").is_file() for folder in folders):
        chosen = [one for one in manoeuvres(vehicle) if one.name in names]
        for trial in simulate_manoeuvres(chosen, vehicle, truth=body, seed=seed, rate=RATE):
            write_trial(trial, out / "trials" / trial.name)
    return load_trials(folders)


def _dive(
    out: Path, vehicle: Vehicle, body: Vehicle, controller: str, number: int, seed: int, report: Any
) -> dict[str, Any]:
    """Return the figures of one path followed by the robot's software, from its file if it exists."""
    folder = out / "dives" / f"{controller}-{number + 1}"
    file = folder / "result.json"
    if file.is_file():
        return dict(load_result(file))
    policy = str(out / "policy") if controller == "policy" else controller
    episode, known = 1000 * seed + number, vehicle_at(SITE, vehicle)
    shutil.rmtree(folder, ignore_errors=True)  # of a dive that was interrupted
    true = vehicle_at(SITE, body)
    site = TaskSite(
        replace(task_named(TASK), **GENTLE),
        [known],
        [(true, site_of(SITE, draw_plant(true, episode, SEVERITY)))],
        lambda name: make_pilot(policy, vehicle, task=TASK),
        PositionSources(positioning=POSITIONING, let_in=True),
        seed=episode,
        record=folder,
    )
    path = site.referee.arrays.path.points.numpy()[0].astype(float).tolist()
    measured = {key: float(x) if np.isfinite(x) else None for key, x in site.run().items()}
    result = {"controller": controller, "dive": number + 1, "metrics": measured, "path": path}
    keep_result(file, result)
    error = measured["error"]
    report(f"  {controller}, path {number + 1}: {'lost' if error is None else f'{error:.2f} m RMS distance'}")
    return result


def _compared(fit: Fit, body: Vehicle, slope: float) -> list[list[str]]:
    """Return rows of the identified parameters, next to those of the true vehicle."""
    M, D = body.mass_matrix(), body.hydrodynamics["calibrated"]
    true = {f"{axis}.m_eff": float(M[i, i]) for i, axis in enumerate(AXES)}
    true |= {f"{axis}.d2": float(np.diag(D.quadratic_damping)[i]) for i, axis in enumerate(AXES)}
    true[SLOPE] = slope
    return [
        [key, number_text(one.estimate), interval_text(one), number_text(true[key]), one.unit]
        for key, one in fit.estimates.items()
        if key in true
    ]


def _dived(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Return the table of the dives."""
    heads = ("controller", "paths", "finished", "RMS distance [m]")
    out = []
    for controller in ("policy", BASELINE):
        own = [row["metrics"] for row in rows if row["controller"] == controller]
        errors = [metrics["error"] for metrics in own if metrics["error"] is not None]
        finished = sum(metrics["success"] == 1.0 for metrics in own)
        out.append(
            (controller, f"{len(own)}", f"{finished}", number_text(float(np.mean(errors or [np.nan]))))
        )
    return Table(
        title="Along paths in open water, by DVL, compass and USBL",
        heads=heads,
        rows=out,
        note="By the robot's complete software, in plants drawn around the vehicle in the water.",
        pictures={
            "dives.png": "First dive of each controller: path from above [m], depth [m] and fins [°] against time [s]"
        },
    )


def _lead(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the result as one sentence for each controller."""
    sentences = []
    for controller in ("policy", BASELINE):
        own = [row["metrics"] for row in rows if row["controller"] == controller]
        finished = sum(metrics["success"] == 1.0 for metrics in own)
        errors = [metrics["error"] for metrics in own if metrics["error"] is not None]
        off = f", {np.mean(errors):.2g} m from them on average" if errors else ""
        sentences.append(f"{controller} followed {finished} of {len(own)} paths to their end{off}.")
    return [" ".join(sentences)]


def _picture(out: Path, rows: Sequence[Mapping[str, Any]]) -> Any:
    """Draw the first path of both controllers: from above, depth over time, and the fins of the policy's dive."""
    first = {row["controller"]: row for row in rows if row["dive"] == 1}
    truths: dict[str, Truth] = {}
    for controller in first:
        (file,) = (out / "dives" / f"{controller}-1").glob("*.truth")
        truths[controller] = read_truth(file)
    figure = new_figure(7.2, 8.4)
    above, depth, fins = figure.subplots(3, 1, height_ratios=(2.0, 1.0, 1.0))
    path = np.array(first["policy"]["path"])
    above.plot(path[:, 0], path[:, 1], color="0.7", linewidth=4.0, label="path")
    for color, (controller, truth) in zip(COLORS, truths.items(), strict=False):
        above.plot(*truth.position[:, :2].T, color=color, linewidth=1.2, label=controller)
        depth.plot(truth.time - truth.time[0], -truth.position[:, 2], color=color, linewidth=1.2)
    above.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
    depth.invert_yaxis()
    depth.set(ylabel="depth [m]")
    truth = truths["policy"]
    for k, name in enumerate(truth.header["actuators"]):
        fins.plot(truth.time - truth.time[0], np.degrees(truth.actuators[:, k]), linewidth=1.0, label=name)
    fins.set(xlabel="time [s]", ylabel="fins [deg]")
    fins.legend(fontsize=7, ncols=4, frameon=False)
    for axes in (depth, fins):
        clean(axes)
    legend_below(figure, above, 3)
    return figure


def _commands(out: Path, name: str, seed: int) -> list[str]:
    """Return command lines that repeat the demonstration's steps manually."""
    identified, trials = out / f"{name}_identified.yaml", " ".join(str(out / "trials" / one) for one in FIT)
    file = out / f"{name}_ballasted.yaml"
    pool = f"finssim pool --vehicle {out / f'{name}_in_water.yaml'} --site {SITE} --positioning {POSITIONING}"
    run = f"finssim run --vehicle {identified} --site {SITE} --pool-file none --policy policy --task {TASK}"
    return [
        f"finssim excite all --kind manoeuvres --vehicle {file} --simulate --out trials",
        f"finssim calibrate hydrodynamics {trials} --vehicle {file} --estimate {SLOPE} --out {identified}",
        f"finssim train {TASK} --vehicle {identified} --randomize {RANGES} --seed {seed} --out policy",
        f"{pool} --start 0,0,-15,0 --lockstep",
        f"{run} --trajectory way.csv --lockstep --arm",
    ]
