"""What `finssim calibrate camera` runs: read pictures, find the board, fit the lens, write the camera file."""

from __future__ import annotations

import json
import math
import os
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich import box
from rich.console import Console
from rich.table import Table

from finssim.calibration.errors import CalibrationError
from finssim.calibration.fit import Estimate
from finssim.calibration.output.fit_output import interval_text, number_text
from finssim.calibration.vision.camera.boards import Board, BoardView, board_found, parse_size, see_board
from finssim.calibration.vision.camera.camera_fit import MODELS, CameraFit, calibrate_camera
from finssim.files import atomic_directory, atomic_write, refuse_unwritable
from finssim.localization.camera_file import write_camera
from finssim.localization.detection.pictures import pictures
from finssim.page import html_page, html_picture, html_table
from finssim.provenance import provenance

if TYPE_CHECKING:
    from rich.console import Console

__all__ = ["run"]

# A lens calibration as a table, as JSON, as the record in a camera file, and as a folder to look at.

RECORD_FILE, REPORT_FILE = "fit.json", "report.html"

READING = (
    "The interval holds the true value in 19 of 20 such calibrations: it comes from how much the pictures disagree, "
    "each picture counting once. Coefficients of the distortion go together; judge the lens by the error over the "
    "picture and by the residual of views that it was not fitted to."
)


def camera_record(fit: CameraFit) -> dict[str, Any]:
    """What a camera file remembers: estimates, intervals, residuals and where they come from, as plain values."""
    return {
        "estimates": {
            name: {"estimate": _rounded(e.estimate), "ci95": [_rounded(x) for x in e.ci95], "unit": e.unit}
            for name, e in fit.estimates.items()
        },
        "rms_px": _rounded(fit.rms),
        "held_out_rms_px": _rounded(fit.held_out_rms),
        "views": len(fit.used),
        "left_out": {view.name: view.left_out for view in fit.views if view.left_out},
        "advice": list(fit.advice),
        "settings": fit.settings,
        "interrupted": fit.interrupted,
        "provenance": provenance(),
    }


def camera_json(fit: CameraFit, out: Path | None = None) -> dict[str, Any]:
    """What `--json` prints: the record, the lens, every view, the correlation of the errors and the coverage."""
    return {
        "kind": "camera",
        **camera_record(fit),
        "parameters": {name: estimate.as_json() for name, estimate in fit.estimates.items()},
        "per_view": [
            {
                "name": view.name,
                "rms_px": _rounded(view.rms),
                "tilt_deg": _rounded(math.degrees(view.tilt)),
                "corners": len(view.pixels),
                "left_out": view.left_out or None,
            }
            for view in fit.views
        ],
        "error95_px": {"where_seen": _rounded(fit.reach.inside), "anywhere": _rounded(fit.reach.anywhere)},
        "empty_edges": {side: _rounded(share) for side, share in fit.reach.edges.items()},
        "correlation": {
            "names": list(fit.correlation.names),
            "matrix": [[_rounded(x) for x in row] for row in fit.correlation.matrix],
        },
        "out": None if out is None else str(out),
    }


def print_camera(fit: CameraFit, console: Console) -> None:
    """Print estimates, residuals and advice; fits 100 columns."""
    table = Table(box=box.SIMPLE_HEAD)
    for heading in ("parameter", "estimate", "95 % interval", "unit", "note"):
        table.add_column(heading, justify="right" if heading == "estimate" else "left", overflow="fold")
    for estimate in fit.estimates.values():
        table.add_row(*_cells(estimate), style="" if estimate.identifiable else "yellow")
    console.print(
        f"{fit.settings['model']} lens from {len(fit.used)} of {len(fit.views)} views", highlight=False
    )
    console.print(table)
    for sentence in summary(fit):
        console.print(f"  {sentence}", highlight=False, markup=False)
    for view in fit.views:
        if view.left_out:
            console.print(f"- {view.name} left out: {view.left_out}", highlight=False, markup=False)
    for sentence in fit.advice:
        console.print(f"! {sentence}", highlight=False, markup=False, style="yellow")


def summary(fit: CameraFit) -> list[str]:
    """The figures that say how good the calibration is."""
    worst = max(fit.used, key=lambda view: view.rms)
    held_out = "too few views to hold any out"
    if math.isfinite(fit.held_out_rms):
        held_out = f"views held out: {fit.held_out_rms:.3f} px"
    found = [
        f"residual {fit.rms:.3f} px rms of a corner, worst view {worst.name} {worst.rms:.3f} px; {held_out}"
    ]
    if math.isfinite(fit.reach.anywhere):
        found.append(
            f"a pixel is known to {fit.reach.inside:.2f} px (95 %) where corners were seen, to "
            f"{fit.reach.anywhere:.2f} px anywhere in the picture"
        )
    return found


