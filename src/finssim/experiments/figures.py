"""Pictures of a training and of its trials: the training curve, and the paths seen from above."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from finssim.engine import Pool
from finssim.experiments.trials import Trials

__all__ = ["draw_paths", "draw_training_curve"]

BLUE, ORANGE, GRAY = "#0072B2", "#D55E00", "0.6"
ARROW = 0.18
"""Length of an arrow that shows a heading [m]."""


def draw_training_curve(curves: Sequence[Mapping[str, Any]]) -> Figure:
    """Mean return and share of episodes held, against control steps and wall time.

    Args:
        curves: Rows of `curves.csv`: steps, seconds, mean_return, held.
    """
    figure = Figure(figsize=(7.2, 3.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    # Episodes last as long as several updates: before the first ends there is no return to show.
    rows = [row for row in curves if row["mean_length"] > 0.0]
    steps = np.array([row["steps"] for row in rows]) / 1e6
    axes.plot(steps, [row["mean_return"] for row in rows], color=BLUE, linewidth=1.6)
    axes.set_xlabel("control steps, all worlds [million]")
    axes.set_ylabel("mean return of an episode", color=BLUE)
    axes.grid(True, color="0.85", linewidth=0.6)
    share = axes.twinx()
    share.plot(steps, [100.0 * row["held"] for row in rows], color=ORANGE, linewidth=1.6)
    share.set_ylabel("episodes held [%]", color=ORANGE)
    share.set_ylim(-3.0, 103.0)
    for side in (axes, share):
        side.spines[["top"]].set_visible(False)
    if rows:
        last = rows[-1]
        axes.set_title(f"{last['steps'] / 1e6:.1f} million steps in {last['seconds']:.0f} s", fontsize=10)
    return figure


def draw_paths(trials: Trials, title: str = "", pool: Pool | None = None) -> Figure:
    """The paths of all trials from above and from the side, in the pool; start and goals with their headings."""
    pool = pool or Pool()
    figure = Figure(figsize=(7.2, 6.0), layout="compressed")
    FigureCanvasAgg(figure)
    above, side = figure.subplots(2, 1, sharex=True, height_ratios=(pool.width, pool.depth))
    for axes, (vertical, low, height) in zip(
        (above, side), ((1, -pool.width / 2, pool.width), (2, -pool.depth, pool.depth)), strict=True
    ):
        frame = Rectangle((-pool.length / 2, low), pool.length, height, facecolor="#eaf3f8", edgecolor=GRAY)
        axes.add_patch(frame)
        for i in range(len(trials.setpoints)):
            path = trials.position[:, i]
            axes.plot(path[:, 0], path[:, vertical], color=BLUE, linewidth=1.2)
        axes.plot(
            trials.goals[:, 0], trials.goals[:, vertical], "o", mfc="none", mec=ORANGE, ms=9, label="goal"
        )
        axes.plot(*trials.position[0, 0, [0, vertical]], "s", color="0.2", ms=5, label="start")
        axes.set_aspect("equal")
        axes.set_xlim(-pool.length / 2 - 0.05, pool.length / 2 + 0.05)
        axes.set_ylim(low - 0.05, low + height + 0.05)
        axes.spines[["top", "right"]].set_visible(False)
    _headings(above, trials)
    above.set_ylabel("y, left [m]")
    side.set_ylabel("z, up [m]")
    side.set_xlabel("x, forward [m]")
    figure.legend(
        *above.get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False, fontsize=9
    )
    if title:
        figure.suptitle(title, fontsize=10)
    return figure


def _headings(axes: Axes, trials: Trials) -> None:
    for x, y, _, yaw in trials.goals:
        tip = (x + ARROW * np.cos(yaw), y + ARROW * np.sin(yaw))
        axes.annotate("", tip, (x, y), arrowprops={"arrowstyle": "->", "color": ORANGE})
