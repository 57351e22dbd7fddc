"""`finssim calibrate camera`: read pictures, detect the board, fit the lens, write the camera file and the report."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from rich.console import Console

from finssim.core.palette import BLUE, VERMILION
from finssim.core.provenance import provenance
from finssim.identification.fit import Estimate
from finssim.identification.report import (
    GRAY,
    HEADS,
    ExtraTable,
    Report,
    command_line,
    draw_arrows,
    interval_text,
    new_figure,
    number_text,
    picture_axes,
    png,
    publish,
    refuse_places,
)
from finssim.localization.camera_file import write_camera
from finssim.localization.detection.pictures import pictures
from finssim.survey.boards import Board, BoardView, parse_size, see_board
from finssim.survey.camera_fit import (
    CameraFit,
    calibrate_camera,
    check_model,
    empty_edges,
    picture_grid,
    pixel_error,
)
from finssim.trials.findings import CalibrationError, finding, plain

if TYPE_CHECKING:
    from matplotlib.figure import Figure

READING = (
    "The interval holds the true value in 19 of 20 such calibrations: it comes from how much the pictures disagree, "
    "each picture counting once. Coefficients of the distortion go together; judge the lens by the error over the "
    "picture and by the residual of views that it was not fitted to."
)

DIGITS = 7
"""Significant digits of the numbers in a record."""

OF_A_VIDEO = 15
"""Interval between used pictures of a video, since neighbours show the same view."""


def camera_record(fit: CameraFit) -> dict[str, Any]:
    """Return the record of a camera file: estimates, intervals, residuals and their provenance, as plain values."""
    record = {
        "estimates": {
            name: {"estimate": e.estimate, "ci95": e.ci95, "unit": e.unit}
            for name, e in fit.estimates.items()
        },
        "rms_px": fit.rms,
        "held_out_rms_px": fit.held_out_rms,
        "views": len(fit.used),
        "left_out": {view.name: view.left_out for view in fit.views if view.left_out},
        "findings": [item.as_json() for item in fit.findings],
        "settings": fit.settings,
        "provenance": provenance(),
    }
    return dict(plain(record, DIGITS))


def camera_json(fit: CameraFit, out: Path | None = None) -> dict[str, Any]:
    """Return the content of `--json`: the record, the lens, every view, the correlation of the errors and the
    coverage."""
    views = [
        {
            "name": view.name,
            "rms_px": view.rms,
            "tilt_deg": math.degrees(view.tilt),
            "corners": len(view.pixels),
            "left_out": view.left_out or None,
        }
        for view in fit.views
    ]
    record = {
        "per_view": views,
        "error95_px": dict(zip(("where_seen", "anywhere"), fit.error95, strict=True)),
        "empty_edges": empty_edges(fit.lens, fit.used),
        "correlation": fit.correlation.as_json(),
    }
    return {
        "kind": "camera",
        **camera_record(fit),
        "parameters": {name: estimate.as_json() for name, estimate in fit.estimates.items()},
        **plain(record, DIGITS),
        "out": None if out is None else str(out),
    }


def camera_report(fit: CameraFit) -> Report:
    """Return the report of the calibration."""
    worst = max(fit.used, key=lambda view: view.rms)
    held_out = "too few views to hold any out"
    if math.isfinite(fit.held_out_rms):
        held_out = f"views held out: {fit.held_out_rms:.3f} px"
    summary = [
        f"residual {fit.rms:.3f} px rms of a corner, worst view {worst.name} {worst.rms:.3f} px; {held_out}"
    ]
    if math.isfinite(fit.error95[1]):
        summary.append(
            f"uncertainty of a pixel (95 %): {fit.error95[0]:.2f} px where corners were detected, "
            f"up to {fit.error95[1]:.2f} px elsewhere in the picture"
        )
    return Report(
        title="Camera calibration",
        heads=(*HEADS, "note"),
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


# Figures of a lens calibration: detected corners, uncertainty over the picture, residuals.


def camera_pictures(fit: CameraFit) -> dict[str, tuple[str, bytes]]:
    """Return the figures: file name -> caption and PNG."""
    drawn = {
        "coverage.png": ("Detected corners, and uncertainty of pixels", _coverage(fit)),
        "residuals.png": ("Residuals of the corners, enlarged", _residuals(fit)),
    }
    return {name: (text, png(figure)) for name, (text, figure) in drawn.items()}


def _coverage(fit: CameraFit) -> Figure:
    from matplotlib.colors import LogNorm

    width, height = fit.lens.width, fit.lens.height
    figure = new_figure(7.4, 7.4 * height / width + 0.3)
    axes = figure.subplots()
    corners = np.concatenate([view.pixels for view in fit.used])
    error = pixel_error(fit.lens, picture_grid(fit.lens), corners, fit.covariance)
    image = axes.imshow(
        np.clip(np.ma.masked_invalid(error), 0.03, 30.0),
        extent=(-0.5, width - 0.5, height - 0.5, -0.5),
        cmap="viridis_r",
        norm=LogNorm(0.03, 30.0),
        alpha=0.75,
    )
    for view in fit.views:
        mark = {"color": VERMILION, "marker": "x"} if view.left_out else {"color": "black", "marker": "."}
        axes.plot(*view.pixels.T, linestyle="", markersize=2.5, **mark)
    picture_axes(axes, fit.lens)
    axes.set_title("corners (crosses: left out) and 95 % uncertainty of a pixel [px]", fontsize=9)
    figure.colorbar(image, ax=axes, shrink=0.8, label="px")
    return figure


def _residuals(fit: CameraFit) -> Figure:
    pixels = np.concatenate([view.pixels for view in fit.used])
    residuals = np.concatenate([view.residuals for view in fit.used])
    figure = new_figure(7.4, 4.0)
    field, cloud = figure.subplots(1, 2, width_ratios=(1.9, 1.0))
    draw_arrows(field, pixels, residuals, np.ones(len(pixels), bool), "px", 1.0)
    picture_axes(field, fit.lens)
    cloud.plot(*residuals.T, ".", color=BLUE, markersize=2.5)
    limit = 1.1 * float(np.abs(residuals).max())
    cloud.set(xlim=(-limit, limit), ylim=(limit, -limit), aspect="equal")
    cloud.set(xlabel="along u [px]", ylabel="along v [px]")
    cloud.axhline(0.0, color=GRAY, linewidth=0.6)
    cloud.axvline(0.0, color=GRAY, linewidth=0.6)
    cloud.set_title(f"rms {fit.rms:.3f} px", fontsize=9)
    return figure


@dataclass(frozen=True, kw_only=True)
class BoardChoice:
    """Calibration board in the images."""

    board: str | None = None
    """(NxM) Number of inner corners of a chessboard, such as 9x6."""
    square: float = 0.025
    """Edge of a square [m]."""
    charuco: str | None = None
    """(NxM) Number of squares of a ChArUco board instead of a chessboard, such as 7x5."""
    marker: float | None = None
    """Edge of the board's markers [m]; default three quarters of a square."""
    dictionary: str = "DICT_5X5_100"
    """(NAME) OpenCV's name of the marker dictionary."""

    def made(self) -> Board:
        """Return the board.

        Raises:
            CalibrationError: There is no board or more than one, or a size cannot be parsed.
        """
        if (self.board is None) == (self.charuco is None):
            given = (
                "neither --board nor --charuco is" if self.board is None else "--board and --charuco are both"
            )
            raise CalibrationError(
                f"{given} given: name the one board that the pictures show, --board COLUMNSxROWS by its inner corners"
            )
        if self.charuco is not None:
            columns, rows = parse_size(self.charuco, "--charuco")
            edge = 0.75 * self.square if self.marker is None else self.marker
            return Board(
                columns=columns, rows=rows, square=self.square, marker=edge, dictionary=self.dictionary
            )
        columns, rows = parse_size(str(self.board), "--board")
        return Board(columns=columns, rows=rows, square=self.square)

    @property
    def options(self) -> dict[str, Any]:
        """Command-line options that specify the board."""
        if self.charuco is None:
            return {"square": self.square, "board": self.board}
        return {
            "square": self.square, "charuco": self.charuco, "dictionary": self.dictionary, "marker": self.marker
        }  # fmt: skip


