"""`finssim compare` and `finssim sweep`: many trainings."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from finssim.cli_options import Json, Seed, Vehicle
from finssim.quiet import start_warp

__all__ = ["compare", "sweep"]


def compare(
    runs: Annotated[
        list[str],
        typer.Argument(
            help="Policy directories, each DIR or NAME=DIR; those of one name differ in the seed alone.",
            metavar="RUN...",
        ),
    ],
    out: Annotated[Path, typer.Option(help="Directory for table, figure and evaluations.", metavar="DIR")],
    measure: Annotated[
        list[str] | None,
        typer.Option(
            help="What to compare; the task's own measures if not given. May be given several times."
        ),
    ] = None,
    vehicle: Vehicle = "finsrov",
    plant: Annotated[
        str, typer.Option(help="What differs from the vehicle file, as for evaluate.", metavar="FILE|NAME")
    ] = "nominal",
    trials: Annotated[
        int | None, typer.Option(help="Trials of each run; as many as evaluate makes if not given.", min=1)
    ] = None,
    seed: Seed = 42,
    as_json: Json = False,
) -> None:
    """Compare trainings over seeds: interquartile means with intervals, who is likely better, learning curves.

    Example: finssim compare runs/hold-seed1 runs/hold-seed2 runs/hold-seed3 sac=runs/sac-1 --out compared
    """
    start_warp()
    from finssim.experiments.campaign import run_experiment
    from finssim.experiments.compare import compare as work
    from finssim.experiments.compare import print_comparison

    run_experiment(
        "comparing", work, print_comparison, runs=runs, out=out,
        vehicle=vehicle, plant=plant, trials=trials, measures=measure or (), seed=seed,
        as_json=as_json,
    )  # fmt: skip


def sweep(
    file: Annotated[
        Path, typer.Argument(help="What to train: task, seeds, settings (.yaml).", metavar="FILE")
    ],
    out: Annotated[
        Path, typer.Option(help="Directory of the runs; those that it has are kept.", metavar="DIR")
    ],
    address: Annotated[
        str | None,
        typer.Option(
            help="Of a Ray cluster to join, HOST:PORT or auto; this machine alone if not given.",
            metavar="ADDRESS",
        ),
    ] = None,
    processes: Annotated[
        int | None,
        typer.Option(help="Trainings at once on this machine; one a processor if not given.", min=1),
    ] = None,
    as_json: Json = False,
) -> None:
    """Train every setting with every seed on one machine or many, and evaluate each policy; goes on where it was.

    Exit status 3: a training failed, which the table tells.

    Example: finssim sweep sweep.yaml --out swept
    """
    from finssim.experiments.sweep import sweep as run

    if not run(file, out=out, address=address, processes=processes, as_json=as_json)["ok"]:
        raise typer.Exit(3)
