"""One figure of a comparison: each measure with its interval, who beats whom, and the learning curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from finssim.experiments.compare.runs import Group
from finssim.experiments.compare.statistics import interquartile_mean, with_bootstrap
from finssim.experiments.envelope import COLORS
from finssim.files import atomic_write

__all__ = ["CURVES", "curve_of", "draw_comparison"]

CURVES = ("evaluated_success", "held", "mean_return")
"""Columns of a training's curves, the first two that every run has are drawn."""
POINTS = 60
"""Of a curve."""
CURVE_RESAMPLES = 200


def draw_comparison(groups: Sequence[Group], result: Mapping[str, Any], path: Path) -> None:
    """Write the figure."""
    curves = [name for name in CURVES if all(name in run.curves for group in groups for run in group.runs)][
        :2
    ]
    measures = list(result["measures"])
    columns = max(len(measures), len(curves) + 1)
    height = 0.45 * len(groups) + 1.2
    figure = Figure(figsize=(3.2 * columns, height + 3.4), layout="constrained")
    grid = figure.add_gridspec(2, columns, height_ratios=(height, 3.2))
    for k, name in enumerate(measures):
        _intervals(figure.add_subplot(grid[0, k]), groups, result, name, labels=k == 0)
    for k, name in enumerate(curves):
        _curves(figure.add_subplot(grid[1, k]), groups, name)
    if len(groups) > 1:
        _matrix(figure.add_subplot(grid[1, len(curves)]), groups, result, measures[0])
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=130)


def _intervals(
    axes: Axes, groups: Sequence[Group], result: Mapping[str, Any], name: str, *, labels: bool
) -> None:
    for i, group in enumerate(groups):
        found = result["groups"][group.name]["measures"][name]
        y, color = len(groups) - 1 - i, COLORS[i % len(COLORS)]
        low, high = found["ci95"]
        if found["value"] is None:
            axes.annotate(
                "not reached", (0.02, y), xycoords=("axes fraction", "data"), fontsize=8, color=color
            )
            continue
        if low is not None and high is not None:
            axes.barh(y, high - low, left=low, height=0.5, color=color, alpha=0.35)
        axes.plot([found["value"]] * 2, [y - 0.25, y + 0.25], color=color, linewidth=2.5)
    axes.set_yticks(range(len(groups)), [g.name for g in reversed(groups)] if labels else [""] * len(groups))
    axes.set_ylim(-0.6, len(groups) - 0.4)
    axes.set_title(name, fontsize=10)
    _plain(axes)


def curve_of(group: Group, name: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Steps (n,) as far as every run of a group came, and low, middle and high of a column there, (3, n).

    The middle is the interquartile mean over the runs, low and high are where a bootstrap over them puts it.
    """
    last = min(float(run.curves["steps"][-1]) for run in group.runs)
    steps = np.linspace(last / POINTS, last, POINTS)
    rows = np.array([np.interp(steps, run.curves["steps"], run.curves[name]) for run in group.runs])
    band = np.empty((3, POINTS))
    for k in range(POINTS):
        found = with_bootstrap([rows[:, k : k + 1]], interquartile_mean, CURVE_RESAMPLES)
        assert found is not None  # a group has runs
        band[:, k] = found.low, found.value, found.high
    return steps, band


def _curves(axes: Axes, groups: Sequence[Group], name: str) -> None:
    for i, group in enumerate(groups):
        steps, (low, middle, high) = curve_of(group, name)
        color = COLORS[i % len(COLORS)]
        axes.fill_between(steps / 1e6, low, high, color=color, alpha=0.2, linewidth=0.0)
        axes.plot(steps / 1e6, middle, color=color, label=group.name)
    axes.set_xlabel("control steps, all worlds [million]")
    axes.set_title(name, fontsize=10)
    axes.legend(frameon=False, fontsize=8)
    _plain(axes)


def _matrix(axes: Axes, groups: Sequence[Group], result: Mapping[str, Any], name: str) -> None:
    n = len(groups)
    table = np.full((n, n), np.nan)
    for pair in result["pairs"]:
        if pair["measure"] == name:
            i, j = (next(k for k, g in enumerate(groups) if g.name == pair[side]) for side in ("a", "b"))
            table[i, j], table[j, i] = pair["probability"], 1.0 - pair["probability"]
    axes.imshow(table, vmin=0.0, vmax=1.0, cmap="PuOr")
    for (i, j), value in np.ndenumerate(table):
        if np.isfinite(value):
            axes.annotate(f"{value:.2f}", (j, i), ha="center", va="center", fontsize=8)
    axes.set_xticks(range(n), [g.name for g in groups], fontsize=8, rotation=20)
    axes.set_yticks(range(n), [g.name for g in groups], fontsize=8)
    axes.set_title(f"chance that the row is better:\n{name}", fontsize=10)


def _plain(axes: Axes) -> None:
    axes.tick_params(labelsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.25)
