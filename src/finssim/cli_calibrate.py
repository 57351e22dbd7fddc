"""`finssim calibrate`, `finssim replay` and `finssim experiment`: from trials to a vehicle, and how good it is."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from finssim.cli_options import Json, Seed, Vehicle
from finssim.quiet import start_warp

__all__ = ["calibrate_app", "experiment_app", "replay"]

calibrate_app = typer.Typer(rich_markup_mode=None, add_completion=False, invoke_without_command=True)
experiment_app = typer.Typer(rich_markup_mode=None, add_completion=False, invoke_without_command=True)

Trials = Annotated[
    list[Path],
    typer.Argument(help="Trial folders, folders of them, or bare .csv or .parquet tables.", metavar="TRIAL"),
]
Out = Annotated[Path, typer.Option(help="Vehicle file to write (.yaml).", metavar="FILE")]
Report = Annotated[
    Path | None,
    typer.Option(help="Directory for report.html, report.md, pictures and fit.json.", metavar="DIR"),
]


@calibrate_app.callback()
def _calibrate(context: typer.Context) -> None:
    """Fit a vehicle's numbers to measurements and write a vehicle file with their 95 % intervals.

    Example: finssim calibrate hydrodynamics --help
    """
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


@calibrate_app.command()
def thruster(
    tables: Annotated[
        list[Path],
        typer.Argument(help="Tables of force against rpm or pulse width (.csv), or trials.", metavar="TABLE"),
    ],
    vehicle: Vehicle,
    out: Out,
    group: Annotated[
        str | None,
        typer.Option(help="Propeller group that all tables speak about.", metavar="NAME"),
    ] = None,
    voltage: Annotated[
        float | None,
        typer.Option(help="Battery voltage at which the numbers shall hold [V], where tables have several."),
    ] = None,
    pool_voltages: Annotated[
        bool,
        typer.Option(
            "--pool-voltages", help="Fit all voltages together instead of checking one on the others."
        ),
    ] = False,
    report: Report = None,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Fit thrust curves: c+ and c- [N s²/rad²], dead zones [rpm], limits [N], pulse width to speed.

    Example: finssim calibrate thruster T200-16V.csv --vehicle bluerov2 --out mine.yaml
    """
    start_warp()
    from finssim.calibration.output.commands import calibrate_thruster as run

    run(
        tables,
        vehicle=vehicle,
        group=group,
        voltage=voltage,
        pool_voltages=pool_voltages,
        out=out,
        report=report,
        seed=seed,
        as_json=as_json,
    )


@calibrate_app.command()
def motor(
    trials: Trials,
    vehicle: Vehicle,
    out: Out,
    report: Report = None,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Fit the motors' response to steps: delay and lag [s], dead zone, and tune the speed loop.

    Example: finssim calibrate motor steps --vehicle mine.yaml --out mine.yaml
    """
    start_warp()
    from finssim.calibration.output.commands import calibrate_motor as run

    run(trials, vehicle=vehicle, out=out, report=report, seed=seed, as_json=as_json)


@calibrate_app.command()
def hydrodynamics(
    trials: Trials,
    vehicle: Vehicle,
    out: Out,
    axes: Annotated[
        str | None,
        typer.Option(
            help="Axes to fit, of surge,sway,heave,roll,pitch,yaw; those that the trials excite if not given.",
            metavar="AXES",
        ),
    ] = None,
    method: Annotated[
        str,
        typer.Option(
            help="regression: each axis by its equation of motion; simulation: what simulates the trials best; auto: "
            "the regression where it replays the trials very well, else the simulation unless that replays them worse.",
            metavar="METHOD",
        ),
    ] = "auto",
    full: Annotated[
        bool, typer.Option("--full", help="Also couplings between axes (simulation method).")
    ] = False,
    estimate: Annotated[
        str,
        typer.Option(
            help="Also fit, of thrust_scale,thrust_lag,thrust_delay,current,buoyancy_excess,k (simulation method); "
            "or parameters of the vehicle's terms, such as lift.coefficient (either method).",
            metavar="NAMES",
        ),
    ] = "",
    damping: Annotated[
        str, typer.Option(help="Drag: linear, quadratic, both, or auto to choose.", metavar="KIND")
    ] = "auto",
    fix: Annotated[
        str,
        typer.Option(
            help="Inertias that are known, added mass included [kg, kg m²]: yaw.m=0.6,surge.m=24 (regression).",
            metavar="AXIS.m=N",
        ),
    ] = "",
    horizon: Annotated[
        float | None,
        typer.Option(help="Longest stretch simulated without a restart [s] (simulation method)."),
    ] = None,
    report: Report = None,
    ranges: Annotated[
        Path | None,
        typer.Option(
            help="Ranges file to write from the 95 % intervals, for `finssim train --randomize`.",
            metavar="FILE",
        ),
    ] = None,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Fit added mass [kg, kg m²] and damping [N s/m, N s²/m², ...] to trials, axis by axis or by simulation.

    Example: finssim calibrate hydrodynamics trials/fit --vehicle mine.yaml --out fitted.yaml --report report
    """
    start_warp()
    from finssim.calibration.output.commands import calibrate_hydrodynamics as run

    run(
        trials,
        vehicle=vehicle,
        axes=axes,
        method=method,
        full=full,
        estimate=estimate,
        damping=damping,
        fix=fix,
        horizon=horizon,
        out=out,
        report=report,
        ranges=ranges,
        seed=seed,
        as_json=as_json,
    )


def replay(
    trials: Trials,
    vehicle: Vehicle,
    hydrodynamics: Annotated[
        list[str] | None,
        typer.Option(
            help="Model to replay: calibrated, simplified or mesh. May be given several times.",
            metavar="MODEL",
        ),
    ] = None,
    horizon: Annotated[
        float | None,
        typer.Option(help="Also predict this far ahead [s] from measured states all along the trials."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Directory for replay.json, replay.md and figures.", metavar="DIR")
    ] = None,
    seed: Seed = 20260903,  # that of the published validation
    as_json: Json = False,
) -> None:
    """Drive models with recorded inputs and score them: NRMSE per axis and trial, in-sample ones labelled.

    Example: finssim replay trials/held-out --vehicle fitted.yaml --hydrodynamics calibrated --out replay
    """
    start_warp()
    from finssim.calibration.replay.replay import run_replay as run

    run(
        trials,
        vehicle=vehicle,
        hydrodynamics=hydrodynamics or "calibrated",
        horizon=horizon,
        out=out,
        seed=seed,
        as_json=as_json,
    )


@experiment_app.callback()
def _experiment(context: typer.Context) -> None:
    """Reproduce a table of the paper in simulation, beside the paper's own numbers.

    Example: finssim experiment replay --help
    """
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


@experiment_app.command("replay")
def _experiment_replay(
    out: Annotated[Path, typer.Option(help="Directory for JSON, Markdown and figures.", metavar="DIR")],
    seeds: Annotated[int, typer.Option(help="Repetitions with other noise and starts.", min=1, max=1000)] = 3,
    seed: Seed = 1,
    as_json: Json = False,
) -> None:
    """Identify on half of the trials of a plant outside the model class, replay three models on the other half.

    Example: finssim experiment replay --seeds 3 --out experiment
    """
    from finssim.experiments.campaign import run_experiment
    from finssim.experiments.replay_experiment import print_table, replay_experiment

    run_experiment(
        "experiment replay", replay_experiment, print_table, out=out, seeds=seeds, seed=seed, as_json=as_json
    )
