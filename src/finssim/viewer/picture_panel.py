"""The camera's picture with the tags outlined, as large as the panel needs it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from finssim.viewer.frame import Picture

__all__ = ["blank", "draw_picture"]

Image = npt.NDArray[np.uint8]

WIDTH = 480
"""Of the drawn picture, at least, if the camera has so many [px]."""
DARK, LINE, FIRST = (30, 45, 58), (40, 230, 90), (255, 70, 60)
"""Ground without a picture, the outline of a tag, and its first edge."""
THICK = 1
"""Pixels that an outline reaches to either side."""


def blank() -> Image:
    """What is shown before the first picture, (h, w, 3)."""
    return np.full((WIDTH * 9 // 16, WIDTH, 3), DARK, np.uint8)


def draw_picture(picture: Picture) -> Image:
    """A picture in colours, smaller by a whole number, (h, w, 3)."""
    rows, columns = picture.size if picture.image is None else picture.image.shape[:2]
    every = max(1, columns // WIDTH)
    if picture.image is None:
        shown = np.full((-(-rows // every), -(-columns // every), 3), DARK, np.uint8)
    else:
        shown = np.repeat(picture.image[::every, ::every, None], 3, axis=2)
    for tag in picture.tags:
        corners = np.asarray(tag.corners, float) / every
        for i in range(4):
            _line(shown, corners[i], corners[(i + 1) % 4], FIRST if i == 0 else LINE)
    return shown


def _line(image: Image, a: npt.NDArray[np.float64], b: npt.NDArray[np.float64], colour: object) -> None:
    """Draw from a to b (x, y); what lies outside is left out."""
    steps = int(np.ceil(np.abs(b - a).max())) + 1
    x, y = (np.linspace(a, b, steps).round().astype(int)).T
    for dx in range(-THICK, THICK + 1):
        for dy in range(-THICK, THICK + 1):
            u, v = x + dx, y + dy
            inside = (u >= 0) & (v >= 0) & (u < image.shape[1]) & (v < image.shape[0])
            image[v[inside], u[inside]] = colour
