"""`finssim collect` and `finssim datasets`: demonstrations."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from finssim.cli_options import Hydrodynamics, Json, Observe, Seed, Vehicle
from finssim.quiet import start_warp

__all__ = ["collect", "datasets"]


def collect(
    experts: Annotated[
        list[str],
        typer.Argument(
            help="A policy's directory or a baseline of the task; or records of driven vehicles (.mcap).",
            metavar="DIR|NAME|RECORD...",
        ),
    ],
    task: Annotated[str, typer.Option(help="Task to be shown; finssim tasks lists them.", metavar="TASK")],
    out: Annotated[Path, typer.Option(help="Folder of the data set.", metavar="DATASET")],
    episodes: Annotated[
        int | None, typer.Option(help="How many; each agent's is one of its own. Not of records.", min=1)
    ] = None,
    vehicle: Vehicle = "finsrov",
    hydrodynamics: Hydrodynamics = "calibrated",
    action: Annotated[
        str | None,
        typer.Option(help="What is commanded: wrench6, wrench4 or thruster8; the task's own if not given."),
    ] = None,
    randomize: Annotated[
        str | None,
        typer.Option(help="Ranges that vehicle and water are drawn from, by name or file.", metavar="FILE"),
    ] = None,
    observe: Observe = "training",
    disturb: Annotated[
        float,
        typer.Option(
            help="Noise on what is done, not on what is written, in parts of full action: shows recoveries."
        ),
    ] = 0.0,
    goal: Annotated[
        str | None,
        typer.Option(
            help="Of records: where to, in place of what they say: x,y,z,yaw_deg [m, deg], or end: where each stretch "
            "ended; of t2 the trajectory.",
            metavar="GOAL",
        ),
    ] = None,
    seed: Seed = 42,
    as_json: Json = False,
) -> None:
    """Keep episodes of a task as a Minari data set: let an expert do it, or take what was done with a vehicle.

    Example: finssim collect pid --task t1 --episodes 200 --out demonstrations/hold
    """
    start_warp()
    records = [Path(word) for word in experts if word.endswith(".mcap")]
    if records and (len(records) < len(experts) or episodes or randomize or disturb):
        raise typer.BadParameter(
            "records are taken as they are, and by themselves: leave out other experts, --episodes, --randomize and "
            "--disturb"
        )
    if not records and (len(experts) > 1 or episodes is None or goal is not None):
        raise typer.BadParameter("give one expert and --episodes, and no --goal, which is of records")
    if records:
        from finssim.experiments.driven import collect_records

        told = collect_records(records, task, out=out, vehicle=vehicle, action=action, goal=goal)
    else:
        options = {
            "vehicle": vehicle, "hydrodynamics": hydrodynamics, "action": action, "randomize": randomize,
            "observe": observe, "disturb": disturb, "seed": seed,
        }  # fmt: skip
        told = _shown(experts[0], task, episodes or 0, out, options)
    _tell(told, out, as_json)


def _shown(expert: str, task: str, episodes: int, out: Path, options: dict[str, Any]) -> dict[str, Any]:
    """Let an expert act in the simulator, with a bar."""
    from rich.console import Console
    from rich.progress import Progress

    from finssim.learning.collect import collect as run

    screen = Console(stderr=True)
    with Progress(console=screen, transient=True, disable=not screen.is_terminal) as progress:
        bar = progress.add_task("collecting", total=1.0)
        return run(
            expert, task, episodes=episodes, out=out,
            show=lambda part: progress.update(bar, completed=part), **options,
        )  # fmt: skip


def _tell(told: dict[str, Any], out: Path, as_json: bool) -> None:
    if as_json:
        print(json.dumps(told, allow_nan=False))
        return
    measures = ", ".join(
        f"{name} {value:.4g}" for name, value in told.get("metrics", {}).items() if value is not None
    )
    print(f"{told['episodes']} episodes, {told['steps']:,} steps{'; means: ' * bool(measures)}{measures}")
    for source in told.get("records", ()):
        print(
            f"{source['file']}: {source['driver']}, {source['episodes']} episodes, {source['steps']:,} steps"
        )
    print(f"written: {out}")


def datasets(
    places: Annotated[
        list[Path], typer.Argument(help="Data sets, or folders that hold some.", metavar="PATH...")
    ],
    as_json: Json = False,
) -> None:
    """List demonstrations: task, vehicle, expert, episodes, steps.

    Example: finssim datasets demonstrations
    """
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from finssim.learning.demonstrations import about, found_in

    rows = {str(path): about(path) for place in places for path in found_in(place)}
    if as_json:
        print(json.dumps(rows))
        return
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    for head in ("data set", "task", "vehicle", "expert", "observes", "episodes", "steps"):
        table.add_column(head, justify="right" if head in ("episodes", "steps") else "left", overflow="fold")
    for name, row in rows.items():
        cells = (name, row["task"], row["vehicle"]["name"], row["expert"], row["observe"])
        table.add_row(*map(Text, cells), str(row["episodes"]), f"{row['steps']:,}")
    Console().print(table)
