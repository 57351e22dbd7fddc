"""The report of a calibrated pool: one HTML page that loads nothing, the same as Markdown with pictures, `fit.json`."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

from finssim.calibration.vision.pool.pool_figures import pool_pictures
from finssim.calibration.vision.pool.pool_fit import PoolFit
from finssim.calibration.vision.pool.pool_record import cells, pool_json, summary
from finssim.files import atomic_directory
from finssim.page import html_page, html_picture, html_table

__all__ = ["RECORD_FILE", "write_pool_report"]

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
