"""Pictures of a fit: estimates with their intervals, correlation, measured beside fitted, residuals."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from finssim.calibration.fit import Correlation, Curve, Estimate, Fit

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from matplotlib.gridspec import SubplotSpec

__all__ = [
    "BLUE",
    "GRAY",
    "ORANGE",
    "draw_correlation",
    "draw_curves",
    "draw_estimates",
    "fit_pictures",
    "new_figure",
    "png",
]

BLUE, ORANGE, GRAY = "#0072B2", "#D55E00", "0.6"
PER_FIGURE = 6
MOST_CURVES = 48
"""More are not drawn; the report says so."""
WIDE = 1.0
"""Half width of the axis of relative intervals."""


def fit_pictures(fit: Fit) -> dict[str, tuple[str, bytes]]:
    """File name -> what the picture shows, and the PNG; equal fits give equal pictures."""
    found: dict[str, tuple[str, Figure]] = {}
    estimates = draw_estimates(list(fit.estimates.values()))
    if estimates is not None:
        found["estimates.png"] = ("95 % intervals relative to the estimates", estimates)
    if fit.correlation is not None and len(fit.correlation.names) > 1:
        found["correlation.png"] = ("Correlation of the errors", draw_correlation(fit.correlation))
    for i, figure in enumerate(draw_curves(fit.curves), start=1):
        found[f"curves_{i}.png"] = ("Measured and fitted, and the residual", figure)
    return {name: (text, png(figure)) for name, (text, figure) in found.items()}


def draw_estimates(estimates: Sequence[Estimate]) -> Figure | None:
    """95 % intervals relative to their estimates, one row each; None where no interval is finite.

    Biases, which should be nothing, have no place in it.
    """
    shown = [
        e
        for e in estimates
        if e.estimate != 0.0
        and not e.name.endswith("bias")
        and all(map(math.isfinite, (e.estimate, *e.ci95)))
    ]
    if not shown:
        return None
    figure = new_figure(7.2, 0.9 + 0.27 * len(shown))
    axes = figure.subplots()
    rows = np.arange(len(shown))[::-1]
    for row, estimate in zip(rows, shown, strict=True):
        low, high = sorted(x / estimate.estimate - 1.0 for x in estimate.ci95)
        color = BLUE if estimate.identifiable else ORANGE
        axes.plot(np.clip([low, high], -WIDE, WIDE), [row, row], color=color, linewidth=3, alpha=0.6)
        axes.plot([0.0], [row], "o" if estimate.identifiable else "x", color=color, markersize=5)
        for end, mark in ((low, "<"), (high, ">")):
            if abs(end) > WIDE:
                axes.plot([math.copysign(WIDE, end)], [row], mark, color=color, markersize=6)
    axes.set_yticks(rows, [f"{e.name}  {e.estimate:.4g} {e.unit}" for e in shown], fontsize=8)
    axes.set_ylim(-0.8, len(shown) - 0.2)
    axes.axvline(0.0, color=GRAY, linewidth=0.8)
    reach = max(abs(x / e.estimate - 1.0) for e in shown for x in e.ci95)
    axes.set_xlim(-1.05 * min(reach, WIDE), 1.05 * min(reach, WIDE))
    axes.xaxis.set_major_formatter(lambda x, _: f"{100 * x:+.3g} %" if x else "0")
    axes.set_xlabel("95 % interval relative to the estimate; crosses: not identified")
    axes.grid(True, axis="x", color="0.9", linewidth=0.6)
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.tick_params(axis="y", length=0)
    return figure


def draw_correlation(correlation: Correlation) -> Figure:
    """The matrix, blue where errors go together, orange where they go against each other."""
    n = len(correlation.names)
    figure = new_figure(max(3.6, 1.9 + 0.36 * n), max(3.0, 1.3 + 0.36 * n))
    axes = figure.subplots()
    image = axes.imshow(correlation.matrix, vmin=-1.0, vmax=1.0, cmap="RdBu")
    axes.set_xticks(range(n), correlation.names, rotation=60, ha="right", fontsize=8)
    axes.set_yticks(range(n), correlation.names, fontsize=8)
    for i in range(n):
        for j in range(n):
            value = correlation.matrix[i, j]
            if i != j and abs(value) >= 0.3:
                color = "white" if abs(value) > 0.7 else "0.2"
                axes.text(j, i, f"{value:.1f}", ha="center", va="center", fontsize=7, color=color)
    axes.spines[:].set_visible(False)
    figure.colorbar(image, ax=axes, shrink=0.8, label="correlation of the errors")
    return figure


def draw_curves(curves: Sequence[Curve]) -> Iterator[Figure]:
    """Figures of up to six curves each: measured and fitted, and below them what is left over."""
    drawn = list(curves)[:MOST_CURVES]
    for start in range(0, len(drawn), PER_FIGURE):
        part = drawn[start : start + PER_FIGURE]
        columns = min(2, len(part))
        rows = math.ceil(len(part) / columns)
        width, height = (3.9 * columns if columns > 1 else 5.4), 2.9 * rows
        # A fixed layout: finding the best one takes longer than drawing.
        figure = new_figure(width, height, constrained=False)
        grid = figure.add_gridspec(
            rows,
            columns,
            left=0.75 / width,
            right=1.0 - 0.12 / width,
            bottom=0.5 / height,
            top=1.0 - 0.3 / height,
            hspace=0.35,
            wspace=0.27,
        )
        for i, curve in enumerate(part):
            _draw(figure, grid[i // columns, i % columns], curve)
        yield figure


def png(figure: Figure) -> bytes:
    """The same bytes for the same figure."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=120, metadata={"Software": None})
    return buffer.getvalue()


def _draw(figure: Figure, cell: SubplotSpec, curve: Curve) -> None:
    inner = cell.subgridspec(2, 1, height_ratios=(3, 1), hspace=0.12)
    above = figure.add_subplot(inner[0])
    below = figure.add_subplot(inner[1], sharex=above)
    above.tick_params(labelbottom=False)
    order = np.argsort(curve.x, kind="stable") if curve.kind == "scatter" else slice(None)
    x, measured, fitted = curve.x[order], curve.measured[order], curve.fitted[order]
    if curve.kind == "scatter":
        above.plot(x, measured, ".", color=GRAY, markersize=2.5, label="measured", rasterized=True)
        below.plot(x, measured - fitted, ".", color=BLUE, markersize=2.0, rasterized=True)
    else:
        above.plot(x, measured, color=GRAY, linewidth=1.6, label="measured")
        below.plot(x, measured - fitted, color=BLUE, linewidth=0.8)
    above.plot(x, fitted, color=ORANGE, linewidth=1.2, label="fitted")
    below.axhline(0.0, color=GRAY, linewidth=0.6)
    above.set_title(curve.title, fontsize=9)
    above.set_ylabel(curve.y_label, fontsize=8)
    below.set_ylabel("residual", fontsize=8)
    below.set_xlabel(curve.x_label, fontsize=8)
    above.legend(fontsize=7, frameon=False)
    for axes in (above, below):
        axes.tick_params(labelsize=7)
        axes.grid(True, color="0.92", linewidth=0.5)
        axes.spines[["top", "right"]].set_visible(False)


def new_figure(width: float, height: float, constrained: bool = True) -> Figure:
    """An empty figure.

    Args:
        width: [inch]
        height: [inch]
        constrained: Whether the layout makes room for labels.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained" if constrained else None)
    FigureCanvasAgg(figure)
    return figure
