"""Corners of boards are found accurately, in pixels whose centres have integer coordinates."""

import cv2
import numpy as np
import pytest

from finssim.survey.boards import Board, parse_size, see_board
from finssim.trials.findings import CalibrationError

CHESSBOARD = Board(columns=9, rows=6, square=0.025)
H = np.array([[1500.0, 260.0, 120.0], [-180.0, 1420.0, 130.0], [0.35, 0.25, 1.0]])
"""Board plane [m] to pixels: an oblique view."""


def drawn(H, width=640, height=480, columns=9, rows=6, square=0.025, samples=6):
    """Return a gray picture of a chessboard: the mean over each pixel, whose centre has integer coordinates."""
    step = (np.arange(samples) + 0.5) / samples - 0.5
    u = (np.arange(width)[:, None] + step).ravel()
    v = (np.arange(height)[:, None] + step).ravel()
    U, V = np.meshgrid(u, v)
    board = np.stack([U, V, np.ones_like(U)], axis=-1) @ np.linalg.inv(H).T
    x, y = board[..., 0] / board[..., 2] / square, board[..., 1] / board[..., 2] / square
    dark = (np.floor(x) + np.floor(y)) % 2 == 0
    inside = (x > -1) & (x < columns) & (y > -1) & (y < rows)
    fine = np.where(inside & dark, 30.0, 220.0)
    return fine.reshape(height, samples, width, samples).mean(axis=(1, 3)).astype(np.uint8)


def at(H, points):
    """Return the pixels of board points."""
    seen = np.column_stack([points[:, :2], np.ones(len(points))]) @ H.T
    return seen[:, :2] / seen[:, 2:]


def order_free(pixels, expected):
    """Return the distance of each found corner to the nearest true one."""
    return np.linalg.norm(pixels[:, None] - expected[None], axis=-1).min(axis=1)


def test_corners_of_a_chessboard_lie_where_it_was_drawn():
    """Integer coordinates are pixel centres: an offset of half a pixel would be detected."""
    pixels, points = see_board(drawn(H), CHESSBOARD)
    expected = at(H, CHESSBOARD.corners)
    assert order_free(pixels, expected).max() < 0.12
    assert (
        np.abs(
            (pixels - expected[np.argmin(np.linalg.norm(pixels[:, None] - expected, axis=-1), axis=1)]).mean()
        )
        < 0.03
    )
    assert points.shape == (54, 3)


def test_a_small_board_is_not_pulled_together():
    """Squares of a dozen pixels keep their corners: the refinement window contains no other corner."""
    small = np.array([[480.0, 30.0, 200.0], [-60.0, 440.0, 160.0], [0.2, 0.5, 1.0]])
    pixels, _ = see_board(drawn(small), CHESSBOARD)
    assert order_free(pixels, at(small, CHESSBOARD.corners)).max() < 0.25


def charuco_picture(columns, rows, legacy=False, pixels=60, margin=40, fine=8):
    """Return a board drawn eight times as large, since OpenCV paints squares a pixel too wide, and averaged."""
    board = cv2.aruco.CharucoBoard(
        (columns, rows), 0.04, 0.03, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    )
    board.setLegacyPattern(legacy)
    size = (columns * pixels + 2 * margin, rows * pixels + 2 * margin)
    large = board.generateImage((fine * size[0], fine * size[1]), marginSize=fine * margin)
    return cv2.GaussianBlur(cv2.resize(large, size, interpolation=cv2.INTER_AREA), (0, 0), 0.8)


@pytest.mark.parametrize(("columns", "rows", "legacy"), [(7, 5, False), (6, 8, False), (6, 8, True)])
def test_corners_of_a_charuco_board_lie_where_it_was_drawn(columns, rows, legacy):
    """The edge between two pixels is at a half; boards of old and new patterns are read."""
    board = Board(columns=columns, rows=rows, square=0.04, marker=0.03)
    pixels, points = see_board(charuco_picture(columns, rows, legacy), board)
    u, v = np.meshgrid(np.arange(1, columns), np.arange(1, rows))
    expected = np.stack([40 + 60 * u.ravel() - 0.5, 40 + 60 * v.ravel() - 0.5], axis=-1)
    assert order_free(pixels, expected).max() < 0.1
    spread = np.ptp(pixels, axis=0) / np.ptp(points[:, :2], axis=0)
    np.testing.assert_allclose(spread, 60 / 0.04, rtol=1e-3)


def test_a_hidden_part_of_a_charuco_board_is_left_out():
    """The corners that remain keep their places on the board."""
    picture = charuco_picture(7, 5)
    picture[:, 330:] = 255
    pixels, points = see_board(picture, Board(columns=7, rows=5, square=0.04, marker=0.03))
    assert 6 <= len(pixels) < 24
    slope = np.polyfit(points[:, 0], pixels[:, 0], 1)[0]
    assert slope == pytest.approx(60 / 0.04, rel=2e-3)


def test_a_picture_without_a_board_shows_none():
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 255, (240, 320)).astype(np.uint8)
    assert see_board(noise, CHESSBOARD) is None


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: parse_size("9", "--board"), "columns x rows such as 9x6"),
        (lambda: Board(columns=9, rows=6, square=0.0), "a length above 0"),
        (lambda: Board(columns=7, rows=5, square=0.03, marker=0.04), "less than the square's"),
        (lambda: Board(columns=2, rows=6, square=0.03), "at least 3"),
        (
            lambda: see_board(
                charuco_picture(7, 5), Board(columns=7, rows=5, square=1, marker=0.5, dictionary="X")
            ),
            "unknown dictionary 'X'",
        ),
    ],
)
def test_what_makes_no_board_is_refused(make, words):
    with pytest.raises(CalibrationError, match=words):
        make()
