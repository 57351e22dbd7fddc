"""A picture of a vehicle's thruster layout."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from finssim.vehicles.vehicle import Vehicle

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["draw_vehicle"]

ARROW = 0.16
"""Length of a thrust arrow, relative to the vehicle's."""


def draw_vehicle(vehicle: Vehicle, picture: Path) -> None:
    """Save a picture of the thruster layout, from above and from the left, arrows along positive thrust.

    Args:
        vehicle: Any vehicle.
        picture: File to write; its suffix chooses the format.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 5.2), layout="constrained")
    above, left = figure.subplots(1, 2)
    # Forward points up the page from above and to the left from the left side: both axes across run backwards.
    _draw_view(above, vehicle, across=1, up=0)
    above.set(title="from above", xlabel="y, left [m]", ylabel="x, forward [m]")
    _draw_view(left, vehicle, across=0, up=2)
    left.set(title="from the left", xlabel="x, forward [m]", ylabel="z, up [m]")
    handles, labels = above.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
    figure.suptitle(vehicle.title)
    figure.savefig(picture, dpi=130)


def _envelope(vehicle: Vehicle) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lower and upper corner: of the hull's mesh, or of the size placed about the centre of buoyancy."""
    if vehicle.hull is not None:
        vertices, _ = vehicle.hull_mesh()
        return vertices.min(axis=0), vertices.max(axis=0)
    half = vehicle.body.size / 2.0
    return vehicle.body.center_of_buoyancy - half, vehicle.body.center_of_buoyancy + half


def _draw_view(axes: Axes, vehicle: Vehicle, across: int, up: int) -> None:
    """One projection, seen along the axis that is neither `across` nor `up`; `across` grows to the left."""
    from matplotlib.patches import Rectangle
    from matplotlib.ticker import MaxNLocator

    lower, upper = _envelope(vehicle)
    size = upper - lower
    axes.add_patch(
        Rectangle((lower[across], lower[up]), size[across], size[up], fc="0.95", ec="0.6", label="envelope")
    )
    length = ARROW * float(max(size[across], size[up]))
    named: Counter[tuple[int, int]] = Counter()
    for name, thruster in vehicle.thrusters.items():
        x, y = float(thruster.position[across]), float(thruster.position[up])
        dx, dy = float(thruster.axis[across]), float(thruster.axis[up])
        axes.plot(x, y, "o", ms=4, color="C0")
        if np.hypot(dx, dy) > 0.1:
            arrow = {"arrowstyle": "-|>", "color": "C0", "lw": 1.6, "shrinkA": 0, "shrinkB": 0}
            axes.annotate("", xy=(x + length * dx, y + length * dy), xytext=(x, y), arrowprops=arrow)
        else:  # towards or away from the viewer
            axes.plot(
                x, y, "o" if thruster.axis[3 - across - up] > 0.0 else "x", ms=11, mfc="none", color="C0"
            )
        place = (round(x / length), round(y / length))
        below = dy >= 0.0
        offset = (0.0, -15.0 - 10.0 * named[place] if below else 8.0 + 10.0 * named[place])
        axes.annotate(
            name, (x, y), xytext=offset, textcoords="offset points", ha="center", fontsize=8, color="0.2"
        )
        named[place] += 1
    axes.plot(*vehicle.body.center_of_gravity[[across, up]], "k+", ms=11, mew=2, label="centre of gravity")
    axes.plot(
        *vehicle.body.center_of_buoyancy[[across, up]], "r^", ms=7, mfc="none", label="centre of buoyancy"
    )
    axes.plot(0.0, 0.0, "s", color="0.3", ms=4, mfc="none", label="body origin")
    pad = 0.15 * float(max(size[across], size[up]))
    axes.set(
        xlim=(upper[across] + pad, lower[across] - pad),
        ylim=(lower[up] - pad, upper[up] + pad),
        aspect="equal",
    )
    axes.xaxis.set_major_locator(MaxNLocator(3 if size[across] < 0.5 * size[up] else 6))
    axes.yaxis.set_major_locator(MaxNLocator(3 if size[up] < 0.5 * size[across] else 6))
    axes.grid(True, color="0.9", lw=0.5)
    axes.set_axisbelow(True)
