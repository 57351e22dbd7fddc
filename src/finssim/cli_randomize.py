"""`finssim randomize`: what ranges mean, and ranges from a calibration's covariance."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from finssim.cli_options import Hydrodynamics, Json, Seed, Vehicle
from finssim.quiet import start_warp

__all__ = ["randomize_app"]

randomize_app = typer.Typer(rich_markup_mode=None, add_completion=False, invoke_without_command=True)


@randomize_app.callback()
def _randomize(context: typer.Context) -> None:
    """Ranges that vehicle, water and sensors are drawn from in every episode of a training.

    Example: finssim randomize show --help
    """
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


@randomize_app.command()
def show(
    ranges: Annotated[
        str,
        typer.Argument(
            help="Ranges: a file, or hold_for_position, fossen_learn_to_swim, equivalent_box, pool, "
            "no_thruster_dynamics.",
            metavar="FILE",
        ),
    ],
    vehicle: Vehicle,
    out: Annotated[Path, typer.Option(help="Directory for spread.png, entries.csv and show.json.")],
    hydrodynamics: Hydrodynamics = "calibrated",
    samples: Annotated[int, typer.Option(help="Vehicles to draw.", min=2, max=100_000)] = 200,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Tell what ranges mean for a vehicle: its numbers in SI, and how far its step responses spread.

    Example: finssim randomize show pool --vehicle finsrov --out ranges/pool
    """
    start_warp()
    from finssim.experiments.randomize_show import randomize_show as run

    run(
        ranges,
        vehicle=vehicle,
        out=out,
        hydrodynamics=hydrodynamics,
        samples=samples,
        seed=seed,
        as_json=as_json,
    )


@randomize_app.command()
def fit(
    report: Annotated[Path, typer.Argument(help="fit.json of a calibration's report.", metavar="FIT")],
    vehicle: Vehicle,
    out: Annotated[Path, typer.Option(help="Ranges file to write (.yaml).", metavar="FILE")],
) -> None:
    """Write ranges with the standard errors of a calibration, correlated as its errors are.

    Example: finssim randomize fit report/fit.json --vehicle mine.yaml --out mine-ranges.yaml
    """
    start_warp()
    from finssim.calibration.output.correlated_ranges import write_correlated_ranges
    from finssim.vehicles import load_vehicle

    write_correlated_ranges(report, load_vehicle(vehicle), out)
    typer.echo(f"written: {out}")
