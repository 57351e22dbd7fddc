"""`finssim demo`: the whole loop on one machine, from a vehicle nobody measured to a policy in a pool."""

from __future__ import annotations

import csv
import json
import shutil
import sys
import time
import webbrowser
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from os import environ
from pathlib import Path
from typing import Annotated, Any

from rich.console import Console

from finssim.calibration.excitation.programmes import Programme, programmes
from finssim.calibration.trials.trial import Trial
from finssim.control.policy import Policy
from finssim.control.policy_description import DESCRIPTION_FILE
from finssim.experiments.campaign import Say, run_jobs, write_json
from finssim.experiments.demo_report import camera_view, report_html
from finssim.experiments.evaluate import Evaluation, print_comparison
from finssim.experiments.excitation import pool_trials, trials_on_robot
from finssim.experiments.identify import (
    HELD_OUT,
    TRIALS,
    Identification,
    commands,
    identify,
    vehicle_files,
)
from finssim.experiments.on_robot import Attendant, OnRobot, kept_folder
from finssim.experiments.paper import T1_SETPOINTS
from finssim.experiments.pool_trial import HARDWARE, Job, play, pool_evaluation, pool_jobs, run_on_robot
from finssim.experiments.programmes import compare_steps, matched, shuttles, trimmed
from finssim.experiments.transfer import finished
from finssim.files import atomic_directory
from finssim.learning.train import train
from finssim.pool import draw_plant
from finssim.quiet import start_warp
from finssim.vehicles import AXES, Vehicle, load_vehicle

__all__ = ["demo"]

PLANT_FILE = "pool.yaml"
"""The plant, for `finssim pool --plant`."""
TRIALS_FOLDER = "deployed"
"""A result and a series for every trial of a controller."""


REPORT_FILE = "report.html"
SEED = 1
PLANT, SEVERITY, RANGES = 1, "realistic", "pool"
CONTROLLERS = ("policy", "pid", "pid-paper")
VIEW_AT = 12.0
"""Time of a trial from which the report shows a picture [s]."""
COAST = 4.0
"""Longest, after a dive [s]: the pool is shallow, and this vehicle hardly rises."""


@dataclass(frozen=True, kw_only=True)
class Scope:
    """How much of everything a demonstration does."""

    levels: dict[str, list[float]]
    """Axis -> levels of the steps and pulses that the fit is made from, for FinsROV [N, N m]."""
    shuttles: dict[str, list[float]]
    """The same of the square waves."""
    held_out: dict[str, list[float]]
    """The same of those that are replayed."""
    setpoints: tuple[str, ...]
    """Tried by every controller, with the tags' corners computed."""
    pictures: tuple[str, ...]
    """Tried by the policy with pictures drawn and searched."""
    duration: float = 60.0
    """Of a trial [s]."""

    def of(self, vehicle: Vehicle) -> Scope:
        """The same for a vehicle: levels that move it as FinsROV's move FinsROV, on the axes that it controls.

        See `programmes.matched`.
        """
        return replace(
            self,
            **{name: matched(getattr(self, name), vehicle) for name in ("levels", "shuttles", "held_out")},
        )


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
"""What `finssim demo` does."""


