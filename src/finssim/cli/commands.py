"""Table of the `finssim` commands and their functions, which define options and help."""

from __future__ import annotations

import itertools
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import typer

from finssim import __version__
from finssim.cli import boundary
from finssim.cli.command_line import CONTEXT, command_app
from finssim.core.registry import COMMANDS as FAMILY
from finssim.core.system import announce, replace_unwritable

SECTIONS: dict[str, dict[str, str]] = {
    "Start": {
        "demo": "finssim.studies.demo:demo",
        "doctor": "finssim.cli.doctor:doctor",
        "new": "finssim.cli.new:new",
    },
    "Describe and simulate": {
        "vehicles": "finssim.cli.commands:vehicles",
        "vehicles show": "finssim.cli.commands:show_vehicle",
        "vehicles import": "finssim.cli.commands:import_vehicle",
        "vehicles export": "finssim.cli.commands:export",
        "simulate": "finssim.cli.simulate:simulate",
    },
    "Identify a vehicle": {
        "excite": "finssim.evaluation.excitation:excite",
        "trials import": "finssim.trials.importers.dispatch:import_trials",
        "trials check": "finssim.trials.check:check",
        "calibrate hydrodynamics": "finssim.identification.hydrodynamics:calibrate_hydrodynamics",
        "calibrate changes": "finssim.identification.adaptation:calibrate_changes",
        "calibrate thruster": "finssim.bench.thruster:calibrate_thruster",
        "calibrate motor": "finssim.bench.motor:calibrate_motor",
        "calibrate camera": "finssim.survey.camera:run",
        "calibrate pool": "finssim.survey.pool:run",
        "calibrate mounts": "finssim.survey.mounts:run",
        "replay": "finssim.identification.prediction:run_replay",
    },
    "Locate it": {
        "localize": "finssim.localization.localize:run",
        "fuse": "finssim.localization.fusion.fuse:run",
        "project": "finssim.localization.points:run_project",
        "backproject": "finssim.localization.points:run_backproject",
    },
    "Train and evaluate": {
        "tasks": "finssim.cli.tasks_show:tasks_list",
        "tasks show": "finssim.cli.tasks_show:tasks_show",
        "train": "finssim.learning.train:train",
        "evaluate": "finssim.evaluation.evaluate:evaluate",
        "sweep": "finssim.studies.sweep:sweep",
        "collect": "finssim.evaluation.records:collect",
        "datasets": "finssim.evaluation.records:datasets",
    },
    "Deploy": {
        "pool": "finssim.pool.run:run",
        "run": "finssim.robot.run:run",
        "teleop": "finssim.robot.teleop:run",
        "record info": "finssim.robot.record_reader:info",
        "record repair": "finssim.robot.record_reader:repair",
        "play": "finssim.cli.playback:play",
        "ardusub-sitl": "finssim.pool.ardusub_sitl:run",
    },
    "Prove": {
        "experiment t1": "finssim.studies.transfer:t1",
        "experiment t2": "finssim.studies.transfer:t2",
        "experiment localization": "finssim.studies.localization:localization_experiment",
        "experiment replay": "finssim.studies.replay:replay_experiment",
    },
}
"""Section of the help -> command -> its function, in the order of a user's workflow."""
COMMANDS = {words: work for section in SECTIONS.values() for words, work in section.items()}
"""Command of the core -> its function."""

FAMILY.ship({words.partition(" ")[0]: "finssim.cli.commands:app" for words in COMMANDS})

GROUPS = {
    "trials": "Check trials, and import foreign logs as trials.\n\nExample: finssim trials check trials",
    "calibrate": "Fit a vehicle's numbers to measurements and write a vehicle file with their 95 % intervals.\n\n"
    "Example: finssim calibrate hydrodynamics --help",
    "experiment": "Reproduce a table of the paper in simulation, beside the paper's own numbers.\n\n"
    "Example: finssim experiment replay --help",
    "record": "Inspect records of runs, and repair truncated ones.\n\nExample: finssim record info run.mcap",
}
"""Help of groups that only have subcommands."""

PICTURES = (".png", ".svg", ".pdf")

app = command_app(
    SECTIONS,
    GROUPS,
    FAMILY,
    name="finssim",
    help="Identify, locate and simulate underwater vehicles, train controllers, and deploy them.",
    pretty_exceptions_enable=False,
    context_settings=CONTEXT,
)


def main() -> None:
    """Run the command line and exit.

    Exit status: 0 success, 1 a bug of FinsSim, 2 a refused input, 3 a negative result, 130 interrupted.
    """
    replace_unwritable(sys.stdout, sys.stderr)
    words = itertools.takewhile(lambda word: not word.startswith("-"), sys.argv[1:3])
    started = announce(f"finssim {' '.join(words)}: starting")
    status = boundary.run(app, sys.argv[1:])
    started()
    sys.exit(status)


def _version(requested: bool) -> None:
    if requested:
        typer.echo(f"finssim {__version__}")
        raise typer.Exit


@app.callback()
def _finssim(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version.", callback=_version, is_eager=True)
    ] = False,
) -> None:
    """Units are SI and radians unless an option's name states otherwise; z is up, and 0 on the still water surface."""


def vehicles(*, as_json: bool = False) -> None:
    """List the vehicles in the catalogue; `show NAME` prints one in full.

    Example: finssim vehicles

    Args:
        as_json: Print one JSON object instead of a table.
    """
    from rich.console import Console

    from finssim.core.registry import VEHICLES
    from finssim.vehicles import load_vehicle
    from finssim.vehicles.show import print_catalogue, vehicle_data

    if as_json:
        print(json.dumps({name: vehicle_data(load_vehicle(name)) for name in sorted(VEHICLES.usable())}))
    else:
        print_catalogue(Console())


