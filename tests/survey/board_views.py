"""Views of a board through a known lens, and OpenCV's photographs of a board."""

from functools import cache
from pathlib import Path

import numpy as np

from finssim.core.optics import Lens
from finssim.core.rotations import quat_from_euler, quat_to_matrix
from finssim.localization.detection.pictures import pictures
from finssim.survey.boards import Board, BoardView, see_board

PHOTOGRAPHS = Path(__file__).resolve().parents[1] / "data" / "opencv_chessboards"
BOARD = Board(columns=9, rows=6, square=0.03)

LENSES = {
    "plumb_bob": Lens(
        1280, 720, 841.0, 838.0, 652.0, 351.0, "plumb_bob", (-0.24, 0.09, 0.0009, -0.0006, -0.01)
    ),
    "rational": Lens(
        1280, 720, 741.0, 738.0, 652.0, 351.0, "rational", (0.4, -0.02, 0.0005, -0.0004, 0.01, 0.7, 0.05, 0.0)
    ),
    "fisheye": Lens(1280, 960, 391.0, 390.0, 645.0, 471.0, "fisheye", (0.03, -0.012, 0.004, -0.001)),
}


def views(lens, count, rng, *, noise=0.15, tilt=0.7, reach=0.75):
    """Return boards all over the picture, tilted in all directions by up to `tilt` [rad]."""
    found = []
    while len(found) < count:
        roll, pitch, yaw = rng.uniform(-tilt, tilt), rng.uniform(-tilt, tilt), rng.uniform(-0.4, 0.4)
        R = quat_to_matrix(quat_from_euler(roll, pitch, yaw))
        where = np.array([lens.width, lens.height]) * (0.5 + reach * (rng.uniform(size=2) - 0.5))
        ray, ok = lens.rays(where)
        if not ok:
            continue
        middle = rng.uniform(0.35, 0.8) * ray
        points_c = (BOARD.corners - BOARD.corners.mean(axis=0)) @ R.T + middle
        pixels, seen = lens.project(points_c)
        if seen.all() and lens.inside(pixels).all():
            pixels = pixels + noise * rng.standard_normal(pixels.shape)
            found.append(
                BoardView(
                    name=f"{len(found):02d}.png",
                    width=lens.width,
                    height=lens.height,
                    pixels=pixels,
                    points=BOARD.corners,
                )
            )
    return found


@cache
def photographed():
    """Return OpenCV's 13 photographs, 9x6 corners of 25 mm."""
    board = Board(columns=9, rows=6, square=0.025)
    found = []
    for _, name, image in pictures(PHOTOGRAPHS, notify=lambda words: None):
        pixels, points = see_board(image, board)
        found.append(BoardView(name=name, width=640, height=480, pixels=pixels, points=points))
    return tuple(found)
