"""A tag as it should look in a picture, and how its gray changes as it moves, blurs or brightens."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from finssim.localization.detection.families import bitmap, family_named

__all__ = ["BLURS", "Pattern", "nearest_blur", "pattern_of"]

Array = npt.NDArray[np.float64]

REACH = 0.1
"""White around the black border that is looked at [cells]. Little: many prints have less margin than the one cell that
is asked for, and the blur brings in what lies beyond."""
REACH_OF_DATA = -0.4
"""The same where data cells lie at the outside of the tag and anything may lie beside them [cells]."""
SAMPLES = 5
"""Along a cell, each way."""
BLURS = np.array([0.2, 0.24, 0.29, 0.35, 0.42, 0.5])
"""Blurs of the pattern to choose from, standard deviation [cells]."""
SURROUND = 0.8
"""Reach of the local mean that is taken off, standard deviation [cells]."""
FLAT = 0.5
"""Share of the contrast of the whole tag below which a place counts as flat."""


@dataclass(frozen=True, eq=False)
class Pattern:
    """A tag as it should look, at n = m² points of a grid on its own plane."""

    points: Array
    """x right, y down from the top left of the measured square, in edges; (n, 2)."""
    values: Array
    """0 black to 1 white, blurred; (n,)."""
    surround: Array
    """Weights of the local mean along a side of the grid, (m, m)."""
    columns: Array
    """Derivatives of the gray by 8 parameters of a homography, blur and gain, less their local means, (n, 10)."""
    solver: Array
    """Their pseudo-inverse, (10, n)."""
    plain: Array
    """Pseudo-inverse of derivatives by 8 parameters, offset and two slopes of the light, blur and gain, (13, n)."""

    def even(self, seen: Array) -> Array:
        """Gray at the points as under even light: less its local mean, over its local contrast, (n,)."""
        level = self.less_mean(seen)
        return level / self._spread(level)

    def less_mean(self, seen: Array) -> Array:
        """Gray less its local mean, (n,)."""
        return seen - self._smooth(seen)

    def contrast(self, seen: Array) -> Array:
        """Local standard deviation of the gray, with a share of that of all of it, (n,)."""
        return self._spread(self.less_mean(seen))

    def _spread(self, level: Array) -> Array:
        square = level * level
        return np.asarray(np.sqrt(self._smooth(square) + FLAT**2 * square.mean() + 1e-12))

    def _smooth(self, seen: Array) -> Array:
        grid = seen.reshape(self.surround.shape)
        return np.asarray((self.surround @ grid @ self.surround.T).ravel())


def nearest_blur(blur: float) -> float:
    """The blur of a pattern that comes nearest."""
    return float(BLURS[np.abs(BLURS - blur).argmin()])


@lru_cache(maxsize=256)
def pattern_of(family: str, tag: int, blur: float) -> Pattern:
    """The pattern of a tag with a blur [cells]."""
    kind = family_named(family)
    reach = REACH_OF_DATA if kind.outside else REACH
    low, high = -kind.outside - reach, kind.border + kind.outside + reach
    places = np.linspace(low, high, round((high - low) * SAMPLES) + 1)
    weight, slope, widening = _weights(places, kind.outside, kind.cells, blur)
    cells = np.pad(bitmap(family, tag).astype(float), 3, constant_values=1.0)
    n = kind.border
    values = (weight @ cells @ weight.T).ravel()
    along_x = (weight @ cells @ slope.T).ravel() * n
    along_y = (slope @ cells @ weight.T).ravel() * n
    blurred = (weight @ cells @ widening.T + widening @ cells @ weight.T).ravel()
    y, x = (z.ravel() / n for z in np.meshgrid(places, places, indexing="ij"))
    radial = x * along_x + y * along_y
    motion = [x * along_x, y * along_x, along_x, x * along_y, y * along_y, along_y, -x * radial, -y * radial]
    far = (places[:, None] - places) / SURROUND
    surround = np.exp(-0.5 * far**2)
    surround /= surround.sum(axis=1, keepdims=True)
    bare = Pattern(np.column_stack([x, y]), values, surround, *(np.empty(0) for _ in range(3)))
    flat = [bare.less_mean(column) / bare.contrast(values) for column in (*motion, blurred, values)]
    columns = np.column_stack(flat)
    plain = np.column_stack([*motion, np.ones_like(x), x - 0.5, y - 0.5, blurred, values])
    return replace(bare, columns=columns, solver=_inverse(columns), plain=_inverse(plain))


def _inverse(columns: Array) -> Array:
    return np.asarray(np.linalg.pinv(columns), np.float64)


def _weights(places: Array, outside: int, cells: int, blur: float) -> tuple[Array, Array, Array]:
    """Share of every cell in the gray at the places along one axis, and its derivatives by place and blur."""
    edges = np.arange(-outside - 3, cells - outside + 4)
    z = (places[:, None] - edges) / blur
    bell = np.exp(-0.5 * z**2) / np.sqrt(2.0 * np.pi)
    share = -np.diff(ndtr(z), axis=1)
    return share, -np.diff(bell, axis=1) / blur, np.diff(z * bell, axis=1) / blur
