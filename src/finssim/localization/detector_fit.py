"""Corners to a few hundredths of a pixel: the whole known tag is laid over the picture until the two agree.

The cells of a decoded tag are known, so each of their edges, inner ones too, tells where the tag lies. A homography is
fitted by Gauss-Newton (inverse compositional, so that its Jacobian is computed once) together with what the light did:
gain, offset, two slopes across the tag, and the blur. Blur widens an edge to both sides alike and moves no corner.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter
from scipy.special import ndtr

from finssim.localization.families import bitmap, family_named

__all__ = ["Fit", "fit_tag"]

Array = npt.NDArray[np.float64]
Gray = npt.NDArray[Any]

REACH = 0.1
"""White around the black border that is looked at [cells]. Little: many prints have less margin than the one cell that
is asked for, and the blur brings in what lies beyond."""
REACH_OF_DATA = -0.4
"""The same where data cells lie at the outside of the tag and anything may lie beside them [cells]."""
SAMPLES = 5
"""Along a cell, each way."""
BLURS = np.array([0.2, 0.24, 0.29, 0.35, 0.42, 0.5])
"""Blurs of the pattern to choose from, standard deviation [cells]."""
LENS_BLUR = 0.7
"""Assumed before the fit, pixel area and interpolation included, standard deviation [px]."""
STEPS = 15
SETTLED = 1e-3
"""Movement of a corner below which the fit ends [px]."""
_SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


@dataclass(frozen=True, eq=False)
class Fit:
    """How a tag lies in the picture."""

    corners: Array
    """Of the measured edge, pixels, (4, 2)."""
    correlation: float
    """Of the picture with the pattern: 1 is perfect, a tag that is not there has little."""
    contrast: float
    """White minus black [gray levels]."""


@dataclass(frozen=True, eq=False)
class _Pattern:
    """A tag as it should look, at n points of its own plane."""

    points: Array
    """x right, y down from the top left of the measured square, in edges; (n, 2)."""
    values: Array
    """0 black to 1 white, blurred; (n,)."""
    columns: Array
    """Derivatives of the gray by 8 parameters of a homography, 3 of the light, blur and gain, (n, 13)."""
    solver: Array
    """Their pseudo-inverse, (13, n)."""


def fit_tag(image: Gray, family: str, tag: int, corners: Array) -> Fit | None:
    """Fit a tag near the place where it was found.

    Args:
        image: Gray, linear in light where corners shall be without bias, (h, w).
        family: Name of its family.
        tag: Its id.
        corners: Where it was found, within about a third of a cell, pixels, (4, 2).

    Returns:
        The fit; where it does not settle near there the given corners, with the correlation that they have. None where
        part of the tag lies outside the picture, or the corners are no convex ring.
    """
    if not _convex(corners):
        return None
    cell = _cell(corners, family)
    patch, shift = _patch(image, corners, cell, smooth=(BLURS[0] * cell) ** 2 - LENS_BLUR**2)
    blur = _nearest(LENS_BLUR / cell)
    pattern = _pattern(family, tag, blur)
    given = _sample(patch, _through(_from_square(corners - shift), pattern.points))
    if given is None:
        return None
    fit, wider = _settle(pattern, patch, corners - shift, limit=1.0 + 0.5 * cell)
    better = _nearest(blur + wider)
    if fit is not None and better != blur:  # the picture is sharper or softer than was assumed
        fit = _settle(_pattern(family, tag, better), patch, fit.corners, limit=1.0 + 0.5 * cell)[0] or fit
    if fit is None:
        return Fit(corners, _correlation(pattern.values, given), float(np.ptp(given)))
    return replace(fit, corners=fit.corners + shift)


def _settle(pattern: _Pattern, patch: Array, start: Array, limit: float) -> tuple[Fit | None, float]:
    """The fit of a pattern from a start, and by how much the picture's blur is wider [cells].

    None where it moves a corner by more than the limit [px], or out of the patch, or does not come to rest.
    """
    H = _from_square(start)
    here = start
    for _ in range(STEPS):
        seen = _sample(patch, _through(H, pattern.points))
        if seen is None:
            break
        solution = pattern.solver @ seen
        gain = float(solution[12])
        if not gain > 0.0 or np.abs(solution[:8]).max() > 0.3 * gain:
            break
        H = H @ np.linalg.inv(np.eye(3) + np.append(solution[:8] / gain, 0.0).reshape(3, 3))
        before, here = here, _through(H, _SQUARE)
        if not np.abs(here - start).max() < limit:
            break
        if np.abs(here - before).max() < SETTLED:
            return Fit(here, _correlation(pattern.columns @ solution, seen), gain), float(solution[11]) / gain
    return None, 0.0


def _correlation(a: Array, b: Array) -> float:
    a, b = a - a.mean(), b - b.mean()
    return float(a @ b) / max(float(np.sqrt((a @ a) * (b @ b))), 1e-12)


def _convex(corners: Array) -> bool:
    """Whether the corners run clockwise in the picture (v down) around a convex ring."""
    side = np.roll(corners, -1, axis=0) - corners
    after = np.roll(side, -1, axis=0)
    return bool(np.all(side[:, 0] * after[:, 1] - side[:, 1] * after[:, 0] > 1.0))


def _cell(corners: Array, family: str) -> float:
    """Mean side of a cell [px]."""
    sides = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    return float(sides.mean()) / family_named(family).border


def _nearest(blur: float) -> float:
    """The blur of a pattern that comes nearest."""
    return float(BLURS[np.abs(BLURS - blur).argmin()])


@lru_cache(maxsize=256)
def _pattern(family: str, tag: int, blur: float) -> _Pattern:
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
    columns = np.column_stack([*motion, np.ones_like(x), x - 0.5, y - 0.5, blurred, values])
    return _Pattern(np.column_stack([x, y]), values, columns, np.linalg.pinv(columns))


def _weights(places: Array, outside: int, cells: int, blur: float) -> tuple[Array, Array, Array]:
    """Share of every cell in the gray at the places along one axis, and its derivatives by place and blur."""
    edges = np.arange(-outside - 3, cells - outside + 4)
    z = (places[:, None] - edges) / blur
    bell = np.exp(-0.5 * z**2) / np.sqrt(2.0 * np.pi)
    share = -np.diff(ndtr(z), axis=1)
    return share, -np.diff(bell, axis=1) / blur, np.diff(z * bell, axis=1) / blur


def _patch(image: Gray, corners: Array, cell: float, smooth: float) -> tuple[Array, Array]:
    """The picture around a tag, blurred by a variance [px²] where that is positive, and its top left pixel."""
    reach = 3.0 * cell + 4.0
    low = np.maximum(np.floor(corners.min(axis=0) - reach), 0.0)
    high = np.ceil(corners.max(axis=0) + reach).astype(int) + 1
    x, y = low.astype(int)
    patch = image[y : high[1], x : high[0]].astype(np.float64)
    if smooth > 0.0:
        patch = gaussian_filter(patch, np.sqrt(smooth), mode="nearest", truncate=3.0)
    return patch, low


def _sample(patch: Array, points: Array) -> Array | None:
    """Gray at points between pixels, bilinear, (n,); None where one lies outside the patch."""
    whole = np.floor(points).astype(np.intp)
    x, y = whole[:, 0], whole[:, 1]
    if x.min() < 0 or y.min() < 0 or x.max() >= patch.shape[1] - 1 or y.max() >= patch.shape[0] - 1:
        return None
    a, b = (points - whole).T
    flat = patch.ravel()
    at = y * patch.shape[1] + x
    below = at + patch.shape[1]
    return np.asarray(
        (1.0 - b) * ((1.0 - a) * flat[at] + a * flat[at + 1])
        + b * ((1.0 - a) * flat[below] + a * flat[below + 1])
    )


def _from_square(corners: Array) -> Array:
    """The homography that takes the unit square, x right and y down, to four corners, (3, 3)."""
    a, b, c, d = corners
    pull = np.linalg.solve(np.column_stack([b - c, d - c]), a - b + c - d)
    columns = [b - a + pull[0] * b, d - a + pull[1] * d, a]
    return np.vstack([np.column_stack(columns), [pull[0], pull[1], 1.0]])


def _through(H: Array, points: Array) -> Array:
    """Points taken through a homography, (n, 2)."""
    p = points @ H[:, :2].T + H[:, 2]
    return np.asarray(p[:, :2] / p[:, 2:])
