"""The picture of a thruster's fit: thrust, what the curve leaves, and what pulse and voltage predict."""

from __future__ import annotations

from typing import TYPE_CHECKING

from finssim.calibration.errors import CalibrationError
from finssim.calibration.fit import Curve, Fit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["draw_thruster"]

BLUE, GRAY = "#0072B2", "0.55"
PULSE = ": speed from pulse"


def draw_thruster(fit: Fit, target: str | None = None) -> Figure:
    """Measured and fitted values of one thruster or group.

    Args:
        fit: Of `fit_thruster`.
        target: Its name in the fit, such as `T200` or `CC`; the first where not given.

    Raises:
        CalibrationError: The fit holds no such target.
    """
    from matplotlib import colormaps  # Matplotlib is slow to import
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    names = list(dict.fromkeys(curve.title.partition(":")[0] for curve in fit.curves))
    chosen = target or (names[0] if names else "")
    curves = {c.title.removeprefix(chosen): c for c in fit.curves if c.title.startswith(f"{chosen}:")}
    if not curves:
        raise CalibrationError(f"the fit holds no '{chosen}': it has {', '.join(names) or 'no curves'}")
    speeds = [curve for title, curve in curves.items() if title.startswith(PULSE)]
    shown = [title for title in (": thrust", ": residual") if title in curves]
    panels = len(shown) + bool(speeds)
    figure = Figure(figsize=(3.6 * panels, 3.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, panels, squeeze=False)[0]
    for ax, title in zip(axes, shown, strict=False):
        curve = curves[title]
        ax.plot(curve.x, curve.measured, ".", color=GRAY, markersize=4, label="measured")
        ax.plot(curve.x, curve.fitted, color=BLUE, linewidth=1.4, label="T = c± ω|ω|")
        _label(ax, curve, "thrust" if title == ": thrust" else "what the curve leaves")
    if ": thrust" in curves:
        axes[0].legend(frameon=False, fontsize=8)
    for i, curve in enumerate(speeds):
        colour = colormaps["viridis"](0.9 * i / max(len(speeds) - 1, 1))
        voltage = curve.title.rpartition(" at ")[2] if " at " in curve.title else "measured"
        axes[-1].plot(curve.x, curve.measured, ".", color=colour, markersize=2.5, label=voltage)
        axes[-1].plot(curve.x, curve.fitted, color=colour, linewidth=1.0)
    if speeds:
        _label(axes[-1], speeds[0], "speed from pulse (lines), measured (dots)")
        axes[-1].legend(frameon=False, fontsize=7, markerscale=3)
    return figure


def _label(axes, curve: Curve, title: str) -> None:  # type: ignore[no-untyped-def]
    axes.set_xlabel(curve.x_label)
    axes.set_ylabel(curve.y_label)
    axes.set_title(title, fontsize=9)
    axes.grid(True, color="0.9", linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)