def run(
    images: Sequence[Path],
    *,
    out: Path,
    board: Annotated[BoardChoice, "options"],
    model: str = "plumb_bob",
    report: Path | None = None,
    seed: int = 1,
    as_json: bool = False,
) -> CameraFit:
    """Fit a lens to images of a board: focal length and centre [px], distortion, with 95 % intervals.

    Example: finssim calibrate camera board/*.jpg --board 9x6 --square 0.025 --out camera.yaml

    Args:
        images (IMAGE): Images of a board, folders of them, or videos.
        out (FILE): Camera file to write (.yaml).
        board: Board in the images.
        model (MODEL): Lens: plumb_bob, rational or fisheye.
        report (DIR): Directory for the report and its figures.
        seed: Seed of every random number; equal seeds give equal results.
        as_json: Print one JSON object instead of tables.

    Returns:
        The fit.

    Raises:
        CalibrationError: The images cannot be used; nothing is written.
        LocalizationError: An image or video cannot be read; nothing is written.
        OutputError: A file cannot be written.
    """
    check_model(model)
    refuse_places(out, report, "camera")
    screen = Console(stderr=True)
    chosen = board.made()
    views, without = _board_views(images, chosen, screen)
    for name in without:
        screen.print(str(finding("board_unseen", name)), highlight=False, markup=False)
    if not views:
        raise CalibrationError(
            f"none of {len(without)} pictures shows a {chosen.words}: give --board or --charuco"
        )
    fit = calibrate_camera(views, model=model, seed=seed)
    fit.settings.update(board=chosen.words, square=chosen.square)
    write_camera(out, fit.lens, {**camera_record(fit), "without_board": without})
    summary = camera_report(fit)
    if report is not None:
        options = {"out": out, **board.options, "model": model, "seed": seed}
        repeat = [command_line("camera", images, options)]
        summary.write(report, camera_json(fit), camera_pictures(fit), repeat, {"Views": _views_table(fit)})
    publish(camera_json(fit, out) if as_json else None, summary.show, (out, report))
    return fit


def _board_views(images: Sequence[Path], board: Board, screen: Console) -> tuple[list[BoardView], list[str]]:
    """Return views of the board, and the names of the pictures without it; Ctrl-C keeps the views detected so far."""
    views: list[BoardView] = []
    without: list[str] = []
    try:
        for _, name, image in pictures(images):
            _, is_video, number = name.partition("#")
            if is_video and int(number) % OF_A_VIDEO:
                continue
            detection = see_board(image, board)
            if detection is None:
                without.append(name)
                continue
            height, width = image.shape
            views.append(
                BoardView(name=name, width=width, height=height, pixels=detection[0], points=detection[1])
            )
    except KeyboardInterrupt:
        screen.print(f"stopped after {len(views) + len(without)} pictures; fitting to those", highlight=False)
    return views, without
