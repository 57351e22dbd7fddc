"""The error-envelope figure: position and yaw error of several controllers against time, median and middle half."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter
from numpy.typing import ArrayLike, NDArray

from finssim.experiments.metrics import (
    EVALUATION_WINDOW,
    POSITION_TOLERANCE,
    YAW_TOLERANCE,
    pose_error,
    resample,
)
from finssim.files import atomic_write

__all__ = ["Envelope", "draw_envelopes", "error_envelope", "save_envelopes"]

Array = NDArray[np.float64]

QUARTILES = (0.25, 0.5, 0.75)

LONGEST_OF_THREE = 28
"""Letters of a label; where one is longer, the legend has two columns."""
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Okabe and Ito's palette: tells controllers apart for the colour-blind too."""


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


def draw_envelopes(envelopes: Mapping[str, Envelope], title: str = "") -> Figure:
    """The figure: position error above, yaw error below, a colour for each controller.

    The success limits are drawn dashed and the evaluation window is gray. Scales are logarithmic, since errors fall
    from metres to millimetres, and start at 1 mm and 0.01 deg, where smaller errors leave the figure.

    Args:
        envelopes: Legend label -> envelope.
        title: Written above, or left out when empty.
    """
    figure = Figure(figsize=(7.2, 5.6), layout="constrained")
    FigureCanvasAgg(figure)
    above, below = figure.subplots(2, 1, sharex=True)
    for color, (label, envelope) in zip(_cycle(len(envelopes)), envelopes.items(), strict=True):
        label = f"{label} ({envelope.trials} trial{'s' if envelope.trials != 1 else ''})"
        _band(above, envelope.t, envelope.position, color, label)
        _band(below, envelope.t, np.degrees(envelope.yaw), color, label)
    _scale(above, 1e-3, POSITION_TOLERANCE, f"success: {POSITION_TOLERANCE:.2f} m on each axis")
    _scale(below, 1e-2, math.degrees(YAW_TOLERANCE), f"success: {math.degrees(YAW_TOLERANCE):.0f}°")
    above.set_ylabel("position error [m]")
    below.set_ylabel("yaw error [°]")
    below.set_xlabel("time since the start of the hold [s]")
    below.set_xlim(0.0, max((float(e.t[-1]) for e in envelopes.values()), default=EVALUATION_WINDOW[1]))
    for axes in (above, below):
        axes.axvspan(*EVALUATION_WINDOW, color="0.92", zorder=0)
        axes.grid(True, which="major", color="0.85", linewidth=0.6)
        axes.spines[["top", "right"]].set_visible(False)
    handles, labels = above.get_legend_handles_labels()
    columns = 3 if max(map(len, labels), default=0) <= LONGEST_OF_THREE else 2
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, frameon=False, fontsize=9)
    if title:
        figure.suptitle(title, fontsize=11)
    return figure


def save_envelopes(envelopes: Mapping[str, Envelope], path: str | Path, title: str = "") -> Path:
    """Draws and writes the figure, whole or not at all; the suffix of `path` chooses the format.

    Raises:
        OutputError: The file cannot be written.
    """
    with atomic_write(path) as temporary:
        draw_envelopes(envelopes, title).savefig(temporary, dpi=150)
    return Path(path)


def _quartiles(x: Array) -> Array:
    """Quartiles over the first axis among the values there are; NaN where fewer than half are there."""
    enough = np.mean(np.isfinite(x), axis=0) >= 0.5
    quartiles = np.full((len(QUARTILES), x.shape[1]), np.nan)
    quartiles[:, enough] = np.nanquantile(x[:, enough], QUARTILES, axis=0)
    return quartiles


def _band(axes: Axes, t: Array, quartiles: Array, color: str, label: str) -> None:
    low, median, high = quartiles
    axes.fill_between(t, low, high, color=color, alpha=0.2, linewidth=0.0)
    axes.plot(t, median, color=color, linewidth=1.6, label=label)


def _scale(axes: Axes, bottom: float, limit: float, label: str) -> None:
    """Logarithmic from `bottom` to what is drawn, with the success limit in sight."""
    top = max((float(np.nanmax(line.get_ydata(), initial=limit)) for line in axes.lines), default=limit)
    axes.set_ylim(bottom, 2.0 * top)
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.axhline(limit, color="0.3", linestyle="--", linewidth=1.0)
    note = axes.annotate(
        label, (1.0, limit), xycoords=("axes fraction", "data"), xytext=(-4, 4), textcoords="offset points"
    )
    note.set(ha="right", fontsize=8, color="0.2")
    note.set_bbox({"facecolor": "white", "alpha": 0.7, "linewidth": 0.0, "pad": 1.0})


def _cycle(count: int) -> list[str]:
    return [COLORS[i % len(COLORS)] for i in range(count)]
