"""Results of episodes as a person reads them: a table of means with intervals, and how single episodes lie."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from finssim.experiments.envelope import COLORS
from finssim.files import atomic_write

__all__ = ["draw_episodes", "print_episodes", "print_episodes_by_plant"]

CAPTION = "means over episodes; in brackets 95 % of a bootstrap over them."


def print_episodes(result: Mapping[str, Any], console: Console) -> None:
    """Print the table of one evaluation: a row for each measure."""
    plant = result["plant"]
    console.print(
        f"{result['task']} · {result['controller']['name']} · {result['vehicle']['name']}, {result['hydrodynamics']}"
        f" · plant {plant['name']}: {plant.get('title', '')} · {result['valid']} of {result['trials']} episodes",
        highlight=False,
    )
    print_table([result], [plant["name"]], console)
    for trial in result["per_trial"]:
        if trial.get("fault"):
            console.print(f"{trial['record']}: {trial['fault']}", highlight=False, markup=False)


def print_episodes_by_plant(results: Sequence[Mapping[str, Any]], console: Console) -> None:
    """Print a column for each plant that one controller was evaluated in."""
    first = results[0]
    console.print(
        f"{first['task']} · {first['controller']['name']} · {first['vehicle']['name']}", highlight=False
    )
    print_table(results, [result["plant"]["name"] for result in results], console)


def print_table(results: Sequence[Mapping[str, Any]], heads: Sequence[str], console: Console) -> None:
    """Print a row for each measure and a column for each result."""
    table = Table(
        caption=CAPTION, caption_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False
    )
    table.add_column("measure", no_wrap=True)
    for head in heads:
        table.add_column(Text(head), justify="right", no_wrap=True)
    for name in results[0]["metrics"]:
        table.add_row(Text(name), *(Text(_cell(result["metrics"][name])) for result in results))
    console.print(table)


def _cell(metric: Mapping[str, Any]) -> str:
    if metric["value"] is None:
        return "–"
    low, high = metric["ci95"]
    return f"{metric['value']:.4g} [{low:.4g}, {high:.4g}]"


def draw_episodes(evaluations: Sequence[Any], folder: Path, title: str) -> None:
    """`episodes.png`: for each measure, every episode as a point, a column for each plant, the mean as a bar."""
    from matplotlib.figure import Figure

    names = list(evaluations[0].result["metrics"])
    columns = min(len(names), 4)
    rows = -(-len(names) // columns)
    figure = Figure(figsize=(2.6 * columns, 2.4 * rows), layout="constrained")
    rng = np.random.default_rng(0)
    for k, name in enumerate(names):
        axes = figure.add_subplot(rows, columns, k + 1)
        for i, evaluation in enumerate(evaluations):
            values = [trial[name] for trial in evaluation.result["per_trial"] if trial[name] is not None]
            color = COLORS[i % len(COLORS)]
            spread = i + rng.uniform(-0.3, 0.3, len(values))
            axes.plot(spread, values, ".", color=color, alpha=0.5, markersize=4)
            if values:
                axes.hlines(np.mean(values), i - 0.4, i + 0.4, color=color, linewidth=2)
        axes.set_title(name, fontsize=9)
        axes.set_xticks(range(len(evaluations)), [e.label for e in evaluations], fontsize=7, rotation=20)
        axes.set_xlim(-0.6, len(evaluations) - 0.4)
        axes.tick_params(labelsize=7)
        axes.spines[["top", "right"]].set_visible(False)
    if title:
        figure.suptitle(title, fontsize=11)
    with atomic_write(folder / "episodes.png") as temporary:
        figure.savefig(temporary, dpi=120)
