"""`finssim collect` and `finssim datasets`: demonstrations."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from finssim.cli_options import Hydrodynamics, Json, Seed, Vehicle
from finssim.quiet import start_warp

__all__ = ["collect", "datasets"]


def collect(
    expert: Annotated[
        str, typer.Argument(help="A policy's directory, or a baseline of the task.", metavar="DIR|NAME")
    ],
    task: Annotated[str, typer.Option(help="Task to be shown; finssim tasks lists them.", metavar="TASK")],
    episodes: Annotated[int, typer.Option(help="How many; each agent's is one of its own.", min=1)],
    out: Annotated[Path, typer.Option(help="Folder of the data set.", metavar="DATASET")],
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
    observe: Annotated[
        str, typer.Option(help="What the expert sees: truth, estimator or training.", metavar="NAME")
    ] = "training",
    disturb: Annotated[
        float,
        typer.Option(
            help="Noise on what is done, not on what is written, in parts of full action: shows recoveries."
        ),
    ] = 0.0,
    seed: Seed = 42,
    as_json: Json = False,
) -> None:
    """Let an expert do a task and keep its episodes as a Minari data set.

    Example: finssim collect pid --task t1 --episodes 200 --out demonstrations/hold
    """
    start_warp()
    from rich.console import Console
    from rich.progress import Progress

    from finssim.learning.collect import collect as run

    screen = Console(stderr=True)
    with Progress(console=screen, transient=True, disable=not screen.is_terminal) as progress:
        bar = progress.add_task("collecting", total=1.0)
        told = run(
            expert, task, episodes=episodes, out=out, vehicle=vehicle, hydrodynamics=hydrodynamics, action=action,
            randomize=randomize, observe=observe, disturb=disturb, seed=seed,
            show=lambda part: progress.update(bar, completed=part),
        )  # fmt: skip
    if as_json:
        print(json.dumps(told, allow_nan=False))
        return
    measures = ", ".join(
        f"{name} {value:.4g}" for name, value in told["metrics"].items() if value is not None
    )
    print(f"{told['episodes']} episodes, {told['steps']:,} steps; means: {measures}")
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
