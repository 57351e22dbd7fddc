"""Tags on one board, surveyed as a whole: a YAML file that says where the first lies and how the others follow."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from finssim.calibration.errors import CalibrationError
from finssim.geometry.rotations import quat_from_euler, quat_rotate
from finssim.localization.detection.tags import corners
from finssim.localization.errors import LocalizationError
from finssim.localization.fields import Fields
from finssim.yaml_file import read_mapping

__all__ = ["grid_points"]


PRINTED = 0.0005
"""Standard error of a tag on a board where the file gives none [m]: printers and glue do no better."""


def grid_points(path: str | Path) -> tuple[dict[int, np.ndarray], float]:
    """Corners of the tags of a grid.

        grid: {first: 0, columns: 6, rows: 4, spacing: [0.13, 0.13], edge: 0.1, position: [0.2, 0.3, 0], yaw_deg: 90}

    Ids run along a column's x, then from row to row; `spacing` is from centre to centre along the printed x and y (a
    negative second number counts rows downwards); `position` is the centre of the first tag; `yaw_deg`, `pitch_deg`,
    `roll_deg` turn the board.

    Args:
        path: The file.

    Returns:
        Tag id -> corners in the survey's frame [m], (4, 3); and their standard error within the board (`sigma`) [m].

    Raises:
        CalibrationError: A key is missing, unknown or senseless.
    """
    try:
        tree = read_mapping(Path(path), LocalizationError, such_as="grid: {first: 0, columns: 6, rows: 4}")
        top = Fields(tree, str(path))
        fields = top.section("grid")
        top.finish()
        first, columns, rows = (int(fields.number(key)) for key in ("first", "columns", "rows"))
        dx, dy = fields.numbers("spacing", 2)
        edge, position = fields.number("edge"), fields.numbers("position", 3)
        angles = [fields.number(f"{name}_deg", 0.0) for name in ("roll", "pitch", "yaw")]
        sigma = fields.number("sigma", PRINTED)
        fields.finish()
    except LocalizationError as error:
        raise CalibrationError(str(error)) from None
    if columns < 1 or rows < 1 or edge <= 0.0 or min(abs(dx), abs(dy)) < edge:
        raise CalibrationError(
            f"{path}: grid of {columns} x {rows} tags of {edge:g} m every {dx:g}, {dy:g} m: expected at least one tag, "
            "an edge above 0 and a spacing above the edge"
        )
    turn = quat_from_euler(*np.radians(angles))
    found = {}
    for row in range(rows):
        for column in range(columns):
            flat = corners(edge) + np.array([column * dx, row * dy, 0.0])
            found[first + row * columns + column] = np.asarray(position) + quat_rotate(turn, flat)
    return found, sigma
