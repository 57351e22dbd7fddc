"""Calibration boards with known corners, and detection of these corners in pictures."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finssim.trials.findings import CalibrationError

Array = NDArray[np.float64]

REFINE_SHARE = 0.35
"""Half width of the corner refinement window, relative to the distance to the nearest neighbour, so that it
contains no other corner [-]."""

WIDEST, NARROWEST = 11, 2
"""Bounds of the window's half width [px]."""


@dataclass(frozen=True, kw_only=True)
class Board:
    """Flat chessboard or ChArUco board."""

    columns: int
    """Number of inner corners along x of a chessboard; of squares of a ChArUco board."""
    rows: int
    """Number along y."""
    square: float
    """Edge of a square [m]."""
    marker: float | None = None
    """Edge of a marker's black border [m]; None for a chessboard."""
    dictionary: str = "DICT_5X5_100"
    """Dictionary of the markers, by OpenCV's name."""

    def __post_init__(self) -> None:
        least = 3 if self.marker is None else 2
        if self.columns < least or self.rows < least:
            raise CalibrationError(
                f"the board has {self.columns}x{self.rows} {'corners' if self.marker is None else 'squares'}, "
                f"expected at least {least} each way"
            )
        if not (math.isfinite(self.square) and self.square > 0.0):
            raise CalibrationError(f"the square is {self.square:.4g} m, expected a length above 0")
        if self.marker is not None and not 0.0 < self.marker < self.square:
            raise CalibrationError(
                f"the marker is {self.marker:.4g} m, expected more than 0 and less than the square's "
                f"{self.square:.4g} m"
            )

    @property
    def words(self) -> str:
        """Description such as `chessboard of 9x6 inner corners, squares of 25 mm`."""
        kind = "chessboard" if self.marker is None else "ChArUco board"
        pattern = "inner corners" if self.marker is None else f"squares, markers of {1e3 * self.marker:g} mm"
        return f"{kind} of {self.columns}x{self.rows} {pattern}, squares of {1e3 * self.square:g} mm"

    @property
    def corners(self) -> Array:
        """Inner corners on the board, row by row, z = 0 [m], (n, 3)."""
        less = 0 if self.marker is None else 1
        x, y = np.meshgrid(np.arange(self.columns - less), np.arange(self.rows - less))
        return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1) * self.square


@dataclass(frozen=True, kw_only=True)
class BoardView:
    """Corners of a board visible in one picture."""

    name: str
    width: int
    """Width of the picture [px]."""
    height: int
    """Height of the picture [px]."""
    pixels: Array
    """Pixels of the corners, integers at pixel centres, (n, 2)."""
    points: Array
    """Corners on the board, board frame, z = 0 [m], (n, 3)."""


def parse_size(text: str, option: str) -> tuple[int, int]:
    """Parse a size such as `9x6`.

    Raises:
        CalibrationError: The text is not of that form.
    """
    parts = text.lower().replace("×", "x").split("x")
    if len(parts) != 2 or not all(part.strip().isdigit() for part in parts):
        raise CalibrationError(f"{option} is '{text}', expected columns x rows such as 9x6")
    return int(parts[0]), int(parts[1])


def see_board(image: NDArray[np.uint8], board: Board) -> tuple[Array, Array] | None:
    """Detect a board in a picture.

    Args:
        image: Gray, (h, w).
        board: The board.

    Returns:
        Pixels (n, 2) and the corners on the board (n, 3) [m]; None if it is not detected. A chessboard is
        detected only completely, a ChArUco board also partially with at least 6 corners.

    Raises:
        CalibrationError: OpenCV has no such dictionary.
    """
    detection = (
        _chessboard(image, board.columns, board.rows) if board.marker is None else _charuco(image, board)
    )
    if detection is None:
        return None
    pixels, index = detection
    return pixels, board.corners[index]


def _chessboard(image: NDArray[np.uint8], columns: int, rows: int) -> tuple[Array, NDArray[np.int64]] | None:
    """Return pixels and indices of all inner corners; uses two detectors, since each misses boards that the
    other detects."""
    import cv2

    size = (columns, rows)
    success, corners = cv2.findChessboardCorners(
        image,
        size,
        flags=cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK,
    )
    if not success:
        success, corners = cv2.findChessboardCornersSB(image, size, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
    if not success:
        return None
    pixels = np.asarray(corners, float).reshape(-1, 2)
    return _refined(image, pixels), np.arange(columns * rows)


def _refined(image: NDArray[np.uint8], pixels: Array) -> Array:
    """Refine corners to subpixel accuracy by image gradients, each within a window that contains no other corner.

    A window of the usual size would pull the corners of a small or oblique board towards their neighbours, by
    pixels.
    """
    import cv2

    distance = np.linalg.norm(pixels[:, None] - pixels[None], axis=-1)
    spacing = np.where(distance > 0.0, distance, np.inf).min(axis=1)
    half = np.clip((REFINE_SHARE * spacing).astype(int), NARROWEST, WIDEST)
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-3)
    refined = pixels.copy()
    for size in np.unique(half):
        start = pixels[half == size].astype(np.float32).reshape(-1, 1, 2)
        refined[half == size] = cv2.cornerSubPix(
            image, start, (int(size), int(size)), (-1, -1), stop
        ).reshape(-1, 2)
    return refined


def _charuco(image: NDArray[np.uint8], board: Board) -> tuple[Array, NDArray[np.int64]] | None:
    """Return pixels and indices of the corners between squares with decoded markers, refined as those of a
    chessboard."""
    import cv2

    code = getattr(cv2.aruco, board.dictionary.upper(), None)
    if not isinstance(code, int):
        raise CalibrationError(
            f"unknown dictionary '{board.dictionary}', expected one of OpenCV's such as DICT_5X5_100 or DICT_4X4_50"
        )
    drawn = cv2.aruco.CharucoBoard(
        (board.columns, board.rows), board.square, board.marker, cv2.aruco.getPredefinedDictionary(code)
    )
    # Boards generated before OpenCV 4.6 start with the other colour if the number of rows is even.
    for legacy in (False, True):
        drawn.setLegacyPattern(legacy)
        pixels, ids, _, _ = cv2.aruco.CharucoDetector(drawn).detectBoard(image)
        if ids is not None and len(ids) >= 6:
            index = np.asarray(ids).ravel().astype(np.int64)
            at = np.asarray(pixels, float).reshape(-1, 2)
            return _refined(image, at), index
    return None
