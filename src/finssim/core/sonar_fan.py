"""Rendering of sonar pictures as fans seen from above."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray


def fan_picture(levels: NDArray[Any], sector: float, side: int = 720) -> NDArray[Any]:
    """Return a sonar's picture as a fan seen from above, with the sonar at the bottom and ahead pointing up;
    NaN outside.

    Args:
        levels: Levels of a picture by beam, starting at the left, and range cell, (beams, bins).
        sector: Field of view [rad].
        side: Number of rows of the result, which span the range [-].

    Returns:
        The picture, (side, columns).
    """
    rows, columns, inside = _fan_cells(*levels.shape, sector, side)
    return np.where(inside, levels[rows, columns], np.nan)


@cache
def _fan_cells(beams: int, bins: int, sector: float, side: int) -> tuple[NDArray[Any], ...]:
    """Return the beam and range cell of each pixel of a fan, and whether the pixel lies inside it, (side,
    columns) each."""
    half = min(1.0, math.sin(min(0.5 * sector, 0.5 * math.pi)))
    x = np.linspace(-half, half, round(2.0 * half * side))
    y = np.linspace(1.0, 0.0, side)[:, None]
    radius, azimuth = np.hypot(x, y), np.arctan2(-x, y)
    beam = (0.5 - azimuth / sector) * beams
    cell = radius * bins
    inside = (beam >= 0.0) & (beam < beams) & (cell < bins)
    rows, columns = (np.where(inside, index, 0).astype(int) for index in (beam, cell))
    return rows, columns, inside
