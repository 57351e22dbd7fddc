"""`finssim excite --pool` and `--robot`: programmes played by the robot's whole software, and the trials they make."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import yaml
from rich.console import Console
from rich.progress import Progress

from finssim.calibration.excitation.programmes import Programme, programmes
from finssim.calibration.trials.trial import Trial
from finssim.calibration.trials.trial_files import load_trials, write_trial
from finssim.control.guidance import Station
from finssim.experiments.excitation.places import box_of, place_of
from finssim.experiments.excitation.pool_trials import RECORDS, pool_trials
from finssim.experiments.excitation.programme_trial import (
    ESTIMATOR,
    about_programme,
    fastest,
    programme_trial,
    trial_of_record,
)
from finssim.experiments.on_robot.play import Attendant, RobotTrial
from finssim.experiments.on_robot.session import OnRobot, RobotError, Session, check_starts, session
from finssim.files import atomic_directory, atomic_write
from finssim.quiet import start_warp
from finssim.robot.perception import Perception
from finssim.vehicles import AXES, Vehicle, load_vehicle

__all__ = ["excite_in_pool", "excite_on_robot", "robot_trials", "trials_on_robot"]

PLAN_FILE = "programmes.yaml"


def excite_in_pool(
    axes: str,
    *,
    vehicle: str,
    out: Path,
    plant: int,
    pool_vehicle: str | None = None,
    severity: str = "realistic",
    seed: int = 0,
    processes: int | None = None,
    **plan: Any,
) -> list[Path]:
    """Play programmes in a virtual pool, each from its start at rest, over several processes.

    Args:
        axes: As for `programmes`; so are seed and plan (kind, levels, repeats, coast, duration).
        vehicle: Name or file of the vehicle as the robot knows it.
        out: Folder to make: a trial for each programme, `records/NAME.mcap`, and `programmes.yaml`.
        plant: Seed of the pool.
        pool_vehicle: Name or file of the vehicle around which the pool's own is drawn; `vehicle` if None.
        severity: nominal, realistic or hard.
        processes: As many as there are processors if None.

    Returns:
        The folders of the trials.

    Raises:
        CalibrationError, PlantSpecError, VehicleError, OutputError: As they say.
    """
    start_warp()
    known, standing = load_vehicle(vehicle), load_vehicle(pool_vehicle or vehicle)
    played = programmes(axes, known, seed=seed, **plan)
    screen = Console(stderr=True)
    with (
        atomic_directory(out, replaces=PLAN_FILE) as folder,
        Progress(console=screen, transient=True, disable=not screen.is_terminal) as progress,
    ):
        bar = progress.add_task("playing programmes", total=1.0)
        pool_trials(
            {"fit": played},
            folder,
            vehicle=vehicle,
            pool_vehicle=pool_vehicle or vehicle,
            plant=plant,
            severity=severity,
            seed=seed,
            processes=processes,
            say=lambda part, what: progress.update(bar, completed=part, description=what),
        )
        for made in (folder / "fit").iterdir():
            made.rename(folder / made.name)
        (folder / "fit").rmdir()
        pool = {"vehicle": standing.name, "plant": plant, "severity": severity}
        (folder / PLAN_FILE).write_text(_about(known, played, seed, plan, {"pool": pool}), encoding="utf-8")
    return [Path(out) / programme.name for programme in played]


def excite_on_robot(
    axes: str,
    *,
    vehicle: str,
    out: Path,
    robot: OnRobot,
    seed: int = 0,
    attendant: Attendant | None = None,
    console: Console | None = None,
    **plan: Any,
) -> list[Path]:
    """Play programmes on a robot, one after the other; what lies in the folder is not played again.

    Args:
        axes: As for `programmes`; so are seed and plan (kind, levels, repeats, coast, duration).
        vehicle: Name or file of the vehicle; its workspace is where programmes go to and fro.
        out: Takes a trial for each programme, `records/NAME.mcap`, and `programmes.yaml`.
        robot: Which, and how.
        attendant: Instead of the terminal's keyboard.
        console: Where it is told how it stands; standard error if None.

    Returns:
        The folders of the trials, without those that were skipped.

    Raises:
        RobotError: It may not be armed, stopped with nobody there to help, or the folder is of another plan.
        KeyboardInterrupt: Ctrl-C; the same command goes on.
        CalibrationError, GoalError, LinkError, VehicleError, OutputError: As they say.
    """
    start_warp()
    known, console = load_vehicle(vehicle), console or Console(stderr=True)
    played = programmes(axes, known, seed=seed, **plan)
    _take_folder(Path(out), _about(known, played, seed, plan, {"robot": True}))
    with session(robot, known, attendant=attendant, console=console) as opened:
        return robot_trials(played, Path(out), opened, say=lambda text: console.print(text, highlight=False))


def robot_trials(
    plan: Sequence[Programme],
    folder: Path,
    opened: Session,
    *,
    role: str = "fit",
    say: Callable[[str], None] = lambda text: None,
) -> list[Path]:
    """Play on an open robot what has no trial in a folder yet; returns the folders of the trials.

    Args:
        plan: Programmes.
        folder: Takes NAME, the trials, and records/NAME.mcap.
        opened: The robot.
        role: Of the trials: fit or held-out.
        say: Told each trial that was played.

    Raises:
        As `excite_on_robot`.
    """
    vehicle = opened.vehicle
    box = box_of(vehicle)
    places = {programme.name: place_of(programme, vehicle, box) for programme in plan}
    starts = {name: Station(place.position, place.yaw) for name, place in places.items()}
    check_starts(starts, vehicle)
    made = []
    for programme in plan:
        name, attempts = programme.name, list[RobotTrial]()
        record = folder / RECORDS / f"{name}.mcap"

        def attempt(programme: Programme = programme, attempts: list[RobotTrial] = attempts) -> RobotTrial:
            attempts.append(programme_trial(programme, vehicle, places[programme.name]))
            return attempts[-1]

        if not record.is_file():
            about = {"command": "finssim excite", **about_programme(programme, opened.robot.title)}
            outcome = opened.trial(
                attempt,
                starts[name],
                record,
                counts=False,
                exact=False,
                perception=lambda: Perception(vehicle, opened.site, mode=ESTIMATOR),
                about=about,
            )
            if outcome is None:
                continue
            unit = "m/s" if programme.axes[0] in AXES[:3] else "rad/s"
            say(f"  up to {fastest(attempts[-1]):.2f} {unit} in {outcome.runtime.t:.0f} s")
        if not (folder / name).is_dir():
            write_trial(trial_of_record(record, name, role), folder / name, format="parquet")
        made.append(folder / name)
    return made


def trials_on_robot(
    plans: Mapping[str, Sequence[Programme]],
    folder: Path,
    vehicle: Vehicle,
    robot: OnRobot,
    *,
    attendant: Attendant | None = None,
    console: Console | None = None,
) -> dict[str, list[Trial]]:
    """What `pool_trials` does in a pool, on a robot: the trials by role, without those that were skipped.

    Args:
        plans: Role of the trials (fit, held-out) -> programmes.
        folder: Takes ROLE/NAME and ROLE/records/NAME.mcap; what is there is not played again.
        vehicle: As the robot knows it.
        robot: Which, and how; not opened where nothing is left to play.
        attendant: Instead of the terminal's keyboard.
        console: Where it is told how it stands; standard error if None.

    Raises:
        As `excite_on_robot`; CalibrationError too where every programme of a role was skipped.
    """
    console = console or Console(stderr=True)
    missing = [p for role, plan in plans.items() for p in plan if not (folder / role / p.name).is_dir()]
    with (
        session(robot, vehicle, attendant=attendant, console=console) if missing else nullcontext() as opened
    ):
        for role, plan in plans.items():
            if opened is not None:
                robot_trials(
                    plan,
                    folder / role,
                    opened,
                    role=role,
                    say=lambda text: console.print(text, highlight=False),
                )
    return {
        role: load_trials([folder / role / p.name for p in plan if (folder / role / p.name).is_dir()])
        for role, plan in plans.items()
    }


def _about(
    vehicle: Vehicle,
    played: Sequence[Programme],
    seed: int,
    plan: Mapping[str, Any],
    where: Mapping[str, Any],
) -> str:
    """What the folder is of."""
    digest = hashlib.sha256(b"".join(p.tau_desired.tobytes() + "".join(p.phase).encode() for p in played))
    about = {
        "vehicle": {"name": vehicle.name, "sha256": vehicle.sha256},
        "kind": plan.get("kind", "published"),
        **where,
        "seed": seed,
        "programmes": [programme.name for programme in played],
        "sha256": digest.hexdigest(),
    }
    return yaml.safe_dump(about, sort_keys=False)


def _take_folder(out: Path, about: str) -> None:
    """Begin a folder, or go on in one that is of the very same plan."""
    file = out / PLAN_FILE
    if not out.exists() or not any(out.iterdir()):
        with atomic_write(file) as temporary:
            temporary.write_text(about, encoding="utf-8")
    elif not file.is_file() or file.read_text(encoding="utf-8") != about:
        raise RobotError(
            f"{out}: holds other files than trials of these programmes of this vehicle: give a new --out, or the same "
            "axes, levels, seed and vehicle to go on with them"
        )