def write_camera_report(fit: CameraFit, folder: str | os.PathLike[str], *, command: str = "") -> None:
    """Write `report.html`, its pictures as PNG and `fit.json`.

    Raises:
        OutputError: The folder holds other files, or cannot be written.
    """
    from finssim.calibration.vision.camera.camera_figures import camera_pictures

    pictures = camera_pictures(fit)
    with atomic_directory(folder, replaces=RECORD_FILE) as temporary:
        for name, (_, data) in pictures.items():
            (temporary / name).write_bytes(data)
        (temporary / RECORD_FILE).write_text(json.dumps(camera_json(fit), indent=1), encoding="utf-8")
        (temporary / REPORT_FILE).write_text(_page(fit, pictures, command), encoding="utf-8")


def _page(fit: CameraFit, pictures: dict[str, tuple[str, bytes]], command: str) -> str:
    rows = [_row(_cells(e), "" if e.identifiable else "doubt") for e in fit.estimates.values()]
    views = [
        _row(
            (v.name, f"{v.rms:.3f}", f"{math.degrees(v.tilt):.0f}", str(len(v.pixels)), v.left_out or "used"),
            "doubt" if v.left_out else "",
        )
        for v in fit.views
    ]
    said = "".join(f'<li class="warning">{escape(sentence)}</li>' for sentence in fit.advice)
    sections = [
        f'<p class="lead">{escape(" · ".join(summary(fit)))}</p>',
        html_table(("parameter", "estimate", "95 % interval", "unit", "note"), rows),
        f'<p class="note">{escape(READING)}</p>',
        f"<h2>What to photograph next</h2><ul>{said}</ul>" if said else "",
        *(f"<h2>{escape(text)}</h2>{html_picture(data, text)}" for text, data in pictures.values()),
        "<h2>Views</h2>",
        html_table(("view", "rms [px]", "tilt [deg]", "corners", "state"), views),
        f"<pre>{escape(command)}</pre>" if command else "",
    ]
    return html_page("Camera calibration", [section for section in sections if section])


def _row(cells: tuple[str, ...], kind: str) -> str:
    inner = "".join(f"<td>{escape(cell)}</td>" for cell in cells)
    return f'<tr class="{kind}">{inner}</tr>' if kind else f"<tr>{inner}</tr>"


def _cells(estimate: Estimate) -> tuple[str, ...]:
    return (
        estimate.name,
        f"{estimate.estimate:.2f}" if estimate.unit == "px" else number_text(estimate.estimate),
        interval_text(estimate),
        estimate.unit,
        estimate.note,
    )


def _rounded(x: float) -> float | None:
    return float(f"{x:.7g}") if math.isfinite(x) else None


OF_A_VIDEO = 15
"""Of a video every so many pictures are looked at: its neighbours show the same view."""


def run(
    images: Sequence[Path],
    *,
    out: Path,
    board: str | None = None,
    square: float = 0.025,
    charuco: str | None = None,
    marker: float | None = None,
    dictionary: str = "DICT_5X5_100",
    model: str = "plumb_bob",
    report: Path | None = None,
    seed: int = 0,
    as_json: bool = False,
) -> CameraFit:
    """Fit a lens to pictures of a board: focal length and centre [px], distortion, with 95 % intervals.

    Example: finssim calibrate camera board/*.jpg --board 9x6 --square 0.025 --out camera.yaml

    Args:
        images (IMAGE): Pictures of a board, folders of them, or videos.
        out (FILE): Camera file to write (.yaml).
        board (NxM): Inner corners of a chessboard, such as 9x6; common ones are tried if not given.
        square: Edge of a square [m].
        charuco (NxM): Squares of a ChArUco board in place of a chessboard, such as 7x5.
        marker: Edge of its markers [m]; three quarters of a square if not given.
        dictionary (NAME): Dictionary of its markers, as OpenCV calls it.
        model (MODEL): Lens: plumb_bob, rational or fisheye.
        report (DIR): Directory for the report and its pictures.
        seed: Seed of every random number; equal seeds give equal results.
        as_json: Print one JSON object instead of tables.

    Returns:
        The fit.

    Raises:
        CalibrationError, LocalizationError, OutputError: As they say; nothing is written then.
        KeyboardInterrupt: After Ctrl-C, when the best until then has been written.
    """
    if model not in MODELS:
        raise CalibrationError(f"unknown lens model '{model}'; available: {', '.join(MODELS)}")
    _refuse_places(out, report)
    screen = Console(stderr=True)
    chosen = _board(board, square, charuco, marker, dictionary)
    if chosen is None:
        chosen = board_found(((name, image) for _, name, image in pictures(images)), square)
        screen.print(f"found a {chosen.words}; --board says otherwise", highlight=False, markup=False)
    views, without = _views(images, chosen, screen)
    for name in without:
        screen.print(f"{name}: left out: the board is not seen in it", highlight=False, markup=False)
    if not views:
        raise CalibrationError(
            f"none of {len(without)} pictures shows a {chosen.words}: give --board or --charuco"
        )
    with _progress(screen) as progress:
        fit = calibrate_camera(views, model=model, seed=seed, progress=progress)
    fit.settings.update(board=chosen.words, square=chosen.square)
    record = {**camera_record(fit), "without_board": without}
    write_camera(out, fit.lens, record)
    if report is not None:
        command = _command(images, out, board, square, charuco, marker, dictionary, model, seed)
        write_camera_report(fit, report, command=command)
    _show(fit, out, report, as_json)
    if fit.interrupted:
        raise KeyboardInterrupt
    return fit


