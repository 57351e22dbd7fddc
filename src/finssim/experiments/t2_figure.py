"""The trajectory figure: for each trajectory the way from above, who followed it how, and the distance over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from finssim.control.guidance import Guide
from finssim.files import atomic_write

__all__ = ["TrackingRun", "draw_tracking", "save_tracking"]

Array = NDArray[np.float64]

TrackingRun = tuple[Guide, Array, Array]
"""What was followed; times since the start [s], (T,); positions, world frame [m], (T, 3)."""

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Okabe and Ito's palette, as in the error envelopes."""


def draw_tracking(runs: Mapping[str, Sequence[TrackingRun]], title: str = "") -> Figure:
    """The figure: a row for each trajectory, its way on the left, distances to the reference on the right.

    Args:
        runs: Legend label -> runs; each controller's runs of one trajectory are drawn in one colour.
        title: Written above, or left out when empty.
    """
    guides = {guide.name: guide for each in runs.values() for guide, _, _ in each}
    figure = Figure(figsize=(9.0, 2.4 * len(guides) + 0.8), layout="constrained")
    FigureCanvasAgg(figure)
    rows = figure.subplots(len(guides), 2, squeeze=False, width_ratios=(1.0, 1.2))
    for (above, beside), guide in zip(rows, guides.values(), strict=True):
        way = guide.at(np.linspace(0.0, guide.duration, 1001)).position
        above.plot(way[:, 0], way[:, 1], color="0.2", linewidth=1.0, linestyle="--", label="reference")
        for i, (label, each) in enumerate(runs.items()):
            _draw(above, beside, [run for run in each if run[0].name == guide.name], label, COLORS[i % 6])
        above.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
        above.set_title(guide.name, fontsize=10, loc="left")
        beside.set(xlabel="time [s]", ylabel="distance [mm]", xlim=(0.0, guide.duration))
        beside.set_ylim(bottom=0.0)
        for axes in (above, beside):
            axes.grid(True, color="0.88", linewidth=0.6)
            axes.spines[["top", "right"]].set_visible(False)
    handles, labels = rows[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    if title:
        figure.suptitle(title, fontsize=11)
    return figure


def save_tracking(runs: Mapping[str, Sequence[TrackingRun]], path: str | Path, title: str = "") -> Path:
    """Draws and writes the figure, whole or not at all; the suffix of `path` chooses the format.

    Raises:
        OutputError: The file cannot be written.
    """
    with atomic_write(path) as temporary:
        draw_tracking(runs, title).savefig(temporary, dpi=150)
    return Path(path)


def _draw(above: Axes, beside: Axes, runs: Sequence[TrackingRun], label: str, color: str) -> None:
    """All runs of one controller on one trajectory; only the first has the label."""
    for k, (guide, t, position) in enumerate(runs):
        during = (t >= 0.0) & (t <= guide.duration + 1e-6)
        t, position = t[during], position[during]
        error = np.linalg.norm(position - guide.at(t).position, axis=-1)
        style = {"color": color, "linewidth": 1.2, "alpha": 0.9 if len(runs) == 1 else 0.5}
        above.plot(position[:, 0], position[:, 1], label=label if k == 0 else None, **style)
        beside.plot(t, 1e3 * error, **style)
