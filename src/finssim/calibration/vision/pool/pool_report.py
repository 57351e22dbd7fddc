"""The report of a calibrated pool: one HTML page that loads nothing, the same as Markdown with pictures, `fit.json`."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.output.fit_figures import draw_correlation
from finssim.calibration.vision.pool.pool_fit import PoolFit
from finssim.calibration.vision.pool.pool_record import cells, pool_json, summary
from finssim.files import atomic_directory
from finssim.page import html_page, html_picture, html_table

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["RECORD_FILE", "write_pool_report"]

# Pictures of a calibrated pool: errors on the map and in the picture, and beside straight lines.

Array = NDArray[np.float64]

BLUE, ORANGE, GRAY = "#0072B2", "#D55E00", "0.6"
ARROW = 0.06
"""Length of the 95th percentile of the arrows, in widths of what is drawn."""


def pool_pictures(fit: PoolFit) -> dict[str, tuple[str, bytes]]:
    """File name -> what the picture shows, and the PNG; equal fits give equal pictures."""
    drawn = {
        "map.png": ("Where each pixel's ray meets the point's plane, less the surveyed point", _map(fit)),
        "picture.png": ("Measured less predicted pixels, enlarged", _picture(fit)),
        "outwards.png": ("Residual against the angle from the plane's normal", _outwards(fit)),
        "held_out.png": ("Errors at points held out, refraction beside straight lines", _held_out(fit)),
    }
    if len(fit.correlation.names) > 1:
        drawn["correlation.png"] = ("Correlation of the errors", draw_correlation(fit.correlation))
    return {name: (text, _png(figure)) for name, (text, figure) in drawn.items() if figure is not None}


def _map(fit: PoolFit) -> Figure:
    """Seen along the plane's normal."""
    figure = _figure(7.4, 5.6)
    axes = figure.subplots()
    axis = _across(fit)
    at, error = fit.seen.points @ axis.T, 1000.0 * fit.error @ axis.T
    _arrows(axes, at, error, fit.used, "mm", 1000.0)
    foot = axis @ np.asarray(fit.model.camera.position)
    axes.plot(*foot, "^", color="black", markersize=8, label="camera")
    axes.set_aspect("equal")
    names = ("x [m]", "y [m]") if fit.surface else ("along the wall [m]", "along the wall, across [m]")
    axes.set_xlabel(names[0])
    axes.set_ylabel(names[1])
    axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(0.0, 1.1), ncols=3, frameon=False)
    return figure


def _picture(fit: PoolFit) -> Figure:
    lens = fit.model.camera.lens
    figure = _figure(7.4, 7.4 * lens.height / lens.width + 0.6)
    axes = figure.subplots()
    _arrows(axes, fit.seen.pixels, fit.residual, fit.used, "px", 1.0)
    axes.set_xlim(-0.5, lens.width - 0.5)
    axes.set_ylim(lens.height - 0.5, -0.5)
    axes.set_aspect("equal")
    axes.set_xlabel("u [px]")
    axes.set_ylabel("v [px]")
    axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(0.0, 1.1), ncols=3, frameon=False)
    return figure


def _arrows(axes: Axes, at: Array, vectors: Array, used: NDArray[np.bool_], unit: str, per: float) -> None:
    """Points and enlarged arrows; `per` of the arrows' unit make one of the axes'."""
    good = used & np.isfinite(vectors).all(axis=1)
    size = float(np.percentile(np.linalg.norm(vectors[good], axis=1), 95)) if good.any() else 1.0
    span = float(np.ptp(at, axis=0).max()) * ARROW
    scale = max(size, 1e-12) / max(span, 1e-12)
    axes.plot(*at[good].T, ".", color=GRAY, markersize=3)
    axes.quiver(
        *at[good].T, *vectors[good].T, angles="xy", scale_units="xy", scale=scale, width=0.0022, color=BLUE,
        label=f"longest of 95 %: {size:.2g} {unit}, enlarged {per / scale:.2g} times",
    )  # fmt: skip
    if not good.all():
        axes.plot(*at[~good].T, "x", color=ORANGE, markersize=6, label="left out")
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(True, color="0.93", linewidth=0.6)


