"""`finssim ros2`: the robot, the virtual pool or a simulated vehicle as ROS 2 nodes, with or without ROS installed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from finssim.cli_options import Seed, Vehicle

__all__ = ["ros2_app"]

ros2_app = typer.Typer(rich_markup_mode=None, add_completion=False, invoke_without_command=True)


@ros2_app.callback()
def _ros2(context: typer.Context) -> None:
    """Be ROS 2 nodes on this machine's ROS domain; those of a sourced ROS 2 see them and are seen.

    Example: finssim ros2 up pool
    """
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


@ros2_app.command(context_settings={"allow_extra_args": True, "ignore_unknown_options": True})
def node(
    context: typer.Context,
    name: Annotated[
        str,
        typer.Argument(
            help="camera, controller, hardware_bridge, localizer, recorder, sim, state_estimation, teleop or "
            "virtual_pool; after it --ros-args as for any ROS 2 node.",
            metavar="NAME",
        ),
    ],
) -> None:
    """Run one node in this process, until Ctrl-C; its parameters come after --ros-args, or from a file there.

    Example: finssim ros2 node state_estimation
    """
    import sys

    from finssim.ros2.graphs import run_node

    sys.argv = [name, *context.args]
    raise typer.Exit(run_node(name))


@ros2_app.command()
def up(
    graph: Annotated[
        str,
        typer.Argument(
            help="sim (a vehicle of the engine), pool (the virtual pool and a robot in it) or robot.",
            metavar="sim|pool|robot",
        ),
    ],
    policy: Annotated[
        str, typer.Option(help="A policy's directory, or pid, or pid-paper.", metavar="DIR|pid|pid-paper")
    ] = "pid",
    task: Annotated[
        str | None,
        typer.Option(help="Task that the policy must have been trained for; its own if not given."),
    ] = None,
    trim: Annotated[
        bool,
        typer.Option(
            "--trim", help="Put an integral in front of a policy, against a steady current or weight."
        ),
    ] = False,
    vehicle: Vehicle = "finsrov",
    namespace: Annotated[
        str | None,
        typer.Option(
            help="What the vehicle's topics stand below and its own frames begin with, such as robot_1: one for each "
            "of several vehicles in a graph. The vehicle's name, and no prefix, if not given.",
            metavar="NAME",
        ),
    ] = None,
    site: Annotated[
        str,
        typer.Option(
            help="Where: pool, tank or open-water, where no camera looks and Doppler log and compass are aboard.",
            metavar="NAME",
        ),
    ] = "pool",
    positioning: Annotated[
        str,
        typer.Option(
            help="Fixes on the wire of a virtual pool: none, motion-capture or usbl.", metavar="NAME"
        ),
    ] = "none",
    let_in: Annotated[
        str | None,
        typer.Option(
            help="Where the vehicle begins, in the map [m], for dead reckoning by Doppler log and compass, where no "
            "camera and no position fix tells.",
            metavar="X,Y",
        ),
    ] = None,
    goal: Annotated[
        str | None,
        typer.Option(
            help="Station to keep: x,y,z [m] in the map (z = 0 on the water) and heading [deg], or a file; the "
            "place where it is armed if not given. The topic goal changes it.",
            metavar="X,Y,Z,YAW|FILE",
        ),
    ] = None,
    trajectory: Annotated[
        str | None,
        typer.Option(help="Trajectory to follow in place of a goal: a name or a file.", metavar="NAME|FILE"),
    ] = None,
    arm: Annotated[
        bool,
        typer.Option("--arm", help="Arm once, as soon as the state is known; otherwise the topic arm does."),
    ] = False,
    robot: Annotated[
        str,
        typer.Option(
            help="Motor controller of a robot: udp://HOST:PORT, serial:DEVICE, dry-run, or pool for a finssim pool "
            "on this machine.",
            metavar="ADDRESS",
        ),
    ] = "pool",
    bind: Annotated[
        str,
        typer.Option(
            help="Own end for udp; pictures are taken at the port after it.", metavar="ADDRESS:PORT"
        ),
    ] = "127.0.0.1:54321",
    pictures: Annotated[
        str | None,
        typer.Option(
            help="Overhead camera of a robot: udp://HOST:PORT, shm:NAME or none; the pool's with --robot pool.",
            metavar="ADDRESS",
        ),
    ] = None,
    pool_file: Annotated[
        Path | None,
        typer.Option(
            help="Pool file: read by a robot, written by a virtual pool (.yaml); none where no camera looks.",
            metavar="FILE|none",
        ),
    ] = None,
    plant: Annotated[
        str, typer.Option(help="Plant of a virtual pool: a seed, or a file.", metavar="SEED|FILE")
    ] = "1",
    severity: Annotated[
        str, typer.Option(help="Of a drawn plant: nominal, realistic or hard.", metavar="NAME")
    ] = "realistic",
    camera: Annotated[
        str | None,
        typer.Option(
            help="What a virtual pool's camera sends: pictures, corners (of the tags) or none. If not given: pictures, "
            "over a tank corners.",
            metavar="KIND",
        ),
    ] = None,
    port: Annotated[
        int, typer.Option(help="UDP port of a virtual pool; its pictures leave from the next.")
    ] = 58766,
    truth: Annotated[
        Path | None, typer.Option(help="File for what truly happened in a virtual pool.", metavar="FILE")
    ] = None,
    start: Annotated[
        str | None,
        typer.Option(
            help="Where the vehicle starts in sim and pool: x,y,z [m], yaw [deg].", metavar="X,Y,Z,YAW"
        ),
    ] = None,
    hydrodynamics: Annotated[
        str | None, typer.Option(help="Model of sim: calibrated, mesh or simplified.", metavar="MODEL")
    ] = None,
    record: Annotated[
        Path | None, typer.Option(help="Record all topics into this file (.mcap).", metavar="FILE")
    ] = None,
    teleop: Annotated[
        str | None,
        typer.Option(
            help="Also drive by hand: joy (topic), gamepad or keyboard. The bridge then arms without localization.",
            metavar="DEVICE",
        ),
    ] = None,
    duration: Annotated[
        float | None,
        typer.Option(help="End so long after the start [s]; with Ctrl-C if not given.", min=0.0),
    ] = None,
    seed: Seed = 0,
) -> None:
    """Start a graph of nodes as processes, print its topics and what happens, and end it with Ctrl-C.

    Exit status 1: a node died. 3: the bridge ended in a fault.

    Example: finssim ros2 up pool --policy pid --goal 0.5,0,-0.5,90 --arm --duration 60
    """
    chosen = {name: value for name, value in locals().items() if name != "graph"}
    from finssim.quiet import start_warp

    start_warp()
    from finssim.ros2.backend import activate
    from finssim.ros2.up import Options
    from finssim.ros2.up import up as run

    activate()
    status = run(graph, Options(**chosen), typer.echo)
    if status:
        raise typer.Exit(status)
