"""One figure of a comparison: each measure with its interval, who beats whom, and the learning curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from finssim.experiments.compare.runs import Group, Run
from finssim.experiments.compare.statistics import interquartile_mean, with_bootstrap
from finssim.experiments.envelope import COLORS
from finssim.files import atomic_write

__all__ = ["CURVES", "curve_of", "draw_comparison"]

CURVES = {
    "evaluation_success": "success, evaluated",
    "evaluation_return": "return, evaluated",
    "held": "share that held at the end",
    "mean_return": "return in training",
}
"""Columns of a training's curves and what they are; the first two that every run has are drawn."""
TITLES = {
    "e_p_m": "position error [m]",
    "e_psi_deg": "heading error [°]",
    "t_s_s": "settling time [s]",
    "horizontal_rmse_m": "horizontal error, rms [m]",
    "vertical_rmse_m": "vertical error, rms [m]",
    "p95_m": "95th percentile of the error [m]",
}
"""What measures are; others are called by their names."""
DARK = 0.3
"""A chance so far from a half stands on a dark square."""
POINTS = 60
"""Of a curve."""
CURVE_RESAMPLES = 200


def draw_comparison(groups: Sequence[Group], result: Mapping[str, Any], path: Path) -> None:
    """Write the figure."""
    runs = [run for group in groups for run in group.runs]
    curves = [name for name in CURVES if all(_drawable(run, name) for run in runs)][:2]
    measures, pairs = list(result["measures"]), len(groups) > 1
    height = 0.42 * len(groups) + 0.9
    columns = max(len(measures), len(curves) + pairs)
    figure = Figure(figsize=(2.4 + 2.6 * columns, height + 3.4), layout="constrained")
    above, below = figure.subfigures(2, 1, squeeze=False, height_ratios=(height, 3.4))[:, 0]
    above.suptitle("interquartile means, with 95 % intervals over the seeds", fontsize=9)
    for k, axes in enumerate(_row(above, len(measures))):
        _intervals(axes, groups, result, measures[k], labels=k == 0)
    panels = _row(below, len(curves) + pairs)
    for k, name in enumerate(curves):
        _curves(panels[k], groups, name, legend=k == 0)
    if pairs:
        _matrix(panels[-1], groups, result, measures[0])
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=130)


def _row(figure: Any, n: int) -> list[Axes]:
    return list(figure.subplots(1, n, squeeze=False)[0]) if n else []


def _intervals(
    axes: Axes, groups: Sequence[Group], result: Mapping[str, Any], name: str, *, labels: bool
) -> None:
    for i, group in enumerate(groups):
        found = result["groups"][group.name]["measures"][name]
        y, color = len(groups) - 1 - i, COLORS[i % len(COLORS)]
        low, high = found["ci95"]
        if found["value"] is None:
            axes.annotate(
                "not reached",
                (0.04, y),
                xycoords=("axes fraction", "data"),
                fontsize=8,
                color=color,
                va="center",
            )
            continue
        if low is not None and high is not None:
            axes.barh(y, high - low, left=low, height=0.5, color=color, alpha=0.35)
        axes.plot([found["value"]] * 2, [y - 0.25, y + 0.25], color=color, linewidth=2.5)
    axes.set_yticks(range(len(groups)), [g.name for g in reversed(groups)] if labels else [""] * len(groups))
    axes.set_ylim(-0.6, len(groups) - 0.4)
    axes.use_sticky_edges = False  # an interval that ends at the least value is not to lie on the axis
    axes.margins(x=0.08)
    if name == "success":
        axes.set_xlim(-0.04, 1.04)
    axes.set_title(TITLES.get(name, name), fontsize=10)
    axes.set_xlabel("less is better" if result["measures"][name] else "more is better", fontsize=8)
    _plain(axes)


def _drawable(run: Run, name: str) -> bool:
    return bool(np.isfinite(run.curves.get(name, np.empty(0))).any())


def curve_of(group: Group, name: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Steps (n,) as far as every run of a group came, and low, middle and high of a column there, (3, n).

    The middle is the interquartile mean over the runs, low and high are where a bootstrap over them puts it.
    """
    last = min(float(run.curves["steps"][-1]) for run in group.runs)
    steps = np.linspace(last / POINTS, last, POINTS)
    rows = np.array([_at(steps, run, name) for run in group.runs])
    band = np.empty((3, POINTS))
    for k in range(POINTS):
        found = with_bootstrap([rows[:, k : k + 1]], interquartile_mean, CURVE_RESAMPLES)
        assert found is not None  # a group has runs
        band[:, k] = found.low, found.value, found.high
    return steps, band


def _at(steps: NDArray[np.float64], run: Run, name: str) -> NDArray[np.float64]:
    """A column between its rows; one without a number, as before the first episode ended, is left out."""
    known = np.isfinite(run.curves[name])
    return np.interp(steps, run.curves["steps"][known], run.curves[name][known])


def _curves(axes: Axes, groups: Sequence[Group], name: str, *, legend: bool) -> None:
    for i, group in enumerate(groups):
        steps, (low, middle, high) = curve_of(group, name)
        color = COLORS[i % len(COLORS)]
        axes.fill_between(steps / 1e6, low, high, color=color, alpha=0.2, linewidth=0.0)
        axes.plot(steps / 1e6, middle, color=color, label=group.name)
    axes.set_xlabel("control steps [million]", fontsize=8)
    axes.set_title(CURVES[name], fontsize=10)
    if legend:
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
            color = "white" if abs(value - 0.5) > DARK else "black"
            axes.annotate(f"{value:.2f}", (j, i), ha="center", va="center", fontsize=9, color=color)
    axes.set_xticks(
        range(n), [g.name for g in groups], fontsize=8, rotation=30, ha="right", rotation_mode="anchor"
    )
    axes.set_yticks(range(n), [g.name for g in groups], fontsize=8)
    axes.set_title(f"chance that the row is better:\n{TITLES.get(name, name)}", fontsize=10)


def _plain(axes: Axes) -> None:
    axes.tick_params(labelsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.25)
