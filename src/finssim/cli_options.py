"""Options that several commands take, each with its meaning and unit."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

__all__ = [
    "Arm",
    "Bind",
    "ByHand",
    "Device",
    "Hydrodynamics",
    "Json",
    "Lockstep",
    "Pictures",
    "PixelStd",
    "Pool",
    "Robot",
    "RobotPool",
    "RobotSite",
    "Seed",
    "Steps",
    "Unattended",
    "Vehicle",
]

Vehicle = Annotated[
    str, typer.Option(help="Vehicle of the catalogue, or the path of a vehicle file.", metavar="NAME|FILE")
]
Hydrodynamics = Annotated[
    str, typer.Option(help="Hydrodynamic model: calibrated, simplified or mesh.", metavar="MODEL")
]
Seed = Annotated[
    int,
    typer.Option(help="Seed of every random number; equal seeds give equal results.", min=0, max=2**31 - 1),
]
Steps = Annotated[
    int | None,
    typer.Option(
        help="Control steps to learn from, all worlds together; what the task needs if not given.", min=1
    ),
]
Device = Annotated[str, typer.Option(help="Where to compute: cpu or cuda.", metavar="DEVICE")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object instead of tables.")]
Pool = Annotated[
    Path, typer.Option(help="Pool file: camera, water plane and frames (.yaml).", metavar="FILE")
]
PixelStd = Annotated[
    float | None,
    typer.Option(
        help="Error of a detected corner, per axis [px]; what the pool's calibration found, else 0.5, if not given."
    ),
]
Robot = Annotated[
    str | None,
    typer.Option(
        help="Robot on which it is done: its motor controller's udp://HOST:PORT or serial:DEVICE, or pool for the "
        "virtual pool on this machine. With --lockstep: pool, or HOST:PORT.",
        metavar="ADDRESS",
    ),
]
RobotPool = Annotated[
    Path | None,
    typer.Option(
        help="Of that robot: camera, water plane and frames (.yaml); none where no camera looks and position fixes "
        "come by wire.",
        metavar="FILE|none",
    ),
]
RobotSite = Annotated[
    str | None,
    typer.Option(
        help="Where that robot is: pool, tank or open-water, by which it is equipped. If not given: pool.",
        metavar="NAME",
    ),
]
Bind = Annotated[
    str,
    typer.Option(
        help="Address and port of this end, for udp; pictures come to the port after it. Loopback unless given.",
        metavar="ADDRESS:PORT",
    ),
]
Pictures = Annotated[
    str | None,
    typer.Option(
        help="Overhead camera: udp://HOST:PORT, shm:NAME or none; the virtual pool's with --robot pool, "
        "otherwise none, if not given.",
        metavar="ADDRESS",
    ),
]
Lockstep = Annotated[
    bool,
    typer.Option("--lockstep", help="Take turns with finssim pool --lockstep, as fast as both compute."),
]
Arm = Annotated[
    bool,
    typer.Option(
        "--arm", help="Let thrusters turn, as soon as the state is known. Without it they never do."
    ),
]
ByHand = Annotated[
    bool,
    typer.Option(
        "--by-hand",
        help="Somebody carries the vehicle to where each trial starts; the tuned PID steers it there if not given.",
    ),
]
Unattended = Annotated[
    bool,
    typer.Option(
        "--unattended",
        help="Nobody presses enter before each trial; a fault ends the session, and nothing is armed after it.",
    ),
]
Observe = Annotated[
    str,
    typer.Option(
        help="What is seen: training (the task's noise), sensors (the vehicle's own and position fixes, "
        "through a filter), a file of other fixes, estimator (about what localization is off by) or truth.",
        metavar="FILE|NAME",
    ),
]
