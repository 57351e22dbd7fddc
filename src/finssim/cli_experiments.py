"""Commands of the experiments in the virtual pool: t1, t2, ablation, all, faults, soak, timing."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from finssim.cli_options import (
    Arm,
    Bind,
    ByHand,
    Json,
    Lockstep,
    Pictures,
    Robot,
    RobotPool,
    RobotSite,
    Seed,
    Steps,
    Unattended,
    Vehicle,
)
from finssim.cli_robot import robot_or_none

if TYPE_CHECKING:
    from finssim.experiments.on_robot import OnRobot

__all__ = ["ablation", "everything", "faults", "open_water", "soak", "stack", "t1", "t2", "timing"]

Out = Annotated[
    Path,
    typer.Option(
        help="Directory for JSON, Markdown, figures, policies and trials; one that was interrupted goes on.",
        metavar="DIR",
    ),
]
Plants = Annotated[
    int, typer.Option(help="Virtual pools, each with its own vehicle, water and camera.", min=1, max=1000)
]
Seeds = Annotated[
    int, typer.Option(help="Trainings of each policy, each tried with its own noise.", min=1, max=1000)
]
Severity = Annotated[
    str,
    typer.Option(
        help="How far the pools are from the vehicle file: nominal, realistic or hard.", metavar="WORD"
    ),
]
Camera = Annotated[
    str,
    typer.Option(
        help="corners (projected through the rippling water, with noise), or pictures (drawn, and searched for tags: "
        "several times slower).",
        metavar="MODE",
    ),
]
Rows = Annotated[str | None, typer.Option(help="Rows of the table, separated by commas; all if not given.")]
Targets = Annotated[
    str | None,
    typer.Option(help="Setpoints or trajectories, separated by commas; all published ones if not given."),
]
Processes = Annotated[
    int | None, typer.Option(help="Trials at once; as many as processors if not given.", min=1)
]


def _options(rows: str | None, targets: str | None, **options: Any) -> dict[str, Any]:
    chosen = {"rows": rows, "targets": targets}
    return options | {key: tuple(words.split(",")) for key, words in chosen.items() if words is not None}


def _robot(address: str | None, options: dict[str, Any], **how: Any) -> OnRobot | None:
    """The robot of an experiment, or none; what tells of pools does not go with it."""
    own = (options["plants"], options["severity"], options["camera"]) == (3, "realistic", "corners")
    if address is not None and not own:
        raise typer.BadParameter(
            "a robot has its own plant and camera: leave --plants, --severity and --camera out"
        )
    return robot_or_none(address, **how)


def t1(
    out: Out,
    plants: Plants = 3,
    seeds: Seeds = 3,
    seed: Seed = 1,
    severity: Severity = "realistic",
    camera: Camera = "corners",
    rows: Rows = None,
    setpoints: Targets = None,
    vehicle: Vehicle = "finsrov",
    steps: Steps = None,
    processes: Processes = None,
    robot: Robot = None,
    pool_file: RobotPool = None,
    site: RobotSite = None,
    bind: Bind = "127.0.0.1:54321",
    pictures: Pictures = None,
    lockstep: Lockstep = False,
    arm: Arm = False,
    by_hand: ByHand = False,
    unattended: Unattended = False,
    as_json: Json = False,
) -> None:
    """Station keeping in the virtual pool (the paper's Table IV): success, errors [m, deg], time to settle [s], jitter.

    With --robot the published protocol on a vehicle, guided on the screen, marked as hardware.

    Example: finssim experiment t1 --rows calibrated,pid --seeds 1 --out t1

    Example: finssim experiment t1 --rows pid --seeds 1 --robot serial:/dev/ttyUSB0 --pool-file p.yaml --arm --out hw
    """
    from finssim.experiments.transfer import run
    from finssim.experiments.transfer_tables import T1

    options = _options(
        rows, setpoints, plants=plants, seeds=seeds, seed=seed, severity=severity, camera=camera
    )
    options["robot"] = _robot(
        robot, options, bind=bind, pictures=pictures, lockstep=lockstep, pool_file=pool_file, site=site, arm=arm,
        by_hand=by_hand, unattended=unattended,
    )  # fmt: skip
    run(T1, out=out, vehicle=vehicle, steps=steps, processes=processes, as_json=as_json, **options)


def t2(
    out: Out,
    plants: Plants = 3,
    seeds: Seeds = 3,
    seed: Seed = 1,
    severity: Severity = "realistic",
    camera: Camera = "corners",
    rows: Rows = None,
    trajectories: Targets = None,
    vehicle: Vehicle = "finsrov",
    steps: Steps = None,
    processes: Processes = None,
    robot: Robot = None,
    pool_file: RobotPool = None,
    site: RobotSite = None,
    bind: Bind = "127.0.0.1:54321",
    pictures: Pictures = None,
    lockstep: Lockstep = False,
    arm: Arm = False,
    by_hand: ByHand = False,
    unattended: Unattended = False,
    as_json: Json = False,
) -> None:
    """Trajectory tracking in the virtual pool (the paper's Table V): horizontal and vertical RMSE, 3-D P95 [m].

    With --robot the published protocol on a vehicle, guided on the screen, marked as hardware.

    Example: finssim experiment t2 --rows calibrated-dr,pid --trajectories lemniscate --seeds 1 --out t2
    """
    from finssim.experiments.transfer import run
    from finssim.experiments.transfer_tables import T2

    options = _options(
        rows, trajectories, plants=plants, seeds=seeds, seed=seed, severity=severity, camera=camera
    )
    options["robot"] = _robot(
        robot, options, bind=bind, pictures=pictures, lockstep=lockstep, pool_file=pool_file, site=site, arm=arm,
        by_hand=by_hand, unattended=unattended,
    )  # fmt: skip
    run(T2, out=out, vehicle=vehicle, steps=steps, processes=processes, as_json=as_json, **options)


def ablation(
    out: Out,
    plants: Plants = 3,
    seeds: Seeds = 3,
    seed: Seed = 1,
    severity: Severity = "realistic",
    camera: Camera = "corners",
    vehicle: Vehicle = "finsrov",
    steps: Steps = None,
    processes: Processes = None,
    as_json: Json = False,
) -> None:
    """What each module is worth: differences of paired trials with intervals, and a sentence that they support.

    Example: finssim experiment ablation --seeds 3 --out ablation
    """
    from finssim.experiments.ablation import ablation as work
    from finssim.experiments.ablation import print_ablation
    from finssim.experiments.campaign import run_experiment

    run_experiment(
        "experiment ablation", work, print_ablation, out=out,
        plants=plants, seeds=seeds, seed=seed, severity=severity, camera=camera, vehicle=vehicle,
        steps=steps, processes=processes, as_json=as_json,
    )  # fmt: skip


def open_water(
    out: Annotated[Path, typer.Option(help="Directory for the result.", metavar="DIR")],
    vehicle: Vehicle = "bluerov2_heavy",
    minutes: Annotated[float, typer.Option(help="Of each way [min].", min=0.1)] = 10.0,
    speed: Annotated[float, typer.Option(help="[m/s]", min=0.01)] = 0.3,
    way: Annotated[str, typer.Option(help="line or square (of 10 m).", metavar="WORD")] = "line",
    positioning: Annotated[
        str, typer.Option(help="Fixes: none, motion-capture or usbl.", metavar="NAME")
    ] = "none",
    seeds: Annotated[int, typer.Option(help="Ways, each with its own water and noise.", min=1, max=1000)] = 3,
    seed: Seed = 1,
    severity: Severity = "realistic",
    as_json: Json = False,
) -> None:
    """Drift of Doppler log, depth, IMU and compass in open water [m], and whether the estimator's ellipse holds it.

    Example: finssim experiment open-water --seeds 1 --out drift
    """
    from finssim.experiments.campaign import run_experiment
    from finssim.experiments.open_water import open_water as work
    from finssim.experiments.open_water import print_open_water

    run_experiment(
        "experiment open-water", work, print_open_water, out=out,
        vehicle=vehicle, minutes=minutes, speed=speed, shape=way, positioning=positioning, seeds=seeds,
        seed=seed, severity=severity, as_json=as_json,
    )  # fmt: skip


def everything(
    out: Out,
    plants: Plants = 3,
    seeds: Seeds = 3,
    seed: Seed = 1,
    severity: Severity = "realistic",
    camera: Camera = "corners",
    steps: Steps = None,
    processes: Processes = None,
    as_json: Json = False,
) -> None:
    """Run localization, replay, t1, t2 and ablation, and write one report with the paper's figures beside ours.

    Example: finssim experiment all --seeds 1 --plants 1 --out everything
    """
    from finssim.experiments.ablation import everything as work
    from finssim.experiments.ablation import print_everything
    from finssim.experiments.campaign import run_experiment

    run_experiment(
        "experiment all", work, print_everything, out=out,
        plants=plants, seeds=seeds, seed=seed, severity=severity, camera=camera, steps=steps,
        processes=processes, as_json=as_json,
    )  # fmt: skip


def faults(
    out: Out,
    seeds: Annotated[
        int, typer.Option(help="Virtual pools, each with its own vehicle, water and noise.", min=1, max=1000)
    ] = 1,
    seed: Seed = 1,
    scenarios: Annotated[
        str | None, typer.Option(help="Faults, separated by commas; all if not given.", metavar="NAMES")
    ] = None,
    severity: Severity = "realistic",
    vehicle: Vehicle = "finsrov",
    processes: Processes = None,
    as_json: Json = False,
) -> None:
    """Break one thing after another while a vehicle drives: time until thrust is gone [s], place in the workspace [m].

    Exit status 3: a fault did what it must not.

    Example: finssim experiment faults --scenarios link-cut,blind-3 --out faults
    """
    from finssim.experiments.campaign import run_experiment
    from finssim.experiments.faults import faults_experiment, print_faults

    chosen = None if scenarios is None else tuple(scenarios.split(","))
    result = run_experiment(
        "experiment faults", faults_experiment, print_faults, out=out,
        seeds=seeds, seed=seed, scenarios=chosen, severity=severity, vehicle=vehicle,
        processes=processes, as_json=as_json,
    )  # fmt: skip
    if not result["ok"]:
        raise typer.Exit(3)


def soak(
    out: Annotated[Path, typer.Option(help="Directory for the result and the samples.", metavar="DIR")],
    hours: Annotated[float, typer.Option(help="Vehicle time to keep a station [h].", min=0.001)] = 20.0,
    seed: Seed = 1,
    severity: Severity = "realistic",
    vehicle: Vehicle = "finsrov",
    as_json: Json = False,
) -> None:
    """Keep a station for hours in lock-step and watch the memory [MiB]. Ctrl-C ends it with what is known until then.

    Exit status 3: the memory grew, or the bridge stopped the vehicle.

    Example: finssim experiment soak --hours 20 --out soak
    """
    from finssim.experiments.campaign import run_experiment
    from finssim.experiments.soak import print_soak
    from finssim.experiments.soak import soak as work

    result = run_experiment(
        "experiment soak", work, print_soak, out=out, hours=hours, seed=seed, severity=severity, vehicle=vehicle,
        as_json=as_json,
    )  # fmt: skip
    if result["verdict"] == "grows" or result["faults"]:
        raise typer.Exit(3)


def timing(
    out: Annotated[Path, typer.Option(help="Directory for the result.", metavar="DIR")],
    minutes: Annotated[float, typer.Option(help="Of the run in real time [min].", min=0.05)] = 10.0,
    camera: Camera = "pictures",
    policy: Annotated[
        str, typer.Option(help="A policy's directory, or pid, or pid-paper.", metavar="DIR|pid|pid-paper")
    ] = "pid",
    seed: Seed = 1,
    vehicle: Vehicle = "finsrov",
    as_json: Json = False,
) -> None:
    """Time the robot beside its pool on this machine: decisions missed, picture to command [ms], lock-step speed.

    Example: finssim experiment timing --minutes 10 --out timing
    """
    from finssim.experiments.campaign import run_experiment
    from finssim.experiments.timing import print_timing
    from finssim.experiments.timing import timing as work

    run_experiment(
        "experiment timing", work, print_timing, out=out, minutes=minutes, camera=camera, policy=policy, seed=seed,
        vehicle=vehicle, as_json=as_json,
    )  # fmt: skip


def stack(
    task: Annotated[str, typer.Argument(help="Task, or FILE.py:CLASS of one's own.", metavar="TASK")],
    policy: Annotated[
        str, typer.Option(help="A policy's directory, or a baseline of the task.", metavar="DIR|NAME")
    ],
    episodes: Annotated[int, typer.Option(help="How many.", min=1, max=10000)] = 20,
    vehicle: Vehicle = "finsrov",
    plant: Annotated[int, typer.Option(help="Seed of every vehicle's plant.", min=0)] = 0,
    severity: Severity = "nominal",
    seed: Seed = 1,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Directory that keeps every episode; one that was interrupted goes on.", metavar="DIR"
        ),
    ] = None,
    records: Annotated[
        bool,
        typer.Option(
            "--records", help="Keep in --out what every agent recorded (.mcap), and its truth (.truth)."
        ),
    ] = False,
    as_json: Json = False,
) -> None:
    """Play any task through the deployed software, all its vehicles in lock-step; print it beside the batch.

    Every vehicle has its plant, motor controller, bridge and pilot; robots tell each other where they are, and the task
    itself scores what is true. In the pool the overhead camera locates vehicles, in open water motion capture does.

    Example: finssim experiment stack team-pursuit --policy runs/team --episodes 20 --out runs/team-stack
    """
    if records and out is None:
        raise typer.BadParameter("--records are kept in a directory: give --out")
    from finssim.quiet import start_warp

    start_warp()
    from finssim.experiments.stack import play

    play(
        task,
        policy,
        vehicle=vehicle,
        episodes=episodes,
        plant=plant,
        severity=severity,  # type: ignore[arg-type]
        seed=seed,
        out=out,
        records=records,
        as_json=as_json,
        show=lambda line: typer.echo(line, err=True),
    )
