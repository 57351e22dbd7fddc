"""Hull shapes in the cube [-1, 1]³: ellipsoid, tube, rounded box, and the open frame of a small ROV."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

__all__ = ["unit_hull"]

Vertices = NDArray[np.float64]
Faces = NDArray[np.int64]

_ROUND = 0.5  # reciprocal exponent of a circle


def unit_hull(fill: float) -> tuple[Vertices, Faces]:
    """Rounded box, tube or open frame that reaches all sides of the cube and takes a share of its volume.

    Args:
        fill: The share, above 0 and up to 1.

    Returns:
        Vertices (n, 3) and outward faces (m, 3).
    """
    cells = (8, 4, 4)

    def excess(along: float, across: float) -> float:
        return _volume(*_superellipsoid(cells, along, across)) / 8.0 - fill

    if excess(_ROUND, _ROUND) > 0.0:
        return _open_frame(fill)
    if excess(0.0, _ROUND) > 0.0:
        return _superellipsoid(cells, brentq(lambda s: excess(s, _ROUND), 0.0, _ROUND, xtol=1e-15), _ROUND)
    if excess(0.0, 0.0) <= 0.0:
        return _superellipsoid(cells, 0.0, 0.0)
    s = brentq(lambda s: excess(s, s), 0.0, _ROUND, xtol=1e-15)
    return _superellipsoid(cells, s, s)


def _open_frame(fill: float, gap: float = 0.02) -> tuple[Vertices, Faces]:
    """Two floats and the deck between them in [-1, 1]³.

    At thickness t a float takes t/3 of the width and the deck t of the height, with `gap`, a share of the
    width, open on either side: fill / k = 2t/3 + t (1 - 2t/3 - 2 gap), where k is the fill of one body in its
    own box.
    """
    body, faces = _superellipsoid((4, 2, 2), 0.15, 0.15)
    k = _volume(body, faces) / 8.0
    b = 5.0 / 3.0 - 2.0 * gap
    t = (b - math.sqrt(b * b - 8.0 / 3.0 * fill / k)) * 0.75
    side = body * [1.0, t / 3.0, 1.0]
    aside = np.array([0.0, 1.0 - t / 3.0, 0.0])
    deck = body * [1.0, 1.0 - 2.0 * t / 3.0 - 2.0 * gap, t]
    vertices = np.concatenate([side - aside, deck, side + aside])
    return vertices, np.concatenate([faces + i * len(body) for i in range(3)])


def _superellipsoid(cells: tuple[int, int, int], along: float, across: float) -> tuple[Vertices, Faces]:
    """Surface in [-1, 1]³: |x|ⁿ + rⁿ = 1 with rᵐ = |y|ᵐ + |z|ᵐ.

    Args:
        cells: Even numbers of cells along x, y and z of the cube whose grid is drawn in to the surface.
        along: 1/n, from 0 (flat ends) to 0.5 (elliptic).
        across: 1/m, from 0 (a rectangular section) to 0.5 (a round one).

    Returns:
        Vertices (n, 3) and faces (m, 3), two for each cell, mirrored on the three planes.
    """
    points, faces = _cube(cells)
    square = np.abs(points[:, 1:]).max(axis=1)
    section = _norm(points[:, 1:], across)
    points[:, 1:] *= np.divide(square, section, out=np.ones_like(square), where=section > 0)[:, None]
    return points / _norm(np.stack([points[:, 0], square], axis=1), along)[:, None], faces


def _norm(x: NDArray[np.float64], s: float) -> NDArray[np.float64]:
    """Norm (sum of |x|^(1/s))^s over the last axis, the greatest |x| for s = 0."""
    greatest = np.abs(x).max(axis=-1)
    if s == 0.0:
        return np.asarray(greatest)
    scaled = np.divide(np.abs(x), greatest[..., None], out=np.zeros_like(x), where=greatest[..., None] > 0)
    return np.asarray(greatest * (scaled ** (1.0 / s)).sum(axis=-1) ** s)


def _cube(cells: tuple[int, int, int]) -> tuple[Vertices, Faces]:
    """Surface of the cube [-1, 1]³ with even `cells` along x, y, z, two triangles to each."""
    corners = []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for i in range(cells[u]):
            for j in range(cells[v]):
                quad = np.ones((4, 3))
                quad[:, u] = np.array([i, i + 1, i + 1, i]) * 2.0 / cells[u] - 1.0
                quad[:, v] = np.array([j, j, j + 1, j + 1]) * 2.0 / cells[v] - 1.0
                # The diagonal that does not point at the middle of the side keeps the rounded body convex.
                first = 1 if (2 * i < cells[u]) == (2 * j < cells[v]) else 0
                a, b, c, d = np.roll(quad, -first, axis=0)
                front = np.stack([[a, b, c], [a, c, d]])
                back = front[:, ::-1].copy()
                back[..., axis] = -1.0
                corners += [front, back]
    points, index = np.unique(np.concatenate(corners).reshape(-1, 3), axis=0, return_inverse=True)
    return points, index.reshape(-1, 3).astype(np.int64)


def _volume(points: Vertices, faces: Faces) -> float:
    return float(np.linalg.det(points[faces]).sum() / 6.0)