def demo(
    out: Annotated[Path, "--out"] = Path("demo"),
    *,
    vehicle: str = "finsrov",
    seed: int = 1,
    steps: Annotated[int | None, (1, None)] = None,
    console: Console | None = None,
    scope: Scope | None = None,
    processes: Annotated[int | None, "python"] = None,
    robot: OnRobot | None = None,
    attendant: Attendant | None = None,
) -> Path:
    """Identify a vehicle in the virtual pool or on a robot, train in it, deploy there beside two PIDs, write a report.

    Trials are recorded and controllers deployed through the robot's whole software: camera, localization, fusion,
    controller, allocation, bridge and the motor controller's protocol. Beside the policy, `pid` and `pid-paper` try the
    same setpoints in the same pool, `pid` tuned from the identified vehicle.

    Example: finssim demo --vehicle bluerov2_heavy --out demo

    Example: finssim demo --robot udp://10.0.0.2:58766 --pool-file pool.yaml --arm --out demo

    Args:
        out: Directory of trials, vehicle, policy, results and report.
        vehicle (NAME|FILE): Vehicle of the catalogue, or the path of a vehicle file.
        seed: Seed of every random number; equal seeds give equal results.
        steps: Control steps to learn from, all worlds together; what the task needs if not given.
        console: Where progress is shown; standard error if None.
        scope: How much of it; `FULL` if None.
        processes: As many as there are processors if None.
        robot: Where trials are made and setpoints held, in place of the virtual pool. What is done stays in `out`, and
            the next call goes on.
        attendant: The person beside that robot, instead of the terminal's keyboard.

    Returns:
        Path of the report.

    Raises:
        KeyboardInterrupt: After Ctrl-C. A policy so far is then in `OUT-training/interrupted`, and, but for a robot's,
            `out` as it was.
    """
    console, standing = console or Console(stderr=True), load_vehicle(vehicle)
    scope = (scope or FULL).of(standing)
    start_warp()
    rescue = out.with_name(f"{out.name}-training") / "interrupted"
    place = _Place(vehicle, robot, attendant, processes, console)
    with atomic_directory(out, replaces=REPORT_FILE) if robot is None else kept_folder(out) as folder:
        found = _identified(folder, out, seed, scope, place)
        began = time.perf_counter()
        policy = folder / "policy"
        if robot is None or not finished(policy, found.vehicle):
            train(
                "t1",
                out=policy,
                vehicle=found.vehicle,
                randomize=RANGES,
                seed=seed,
                steps=steps,
                console=console,
                shown=out / "policy",
                interrupted=rescue,
            )
        training = {
            "seconds": time.perf_counter() - began,
            "seed": seed,
            "steps": Policy.load(policy).description.training["steps"],
        }
        with _rescued(policy, rescue, console):
            evaluations, picture = _deployed(folder, policy, seed, scope, place)
            _write(folder, found, evaluations, training, _commands(out, place, training), picture)
    print_comparison([e.result for e in evaluations if e.result["camera"] != "pictures"], Console())
    report = Path(out) / REPORT_FILE
    print(f"report: {report}")
    if _has_display():
        webbrowser.open(report.resolve().as_uri())
    return report


@dataclass(frozen=True)
class _Place:
    """With what and where it is done."""

    vehicle: str
    """Name or file, as the catalogue has it."""
    robot: OnRobot | None
    attendant: Attendant | None
    processes: int | None
    console: Console


def _identified(folder: Path, out: Path, seed: int, scope: Scope, place: _Place) -> Identification:
    """Trials, the vehicle they tell of, and in a pool how its speeds compare with the plant's."""
    standing, console = load_vehicle(place.vehicle), place.console
    plans = _plans(standing, scope)
    if place.robot is not None:
        robot = place.robot
        console.print("recording trials on the robot", highlight=False)

        def record(folder: Path, rough: Path, seed: int) -> dict[str, list[Trial]]:
            return trials_on_robot(
                plans, folder, load_vehicle(rough), robot, attendant=place.attendant, console=console
            )

        return _told(identify(folder, place.vehicle, seed=seed, shown=out, record=record), console)
    spec = draw_plant(standing, PLANT, SEVERITY)
    spec.write(folder / PLANT_FILE)
    console.print("recording trials in the virtual pool", highlight=False)
    with console.status("recording trials in the virtual pool") as status:

        def say(part: float, what: str) -> None:
            fitting = f"fitting {standing.name} to the trials, replaying others"
            status.update(f"recording trials in the virtual pool: {what}" if part < 1.0 else fitting)

        def show(run: Any, result: Mapping[str, Any]) -> None:
            unit = "m/s" if run.programme.axes[0] in AXES[:3] else "rad/s"
            text = f"up to {result['fastest']:.2f} {unit} in {result['duration']:.0f} s"
            text = f"left out: {result['fault']}" if result["fault"] else text
            console.print(f"  {run.target}: {text}", highlight=False)

        def simulated(folder: Path, rough: Path, seed: int) -> dict[str, list[Trial]]:
            return pool_trials(
                plans, folder, vehicle=str(rough), pool_vehicle=place.vehicle, plant=PLANT, severity=SEVERITY,
                seed=seed, leave_out=True, processes=place.processes, say=say, show=show,
            )  # fmt: skip

        found = identify(folder, place.vehicle, seed=seed, shown=out, record=simulated)
        linear = {axis: levels for axis, levels in scope.levels.items() if axis not in ("roll", "pitch")}
        found = replace(found, steps=tuple(compare_steps(found.vehicle, standing, spec, linear)))
    return _told(found, console)


