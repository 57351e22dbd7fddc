"""Common style of figures, and figures of several experiments: errors against time, paths, episodes."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.core.files import atomic_write
from finssim.core.palette import COLORS
from finssim.evaluation.metrics import (
    EVALUATION_WINDOW,
    POSITION_TOLERANCE,
    YAW_TOLERANCE,
    pose_error,
    resample,
)
from finssim.evaluation.trials import GoalTrial

Array = NDArray[np.float64]

QUARTILES = (0.25, 0.5, 0.75)

LONGEST_OF_THREE = 28
"""Length of a label in characters above which the legend has two columns."""
DPI = 130


ENVELOPE = (
    "Position error [m] and yaw error [°] against time [s]: median and quartiles of the trials; dashed: the limits "
    "of success; gray: the evaluation window."
)
TRACKS = "Paths from above [m] beside their distance to the reference [m] against time [s]."
"""Captions of the two figures of the paper's tasks."""


def new_figure(width: float, height: float, title: str = "", layout: Any = "constrained") -> Any:
    """Return an empty Matplotlib figure of this size [inch]; Matplotlib is imported here because it is slow
    to import."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout=layout)
    FigureCanvasAgg(figure)
    if title:
        figure.suptitle(title, fontsize=11)
    return figure


def clean(*panels: Any) -> None:
    """Set two spines, small ticks and a light grid."""
    for axes in panels:
        axes.tick_params(labelsize=8)
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(True, which="major", color="0.87", linewidth=0.6)
        axes.set_axisbelow(True)


def legend_below(figure: Any, axes: Any, columns: int) -> None:
    """Draw the legend of one panel below all panels."""
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, frameon=False, fontsize=9)


def save_figure(figure: Any, path: Path) -> Path:
    """Write a figure, completely or not at all; the suffix of the path selects the format.

    Raises:
        OutputError: The file cannot be written.
    """
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=DPI)
    return path


def png(figure: Any) -> bytes:
    """Return the bytes of a figure for a report."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    return buffer.getvalue()


def error_envelope(trials: Sequence[GoalTrial]) -> tuple[Array, Array, Array]:
    """Return pointwise quartiles of the errors of one controller's trials, on the 10 Hz evaluation grid.

    Args:
        trials: Trials of station keeping.

    Returns:
        Time since the start of the hold [s], shape (G,), as long as the shortest grid; lower quartile, median
        and upper quartile, shape (3, G), of the distance to the goal [m] and of the magnitude of the yaw
        error [rad]: NaN if more than half of the trials have no value.

    Raises:
        ValueError: There are no trials.
    """
    if not trials:
        raise ValueError("an envelope needs at least one trial")
    grids, distances, turns = [], [], []
    for trial in trials:
        grid, position, yaw = resample(trial.motion.t, trial.motion.position, trial.motion.yaw)
        error, yaw_error = pose_error(position, yaw, trial.goal)
        grids.append(grid)
        distances.append(np.linalg.norm(error, axis=-1))
        turns.append(np.abs(yaw_error))
    length = min(map(len, grids))
    position, yaw = (_quartiles(np.stack([x[:length] for x in each])) for each in (distances, turns))
    return grids[0][:length], position, yaw


def draw_envelopes(runs: Mapping[str, Sequence[GoalTrial]], title: str = "") -> Any:
    """Draw the position error above and the yaw error below, with a colour for each controller.

    The success limits are dashed and the evaluation window is gray. Scales are logarithmic, since errors
    decrease from metres to millimetres, and start at 1 mm and 0.01 deg; smaller errors are not shown.

    Args:
        runs: Legend label -> trials of station keeping, of one controller.
        title: Title of the figure; omitted if empty.
    """
    figure = new_figure(7.2, 5.6, title)
    above, below = figure.subplots(2, 1, sharex=True)
    clean(above, below)
    ends = []
    for i, (label, trials) in enumerate(runs.items()):
        t, position, yaw = error_envelope(trials)
        ends.append(float(t[-1]))
        label = f"{label} ({len(trials)} trial{'s' if len(trials) != 1 else ''})"
        for axes, (low, median, high) in ((above, position), (below, np.degrees(yaw))):
            color = COLORS[i % len(COLORS)]
            axes.fill_between(t, low, high, color=color, alpha=0.2, linewidth=0.0)
            axes.plot(t, median, color=color, linewidth=1.6, label=label)
    _scale(above, 1e-3, POSITION_TOLERANCE, f"success: {POSITION_TOLERANCE:.2f} m on each axis")
    _scale(below, 1e-2, math.degrees(YAW_TOLERANCE), f"success: {math.degrees(YAW_TOLERANCE):.0f}°")
    above.set_ylabel("position error [m]")
    end = max(ends, default=EVALUATION_WINDOW[1])
    below.set(ylabel="yaw error [°]", xlabel="time since the start of the hold [s]", xlim=(0.0, end))
    labels = above.get_legend_handles_labels()[1]
    legend_below(figure, above, 3 if max(map(len, labels), default=0) <= LONGEST_OF_THREE else 2)
    return figure


def _quartiles(x: Array) -> Array:
    """Return quartiles over the first axis among the finite values; NaN if fewer than half are finite."""
    enough = np.mean(np.isfinite(x), axis=0) >= 0.5
    quartiles = np.full((len(QUARTILES), x.shape[1]), np.nan)
    quartiles[:, enough] = np.nanquantile(x[:, enough], QUARTILES, axis=0)
    return quartiles


def _scale(axes: Any, bottom: float, limit: float, label: str) -> None:
    """Set a logarithmic scale from `bottom` to the largest value, with the success limit visible."""
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


def draw_tracking(runs: Mapping[str, Sequence[GoalTrial]], title: str = "") -> Any:
    """Draw a row for each trajectory: its path from above on the left, distances to the reference on the right.

    Args:
        runs: Legend label -> trials; each controller's trials of one trajectory are drawn in one colour.
        title: Title of the figure; omitted if empty.
    """
    guides = {trial.name: trial.guide for trials in runs.values() for trial in trials}
    figure = new_figure(9.0, 2.4 * len(guides) + 0.8, title)
    rows = figure.subplots(len(guides), 2, squeeze=False, width_ratios=(1.0, 1.2))
    for (above, beside), (name, guide) in zip(rows, guides.items(), strict=True):
        way = guide.at(np.linspace(0.0, guide.duration, 1001)).position
        above.plot(way[:, 0], way[:, 1], color="0.2", linewidth=1.0, linestyle="--", label="reference")
        for i, (label, trials) in enumerate(runs.items()):
            motions = [trial.motion for trial in trials if trial.name == name]
            for k, motion in enumerate(motions):
                during = (motion.t >= 0.0) & (motion.t <= guide.duration + 1e-6)
                t, position = motion.t[during], motion.position[during]
                error = np.linalg.norm(position - guide.at(t).position, axis=-1)
                style = {"color": COLORS[i % 6], "linewidth": 1.2, "alpha": 0.5 if motions[1:] else 0.9}
                above.plot(position[:, 0], position[:, 1], label=None if k else label, **style)
                beside.plot(t, 1e3 * error, **style)
        above.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
        above.set_title(name, fontsize=10, loc="left")
        beside.set(xlabel="time [s]", ylabel="distance [mm]", xlim=(0.0, guide.duration))
        beside.set_ylim(bottom=0.0)
        clean(above, beside)
    legend_below(figure, rows[0][0], 4)
    return figure
