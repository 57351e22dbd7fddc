"""Options that several commands take, each with its meaning and unit."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

__all__ = ["Device", "Hydrodynamics", "Json", "PixelStd", "Pool", "Seed", "Steps", "Vehicle"]

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
