"""What the calibrations by sight share: where they write, what they print, their report and its figures."""

from __future__ import annotations

import json
import math
import os
import shlex
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from rich import box
from rich.console import Console
from rich.table import Table

from finssim.calibration.errors import CalibrationError
from finssim.calibration.findings import Finding, sentences
from finssim.calibration.fit import Correlation, Estimate
from finssim.calibration.output.fit_figures import BLUE, GRAY, ORANGE
from finssim.files import atomic_directory, atomic_write, refuse_unwritable
from finssim.page import html_page, html_picture, html_table

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from finssim.geometry.optics import Lens

__all__ = [
    "AS_GIVEN", "Report", "command_line", "correlation_json", "draw_arrows", "html_row", "picture_axes",
    "plain", "plain_axes", "publish", "refuse_places",
]  # fmt: skip

HEADS = ("parameter", "estimate", "95 % interval", "unit", "note")
REPORT_FILE, MARKDOWN_FILE, RECORD_FILE = "report.html", "report.md", "fit.json"

AS_GIVEN = "as given"
"""Note of a number that was not estimated: the table on the terminal leaves it out."""

ARROW = 0.06
"""Length of the 95th percentile of arrows in a figure, in widths of what is drawn."""

Pictures = Mapping[str, tuple[str, bytes]]
"""File name -> what the picture shows, and the PNG."""


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
                table.add_row(*self.cells(estimate), style="" if estimate.identifiable else "yellow")
        console.print(self.headline, highlight=False)
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
        tables: Mapping[str, str] | None = None,
    ) -> None:
        """Write `report.html`, `report.md`, the pictures as PNG and `fit.json`.

        Args:
            folder: Directory to make; an earlier report there is replaced.
            record: What `fit.json` holds.
            pictures: To draw.
            repeat: The command line that makes the fit again, and what it was made from.
            tables: Heading -> HTML of further tables for the page.

        Raises:
            OutputError: The folder holds other files, or cannot be written.
        """
        texts = {
            RECORD_FILE: json.dumps(record, indent=1, allow_nan=False) + "\n",
            REPORT_FILE: self._html(pictures, repeat, tables or {}),
            MARKDOWN_FILE: self._markdown(pictures, repeat),
        }
        with atomic_directory(folder, replaces=RECORD_FILE) as temporary:
            for name, (_, data) in pictures.items():
                (temporary / name).write_bytes(data)
            for name, text in texts.items():
                (temporary / name).write_text(text, encoding="utf-8")

    def _html(self, pictures: Pictures, repeat: Sequence[str], tables: Mapping[str, str]) -> str:
        rows = [
            html_row((*self.cells(e)[:4], e.note), "" if e.identifiable or e.note == AS_GIVEN else "doubt")
            for e in self.estimates
        ]
        parts = [f"<h1>{escape(self.title)}</h1>"]
        parts += [f'<p class="lead">{escape(sentence)}</p>' for sentence in self.summary]
        if self.advice:
            items = "".join(f'<li class="warning">{escape(sentence)}</li>' for sentence in self.advice)
            parts += [f"<h2>{self.advice_title}</h2>", f"<ul>{items}</ul>"]
        parts += ["<h2>Estimates</h2>", html_table(HEADS, rows)]
        parts += [f'<p class="note">{escape(note)}</p>' for note in (self.reading, *self.notes)]
        for text, data in pictures.values():
            parts += [f"<h2>{escape(text)}</h2>", html_picture(data, text)]
        for heading, table in tables.items():
            parts += [f"<h2>{heading}</h2>", table]
        parts += ["<h2>How to repeat it</h2>", f"<pre>{escape(chr(10).join(repeat))}</pre>"]
        return html_page(self.title, parts)

    def _markdown(self, pictures: Pictures, repeat: Sequence[str]) -> str:
        rows = [HEADS, ["---"] * len(HEADS), *map(self.cells, self.estimates)]
        lines = [f"# {self.title}", "", *(f"{sentence}.  " for sentence in self.summary)]
        if self.advice:
            lines += ["", f"## {self.advice_title}", "", *(f"- {sentence}" for sentence in self.advice)]
        lines += ["", "## Estimates", ""]
        lines += ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows]
        lines += ["", self.reading]
        lines += ["", *(f"- {note}" for note in self.notes)] if self.notes else []
        lines += ["", "## Pictures", "", *(f"![{text}]({name})" for name, (text, _) in pictures.items())]
        lines += ["", "## How to repeat it", "", "```text", *repeat, "```"]
        return "\n".join(lines) + "\n"


def html_row(cells: Sequence[str], kind: str = "") -> str:
    """A row of a table, its last cell in words; `kind` is a class of the page's style."""
    inner = "".join(f"<td>{escape(cell)}</td>" for cell in cells[:-1])
    return f'<tr class="{kind}">{inner}<td class="words">{escape(cells[-1])}</td></tr>'


def refuse_places(out: Path, report: Path | None, kind: str) -> None:
    """Refuse a file that is no YAML, or a place that cannot be written, before anything is computed."""
    if Path(out).suffix not in (".yaml", ".yml"):
        raise CalibrationError(
            f"{out} ends in '{Path(out).suffix}', expected .yaml: name a {kind} file to write"
        )
    refuse_unwritable(atomic_write(out))
    if report is not None:
        refuse_unwritable(atomic_directory(report, replaces=RECORD_FILE))


def publish(
    record: Mapping[str, Any] | None, show: Callable[[Console], None], written: Iterable[Path | None]
) -> None:
    """Print one JSON object for programs; or, without one, for people, and which files were written."""
    if record is not None:
        print(json.dumps(record, allow_nan=False))
        return
    console = Console() if sys.stdout.isatty() else Console(width=100)
    show(console)
    for path in filter(None, written):
        console.print(f"written: {path}", highlight=False, markup=False, soft_wrap=True)


def command_line(kind: str, inputs: Iterable[Path], options: Mapping[str, Any]) -> str:
    """The command line that does this again; options that are None or empty are left out."""
    words = ["finssim", "calibrate", kind, *map(str, inputs)]
    for name, value in options.items():
        for item in value if isinstance(value, (list, tuple)) else [] if value is None else [value]:
            words += [f"--{name.replace('_', '-')}", str(item)]
    return shlex.join(words)


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