def _outwards(fit: PoolFit) -> Figure:
    """Length of the residuals of both models against the direction of the ray in the air."""
    figure = _figure(7.4, 3.8)
    axes = figure.subplots()
    rays, ok = fit.model.camera.lens.rays(fit.seen.pixels)
    cosine = np.abs((rays @ np.asarray(fit.model.camera.R_pc).T) @ fit.model.interface.normal)
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    good = ok & fit.used
    for residual, color, name in (
        (fit.pinhole_residual, ORANGE, "straight lines"),
        (fit.residual, BLUE, "refraction"),
    ):
        size = np.maximum(np.linalg.norm(residual[good], axis=1), 1e-3)
        axes.semilogy(angle[good], size, ".", color=color, markersize=4, alpha=0.6, label=name)
    axes.set_xlabel("angle between the ray in the air and the plane's normal [degrees]")
    axes.set_ylabel("residual [px]")
    axes.legend(fontsize=8, frameon=False)
    axes.grid(True, color="0.93", linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    return figure


def _held_out(fit: PoolFit) -> Figure | None:
    """Share of held-out points within an error, for both models."""
    both = ((fit.held_out, BLUE, "refraction"), (fit.pinhole_held_out, ORANGE, "straight lines"))
    if fit.held_out is None:
        return None
    figure = _figure(7.4, 3.8)
    axes = figure.subplots()
    for out, color, name in both:
        if out is None:
            continue
        size = 100.0 * np.linalg.norm(out.points, axis=1)
        size = np.sort(size[np.isfinite(size)])
        share = 100.0 * np.arange(1, len(size) + 1) / max(len(size), 1)
        axes.semilogx(np.maximum(size, 1e-3), share, color=color, label=name)
    axes.set_xlabel("error in the water, at the point's own depth [cm]")
    axes.set_ylabel("points within [%]")
    axes.set_ylim(0.0, 101.0)
    axes.legend(fontsize=8, frameon=False)
    axes.grid(True, which="both", color="0.93", linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    return figure


def _across(fit: PoolFit) -> Array:
    """Two axes across the normal of the points' planes, (2, 3): x and y of the survey for a surface."""
    if fit.surface:
        return np.eye(3)[:2]
    return np.stack([np.asarray(e, float) for e in fit.model.interface.tangents()])


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=120, metadata={"Software": None})
    return buffer.getvalue()


def _figure(width: float, height: float) -> Figure:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


REPORT_FILE, MARKDOWN_FILE, RECORD_FILE = "report.html", "report.md", "fit.json"
HEADS = ("parameter", "estimate", "95 % interval", "unit", "note")

READING = (
    "The interval holds the true value in 19 of 20 such calibrations, if what was given beforehand (index, tape, "
    "level, camera file) is as exact as it was said to be. A note says where the pixels do not tell a number and what "
    "it rests on instead. Judge the result by the error at points held out, in the depth where it will be used. "
    "Arrows that swirl or grow outwards tell of a wrong lens, window or water height; others are noise."
)


def write_pool_report(
    fit: PoolFit,
    folder: str | os.PathLike[str],
    *,
    out: Path | None = None,
    inputs: Mapping[str, str] | None = None,
    command: str = "",
) -> None:
    """Write `report.html`, `report.md`, the pictures as PNG and `fit.json`.

    Args:
        fit: The calibration.
        folder: Directory to make; an earlier report there is replaced.
        out: Pool file that was written.
        inputs: File -> SHA-256 of what the fit was made from.
        command: The command line that makes the fit again.

    Raises:
        OutputError: The folder holds other files, or cannot be written.
    """
    pictures = pool_pictures(fit)
    whole = pool_json(fit, out=out, inputs=inputs)
    with atomic_directory(folder, replaces=RECORD_FILE) as temporary:
        for name, (_, data) in pictures.items():
            (temporary / name).write_bytes(data)
        text = json.dumps(whole, indent=1, allow_nan=False)
        (temporary / RECORD_FILE).write_text(text + "\n", encoding="utf-8")
        (temporary / REPORT_FILE).write_text(_html(fit, pictures, inputs or {}, command), encoding="utf-8")
        (temporary / MARKDOWN_FILE).write_text(
            _markdown(fit, pictures, inputs or {}, command), encoding="utf-8"
        )


def _title(fit: PoolFit) -> str:
    what = "water surface" if fit.surface else "wall"
    return f"Camera and {what} from {fit.residual_json()['locations']} surveyed places"


def _html(
    fit: PoolFit, pictures: Mapping[str, tuple[str, bytes]], inputs: Mapping[str, str], command: str
) -> str:
    rows = [
        f'<tr class="{"" if e.identifiable or e.note == "as given" else "doubt"}">'
        + "".join(f"<td>{escape(cell)}</td>" for cell in cells(e)[:4])
        + f'<td class="words">{escape(e.note)}</td></tr>'
        for e in fit.estimates.values()
    ]
    parts = [
        f"<h1>{escape(_title(fit))}</h1>",
        *(f'<p class="lead">{escape(sentence)}</p>' for sentence in summary(fit)),
    ]
    if fit.advice:
        items = "".join(f'<li class="warning">{escape(sentence)}</li>' for sentence in fit.advice)
        parts += ["<h2>Advice</h2>", f"<ul>{items}</ul>"]
    parts += ["<h2>Estimates</h2>", html_table(HEADS, rows), f'<p class="note">{escape(READING)}</p>']
    parts += [f'<p class="note">{escape(note)}</p>' for note in fit.notes]
    for text, data in pictures.values():
        parts += [f"<h2>{escape(text)}</h2>", html_picture(data, text)]
    lines = [command, *(f"{path}  sha256 {digest}" for path, digest in inputs.items())]
    parts += ["<h2>How to repeat it</h2>", f"<pre>{escape(chr(10).join(filter(None, lines)))}</pre>"]
    return html_page(_title(fit), parts)


def _markdown(
    fit: PoolFit, pictures: Mapping[str, tuple[str, bytes]], inputs: Mapping[str, str], command: str
) -> str:
    lines = [f"# {_title(fit)}", "", *(f"{sentence}.  " for sentence in summary(fit))]
    if fit.advice:
        lines += ["", "## Advice", "", *(f"- {sentence}" for sentence in fit.advice)]
    lines += ["", "## Estimates", "", *_md_table([cells(e) for e in fit.estimates.values()]), "", READING]
    lines += ["", *(f"- {note}" for note in fit.notes)] if fit.notes else []
    lines += ["", "## Pictures", "", *(f"![{text}]({name})" for name, (text, _) in pictures.items())]
    lines += ["", "## How to repeat it", "", "```text", *filter(None, [command])]
    lines += [*(f"{path}  sha256 {digest}" for path, digest in inputs.items()), "```"]
    return "\n".join(lines) + "\n"


def _md_table(rows: Sequence[Sequence[str]]) -> list[str]:
    def line(words: Sequence[str]) -> str:
        return "| " + " | ".join(word.replace("|", "\\|") for word in words) + " |"

    return [line(HEADS), line(["---"] * len(HEADS)), *(line(row) for row in rows)]
