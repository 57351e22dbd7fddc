"""`finssim pool`: the virtual pool as a process of its own."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from finssim.cli_options import Seed, Vehicle
from finssim.quiet import start_warp

__all__ = ["pool"]


def pool(
    vehicle: Vehicle = "finsrov",
    plant: Annotated[
        str,
        typer.Option(
            help="Plant in the water: a seed to draw it from, or a plant file.", metavar="SEED|FILE"
        ),
    ] = "1",
    severity: Annotated[
        str,
        typer.Option(
            help="How far a drawn plant and its camera are from what is known: nominal, realistic or hard.",
            metavar="NAME",
        ),
    ] = "realistic",
    lockstep: Annotated[
        bool, typer.Option("--lockstep", help="Time goes as fast as one robot asks, instead of in real time.")
    ] = False,
    camera: Annotated[
        str | None,
        typer.Option(
            help="What the camera sends: pictures, corners (of the tags) or none. If not given: pictures, over a team "
            "or a tank corners, in open water and of a task none.",
            metavar="KIND",
        ),
    ] = None,
    pictures: Annotated[
        str,
        typer.Option(
            help="How pictures travel in real time: udp, or shm:NAME (shared memory; shm alone: pool, and pool-PORT "
            "on another port than the default).",
            metavar="WAY",
        ),
    ] = "udp",
    port: Annotated[
        int,
        typer.Option(
            help="UDP port of the motor controller; pictures leave from the next, lock-step (TCP) is the "
            "one after."
        ),
    ] = 58766,
    bind: Annotated[
        str, typer.Option(help="Address of this end: this machine alone unless given.", metavar="ADDRESS")
    ] = "127.0.0.1",
    robot: Annotated[
        str,
        typer.Option(
            help="The only robot that may command in real time; its pictures go to the port after this.",
            metavar="HOST:PORT",
        ),
    ] = "127.0.0.1:54321",
    pool_file: Annotated[
        Path | None,
        typer.Option(
            help="Pool file to write: the camera as its calibration has it (.yaml).", metavar="FILE"
        ),
    ] = None,
    truth: Annotated[
        Path | None,
        typer.Option(
            help="File to write what truly happened into, for scoring; of a team a folder.", metavar="FILE"
        ),
    ] = None,
    start: Annotated[
        str | None,
        typer.Option(
            help="Where the vehicle starts, world frame: x,y,z [m], yaw [deg]; in the middle if not given.",
            metavar="X,Y,Z,YAW",
        ),
    ] = None,
    task: Annotated[
        str | None,
        typer.Option(
            help="The site of a task in open water, in real time, with ports as of --team; messages between the robots "
            "go to the port five after --port. What the task commands is commanded here; the task scores what is true.",
            metavar="TASK",
        ),
    ] = None,
    team: Annotated[
        str | None,
        typer.Option(
            help="Several vehicles in one water, in real time: names or files with commas between, the agents of "
            "--task, or side by side without. Each has a motor controller, at --port, ten ports on, and so on, for a "
            "robot at --robot, ten ports on, and so on. A camera sees them all; each has tags of its own ids.",
            metavar="NAME,NAME",
        ),
    ] = None,
    site: Annotated[
        str,
        typer.Option(help="Where: pool, tank or open-water (current, waves, 20 m of water).", metavar="NAME"),
    ] = "pool",
    positioning: Annotated[
        str,
        typer.Option(help="Fixes on the robot's wire: none, motion-capture or usbl.", metavar="NAME"),
    ] = "none",
    duration: Annotated[
        float | None, typer.Option(help="When to end, pool's clock [s]; never if not given.", min=0.0)
    ] = None,
    seed: Seed = 0,
) -> None:
    """Be the vehicle and its pool for a robot on this machine, until Ctrl-C.

    Example: finssim pool --plant 1 --severity realistic --pool-file pool.yaml --truth truth.fst
    """
    start_warp()
    from finssim.pool.run import run, run_team

    if task is not None or team is not None:
        files = task is not None and (pool_file is not None or truth is not None)
        if not plant.isdecimal() or lockstep or start is not None or files:
            raise typer.BadParameter(
                "--team and --task draw their plants, their time is real and their starts are their own: give a seed "
                "for --plant, leave --lockstep and --start out, and of a task --pool-file and --truth"
            )
        names = [name.strip() for name in team.split(",")] if team is not None else [vehicle]
        blind = task is not None or site == "open-water"
        run_team(
            names,
            task=task,
            plant=int(plant),
            severity=severity,  # type: ignore[arg-type]
            camera=camera or ("none" if blind else "corners"),  # type: ignore[arg-type]
            site=site,
            positioning=positioning,
            pool_file=pool_file,
            truth=truth,
            port=port,
            bind=bind,
            robot=robot,
            duration=duration,
            seed=seed,
        )
        return
    run(
        vehicle,
        plant=plant,
        severity=severity,  # type: ignore[arg-type]
        lockstep=lockstep,
        camera=camera or {"pool": "pictures", "tank": "corners"}.get(site, "none"),  # type: ignore[arg-type]
        pictures=pictures,
        port=port,
        bind=bind,
        robot=robot,
        pool_file=pool_file,
        truth=truth,
        start=start,
        duration=duration,
        seed=seed,
        site=site,
        positioning=positioning,
    )
