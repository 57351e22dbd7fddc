"""`finssim trials` and `finssim excite`: logs of trials, and how to make good ones."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from finssim.cli_options import (
    Arm,
    Bind,
    ByHand,
    Hydrodynamics,
    Json,
    Lockstep,
    Pictures,
    Robot,
    RobotPool,
    RobotSite,
    Seed,
    Unattended,
    Vehicle,
)
from finssim.cli_robot import robot_or_none
from finssim.quiet import start_warp

__all__ = ["excite", "trials_app"]

trials_app = typer.Typer(rich_markup_mode=None, add_completion=False, invoke_without_command=True)


@trials_app.callback()
def _trials(context: typer.Context) -> None:
    """Look at logs of trials, and make trials of foreign logs.

    Example: finssim trials check trials
    """
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


@trials_app.command()
def check(
    paths: Annotated[
        list[Path],
        typer.Argument(
            help="Trial folders, folders of them, or bare .csv or .parquet tables.", metavar="TRIAL"
        ),
    ],
    vehicle: Annotated[
        str | None,
        typer.Option(help="Vehicle that made them, where their headers name none.", metavar="NAME|FILE"),
    ] = None,
    as_json: Json = False,
) -> None:
    """Say what trials can and cannot identify: rates [Hz], gaps [s], clock jumps, saturation, excitation.

    Example: finssim trials check trials --vehicle bluerov2
    """
    from finssim.calibration.check.check import check as run

    run(paths, vehicle=vehicle, as_json=as_json)


@trials_app.command("import")
def _import(
    logs: Annotated[
        list[Path],
        typer.Argument(
            help="Tables (.csv, .parquet), ArduSub logs (.BIN, .tlog), ROS 2 bags (.mcap, .db3, folder).",
            metavar="LOG",
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder in which the trial folders are made.", metavar="DIR")],
    column_map: Annotated[
        Path | None,
        typer.Option(
            "--map",
            help="Map of the log's columns or topics, with units and frames (.yaml).",
            metavar="FILE",
        ),
    ] = None,
    format: Annotated[
        str, typer.Option(help="auto (by suffix), csv, ardupilot or rosbag.", metavar="FORMAT")
    ] = "auto",
    vehicle: Annotated[
        str | None, typer.Option(help="Vehicle that made the logs.", metavar="NAME|FILE")
    ] = None,
    split: Annotated[
        str | None,
        typer.Option(
            help="Several trials of one log: by phase, gaps, gaps=SECONDS, arming or column.", metavar="RULE"
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Make trial folders of logs, in SI units and the body frame x forward, y left, z up.

    Example: finssim trials import dive.BIN --vehicle bluerov2 --split arming --out trials
    """
    from finssim.calibration.importers.dispatch import import_trials

    def say(note: str) -> None:
        typer.echo(note, err=True)

    folders = import_trials(
        logs,
        out=out,
        column_map=column_map,
        format=format,  # type: ignore[arg-type]
        vehicle=vehicle,
        split=split,
        say=say,
    )
    _print_folders(folders, as_json)


