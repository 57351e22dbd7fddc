"""Curves as the browser's plots take them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from typing import Any

import numpy as np
import numpy.typing as npt

from finssim.viewer.frame import Curve

__all__ = ["Plot", "legend_of", "plots_of"]

Array = npt.NDArray[np.float64]

LINES = ("#d9480f", "#1c6ef2", "#2b8a3e", "#862e9c")
"""Colours, in the order of the curves."""


class Plot:
    """Curves of one title, over the same times."""

    def __init__(self, title: str, curves: Sequence[Curve]) -> None:
        self.title, self.curves = title, list(curves)

    def data(self, now: float) -> tuple[Array, ...]:
        """Time, and for every curve all of it and the part up to a time [s]."""
        time = self.curves[0].time
        past = time <= now + 1e-9
        columns = [time]
        for curve in self.curves:
            columns += [curve.value, np.where(past, curve.value, np.nan)]
        return tuple(np.ascontiguousarray(column, float) for column in columns)

    def series(self) -> tuple[Any, ...]:
        """How they are drawn: all of a curve faintly, what has been in full."""
        drawn: list[Any] = [{"label": "t [s]"}]
        for curve, colour in zip(self.curves, LINES, strict=False):
            drawn += [{"label": "", "stroke": f"{colour}40", "width": 1}]
            drawn += [{"label": curve.label, "stroke": colour, "width": 2}]
        return tuple(drawn)


def plots_of(curves: Sequence[Curve]) -> list[Plot]:
    """Curves by title, in the order in which titles first appear."""
    order = list(dict.fromkeys(curve.plot for curve in curves))
    sorted_curves = sorted(curves, key=lambda curve: order.index(curve.plot))
    return [Plot(title, list(same)) for title, same in groupby(sorted_curves, key=lambda curve: curve.plot)]


def legend_of(plots: Sequence[Plot]) -> str:
    """Which colour is which curve, as markup; curves of the same place in their plots share label and colour."""
    labels = dict.fromkeys(
        (colour, curve.label) for plot in plots for colour, curve in zip(LINES, plot.curves, strict=False)
    )
    return " · ".join(f'<span style="color:{colour}">■</span> {label}' for colour, label in labels)
