"""How an experiment meets its user: a bar while it works, then its table or one JSON object."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress

from finssim.quiet import start_warp

__all__ = ["Say", "run_experiment"]

Say = Callable[[float, str], None]
"""Told the share that is done and what comes next."""


def run_experiment(
    name: str,
    work: Callable[[Say], dict[str, Any]],
    show: Callable[[Mapping[str, Any], Console], None],
    *,
    out: Path,
    as_json: bool,
    console: Console | None,
    bar: bool = True,
) -> dict[str, Any]:
    """Run an experiment with a progress bar on standard error and print what it found.

    Args:
        name: What the bar is called.
        work: The experiment, which writes its directory itself.
        show: Prints its table.
        out: The directory.
        as_json: Print one JSON object in place of the table.
        console: Where the table goes; standard output if None.
        bar: Show it; False where the work has a line of its own on the screen.

    Returns:
        What `work` returned.
    """
    start_warp()
    screen = Console(stderr=True)
    with Progress(console=screen, transient=True, disable=not bar or not screen.is_terminal) as progress:
        task = progress.add_task(name, total=1.0)
        result = work(lambda part, what: progress.update(task, completed=part, description=what))
    if as_json:
        print(json.dumps(result, allow_nan=False))
        return result
    console = console or Console()
    show(result, console)
    console.print(f"written: {out}", highlight=False, soft_wrap=True)
    return result
