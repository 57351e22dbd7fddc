"""`finssim tasks`: what can be learnt."""

from __future__ import annotations

from typing import Annotated

import typer

from finssim.cli_options import Json, Vehicle
from finssim.quiet import start_warp

__all__ = ["tasks_app"]

tasks_app = typer.Typer(rich_markup_mode=None, add_completion=False, invoke_without_command=True)


@tasks_app.callback()
def _tasks(context: typer.Context, as_json: Json = False) -> None:
    """List the tasks: agents, sizes of observation and action, period and length [s]; `show NAME` tells one in full.

    Example: finssim tasks
    """
    if context.invoked_subcommand is None:
        start_warp()
        from finssim.experiments.tasks_show import tasks_list

        tasks_list(as_json=as_json)


@tasks_app.command()
def show(
    name: Annotated[
        str, typer.Argument(help="Task, or one's own as FILE.py:CLASS.", metavar="NAME|FILE.py:CLASS")
    ],
    vehicle: Vehicle = "finsrov",
    action: Annotated[
        str | None,
        typer.Option(help="wrench6, wrench4 or thruster8; the task's own if not given.", metavar="MODE"),
    ] = None,
    as_json: Json = False,
) -> None:
    """Tell all of a task as a vehicle does it: observation, action [N, N m], reward, success, settings.

    Example: finssim tasks show docking --vehicle bluerov2_heavy
    """
    start_warp()
    from finssim.experiments.tasks_show import tasks_show

    tasks_show(name, vehicle=vehicle, action=action, as_json=as_json)
