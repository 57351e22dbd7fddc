"""The spread of step responses over drawn vehicles, as a picture."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

__all__ = ["draw_spread"]

Array = NDArray[np.float64]

BLUE, BLACK = "#0072B2", "0.1"
LABELS = {
    "surge": "surge speed [m/s]",
    "sway": "sway speed [m/s]",
    "heave": "heave speed, down [m/s]",
    "yaw": "yaw rate [rad/s]",
}


def draw_spread(
    t: Array, bands: Mapping[str, Array], lines: Mapping[str, Array], nominal: Mapping[str, Array], title: str
) -> Figure:
    """A panel for each axis: 5 to 95 % and the middle half of the drawn vehicles, some of them, and the file's own.

    Args:
        t: Times [s], (T,).
        bands: Axis -> 5, 25, 50, 75 and 95 % of the speed at each time, (5, T).
        lines: Axis -> speeds of a few of the vehicles, (n, T).
        nominal: Axis -> speed of the vehicle of the file, (T,).
        title: Written above.
    """
    figure = Figure(figsize=(8.4, 6.0), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, (axis, band) in zip(figure.subplots(2, 2, sharex=True).flat, bands.items(), strict=True):
        axes.fill_between(t, band[0], band[4], color=BLUE, alpha=0.18, linewidth=0.0, label="5 to 95 %")
        axes.fill_between(t, band[1], band[3], color=BLUE, alpha=0.30, linewidth=0.0, label="25 to 75 %")
        for k, line in enumerate(lines[axis]):
            axes.plot(t, line, color=BLUE, linewidth=0.5, alpha=0.6, label=None if k else "some of them")
        axes.plot(t, nominal[axis], color=BLACK, linewidth=1.8, label="as the file has it")
        axes.set_ylabel(LABELS[axis])
        axes.grid(True, color="0.88", linewidth=0.6)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
        axes.set_xlim(0.0, float(t[-1]))
    for axes in figure.axes[2:]:
        axes.set_xlabel("time since the step [s]")
    figure.align_ylabels()
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    figure.suptitle(title, fontsize=10)
    return figure
