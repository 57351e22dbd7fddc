"""What `finssim calibrate camera` runs: read pictures, find the board, fit the lens, write the camera file."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console

from finssim.calibration.errors import CalibrationError
from finssim.calibration.vision.camera.boards import Board, BoardView, board_found, parse_size, see_board
from finssim.calibration.vision.camera.camera_fit import MODELS, CameraFit, calibrate_camera
from finssim.calibration.vision.camera.camera_report import (
    RECORD_FILE,
    camera_json,
    camera_record,
    print_camera,
    write_camera_report,
)
from finssim.files import atomic_directory, atomic_write, refuse_unwritable
from finssim.localization.camera_file import write_camera
from finssim.localization.detection.pictures import pictures

__all__ = ["run"]

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
    """Fit a lens to pictures of a board and write it.

    Args:
        images: Pictures, folders of them, or videos.
        out: Camera file to write, .yaml.
        board: Inner corners of a chessboard, `9x6`; common sizes are tried if None and no `charuco`.
        square: Edge of a square [m].
        charuco: Squares of a ChArUco board, `7x5`.
        marker: Edge of its markers' black border [m]; three quarters of a square if None.
        dictionary: Of its markers, as OpenCV calls it.
        model: plumb_bob, rational or fisheye.
        report: Directory of the report, or None.
        seed: Of the split for the held-out error.
        as_json: Print one JSON object in place of the table.

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