def _told(found: Identification, console: Console) -> Identification:
    """Say what was identified."""
    off = [abs(float(s["model_speed"]) / float(s["plant_speed"]) - 1.0) for s in found.steps]
    speeds = f", terminal speeds within {100.0 * max(off):.0f} % of the pool's own vehicle" if off else ""
    identifiable = sum(e.identifiable for e in found.fit.estimates.values())
    console.print(
        f"identified from {len(found.fit.trials)} trials in {found.seconds:.0f} s: {identifiable} of "
        f"{len(found.fit.estimates)} parameters told, NRMSE on {len(found.replay.pairs)} other trials "
        f"{found.replay.aggregate('calibrated').value:.3f}{speeds}",
        highlight=False,
    )
    return found


def _plans(standing: Vehicle, scope: Scope) -> dict[str, list[Programme]]:
    """Programmes by role."""
    plans = {
        role: programmes(tuple(levels), standing, levels=levels, coast=COAST)
        for role, levels in (("fit", scope.levels), ("held-out", scope.held_out))
    }
    plans["fit"] += shuttles(scope.shuttles, standing) if scope.shuttles else []
    return {role: [trimmed(programme, standing) for programme in plan] for role, plan in plans.items()}


def _deployed(
    folder: Path, policy: Path, seed: int, scope: Scope, where: _Place
) -> tuple[list[Evaluation], bytes | None]:
    """All controllers in the pool, the policy with pictures too, and one of those pictures; or all on the robot."""
    console = where.console
    common: dict[str, Any] = {
        "vehicle": str(folder / vehicle_files(load_vehicle(where.vehicle).name)[1]),
        "pool_vehicle": where.vehicle,
        "plant": PLANT,
        "severity": SEVERITY,
        "seed": seed,
        "duration": scope.duration,
    }
    names = {name: str(policy) if name == "policy" else name for name in CONTROLLERS}
    if where.robot is not None:
        common |= {"pool_vehicle": common["vehicle"], "plant": 0, "severity": HARDWARE}
        jobs = pool_jobs(names, scope.setpoints, camera=HARDWARE, **common)
        results = run_on_robot(
            jobs, folder / TRIALS_FOLDER, where.robot, attendant=where.attendant, console=console
        )
        played = {result["key"]: result for result in results}
        jobs = [job for job in jobs if job.key() in played]
        return _by_row(jobs, [played[job.key()] for job in jobs], folder / TRIALS_FOLDER), None
    # Pictures first: they take longest, and the other processor has time for the rest.
    jobs = pool_jobs({"policy-with-pictures": str(policy)}, scope.pictures, camera="pictures", **common)
    seen = jobs[:1]
    jobs += pool_jobs(names, scope.setpoints, camera="corners", **common)
    place = folder / TRIALS_FOLDER
    console.print("holding setpoints in the virtual pool", highlight=False)
    with console.status("holding setpoints in the virtual pool") as status:
        say: Say = lambda part, what: status.update(f"holding setpoints in the virtual pool: {what}")  # noqa: E731

        def show(job: Job, result: Mapping[str, Any]) -> None:
            held = "held" if result["success"] else result["fault"] or "not held"
            if result["e_p_m"] is not None:
                held += f", {result['e_p_m']:.3f} m and {result['e_psi_deg']:.1f}° off"
            console.print(f"  {job.row} at {job.target}: {held}", highlight=False)

        results = run_jobs(jobs, place, play, processes=where.processes, say=say, show=show)
        evaluations = _by_row(jobs, results, place)
        picture = camera_view(seen[0], place / seen[0].key(), VIEW_AT, seed) if seen else None
    return evaluations, picture


