"""The `finssim` command. Each handler imports what it runs, so that `finssim --help` answers at once."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from finssim import (
    __version__,
    boundary,
    cli_calibrate,
    cli_experiments,
    cli_imitation,
    cli_learn,
    cli_localization,
    cli_pool,
    cli_randomize,
    cli_record,
    cli_robot,
    cli_ros2,
    cli_study,
    cli_tasks,
    cli_trials,
    cli_view,
    cli_vision,
)
from finssim.cli_options import (
    Arm,
    Bind,
    ByHand,
    Device,
    Hydrodynamics,
    Json,
    Lockstep,
    Pictures,
    Robot,
    RobotPool,
    RobotSite,
    Seed,
    Steps,
    Unattended,
    Vehicle,
)
from finssim.quiet import start_warp

__all__ = ["app", "main"]

app = typer.Typer(
    name="finssim",
    help="Identify and locate underwater vehicles, simulate them, train controllers, and check all of it.",
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
)
vehicles_app = typer.Typer(invoke_without_command=True, rich_markup_mode=None, add_completion=False)
app.add_typer(vehicles_app, name="vehicles")
app.command()(cli_learn.train)
app.command()(cli_learn.evaluate)
app.add_typer(cli_tasks.tasks_app, name="tasks")
app.command()(cli_imitation.collect)
app.command()(cli_imitation.datasets)
app.command()(cli_study.compare)
app.command()(cli_study.sweep)
app.add_typer(cli_trials.trials_app, name="trials")
app.command()(cli_trials.excite)
app.add_typer(cli_calibrate.calibrate_app, name="calibrate")
app.command()(cli_calibrate.replay)
app.add_typer(cli_calibrate.experiment_app, name="experiment")
cli_calibrate.calibrate_app.command()(cli_vision.camera)
cli_calibrate.calibrate_app.command()(cli_vision.pool)
cli_calibrate.calibrate_app.command()(cli_vision.mounts)
cli_calibrate.experiment_app.command("localization")(cli_vision.experiment_localization)
cli_calibrate.experiment_app.command()(cli_experiments.t1)
cli_calibrate.experiment_app.command()(cli_experiments.t2)
cli_calibrate.experiment_app.command()(cli_experiments.ablation)
cli_calibrate.experiment_app.command("open-water")(cli_experiments.open_water)
cli_calibrate.experiment_app.command("all")(cli_experiments.everything)
cli_calibrate.experiment_app.command()(cli_experiments.faults)
cli_calibrate.experiment_app.command()(cli_experiments.soak)
cli_calibrate.experiment_app.command()(cli_experiments.timing)
cli_calibrate.experiment_app.command()(cli_experiments.stack)
app.command()(cli_localization.localize)
app.command()(cli_localization.fuse)
app.command()(cli_localization.project)
app.command()(cli_localization.backproject)
app.add_typer(cli_randomize.randomize_app, name="randomize")
app.add_typer(cli_record.record_app, name="record")
app.command()(cli_record.play)
app.command()(cli_record.teleop)
app.command()(cli_robot.run)
app.command()(cli_pool.pool)
app.command()(cli_view.view)
app.add_typer(cli_ros2.ros2_app, name="ros2")

PICTURES = (".png", ".svg", ".pdf")


def main() -> None:
    """Run the command line and exit: 0 well, 1 a fault of FinsSim, 2 a refused input, 130 interrupted."""
    sys.exit(boundary.run(app, sys.argv[1:]))


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"finssim {__version__}")
        raise typer.Exit


@app.callback()
def _finssim(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version.", callback=_version, is_eager=True)
    ] = False,
) -> None:
    """Units are SI and radians unless an option's name says otherwise; z is up, and 0 on the still water surface."""


@app.command()
def demo(
    out: Annotated[
        Path, typer.Option(help="Directory of trials, vehicle, policy, results and report.")
    ] = Path("demo"),
    vehicle: Vehicle = "finsrov",
    seed: Seed = 1,
    steps: Steps = None,
    robot: Robot = None,
    pool_file: RobotPool = None,
    site: RobotSite = None,
    bind: Bind = "127.0.0.1:54321",
    pictures: Pictures = None,
    lockstep: Lockstep = False,
    arm: Arm = False,
    by_hand: ByHand = False,
    unattended: Unattended = False,
) -> None:
    """Identify a vehicle in the virtual pool or on a robot, train in it, deploy there beside two PIDs, write a report.

    Example: finssim demo --vehicle bluerov2_heavy --out demo

    Example: finssim demo --robot udp://10.0.0.2:58766 --pool-file pool.yaml --arm --out demo
    """
    start_warp()
    from finssim.experiments.demo import demo as run

    where = cli_robot.robot_or_none(
        robot, bind=bind, pictures=pictures, lockstep=lockstep, pool_file=pool_file, site=site, arm=arm,
        by_hand=by_hand, unattended=unattended,
    )  # fmt: skip
    run(out, vehicle=vehicle, seed=seed, steps=steps, robot=where)


