"""`finssim view`: the virtual pool, the simulator or a record in the browser."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from finssim.cli_options import Hydrodynamics, Seed

__all__ = ["view"]


def view(
    source: Annotated[
        str,
        typer.Argument(
            help="What to look at: pool (the virtual pool with a robot in it), sim (the simulator), a record (.mcap), "
            "or a folder that the engine's recorder wrote.",
            metavar="pool|sim|FILE|FOLDER",
        ),
    ] = "pool",
    vehicle: Annotated[
        str | None,
        typer.Option(
            help="Vehicle of the catalogue, or the path of a vehicle file; finsrov, or that of the record, if not "
            "given.",
            metavar="NAME|FILE",
        ),
    ] = None,
    policy: Annotated[
        str,
        typer.Option(
            help="Who steers in pool and sim: a policy's directory, or pid, or pid-paper.",
            metavar="DIR|pid|pid-paper",
        ),
    ] = "pid",
    task: Annotated[
        str | None,
        typer.Option(
            help="Task that the policy must have been trained for: t1 or t2; t2 also follows a trajectory if none is "
            "named.",
            metavar="TASK",
        ),
    ] = None,
    goal: Annotated[
        str | None,
        typer.Option(
            help="Station to keep in pool and sim: x,y,z [m] in the world frame and heading [deg], or a file.",
            metavar="X,Y,Z,YAW|FILE",
        ),
    ] = None,
    trajectory: Annotated[
        str | None,
        typer.Option(help="Trajectory to follow in place of a goal: a name or a file.", metavar="NAME|FILE"),
    ] = None,
    plant: Annotated[
        str,
        typer.Option(help="Plant in the pool: a seed to draw it from, or a plant file.", metavar="SEED|FILE"),
    ] = "1",
    severity: Annotated[
        str,
        typer.Option(help="How hard a drawn plant is: nominal, realistic or hard.", metavar="NAME"),
    ] = "realistic",
    camera: Annotated[
        str,
        typer.Option(
            help="What the pool's camera sends: pictures, or corners (of the tags).", metavar="KIND"
        ),
    ] = "corners",
    hydrodynamics: Hydrodynamics = "calibrated",
    truth: Annotated[
        Path | None,
        typer.Option(
            help="Truth file of the pool that a record was made in, to show beside it.", metavar="FILE"
        ),
    ] = None,
    truth_offset: Annotated[
        float | None,
        typer.Option(
            help="Robot's clock when the pool's showed 0 [s]; found by comparing both motions if not given."
        ),
    ] = None,
    basin: Annotated[
        str | None,
        typer.Option(
            help="Pool to draw around a record: length,width,depth [m]; the vehicle's workspace if not given.",
            metavar="L,W,D",
        ),
    ] = None,
    world: Annotated[
        int | None, typer.Option(help="World of a folder's run; the first that it has if not given.", min=0)
    ] = None,
    speed: Annotated[float, typer.Option(help="Times as fast as real.", min=0.01, max=100.0)] = 1.0,
    port: Annotated[
        int, typer.Option(help="Port of the page; the next free one if it is taken.", min=1, max=65535)
    ] = 8080,
    bind: Annotated[
        str, typer.Option(help="Address to serve at: this machine alone unless given.", metavar="ADDRESS")
    ] = "127.0.0.1",
    no_browser: Annotated[
        bool, typer.Option("--no-browser", help="Print the page's address, and do not open it.")
    ] = False,
    duration: Annotated[
        float | None,
        typer.Option(help="When to end [s] after the page is up; with Ctrl-C if not given.", min=0.0),
    ] = None,
    seed: Seed = 0,
) -> None:
    """Look at a vehicle in the browser, live or recorded: poses, goal, forces, camera, health, errors [m, deg].

    Example: finssim view run.mcap --truth truth.fst --basin 4,2,1

    Example: finssim view pool --policy pid --trajectory ellipse --severity hard --camera pictures
    """
    from finssim.quiet import start_warp

    start_warp()
    from finssim.viewer.run import Choice, run

    run(
        Choice(
            source=source,
            vehicle=vehicle,
            policy=policy,
            task=task,
            goal=goal,
            trajectory=trajectory,
            plant=plant,
            severity=severity,
            camera=camera,
            hydrodynamics=hydrodynamics,
            truth=truth,
            truth_offset=truth_offset,
            basin=basin,
            world=world,
            seed=seed,
        ),
        speed=speed,
        port=port,
        bind=bind,
        browser=not no_browser,
        duration=duration,
    )