def _by_row(jobs: Sequence[Job], results: Sequence[dict[str, Any]], place: Path) -> list[Evaluation]:
    """One evaluation for each row, the policy's first."""
    rows = sorted({job.row for job in jobs}, key=lambda row: [*CONTROLLERS, row].index(row))
    chosen = [[i for i, job in enumerate(jobs) if job.row == row] for row in rows]
    return [pool_evaluation([jobs[i] for i in those], [results[i] for i in those], place) for those in chosen]


def _write(
    folder: Path,
    found: Identification,
    evaluations: Sequence[Evaluation],
    training: Mapping[str, Any],
    commands: Sequence[str],
    picture: bytes | None,
) -> None:
    """Write NAME.json of every controller, `steps.json`, `camera.png` and `report.html`."""
    for evaluation in evaluations:
        write_json(folder / f"{evaluation.result['controller']['name']}.json", evaluation.result)
    (folder / "steps.json").write_text(json.dumps(found.steps, indent=2) + "\n", encoding="utf-8")
    if picture is not None:
        (folder / "camera.png").write_bytes(picture)
    with (folder / "policy" / "curves.csv").open(encoding="utf-8", newline="") as file:
        curves = [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]
    html = report_html(evaluations, curves, training, commands, found, picture)
    (folder / REPORT_FILE).write_text(html, encoding="utf-8")


def _commands(out: Path, place: _Place, training: Mapping[str, Any]) -> list[str]:
    """Command lines that repeat the demonstration's steps by hand."""
    name = load_vehicle(place.vehicle).name
    rough, identified = (out / file for file in vehicle_files(name))
    seed, steps = training["seed"], training["steps"]
    goal = f"finssim run --policy policy --vehicle {identified} --goal 1,0.3,-0.5,90"
    excite = f"finssim excite all --vehicle {rough}"
    middle = [
        *commands(out, name, seed),
        f"finssim train t1 --vehicle {identified} --randomize {RANGES} --seed {seed} --steps {steps} --out policy",
    ]
    if place.robot is not None:
        robot = f"{place.robot.options} --arm"
        return [
            f"{excite} {robot} --coast {COAST:g} --out more-trials",
            *middle,
            f"{goal} {robot} --record run.mcap",
            f"finssim evaluate run.mcap --task t1 --vehicle {identified}",
        ]
    return [
        f"finssim trials import {out / TRIALS / 'fit' / 'records'}/*.mcap --split phase --out trials",
        f"{excite} --pool {PLANT} --severity {SEVERITY} --pool-vehicle {place.vehicle} --coast {COAST:g} "
        "--out more-trials",
        *middle,
        f"finssim pool --vehicle {place.vehicle} --plant {out / PLANT_FILE} --pool-file site.yaml --truth truth.fst",
        f"{goal} --robot pool --pool-file site.yaml --arm",
    ]


@contextmanager
def _rescued(policy: Path, rescue: Path, console: Console) -> Iterator[None]:
    """Keep a trained policy when what follows its training is interrupted, and `folder` goes."""
    try:
        yield
    except KeyboardInterrupt:
        with atomic_directory(rescue, replaces=DESCRIPTION_FILE) as copy:
            shutil.copytree(policy, copy, dirs_exist_ok=True)
        console.print(f"policy kept: {rescue}", highlight=False, soft_wrap=True)
        raise


def _has_display() -> bool:
    """Whether a person sits in front of a screen where a browser could open."""
    if not sys.stdout.isatty():
        return False
    return sys.platform in ("darwin", "win32") or bool(
        environ.get("DISPLAY") or environ.get("WAYLAND_DISPLAY")
    )
