"""Figures of one style, and the one that several experiments draw: errors of controllers against time."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from finssim.experiments.metrics import (
    EVALUATION_WINDOW,
    POSITION_TOLERANCE,
    YAW_TOLERANCE,
    pose_error,
    resample,
)
from finssim.files import atomic_write

__all__ = [
    "COLORS",
    "clean",
    "draw_envelopes",
    "error_envelope",
    "legend_below",
    "new_figure",
    "png",
    "save_figure",
]

Array = NDArray[np.float64]

QUARTILES = (0.25, 0.5, 0.75)

LONGEST_OF_THREE = 28
"""Letters of a label; where one is longer, the legend has two columns."""
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Okabe and Ito's palette: tells controllers apart for the colour-blind too."""
DPI = 130


def new_figure(width: float, height: float, title: str = "", layout: Any = "constrained") -> Any:
    """An empty Matplotlib figure [inch], which is imported here, as it is slow to."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout=layout)
    FigureCanvasAgg(figure)
    if title:
        figure.suptitle(title, fontsize=11)
    return figure


def clean(*panels: Any) -> None:
    """Two spines, small ticks and a light grid."""
    for axes in panels:
        axes.tick_params(labelsize=8)
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(True, which="major", color="0.87", linewidth=0.6)
        axes.set_axisbelow(True)


def legend_below(figure: Any, axes: Any, columns: int) -> None:
    """What is labelled in one of the panels, below them all."""
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, frameon=False, fontsize=9)


def save_figure(figure: Any, path: Path) -> Path:
    """Write it, whole or not at all; the suffix of the path chooses the format.

    Raises:
        OutputError: The file cannot be written.
    """
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=DPI)
    return path


def png(figure: Any) -> bytes:
    """The same for a report."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    return buffer.getvalue()


@dataclass(frozen=True, kw_only=True)
class Envelope:
    """Lower quartile, median and upper quartile over the trials of one controller, at each time."""

    t: Array
    """Time since the start of the hold [s], shape (G,)."""
    position: Array
    """Distance to the goal [m], shape (3, G)."""
    yaw: Array
    """Magnitude of the yaw error [rad], shape (3, G)."""
    trials: int


def error_envelope(trials: Sequence[tuple[ArrayLike, ArrayLike, ArrayLike, ArrayLike]]) -> Envelope:
    """Pointwise quartiles of the errors of one controller's trials, on the 10 Hz evaluation grid.

    Args:
        trials: For each trial, what `measure_trial` takes: t [s], position [m], yaw [rad], goal [m, rad], world frame.

    Returns:
        The envelope, as long as the shortest grid; NaN where more than half of the trials have no value.

    Raises:
        ValueError: There is no trial.
    """
    if not trials:
        raise ValueError("an envelope needs at least one trial")
    grids, distances, turns = [], [], []
    for t, position, yaw, goal in trials:
        grid, position, yaw = resample(t, position, yaw)
        error, yaw_error = pose_error(position, yaw, np.asarray(goal, dtype=np.float64))
        grids.append(grid)
        distances.append(np.linalg.norm(error, axis=-1))
        turns.append(np.abs(yaw_error))
    length = min(map(len, grids))
    position, yaw = (_quartiles(np.stack([x[:length] for x in each])) for each in (distances, turns))
    return Envelope(t=grids[0][:length], position=position, yaw=yaw, trials=len(trials))


def draw_envelopes(envelopes: Mapping[str, Envelope], title: str = "") -> Any:
    """The figure: position error above, yaw error below, a colour for each controller.

    The success limits are drawn dashed and the evaluation window is gray. Scales are logarithmic, since errors fall
    from metres to millimetres, and start at 1 mm and 0.01 deg, where smaller errors leave the figure.

    Args:
        envelopes: Legend label -> envelope.
        title: Written above, or left out when empty.
    """
    figure = new_figure(7.2, 5.6, title)
    above, below = figure.subplots(2, 1, sharex=True)
    clean(above, below)
    for i, (label, envelope) in enumerate(envelopes.items()):
        label = f"{label} ({envelope.trials} trial{'s' if envelope.trials != 1 else ''})"
        for axes, (low, median, high) in ((above, envelope.position), (below, np.degrees(envelope.yaw))):
            color = COLORS[i % len(COLORS)]
            axes.fill_between(envelope.t, low, high, color=color, alpha=0.2, linewidth=0.0)
            axes.plot(envelope.t, median, color=color, linewidth=1.6, label=label)
    _scale(above, 1e-3, POSITION_TOLERANCE, f"success: {POSITION_TOLERANCE:.2f} m on each axis")
    _scale(below, 1e-2, math.degrees(YAW_TOLERANCE), f"success: {math.degrees(YAW_TOLERANCE):.0f}°")
    above.set_ylabel("position error [m]")
    end = max((float(e.t[-1]) for e in envelopes.values()), default=EVALUATION_WINDOW[1])
    below.set(ylabel="yaw error [°]", xlabel="time since the start of the hold [s]", xlim=(0.0, end))
    labels = above.get_legend_handles_labels()[1]
    legend_below(figure, above, 3 if max(map(len, labels), default=0) <= LONGEST_OF_THREE else 2)
    return figure


def _quartiles(x: Array) -> Array:
    """Quartiles over the first axis among the values there are; NaN where fewer than half are there."""
    enough = np.mean(np.isfinite(x), axis=0) >= 0.5
    quartiles = np.full((len(QUARTILES), x.shape[1]), np.nan)
    quartiles[:, enough] = np.nanquantile(x[:, enough], QUARTILES, axis=0)
    return quartiles


def _scale(axes: Any, bottom: float, limit: float, label: str) -> None:
    """Logarithmic from `bottom` to what is drawn, with the success limit in sight."""
    top = max((float(np.nanmax(line.get_ydata(), initial=limit)) for line in axes.lines), default=limit)
    axes.set_ylim(bottom, 2.0 * top)
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.axvspan(*EVALUATION_WINDOW, color="0.92", zorder=0)
    axes.axhline(limit, color="0.3", linestyle="--", linewidth=1.0)
    note = axes.annotate(
        label, (1.0, limit), xycoords=("axes fraction", "data"), xytext=(-4, 4), textcoords="offset points"
    )
    note.set(ha="right", fontsize=8, color="0.2")
    note.set_bbox({"facecolor": "white", "alpha": 0.7, "linewidth": 0.0, "pad": 1.0})
