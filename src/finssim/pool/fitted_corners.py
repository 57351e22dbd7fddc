"""What a detector that lays the whole known tag over the picture makes of it when ripples bend the tag's image.

The fit of `localization.detection` moves a homography until the edges of all cells agree with the picture, so its
corners are those of the tag as ripples shift it on average, not of the bent image. For small bends that is linear:
the corners follow from a few points of the tag by a matrix that the tag's cells alone decide.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from finssim.localization.detection.families import bitmap, family_named

__all__ = ["CornerFit"]

Array = npt.NDArray[np.float64]

NODES = 6
"""Along each side of the tag: a polynomial of degree 5 follows ripples as long as the tag's edge."""
HOMOGENEOUS = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [1.0, 1.0, 1.0], [0.0, 1.0, 1.0]])
"""Corners of the unit square."""
_UNITY = np.eye(3)


class CornerFit:
    """The tags of a vehicle: where to look at each, and which corners the fit reports."""

    def __init__(self, family: str, tags: Sequence[int], edge: float) -> None:
        """
        Args:
            family: Name of the tags' family.
            tags: Their ids.
            edge: Of the black border [m].
        """
        along = 0.5 - 0.5 * np.cos(np.pi * np.arange(NODES) / (NODES - 1))  # Chebyshev's, the ends included
        self._square = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
        self._at_corner = [0, NODES - 1, NODES * NODES - 1, NODES * (NODES - 1)]
        self.nodes = np.zeros((NODES * NODES, 3))
        """Points of a tag whose pixels `corners` wants, tag frame [m], (N, 3)."""
        self.nodes[:, 0] = edge * (self._square[:, 0] - 0.5)
        self.nodes[:, 1] = edge * (0.5 - self._square[:, 1])
        self._matrix = np.stack([_fit_matrix(family, tag, along, self._square) for tag in tags])

    def corners(self, pixels: Array) -> tuple[Array, Array]:
        """Corners that the fit reports, and how far ripples bend each tag.

        Args:
            pixels: Of `nodes` of every tag, (T, N, 2).

        Returns:
            Corners (T, 4, 2) [px], and the rms distance of the nodes from where the fit has them, in edges of the tag,
            (T,). Those of a tag of which not all nodes have pixels mean nothing.
        """
        with np.errstate(all="ignore"):
            square = [_from_square(tag) for tag in pixels[:, self._at_corner].tolist()]
            H, back = np.array(square), np.array([_adjugate(tag) for tag in square])
            seen = pixels @ back[:, :, :2].transpose(0, 2, 1) + back[:, None, :, 2]
            moved = (seen[..., :2] / seen[..., 2:] - self._square).transpose(0, 2, 1).reshape(len(H), -1)
            change = (self._matrix @ moved[..., None])[..., 0]
            warp = np.zeros((len(H), 9))
            warp[:, :8] = change[:, :8]
            image = HOMOGENEOUS @ (H @ (warp.reshape(-1, 3, 3) + _UNITY)).transpose(0, 2, 1)
            left = change[:, 8:]
            bend = np.sqrt(2.0 * (left * left).sum(axis=1) / left.shape[1])
            return image[..., :2] / image[..., 2:], bend


def _fit_matrix(family: str, tag: int, along: Array, square: Array) -> Array:
    """From motions of the nodes, all x before all y, to the fit's homography (8 rows) and what it leaves of them."""
    points, across = _cell_edges(family, tag)
    columns, there = _warp_columns(points), _interpolation(along, points)
    rows = np.where(across[:, None], columns[:, 0], columns[:, 1])
    u, v = np.where(across[:, None], there, 0.0), np.where(across[:, None], 0.0, there)
    warp = np.linalg.pinv(rows) @ np.concatenate([u, v], axis=1)
    at_nodes = _warp_columns(square)
    left = np.eye(2 * len(square)) - np.concatenate([at_nodes[:, 0], at_nodes[:, 1]]) @ warp
    return np.concatenate([warp, left])


def _cell_edges(family: str, tag: int) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Middles of all edges between a black and a white cell, unit square of the border with y down, (E, 2), and
    whether each is upright, so that the fit feels motion along x there, (E,)."""
    kind = family_named(family)
    cells = np.pad(bitmap(family, tag).astype(bool), 1, constant_values=True)
    upright = np.argwhere(cells[:, 1:] != cells[:, :-1])[:, ::-1] + np.array([0.0, -0.5])
    level = np.argwhere(cells[1:] != cells[:-1])[:, ::-1] + np.array([-0.5, 0.0])
    points = (np.concatenate([upright, level]) - kind.outside) / kind.border
    return points, np.arange(len(points)) < len(upright)


def _warp_columns(points: Array) -> Array:
    """d(x, y)/d(h) of the homography I + [[h0, h1, h2], [h3, h4, h5], [h6, h7, 0]] at points, (E, 2, 8)."""
    x, y = points.T
    one, zero = np.ones_like(x), np.zeros_like(x)
    return np.stack(
        [
            np.stack([x, y, one, zero, zero, zero, -x * x, -x * y], axis=-1),
            np.stack([zero, zero, zero, x, y, one, -x * y, -y * y], axis=-1),
        ],
        axis=1,
    )


def _interpolation(along: Array, points: Array) -> Array:
    """Weights of the nodes of a square grid in the polynomial through them, at points, (E, N)."""
    one = np.vander(along, len(along))
    by_x, by_y = (np.vander(x, len(along)) @ np.linalg.inv(one) for x in points.T)
    return np.asarray((by_y[:, :, None] * by_x[:, None, :]).reshape(len(points), -1))


def _from_square(corners: list[list[float]]) -> list[list[float]]:
    """The homography that takes the unit square, x right and y down, to four corners, (3, 3); unity where none does."""
    (ax, ay), (bx, by), (cx, cy), (dx, dy) = corners
    ux, uy, vx, vy = bx - cx, by - cy, dx - cx, dy - cy
    wx, wy = ax - bx + cx - dx, ay - by + cy - dy
    area = ux * vy - uy * vx
    if not abs(area) > 1e-9:
        return [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    p, q = (wx * vy - wy * vx) / area, (ux * wy - uy * wx) / area
    return [[bx - ax + p * bx, dx - ax + q * dx, ax], [by - ay + p * by, dy - ay + q * dy, ay], [p, q, 1.0]]


def _adjugate(H: list[list[float]]) -> list[list[float]]:
    """The homography back, (3, 3): the inverse but for a factor, which a homography does not feel."""
    (a, b, c), (d, e, f), (g, h, i) = H
    return [
        [e * i - f * h, c * h - b * i, b * f - c * e],
        [f * g - d * i, a * i - c * g, c * d - a * f],
        [d * h - e * g, b * g - a * h, a * e - b * d],
    ]