def show_vehicle(
    name: str,
    *,
    picture: Path | None = None,
    as_json: bool = False,
) -> None:
    """Print mass [kg], trim, terminal speeds, wrench capability [N, N m], time constants [s], thrusters and stability.

    Example: finssim vehicles show finsrov --picture finsrov.png

    Args:
        name (NAME|FILE): Vehicle in the catalogue, or path of a vehicle file.
        picture: Also draw the thruster layout in this file (.png, .svg).
        as_json: Print one JSON object instead of tables.
    """
    from rich.console import Console

    from finssim.sim.free_motion import stability
    from finssim.vehicles import load_vehicle
    from finssim.vehicles.show import print_motions, print_vehicle, vehicle_data

    if picture is not None and picture.suffix not in PICTURES:
        raise ValueError(f"{picture} ends in '{picture.suffix}', expected one of {' '.join(PICTURES)}")
    vehicle = load_vehicle(name)
    if "perception" not in vehicle.defaults:
        from finssim.vehicles.device_files import device_of

        for sensor in vehicle.perception:
            device_of(vehicle, sensor)
    model = next(
        (name for name in ("calibrated", "simplified", "mesh") if name in vehicle.hydrodynamics), None
    )
    top, found = (None, {}) if model is None else stability(vehicle, model)
    motions = {n: (m.words(m.at_rest), m.words(m.at_top_speed), m.unstable_above) for n, m in found.items()}
    if as_json:
        print(json.dumps(vehicle_data(vehicle) | {"top_speed": top, "without_control": motions}))
    else:
        print_vehicle(vehicle, Console())
        if top is not None:
            print_motions(top, motions, Console())
    if picture is not None:
        from finssim.core.files import atomic_write
        from finssim.vehicles.show import draw_vehicle

        with atomic_write(picture) as temporary:
            draw_vehicle(vehicle, temporary)
        typer.echo(f"thruster layout: {picture}", err=as_json)


def import_vehicle(file: Path, *, out: Path, folder: Sequence[Path] = (), as_json: bool = False) -> None:
    """Write a vehicle file from the model of another simulator, and list what was guessed and what was not read.

    Supported are SDF of gz-sim (plugins Hydrodynamics, Thruster and Buoyancy), URDF and xacro with these or
    with the plugins of uuv_simulator, coefficients of Fossen's equations in Python or MATLAB, which are not
    executed, scenarios of Stonefish and HoloOcean and parameters of MarineGym.

    Example: finssim vehicles import model.sdf --out rov.yaml

    Args:
        file (FILE): Model of the other program; the files that it names are in its folder or below.
        out (FILE): Vehicle file to write (.yaml), with the mesh of the hull in the same folder.
        folder (FOLDER): Further folder in which packages named by the file are searched.
        as_json: Print one JSON object instead of text.
    """
    from tempfile import TemporaryDirectory

    from finssim.identification.vehicle_file import write_vehicle, yaml_path
    from finssim.vehicles import check_vehicle, load_vehicle
    from finssim.vehicles.importers.draft import read_foreign

    yaml_path(out, "vehicle")
    draft = read_foreign(file, folder)
    with TemporaryDirectory() as folder:
        write_vehicle(draft.vehicle(Path(folder)), out)
    failed = [finding.sentence for finding in check_vehicle(load_vehicle(out)) if not finding.passed]
    lists = {
        "guessed": draft.guesses(),
        "different": draft.different,
        "not read": [f"{what} x {n}" if n > 1 else what for what, n in sorted(draft.not_read.items())],
        "check": failed,
    }
    if as_json:
        print(json.dumps({"file": str(out), **lists}))
        return
    print(f"{out}: {draft.source}")
    for kind, sentences in lists.items():
        for sentence in sentences:
            print(f"{kind}: {sentence}")


def export(
    name: str,
    *,
    format: Literal["sdf", "urdf"] | None = None,
    out: Path | None = None,
    hydrodynamics: str = "calibrated",
    as_json: bool = False,
) -> None:
    """Write a vehicle as SDF or URDF with the plugins of gz-sim, and list what the format cannot represent.

    Example: finssim vehicles export bluerov2_heavy --format sdf

    Args:
        name (NAME|FILE): Vehicle in the catalogue, or path of a vehicle file.
        format: Format of the file; SDF is a complete world. Default: by the suffix of the file, or sdf.
        out (FILE): File to write; default NAME.sdf or NAME.urdf.
        hydrodynamics (SET): Set of coefficients of the vehicle file.
        as_json: Print one JSON object instead of text.
    """
    from finssim.vehicles import load_vehicle
    from finssim.vehicles.export import export_vehicle

    kind = format or ("urdf" if out is not None and out.suffix == ".urdf" else "sdf")
    if kind not in ("sdf", "urdf"):
        raise ValueError(f"unknown format '{kind}'; available: sdf, urdf")
    vehicle = load_vehicle(name)
    file = out or Path(f"{vehicle.name}.{kind}")
    if file.suffix != f".{kind}":
        raise ValueError(f"{file} ends in '{file.suffix}', expected .{kind}, as the format")
    lost = export_vehicle(vehicle, file, kind, hydrodynamics)
    lines = [str(file), *(f"not held: {sentence}" for sentence in lost)]
    print(json.dumps({"file": str(file), "not held": lost}) if as_json else "\n".join(lines))
