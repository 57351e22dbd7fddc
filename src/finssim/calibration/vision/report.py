"""What the calibrations by sight share: where they write, what they print, their report and its figures."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from finssim.calibration.findings import Finding, sentences
from finssim.calibration.fit import Correlation, Estimate
from finssim.calibration.output.report import BLUE, GRAY, ORANGE
from finssim.page import Page, Pictures

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from finssim.geometry.optics import Lens

__all__ = ["AS_GIVEN", "ExtraTable", "Report", "correlation_json", "draw_arrows", "picture_axes", "plain"]

HEADS = ("parameter", "estimate", "95 % interval", "unit", "note")
AS_GIVEN = "as given"
"""Note of a number that was not estimated: the table on the terminal leaves it out."""

ARROW = 0.06
"""Length of the 95th percentile of arrows in a figure, in widths of what is drawn."""

ExtraTable = tuple[Sequence[str], Sequence[Sequence[str]], Sequence[str]]
"""Heads, rows, and a class of the page's style for each row."""


@dataclass(frozen=True, kw_only=True)
class Report:
    """A calibration in words, for the terminal and for a page."""

    title: str
    """Of the page."""
    headline: str
    """Above the table on the terminal."""
    estimates: Sequence[Estimate]
    cells: Callable[[Estimate], tuple[str, ...]]
    """Texts of an estimate, in the order of `HEADS`."""
    summary: Sequence[str]
    """The figures that say how good the calibration is, one sentence each."""
    findings: Sequence[Finding]
    advice_title: str = "Advice"
    reading: str
    """What the intervals mean."""

    @property
    def notes(self) -> list[str]:
        """Sentences worth knowing."""
        return sentences(one for one in self.findings if one.severity == "note")

    @property
    def advice(self) -> list[str]:
        """Sentences on what to do."""
        return sentences(one for one in self.findings if one.severity != "note")

    def show(self, console: Console) -> None:
        """Print estimates, figures and advice; fits 100 columns."""
        table = Table(box=box.SIMPLE_HEAD)
        for heading in HEADS:
            table.add_column(heading, justify="right" if heading == "estimate" else "left", overflow="fold")
        for estimate in self.estimates:
            if estimate.note != AS_GIVEN:
                table.add_row(
                    *map(Text, self.cells(estimate)), style="" if estimate.identifiable else "yellow"
                )
        console.print(self.headline, highlight=False, markup=False)
        console.print(table)
        lines = [f"  {sentence}" for sentence in self.summary] + [f"- {note}" for note in self.notes]
        for line in lines:
            console.print(line, highlight=False, markup=False)
        for sentence in self.advice:
            console.print(f"! {sentence}", highlight=False, markup=False, style="yellow")

    def write(
        self,
        folder: str | os.PathLike[str],
        record: Mapping[str, Any],
        pictures: Pictures,
        repeat: Sequence[str],
        tables: Mapping[str, ExtraTable] | None = None,
    ) -> None:
        """Write `report.html`, `report.md`, the pictures as PNG and `fit.json`.

        Args:
            folder: Directory to make; an earlier report there is replaced.
            record: What `fit.json` holds.
            pictures: To draw.
            repeat: The command line that makes the fit again, and what it was made from.
            tables: Heading -> further tables.

        Raises:
            OutputError: The folder holds other files, or cannot be written.
        """
        page = Page(self.title)
        for sentence in self.summary:
            page.lead(sentence)
        page.items(self.advice_title, self.advice)
        page.heading("Estimates")
        kinds = ["" if e.identifiable or e.note == AS_GIVEN else "doubt" for e in self.estimates]
        page.table(HEADS, [self.cells(e) for e in self.estimates], kinds, last="words")
        for note in (self.reading, *self.notes):
            page.note(note)
        page.pictures(pictures)
        for heading, (heads, rows, kinds) in (tables or {}).items():
            page.heading(heading)
            page.table(heads, rows, kinds, last="words")
        page.code("How to repeat it", repeat)
        page.write(folder, record, pictures)


def plain(x: float | None, digits: int = 17) -> float | None:
    """A number for JSON with so many significant digits; None where there is none."""
    return float(f"{x:.{digits}g}") if x is not None and math.isfinite(x) else None


def correlation_json(correlation: Correlation, digits: int) -> dict[str, Any]:
    """Names and matrix as plain values."""
    matrix = [[plain(x, digits) for x in row] for row in correlation.matrix]
    return {"names": list(correlation.names), "matrix": matrix}


def picture_axes(axes: Axes, lens: Lens) -> None:
    """Axes of pixels over a lens's picture."""
    axes.set(xlim=(-0.5, lens.width - 0.5), ylim=(lens.height - 0.5, -0.5), aspect="equal")
    axes.set(xlabel="u [px]", ylabel="v [px]")


def plain_axes(axes: Axes, which: str = "major") -> None:
    """Axes with a light grid and no frame."""
    axes.grid(True, which=which, color="0.93", linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)


def draw_arrows(
    axes: Axes,
    at: NDArray[np.float64],
    vectors: NDArray[np.float64],
    used: NDArray[np.bool_],
    unit: str,
    per: float,
) -> None:
    """Points and enlarged arrows, and crosses where there is none; `per` of the arrows' unit make one of the axes'.

    Args:
        axes: To draw into.
        at: (N, 2).
        vectors: (N, 2).
        used: Which rows the calibration used, (N,).
        unit: Of the arrows.
        per: Arrow units in one of the axes' units.
    """
    good = used & np.isfinite(vectors).all(axis=1)
    size = float(np.percentile(np.linalg.norm(vectors[good], axis=1), 95)) if good.any() else 1.0
    scale = max(size, 1e-12) / max(float(np.ptp(at, axis=0).max()) * ARROW, 1e-12)
    axes.plot(*at[good].T, ".", color=GRAY, markersize=3)
    label = f"longest of 95 %: {size:.2g} {unit}, enlarged {per / scale:.2g} times"
    arrows = {"angles": "xy", "scale_units": "xy", "scale": scale, "width": 0.0022}
    axes.quiver(*at[good].T, *vectors[good].T, color=BLUE, label=label, **arrows)
    if not good.all():
        axes.plot(*at[~good].T, "x", color=ORANGE, markersize=6, label="left out")
    axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(0.0, 1.1), ncols=3, frameon=False)
    plain_axes(axes)
