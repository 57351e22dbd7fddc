"""`finssim record`, `play`, `teleop`: what a run left behind, and a person at the controls."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from finssim.cli_options import Json, Vehicle

__all__ = ["play", "record_app", "teleop"]

record_app = typer.Typer(rich_markup_mode=None, add_completion=False, invoke_without_command=True)


@record_app.callback()
def _record(context: typer.Context) -> None:
    """Look at records of runs, and mend those that were cut off.

    Example: finssim record info run.mcap
    """
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


File = Annotated[Path, typer.Argument(help="Record of a run (.mcap).", metavar="FILE")]


@record_app.command()
def info(file: File, as_json: Json = False) -> None:
    """Tell what a record holds: vehicle, duration [s], topics with rates [Hz] and gaps [s], events, damage.

    Example: finssim record info run.mcap
    """
    from finssim.robot.record_show import info as run

    run(file, as_json=as_json)


@record_app.command()
def repair(
    file: File,
    out: Annotated[
        Path | None,
        typer.Option(help="File to write; FILE-repaired.mcap if not given.", metavar="FILE"),
    ] = None,
) -> None:
    """Write a whole record of all that can be read of a cut or damaged one; FILE itself stays as it is.

    Example: finssim record repair run.mcap --out whole.mcap
    """
    from finssim.robot.record_repair import repair_record

    target = out or file.with_name(f"{file.stem}-repaired.mcap")
    for note in repair_record(file, target) or ["nothing is damaged"]:
        typer.echo(note)
    typer.echo(f"wrote {target}")


def play(
    file: File,
    speed: Annotated[
        float, typer.Option(help="Times as fast as it was recorded.", metavar="FACTOR", show_default="1")
    ] = 1.0,
    fast: Annotated[bool, typer.Option("--fast", help="Without waiting.")] = False,
    topics: Annotated[
        str | None,
        typer.Option(help="Only these, with commas between: odom,thruster_cmd.", metavar="NAMES"),
    ] = None,
    start: Annotated[
        float, typer.Option(help="Begin so long after the start of the record [s].", min=0.0)
    ] = 0.0,
    as_json: Json = False,
) -> None:
    """Print the messages of a record as they came, a line each [s, SI units]; pictures by their size.

    Example: finssim play run.mcap --topics odom,events --speed 4
    """
    from finssim.robot.record_show import play_record

    chosen = [name.strip() for name in topics.split(",")] if topics else None
    play_record(file, speed=float("inf") if fast else speed, topics=chosen, start=start, as_json=as_json)


def teleop(
    vehicle: Vehicle = "finsrov",
    device: Annotated[
        str, typer.Option(help="What is in the hands: gamepad or keyboard.", metavar="NAME")
    ] = "gamepad",
    robot: Annotated[
        str,
        typer.Option(
            help="Wire to the motor controller: udp://HOST:PORT, serial:DEVICE, dry-run, or pool "
            "(the virtual pool on this machine).",
            metavar="WIRE",
        ),
    ] = "pool",
    bind: Annotated[
        str, typer.Option(help="This end of the wire, for UDP.", metavar="ADDRESS:PORT")
    ] = "127.0.0.1:54321",
    pool_file: Annotated[
        Path | None,
        typer.Option(
            help="Pool file: camera, water plane and frames (.yaml); without it nobody knows the position.",
            metavar="FILE",
        ),
    ] = None,
    pictures: Annotated[
        str | None,
        typer.Option(
            help="Overhead camera: udp://HOST:PORT, shm:NAME or none; the virtual pool's with --robot pool, "
            "otherwise none, if not given. Needs --pool-file.",
            metavar="ADDRESS",
        ),
    ] = None,
    policy: Annotated[
        str | None,
        typer.Option(
            help="Whom SELECT or m hands over to: pid, or a policy's directory. Needs --pool-file and --goal.",
            metavar="DIR|pid",
        ),
    ] = None,
    goal: Annotated[
        str | None,
        typer.Option(help="Where the policy steers to, in m and deg.", metavar="X,Y,Z,YAW"),
    ] = None,
    record: Annotated[
        Path | None, typer.Option(help="Record of the run to write (.mcap).", metavar="FILE")
    ] = None,
    key_hold: Annotated[
        float, typer.Option(help="A key counts as held so long after its last press [s].", metavar="S")
    ] = 0.6,
    rate: Annotated[float, typer.Option(help="Turns of the loop a second [Hz].", min=20.0, max=200.0)] = 60.0,
    duration: Annotated[
        float | None, typer.Option(help="End after so long [s]; with Ctrl-C if not given.", min=0.0)
    ] = None,
) -> None:
    """Drive by hand. Starts disarmed; START or enter arms; without a hand on LB or the keys there is no thrust.

    Example: finssim teleop --device keyboard --robot pool --record drive.mcap
    """
    from finssim.quiet import start_warp

    start_warp()
    from finssim.robot.teleop_run import run

    run(
        vehicle,
        device=device,
        robot=robot,
        bind=bind,
        pool_file=pool_file,
        pictures=pictures,
        policy=policy,
        goal=goal,
        record=record,
        key_hold=key_hold,
        rate=rate,
        duration=duration,
    )
