"""Pictures of a lens calibration: where corners were seen, how well the picture is known, what is left over."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import numpy as np

from finssim.calibration.vision.camera.camera_fit import CameraFit
from finssim.calibration.vision.camera.lens_reach import COLUMNS, ROWS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["camera_pictures"]

BLUE, ORANGE, GRAY = "#0072B2", "#D55E00", "0.6"
ARROW_SHARE = 0.06
"""Length of the 95th percentile of the residuals, in widths of the image."""


def camera_pictures(fit: CameraFit) -> dict[str, tuple[str, bytes]]:
    """File name -> what the picture shows, and the PNG."""
    return {
        "coverage.png": (
            "Where corners were seen, and how well pixels are known there",
            _png(_draw_coverage(fit)),
        ),
        "residuals.png": ("Corners less what the lens predicts, enlarged", _png(_draw_residuals(fit))),
        "views.png": ("Residual of every picture", _png(_draw_views(fit))),
    }


def _frame(axes: Axes, fit: CameraFit) -> None:
    axes.set_xlim(-0.5, fit.lens.width - 0.5)
    axes.set_ylim(fit.lens.height - 0.5, -0.5)
    axes.set_aspect("equal")
    axes.set_xlabel("u [px]")
    axes.set_ylabel("v [px]")


def _draw_coverage(fit: CameraFit) -> Figure:
    from matplotlib.colors import LogNorm

    figure = _figure(7.4, 7.4 * fit.lens.height / fit.lens.width + 0.3)
    axes = figure.subplots()
    error = np.ma.masked_invalid(fit.reach.error95)
    extent = (-0.5, fit.lens.width - 0.5, fit.lens.height - 0.5, -0.5)
    shown = axes.imshow(
        np.clip(error, 0.03, 30.0), extent=extent, cmap="viridis_r", norm=LogNorm(0.03, 30.0), alpha=0.75
    )
    for i in range(ROWS):
        for j in range(COLUMNS):
            if not error.mask.any() or not error.mask[i, j]:
                u, v = (j + 0.5) / COLUMNS * fit.lens.width, (i + 0.5) / ROWS * fit.lens.height
                axes.text(u, v, f"{error[i, j]:.1f}", ha="center", va="center", fontsize=7, color="0.25")
    for view in fit.views:
        mark = {"color": ORANGE, "marker": "x"} if view.left_out else {"color": "black", "marker": "."}
        axes.plot(*view.pixels.T, linestyle="", markersize=2.5, **mark)
    _frame(axes, fit)
    axes.set_title("corners (crosses: left out) and 95 % uncertainty of a pixel [px]", fontsize=9)
    figure.colorbar(shown, ax=axes, shrink=0.8, label="px")
    return figure


def _draw_residuals(fit: CameraFit) -> Figure:
    pixels = np.concatenate([view.pixels for view in fit.used])
    residuals = np.concatenate([view.residuals for view in fit.used])
    size = np.percentile(np.linalg.norm(residuals, axis=1), 95.0)
    figure = _figure(7.4, 4.0)
    field, cloud = figure.subplots(1, 2, width_ratios=(1.9, 1.0))
    factor = ARROW_SHARE * fit.lens.width / max(size, 1e-9)
    field.quiver(
        *pixels.T, *(factor * residuals.T), color=BLUE, angles="xy", scale_units="xy", scale=1.0, width=0.0022
    )
    _frame(field, fit)
    field.set_title(f"residuals, {factor:.0f} times enlarged", fontsize=9)
    cloud.plot(*residuals.T, ".", color=BLUE, markersize=2.5)
    limit = 1.1 * float(np.abs(residuals).max())
    cloud.set_xlim(-limit, limit)
    cloud.set_ylim(limit, -limit)
    cloud.set_aspect("equal")
    cloud.axhline(0.0, color=GRAY, linewidth=0.6)
    cloud.axvline(0.0, color=GRAY, linewidth=0.6)
    cloud.set_xlabel("along u [px]")
    cloud.set_ylabel("along v [px]")
    cloud.set_title(f"rms {fit.rms:.3f} px", fontsize=9)
    return figure


def _draw_views(fit: CameraFit) -> Figure:
    figure = _figure(7.4, 1.0 + 0.2 * len(fit.views))
    axes = figure.subplots()
    rows = np.arange(len(fit.views))[::-1]
    axes.barh(
        rows,
        [view.rms for view in fit.views],
        color=[ORANGE if view.left_out else BLUE for view in fit.views],
        height=0.7,
    )
    axes.set_yticks(rows, [view.name for view in fit.views], fontsize=7)
    axes.axvline(fit.held_out_rms, color="black", linewidth=0.8, linestyle="--", label="views held out")
    axes.set_xlabel("rms of a corner's distance [px]; orange: left out")
    axes.legend(fontsize=7, frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    return figure


def _figure(width: float, height: float) -> Figure:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=120, metadata={"Software": None})
    return buffer.getvalue()
