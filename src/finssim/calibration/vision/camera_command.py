"""What `finssim calibrate camera` runs: read pictures, find the board, fit the lens, write the camera file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console

from finssim.calibration.errors import CalibrationError
from finssim.calibration.findings import finding
from finssim.calibration.fit import Estimate
from finssim.calibration.output.fit_figures import BLUE, GRAY, ORANGE, new_figure, png
from finssim.calibration.output.fit_output import interval_text, number_text
from finssim.calibration.output.publish import command_line, publish, refuse_places
from finssim.calibration.vision.camera_fit import (
    COLUMNS,
    MODELS,
    ROWS,
    Board,
    BoardView,
    CameraFit,
    board_found,
    calibrate_camera,
    parse_size,
    see_board,
)
from finssim.calibration.vision.report import (
    ExtraTable,
    Report,
    correlation_json,
    picture_axes,
    plain,
)
from finssim.localization.camera_file import write_camera
from finssim.localization.detection.pictures import pictures
from finssim.provenance import provenance

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["run"]

READING = (
    "The interval holds the true value in 19 of 20 such calibrations: it comes from how much the pictures disagree, "
    "each picture counting once. Coefficients of the distortion go together; judge the lens by the error over the "
    "picture and by the residual of views that it was not fitted to."
)

DIGITS = 7
"""Of the numbers in a record."""

ARROW_SHARE = 0.06
"""Length of the 95th percentile of the residuals, in widths of the image."""

OF_A_VIDEO = 15
"""Of a video every so many pictures are looked at: its neighbours show the same view."""


def camera_record(fit: CameraFit) -> dict[str, Any]:
    """What a camera file remembers: estimates, intervals, residuals and where they come from, as plain values."""
    estimates = {}
    for name, e in fit.estimates.items():
        ci95 = [plain(x, DIGITS) for x in e.ci95]
        estimates[name] = {"estimate": plain(e.estimate, DIGITS), "ci95": ci95, "unit": e.unit}
    return {
        "estimates": estimates,
        "rms_px": plain(fit.rms, DIGITS),
        "held_out_rms_px": plain(fit.held_out_rms, DIGITS),
        "views": len(fit.used),
        "left_out": {view.name: view.left_out for view in fit.views if view.left_out},
        "findings": [one.as_json() for one in fit.findings],
        "settings": fit.settings,
        "provenance": provenance(),
    }


def camera_json(fit: CameraFit, out: Path | None = None) -> dict[str, Any]:
    """What `--json` prints: the record, the lens, every view, the correlation of the errors and the coverage."""
    reach = fit.reach
    return {
        "kind": "camera",
        **camera_record(fit),
        "parameters": {name: estimate.as_json() for name, estimate in fit.estimates.items()},
        "per_view": [
            {
                "name": view.name,
                "rms_px": plain(view.rms, DIGITS),
                "tilt_deg": plain(math.degrees(view.tilt), DIGITS),
                "corners": len(view.pixels),
                "left_out": view.left_out or None,
            }
            for view in fit.views
        ],
        "error95_px": {"where_seen": plain(reach.inside, DIGITS), "anywhere": plain(reach.anywhere, DIGITS)},
        "empty_edges": {side: plain(share, DIGITS) for side, share in reach.edges.items()},
        "correlation": correlation_json(fit.correlation, DIGITS),
        "out": None if out is None else str(out),
    }


def camera_report(fit: CameraFit) -> Report:
    """The calibration in words."""
    worst = max(fit.used, key=lambda view: view.rms)
    held_out = "too few views to hold any out"
    if math.isfinite(fit.held_out_rms):
        held_out = f"views held out: {fit.held_out_rms:.3f} px"
    summary = [
        f"residual {fit.rms:.3f} px rms of a corner, worst view {worst.name} {worst.rms:.3f} px; {held_out}"
    ]
    if math.isfinite(fit.reach.anywhere):
        summary.append(
            f"a pixel is known to {fit.reach.inside:.2f} px (95 %) where corners were seen, to "
            f"{fit.reach.anywhere:.2f} px anywhere in the picture"
        )
    return Report(
        title="Camera calibration",
        headline=f"{fit.settings['model']} lens from {len(fit.used)} of {len(fit.views)} views",
        estimates=list(fit.estimates.values()),
        cells=_cells,
        summary=summary,
        findings=[
            *(finding("view_left_out", v.name, reason=v.left_out) for v in fit.views if v.left_out),
            *fit.findings,
        ],
        advice_title="What to photograph next",
        reading=READING,
    )


def _cells(estimate: Estimate) -> tuple[str, ...]:
    value = f"{estimate.estimate:.2f}" if estimate.unit == "px" else number_text(estimate.estimate)
    return estimate.name, value, interval_text(estimate), estimate.unit, estimate.note


def _views_table(fit: CameraFit) -> ExtraTable:
    rows = [
        (v.name, f"{v.rms:.3f}", f"{math.degrees(v.tilt):.0f}", str(len(v.pixels)), v.left_out or "used")
        for v in fit.views
    ]
    heads = ("view", "rms [px]", "tilt [deg]", "corners", "state")
    return heads, rows, ["doubt" if v.left_out else "" for v in fit.views]


# Pictures of a lens calibration: where corners were seen, how well the picture is known, what is left over.


def camera_pictures(fit: CameraFit) -> dict[str, tuple[str, bytes]]:
    """File name -> what the picture shows, and the PNG."""
    drawn = {
        "coverage.png": ("Where corners were seen, and how well pixels are known there", _coverage(fit)),
        "residuals.png": ("Corners less what the lens predicts, enlarged", _residuals(fit)),
    }
    return {name: (text, png(figure)) for name, (text, figure) in drawn.items()}


def _coverage(fit: CameraFit) -> Figure:
    from matplotlib.colors import LogNorm

    width, height = fit.lens.width, fit.lens.height
    figure = new_figure(7.4, 7.4 * height / width + 0.3)
    axes = figure.subplots()
    error = fit.reach.error95
    image = axes.imshow(
        np.clip(np.ma.masked_invalid(error), 0.03, 30.0),
        extent=(-0.5, width - 0.5, height - 0.5, -0.5),
        cmap="viridis_r",
        norm=LogNorm(0.03, 30.0),
        alpha=0.75,
    )
    for i, j in np.argwhere(np.isfinite(error)):
        u, v = (j + 0.5) / COLUMNS * width, (i + 0.5) / ROWS * height
        axes.text(u, v, f"{error[i, j]:.1f}", ha="center", va="center", fontsize=7, color="0.25")
    for view in fit.views:
        mark = {"color": ORANGE, "marker": "x"} if view.left_out else {"color": "black", "marker": "."}
        axes.plot(*view.pixels.T, linestyle="", markersize=2.5, **mark)
    picture_axes(axes, fit.lens)
    axes.set_title("corners (crosses: left out) and 95 % uncertainty of a pixel [px]", fontsize=9)
    figure.colorbar(image, ax=axes, shrink=0.8, label="px")
    return figure


def _residuals(fit: CameraFit) -> Figure:
    pixels = np.concatenate([view.pixels for view in fit.used])
    residuals = np.concatenate([view.residuals for view in fit.used])
    size = np.percentile(np.linalg.norm(residuals, axis=1), 95.0)
    figure = new_figure(7.4, 4.0)
    field, cloud = figure.subplots(1, 2, width_ratios=(1.9, 1.0))
    factor = ARROW_SHARE * fit.lens.width / max(size, 1e-9)
    arrows = {"angles": "xy", "scale_units": "xy", "scale": 1.0, "width": 0.0022}
    field.quiver(*pixels.T, *(factor * residuals.T), color=BLUE, **arrows)
    picture_axes(field, fit.lens)
    field.set_title(f"residuals, {factor:.0f} times enlarged", fontsize=9)
    cloud.plot(*residuals.T, ".", color=BLUE, markersize=2.5)
    limit = 1.1 * float(np.abs(residuals).max())
    cloud.set(xlim=(-limit, limit), ylim=(limit, -limit), aspect="equal")
    cloud.set(xlabel="along u [px]", ylabel="along v [px]")
    cloud.axhline(0.0, color=GRAY, linewidth=0.6)
    cloud.axvline(0.0, color=GRAY, linewidth=0.6)
    cloud.set_title(f"rms {fit.rms:.3f} px", fontsize=9)
    return figure


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
    """
    if model not in MODELS:
        raise CalibrationError(f"unknown lens model '{model}'; available: {', '.join(MODELS)}")
    refuse_places(out, report, "camera")
    screen = Console(stderr=True)
    chosen = _board(board, square, charuco, marker, dictionary)
    if chosen is None:
        chosen = board_found(((name, image) for _, name, image in pictures(images)), square)
        screen.print(f"found a {chosen.words}; --board says otherwise", highlight=False, markup=False)
    views, without = _views(images, chosen, screen)
    for name in without:
        screen.print(str(finding("board_unseen", name)), highlight=False, markup=False)
    if not views:
        raise CalibrationError(
            f"none of {len(without)} pictures shows a {chosen.words}: give --board or --charuco"
        )
    fit = calibrate_camera(views, model=model, seed=seed)
    fit.settings.update(board=chosen.words, square=chosen.square)
    write_camera(out, fit.lens, {**camera_record(fit), "without_board": without})
    words = camera_report(fit)
    if report is not None:
        kind = {"board": board}
        if charuco is not None:
            kind = {"charuco": charuco, "dictionary": dictionary, "marker": marker}
        options = {"out": out, "square": square, **kind, "model": model, "seed": seed}
        repeat = [command_line("camera", images, options)]
        words.write(report, camera_json(fit), camera_pictures(fit), repeat, {"Views": _views_table(fit)})
    publish(camera_json(fit, out) if as_json else None, words.show, (out, report))
    return fit


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
