"""Paths of the reference and of what was flown, from above: the paper's trajectory figure, from the virtual pool."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from finssim.control.trajectories import load_trajectory
from finssim.experiments.transfer.series import read_series
from finssim.files import atomic_write

__all__ = ["FIGURE_FILE", "draw_t2"]

FIGURE_FILE = "t2_paths.png"

SHOWN = 4
"""Rows that are drawn, at most: more cannot be told apart."""


def draw_t2(
    by_row: Mapping[str, list[dict[str, Any]]], titles: Mapping[str, str], folder: Path
) -> Path | None:
    """Draw, of each row and trajectory, the trial with the median error into `folder`; None if nothing was flown."""
    from matplotlib.figure import Figure

    flown = {name: [r for r in results if r["p95_m"] is not None] for name, results in by_row.items()}
    flown = dict([(name, results) for name, results in flown.items() if results][:SHOWN])
    targets = list(dict.fromkeys(r["job"]["target"] for results in flown.values() for r in results))
    if not targets:
        return None
    columns = min(2, len(targets))
    lines = -(-len(targets) // columns)
    figure = Figure(figsize=(5.5 * columns, 3.4 * lines), layout="constrained")
    for k, target in enumerate(targets):
        axes = figure.add_subplot(lines, columns, k + 1, aspect="equal")
        _draw_target(axes, target, flown, titles, folder)
    figure.axes[0].legend(fontsize=8, loc="upper left", bbox_to_anchor=(0.0, -0.12), ncols=2, frameon=False)
    with atomic_write(folder / FIGURE_FILE) as temporary:
        figure.savefig(temporary, format="png", dpi=130)
    return folder / FIGURE_FILE


def _draw_target(
    axes: Any,
    target: str,
    flown: Mapping[str, list[dict[str, Any]]],
    titles: Mapping[str, str],
    folder: Path,
) -> None:
    played = next(r for results in flown.values() for r in results if r["job"]["target"] == target)
    trajectory = load_trajectory(target).scaled(played.get("room", 1.0))
    way = trajectory.at(np.linspace(0.0, trajectory.duration, 1000)).position
    axes.plot(way[:, 0], way[:, 1], "k--", linewidth=1.2, label="reference")
    for name, results in flown.items():
        of_target = sorted((r for r in results if r["job"]["target"] == target), key=lambda r: r["p95_m"])
        if of_target:
            path = read_series(folder / "trials" / of_target[len(of_target) // 2]["key"])["position"]
            axes.plot(path[:, 0], path[:, 1], linewidth=1.2, label=titles[name])
    axes.set(title=target, xlabel="x [m]", ylabel="y [m]")
    axes.grid(alpha=0.3)