def excite(
    axes: Annotated[
        str,
        typer.Argument(
            help="all, or of surge,sway,heave,roll,pitch,yaw separated by commas.", metavar="AXES"
        ),
    ],
    vehicle: Vehicle,
    out: Annotated[Path, typer.Option(help="Directory of the programmes or trials.", metavar="DIR")],
    kind: Annotated[
        str,
        typer.Option(
            help="published (steps, dive-and-coast, pulses), validation, or multisine.", metavar="KIND"
        ),
    ] = "published",
    levels: Annotated[
        list[str] | None,
        typer.Option(
            help='Magnitudes [N, N m]: "5,10" for every axis or "surge=5,10"; may be given several times.',
            metavar="LEVELS",
        ),
    ] = None,
    repeats: Annotated[int, typer.Option(help="How often every programme comes.", min=1, max=100)] = 1,
    simulate: Annotated[
        bool, typer.Option("--simulate", help="Run them in the simulator and write the trials they make.")
    ] = False,
    pool: Annotated[
        int | None,
        typer.Option(
            help="Seed of a virtual pool: the robot's whole software plays them there, records, and makes trials.",
            min=0,
            metavar="SEED",
        ),
    ] = None,
    severity: Annotated[
        str | None,
        typer.Option(
            help="Of that pool: nominal, realistic or hard; realistic if not given.", metavar="NAME"
        ),
    ] = None,
    pool_vehicle: Annotated[
        str | None,
        typer.Option(
            help="Vehicle around which that pool's own is drawn; the robot's if not given.",
            metavar="NAME|FILE",
        ),
    ] = None,
    robot: Robot = None,
    pool_file: RobotPool = None,
    site: RobotSite = None,
    bind: Bind = "127.0.0.1:54321",
    pictures: Pictures = None,
    lockstep: Lockstep = False,
    arm: Arm = False,
    by_hand: ByHand = False,
    unattended: Unattended = False,
    hydrodynamics: Hydrodynamics = "calibrated",
    noise: Annotated[
        str, typer.Option(help="Noise of simulated trials: sensors, published or none.", metavar="NAME")
    ] = "sensors",
    inputs: Annotated[
        str,
        typer.Option(
            help="Inputs that simulated trials log, of wrench,rpm,force,pwm,command.", metavar="NAMES"
        ),
    ] = "rpm,wrench",
    rate: Annotated[float, typer.Option(help="Rows of a simulated trial per second [Hz].")] = 50.0,
    coast: Annotated[float, typer.Option(help="Longest coast after a dive [s].")] = 30.0,
    duration: Annotated[float, typer.Option(help="Of a multi-sine [s].")] = 60.0,
    room: Annotated[
        float | None,
        typer.Option(help="Longest way along a linear axis [m]: lowers the levels to fit a pool."),
    ] = None,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Write excitation programmes (wrench [N, N m] and thrust [N] at 50 Hz) for a robot, or run them in a simulation.

    Example: finssim excite surge,yaw --vehicle finsrov --pool 1 --out trials

    Example: finssim excite all --vehicle finsrov --robot udp://10.0.0.2:58766 --pool-file pool.yaml --arm --out trials
    """
    wanted = _levels(levels)
    start_warp()
    plan = {"kind": kind, "levels": wanted, "repeats": repeats, "coast": coast, "duration": duration}
    if robot is not None and (
        simulate or pool is not None or severity is not None or pool_vehicle is not None
    ):
        raise typer.BadParameter(
            "--robot is where it is done: leave --simulate, --pool and what tells of it out"
        )
    where = robot_or_none(
        robot, bind=bind, pictures=pictures, lockstep=lockstep, pool_file=pool_file, site=site, arm=arm,
        by_hand=by_hand, unattended=unattended,
    )  # fmt: skip
    if where is not None:
        from finssim.experiments.excitation import excite_on_robot

        made = excite_on_robot(axes, vehicle=vehicle, out=out, robot=where, seed=seed, room=room, **plan)
        _print_folders(made, as_json)
        return
    if pool is not None:
        if simulate or room is not None:
            raise typer.BadParameter(
                "--pool goes with neither --simulate nor --room: a pool has its own room"
            )
        from finssim.experiments.excitation import excite_in_pool

        made = excite_in_pool(
            axes,
            vehicle=vehicle,
            out=out,
            plant=pool,
            pool_vehicle=pool_vehicle,
            severity=severity or "realistic",
            seed=seed,
            **plan,
        )
        _print_folders(made, as_json)
        return
    if severity is not None or pool_vehicle is not None:
        raise typer.BadParameter(
            "--severity and --pool-vehicle tell of a virtual pool: name one with --pool SEED"
        )
    from finssim.calibration.excitation.excite import excite as run

    folders = run(
        axes,
        vehicle=vehicle,
        out=out,
        simulate=simulate,
        rate=rate,
        noise=noise,
        seed=seed,
        room=room,
        hydrodynamics=hydrodynamics,
        inputs=tuple(word.strip() for word in inputs.split(",")),
        **plan,
    )
    _print_folders(folders, as_json)


def _levels(words: list[str] | None) -> dict[str, list[float]] | list[float] | None:
    """Levels by axis from `surge=5,10`, or for every axis from `5,10`."""
    if not words:
        return None
    named: dict[str, list[float]] = {}
    common: list[float] = []
    for word in words:
        axis, sign, numbers = word.rpartition("=")
        try:
            values = [float(number) for number in numbers.split(",")]
        except ValueError:
            values = [math.nan]
        if not all(math.isfinite(value) for value in values):
            raise typer.BadParameter(f"levels are '{word}', expected numbers such as 5,10 or surge=5,10")
        if sign:
            named.setdefault(axis.strip(), []).extend(values)
        else:
            common.extend(values)
    if named and common:
        raise typer.BadParameter("levels are given for every axis and for single ones: give one of the two")
    return named or common


def _print_folders(folders: list[Path], as_json: bool) -> None:
    if as_json:
        import json

        typer.echo(json.dumps({"trials": [str(folder) for folder in folders]}))
    else:
        for folder in folders:
            typer.echo(str(folder))