@app.command()
def simulate(
    vehicle: Vehicle,
    command: Annotated[
        str,
        typer.Option(
            help='Constant wrench: "surge=10 yaw=1". surge sway heave in N, roll pitch yaw in N m; the rest is 0.',
            metavar="WRENCH",
        ),
    ],
    duration: Annotated[float, typer.Option(help="Simulated time [s].")],
    out: Annotated[
        Path,
        typer.Option(
            help="Table to write, one row per control step of 0.1 s: a .csv file. OUT.json tells its origin."
        ),
    ],
    hydrodynamics: Hydrodynamics = "calibrated",
    depth: Annotated[float, typer.Option(help="Depth of the body origin at the start [m].")] = 5.0,
    device: Device = "cpu",
) -> None:
    """Simulate a vehicle from rest under a constant wrench and record its motion.

    Example: finssim simulate --vehicle finsrov --command "surge=10 yaw=1" --duration 10 --out run.csv
    """
    start_warp()
    from finssim.experiments.simulate import simulate as run

    run(
        vehicle=vehicle,
        command=command,
        duration=duration,
        hydrodynamics=hydrodynamics,
        depth=depth,
        device=device,
        out=out,
    )


@vehicles_app.callback()
def _vehicles(context: typer.Context) -> None:
    """List the vehicles of the catalogue; `show NAME` prints one in full.

    Example: finssim vehicles
    """
    if context.invoked_subcommand is None:
        from rich.console import Console

        from finssim.vehicles.show import print_catalogue

        print_catalogue(Console())


@vehicles_app.command("show")
def _show(
    name: Annotated[
        str,
        typer.Argument(help="Vehicle of the catalogue, or the path of a vehicle file.", metavar="NAME|FILE"),
    ],
    picture: Annotated[
        Path | None, typer.Option(help="Also draw the thruster layout into this file (.png, .svg).")
    ] = None,
) -> None:
    """Print mass [kg], trim, terminal speeds, wrench capability [N, N m], time constants [s] and thrusters.

    Example: finssim vehicles show finsrov --picture finsrov.png
    """
    from rich.console import Console

    from finssim.vehicles import load_vehicle
    from finssim.vehicles.show import print_vehicle

    if picture is not None and picture.suffix not in PICTURES:
        raise typer.BadParameter(
            f"{picture} ends in '{picture.suffix}', expected one of {' '.join(PICTURES)}"
        )
    vehicle = load_vehicle(name)
    print_vehicle(vehicle, Console(), None)
    if picture is not None:
        from finssim.files import atomic_write
        from finssim.vehicles.picture import draw_vehicle

        with atomic_write(picture) as temporary:
            draw_vehicle(vehicle, temporary)
        typer.echo(f"thruster layout: {picture}")


@app.command()
def validate(
    name: Annotated[str, typer.Argument(help="Vehicle with published responses: finsrov.", metavar="NAME")],
    hydrodynamics: Hydrodynamics = "calibrated",
    as_json: Json = False,
) -> None:
    """Print simulated beside published pool responses, and say where they disagree.

    Example: finssim validate finsrov
    """
    start_warp()
    from finssim.experiments.validate import validate as run

    run(name, as_json=as_json, hydrodynamics=hydrodynamics)


@app.command()
def bench(device: Device = "cpu", as_json: Json = False) -> None:
    """Measure this machine's speed: physics steps/s, environment steps/s, mesh faces/s.

    Example: finssim bench --json > bench.json
    """
    start_warp()
    from finssim.experiments.bench import bench as run

    run(as_json=as_json, device=device)


@app.command()
def doctor(as_json: Json = False) -> None:
    """Say what is installed, which devices compute, and what each missing extra would enable.

    Example: finssim doctor
    """
    from finssim.doctor import doctor as run

    if not run(json=as_json):
        raise typer.Exit(1)
