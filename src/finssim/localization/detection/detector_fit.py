"""Corners to a few hundredths of a pixel: the whole known tag is laid over the picture until the two agree.

The cells of a decoded tag are known, so each of their edges, inner ones too, tells where the tag lies. A homography is
fitted by Gauss-Newton (inverse compositional, so that its Jacobian is computed once) together with what the light did:
gain, offset, two slopes across the tag, and the blur. Blur widens an edge to both sides alike and moves no corner. Then
the same in local contrast, which glare and shadows change little, with less weight where something hides the tag.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter

from finssim.localization.detection.detector_pattern import BLURS, Pattern, nearest_blur, pattern_of
from finssim.localization.detection.families import family_named

__all__ = ["Fit", "fit_tag"]

Array = npt.NDArray[np.float64]
Gray = npt.NDArray[Any]

LENS_BLUR = 0.7
"""Assumed before the fit, pixel area and interpolation included, standard deviation [px]."""
STEPS = 15
SETTLED = 2e-3
"""Movement of a corner below which the fit ends [px]."""
COARSE = 0.05
"""The same for the first part of the fit."""
SMALLEST_RESIDUAL = 0.02
"""Misfit that is always taken for noise, share of the contrast."""
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
    blur = nearest_blur(LENS_BLUR / cell)
    pattern = pattern_of(family, tag, blur)
    given = _sample(patch, _through(_from_square(corners - shift), pattern.points))
    if given is None:
        return None
    limit = 1.0 + 0.5 * cell
    coarse = _settle(pattern, patch, corners - shift, limit, plain=True)
    found = coarse
    if coarse is not None:
        seen_blur = nearest_blur(blur + coarse.wider)  # sharper or softer than was assumed
        pattern = pattern_of(family, tag, seen_blur)
        found = _settle(pattern, patch, coarse.corners, limit) or coarse
        weights = _weights_of(found.left, found.gain) if found is not coarse else None
        if weights is not None:
            found = _settle(pattern, patch, found.corners, limit, solver=_solver(pattern, weights)) or found
    if coarse is None or found is None:
        return Fit(corners, _correlation(pattern.values, given), float(np.ptp(given)))
    return Fit(found.corners + shift, found.correlation, coarse.gain)


@dataclass(frozen=True, eq=False)
class _Settled:
    """Where a pattern came to rest on the patch."""

    corners: Array
    """(4, 2)."""
    gain: float
    """White minus black, in gray levels or in shares of the local contrast."""
    wider: float
    """By how much the picture's blur is wider than the pattern's [cells]."""
    left: Array
    """What the pattern does not explain, in the same unit, (n,)."""
    correlation: float


def _settle(
    pattern: Pattern,
    patch: Array,
    start: Array,
    limit: float,
    *,
    plain: bool = False,
    solver: Array | None = None,
) -> _Settled | None:
    """Gauss-Newton from a start; `plain` comes from farther, in gray as it is, and ends sooner.

    None where it moves a corner by more than the limit [px], or out of the patch, or does not come to rest.
    """
    solver = pattern.plain if plain else pattern.solver if solver is None else solver
    H = _from_square(start)
    here = start
    for _ in range(STEPS):
        seen = _sample(patch, _through(H, pattern.points))
        if seen is None:
            return None
        seen = seen if plain else pattern.even(seen)
        solution = solver @ seen
        gain = float(solution[-1])
        if not gain > 0.0 or np.abs(solution[:8]).max() > 0.3 * gain:
            return None
        H = H @ _undone((solution[:8] / gain).tolist())
        before, here = here, _through(H, _SQUARE).T
        if not np.abs(here - start).max() < limit:
            return None
        if np.abs(here - before).max() < (COARSE if plain else SETTLED):
            told = pattern.values if plain else pattern.columns @ solution
            return _Settled(here, gain, float(solution[-2]) / gain, seen - told, _correlation(told, seen))
    return None


def _weights_of(left: Array, gain: float) -> Array | None:
    """Weights of the points, small where glare, a shadow's edge or a finger hides the tag; None if nothing does."""
    scale = max(1.48 * float(np.median(np.abs(left))), SMALLEST_RESIDUAL * gain)
    far = (left / (3.0 * scale)) ** 2
    if np.mean(far > 1.0) < 0.01:
        return None
    return np.asarray(1.0 / (1.0 + far) ** 2)


def _solver(pattern: Pattern, weights: Array) -> Array:
    """Weighted pseudo-inverse, (10, n)."""
    weighted = pattern.columns * weights[:, None]
    return np.asarray(np.linalg.solve(weighted.T @ pattern.columns, weighted.T))


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
    """Gray at points between pixels (2, n), bilinear, (n,); None where one lies outside the patch."""
    height, width = patch.shape
    x, y = points
    if not (points.min() >= 0.0 and x.max() < width - 1 and y.max() < height - 1):
        return None
    whole = points.astype(np.intp)
    a, b = points - whole
    flat = patch.ravel()
    at = whole[1] * width + whole[0]
    upper, lower = flat.take(at), flat.take(at + width)
    upper += a * (flat.take(at + 1) - upper)
    lower += a * (flat.take(at + width + 1) - lower)
    return np.asarray(upper + b * (lower - upper))


def _from_square(corners: Array) -> Array:
    """The homography that takes the unit square, x right and y down, to four corners, (3, 3)."""
    (ax, ay), (bx, by), (cx, cy), (dx, dy) = corners.tolist()
    # The last row (g, h, 1) solves g (b - c) + h (d - c) = a - b + c - d.
    x, y = ax - bx + cx - dx, ay - by + cy - dy
    determinant = (bx - cx) * (dy - cy) - (dx - cx) * (by - cy)
    g = (x * (dy - cy) - y * (dx - cx)) / determinant
    h = (y * (bx - cx) - x * (by - cy)) / determinant
    return np.array(
        [[bx - ax + g * bx, dx - ax + h * dx, ax], [by - ay + g * by, dy - ay + h * dy, ay], [g, h, 1.0]]
    )


def _undone(motion: list[float]) -> Array:
    """Inverse of the homography [1+m0 m1 m2; m3 1+m4 m5; m6 m7 1] but for a factor, by its adjugate, (3, 3)."""
    a, b, c, d, e, f, g, h = motion
    a, e = 1.0 + a, 1.0 + e
    return np.array(
        [
            [e - f * h, c * h - b, b * f - c * e],
            [f * g - d, a - c * g, c * d - a * f],
            [d * h - e * g, b * g - a * h, a * e - b * d],
        ]
    )


def _through(H: Array, points: Array) -> Array:
    """Points (n, 2) taken through a homography, (2, n): in rows, which NumPy works through several times faster."""
    p = H[:, :2] @ points.T + H[:, 2:]
    return np.asarray(p[:2] / p[2])
