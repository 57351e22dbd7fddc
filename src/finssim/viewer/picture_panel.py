"""The camera's picture with the tags outlined, in the panel's size, and the tags enlarged in a corner."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from finssim.viewer.frame import Picture

__all__ = ["blank", "draw_picture"]

Image = npt.NDArray[np.uint8]
Array = npt.NDArray[np.float64]

WIDTH = 480
"""Of the drawn picture, at least, if the camera has so many [px]."""
DARK, LINE, FIRST = (30, 45, 58), (40, 230, 90), (255, 70, 60)
"""Ground without a picture, the outline of a tag, and its first edge."""
INSET = 70
"""Half the edge of the part that is enlarged [px of the camera]."""
ENLARGED = 1.5
"""How much larger than in the camera's picture that part is drawn."""


def blank() -> Image:
    """What is shown before the first picture, (h, w, 3)."""
    return np.full((WIDTH * 9 // 16, WIDTH, 3), DARK, np.uint8)


def draw_picture(picture: Picture) -> Image:
    """A picture in colours, smaller by a whole number, (h, w, 3)."""
    rows, columns = picture.size if picture.image is None else picture.image.shape[:2]
    every = max(1, columns // WIDTH)
    if picture.image is None:
        full = np.full((rows, columns, 3), DARK, np.uint8)
    else:
        full = np.repeat(picture.image[:, :, None], 3, axis=2)
    shown = np.ascontiguousarray(full[::every, ::every])
    outlines = [np.asarray(tag.corners, float) for tag in picture.tags]
    for corners in outlines:
        _outline(shown, corners / every, reach=0)
    if outlines:
        _inset(shown, full, outlines)
    return shown


def _inset(shown: Image, full: Image, outlines: list[Array]) -> None:
    """Put the surroundings of the tags, enlarged, into the lower left corner."""
    middle = np.concatenate(outlines).mean(axis=0)
    size = min(round(2 * INSET * ENLARGED), shown.shape[0], shown.shape[1])
    first = middle - 0.5 * size / ENLARGED
    x, y = ((first[:, None] + (np.arange(size) + 0.5) / ENLARGED).round().astype(int)).clip(0)
    part = full[np.minimum(y, full.shape[0] - 1)][:, np.minimum(x, full.shape[1] - 1)].copy()
    for corners in outlines:
        _outline(part, (corners - first) * ENLARGED, reach=1)
    part[:2], part[:, -2:] = 255, 255
    shown[-size:, :size] = part


def _outline(image: Image, corners: Array, reach: int) -> None:
    """Draw a tag's edges, lines `reach` pixels to either side; what lies outside is left out."""
    for i in range(4):
        a, b = corners[i], corners[(i + 1) % 4]
        if not np.isfinite([a, b]).all():
            continue
        steps = int(np.ceil(np.abs(b - a).max())) + 1
        x, y = np.linspace(a, b, min(steps, 4000)).round().astype(int).T
        for dx in range(-reach, reach + 1):
            for dy in range(-reach, reach + 1):
                u, v = x + dx, y + dy
                inside = (u >= 0) & (v >= 0) & (u < image.shape[1]) & (v < image.shape[0])
                image[v[inside], u[inside]] = FIRST if i == 0 else LINE