def _refuse_places(out: Path, report: Path | None) -> None:
    if Path(out).suffix not in (".yaml", ".yml"):
        raise CalibrationError(
            f"{out} ends in '{Path(out).suffix}', expected .yaml: name a camera file to write"
        )
    refuse_unwritable(atomic_write(out))
    if report is not None:
        refuse_unwritable(atomic_directory(report, replaces=RECORD_FILE))


def _board(
    board: str | None, square: float, charuco: str | None, marker: float | None, dictionary: str
) -> Board | None:
    if board is not None and charuco is not None:
        raise CalibrationError(
            "--board and --charuco are both given: name the one board that the pictures show"
        )
    if charuco is not None:
        columns, rows = parse_size(charuco, "--charuco")
        edge = 0.75 * square if marker is None else marker
        return Board(columns=columns, rows=rows, square=square, marker=edge, dictionary=dictionary)
    if board is None:
        return None
    columns, rows = parse_size(board, "--board")
    return Board(columns=columns, rows=rows, square=square)


def _views(images: Sequence[Path], board: Board, screen: Console) -> tuple[list[BoardView], list[str]]:
    """Views of the board, and the names of the pictures that do not show it; Ctrl-C keeps those until then."""
    views: list[BoardView] = []
    without: list[str] = []
    try:
        for _, name, image in pictures(images):
            _, is_video, number = name.partition("#")
            if is_video and int(number) % OF_A_VIDEO:
                continue
            seen = see_board(image, board)
            if seen is None:
                without.append(name)
                continue
            height, width = image.shape
            views.append(BoardView(name=name, width=width, height=height, pixels=seen[0], points=seen[1]))
    except KeyboardInterrupt:
        screen.print(f"stopped after {len(views) + len(without)} pictures; fitting to those", highlight=False)
    return views, without


@contextmanager
def _progress(screen: Console) -> Iterator[Callable[[float, str], None]]:
    """A bar on standard error, fed with the part done and a few words."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=screen, transient=True, disable=not screen.is_terminal) as bars:
        bar = bars.add_task("fit", total=1.0)
        yield lambda part, words: bars.update(bar, completed=part, description=words)


def _show(fit: CameraFit, out: Path, report: Path | None, as_json: bool) -> None:
    if as_json:
        print(json.dumps(camera_json(fit, out), allow_nan=False))
        return
    console = Console() if sys.stdout.isatty() else Console(width=100)
    print_camera(fit, console)
    for place in filter(None, (out, report)):
        console.print(f"written: {place}", highlight=False, markup=False, soft_wrap=True)


def _command(
    images: Sequence[Path],
    out: Path,
    board: str | None,
    square: float,
    charuco: str | None,
    marker: float | None,
    dictionary: str,
    model: str,
    seed: int,
) -> str:
    """The command line that does this again."""
    words = [
        "finssim",
        "calibrate",
        "camera",
        *map(str, images),
        "--out",
        str(out),
        "--square",
        f"{square:g}",
    ]
    if charuco is not None:
        words += ["--charuco", charuco, "--dictionary", dictionary]
        words += [] if marker is None else ["--marker", f"{marker:g}"]
    elif board is not None:
        words += ["--board", board]
    return shlex.join([*words, "--model", model, "--seed", str(seed)])
