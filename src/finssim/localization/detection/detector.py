"""Tag detection in a picture, corner refinement to a few hundredths of a pixel, and tracking in a stream of
pictures."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from finssim.localization import LocalizationError
from finssim.localization.detection.detections import Detection, best_detections
from finssim.localization.detection.families import EDGES, bitmap, family_named, find_tags

__all__ = ["REFINEMENTS", "Detector", "RegionTracker", "adjugate", "detector", "from_square"]

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.uint8]

# Expected appearance of a tag in a picture, and the derivatives of its gray by motion, blur and brightness.

REACH = 0.1
"""Width of the white around the black border that is used in the fit [cells]. It is small: many prints have a
narrower margin than the specified one cell, and blur mixes in the background beyond it."""
REACH_OF_DATA = -0.4
"""Width of the white around the border that is used if data cells lie at the outside of the tag, next to any
background [cells]."""
SAMPLES = 5
"""Number of samples along a cell, in each direction."""
BLURS = np.array([0.2, 0.24, 0.29, 0.35, 0.42, 0.5])
"""Candidate blurs of the pattern, standard deviation [cells]."""
SURROUND = 0.8
"""Width of the Gaussian window of the local mean that is subtracted, standard deviation [cells]."""
FLAT = 0.5
"""Floor of the local contrast, as a fraction of the contrast of the complete tag [-]."""


@dataclass(frozen=True, eq=False)
class Pattern:
    """Expected appearance of a tag at n = m² points of a grid on its own plane."""

    points: Array
    """x right, y down from the top left of the measured square [edges]; (n, 2)."""
    values: Array
    """Grey, 0 black to 1 white, blurred; (n,)."""
    surround: Array
    """Weights of the local mean along a side of the grid, (m, m)."""
    columns: Array
    """Derivatives of the gray by 8 parameters of a homography, blur and gain, minus their local means, (n, 10)."""
    solver: Array
    """Pseudo-inverse of `columns`, parameters per grey level [-], (10, n)."""
    plain: Array
    """Pseudo-inverse of the derivatives by 8 parameters of a homography, offset and two slopes of the
    illumination, blur and gain, per grey level [-], (13, n)."""

    def even(self, gray: Array) -> Array:
        """Return the gray at the points as under even illumination: minus its local mean, divided by its
        local contrast, (n,)."""
        level = self.less_mean(gray)
        return level / self._spread(level)

    def less_mean(self, gray: Array) -> Array:
        """Return the gray minus its local mean, (n,)."""
        return gray - self._smooth(gray)

    def contrast(self, gray: Array) -> Array:
        """Return the local standard deviation of the gray, with a floor relative to the overall contrast, (n,)."""
        return self._spread(self.less_mean(gray))

    def _spread(self, level: Array) -> Array:
        square = level * level
        return np.asarray(np.sqrt(self._smooth(square) + FLAT**2 * square.mean() + 1e-12))

    def _smooth(self, gray: Array) -> Array:
        grid = gray.reshape(self.surround.shape)
        return np.asarray((self.surround @ grid @ self.surround.T).ravel())


def nearest_blur(blur: float) -> float:
    """Return the candidate blur [cells] that is nearest to the given one [cells]."""
    return float(BLURS[np.abs(BLURS - blur).argmin()])


@lru_cache(maxsize=256)
def pattern_of(family: str, tag: int, blur: float) -> Pattern:
    """Return the pattern of a tag with a given blur [cells]."""
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
    """Return each cell's contribution to the gray at positions along one axis, and its derivatives by
    position and blur."""
    from scipy.special import ndtr  # here and below: who is sent corners starts without them

    edges = np.arange(-outside - 3, cells - outside + 4)
    z = (places[:, None] - edges) / blur
    bell = np.exp(-0.5 * z**2) / np.sqrt(2.0 * np.pi)
    share = -np.diff(ndtr(z), axis=1)
    return share, -np.diff(bell, axis=1) / blur, np.diff(z * bell, axis=1) / blur


# Corners to a few hundredths of a pixel: the known tag is fitted to the picture.
#
# The cells of a decoded tag are known, so each of their edges, inner ones too, locates the tag. A homography
# is fitted by Gauss-Newton (inverse compositional, so that its Jacobian is computed once) together with the effects of
# the illumination: gain, offset, two slopes across the tag, and the blur. Blur widens an edge equally to both sides and
# moves no corner. A second fit in local contrast, which glare and shadows change little, follows; a third gives less
# weight to points where something covers the tag.

Gray = npt.NDArray[Any]

LENS_BLUR = 0.7
"""Blur assumed before the fit, pixel area and interpolation included, standard deviation [px]."""
STEPS = 15
SETTLED = 2e-3
"""Movement of a corner below which the fit ends [px]."""
COARSE = 0.05
"""Movement of a corner below which the first stage of the fit ends [px]."""
SMALLEST_RESIDUAL = 0.02
"""Residual that is always attributed to noise, as a fraction of the contrast [-]."""
_SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


@dataclass(frozen=True, eq=False)
class TagFit:
    """Fitted position of a tag in the picture."""

    corners: Array
    """Corners of the measured edge [px], (4, 2)."""
    correlation: float
    """Correlation of the picture with the pattern: 1 is perfect; low if the tag is absent."""
    contrast: float
    """White minus black [gray levels]."""


def fit_tag(image: Gray, family: str, tag: int, corners: Array) -> TagFit | None:
    """Fit a tag near a detected position.

    Args:
        image: Gray, linear in light if the corners must be unbiased, (h, w).
        family: Name of its family.
        tag: Its id.
        corners: Detected corners, accurate to about a third of a cell [px], (4, 2).

    Returns:
        The fit; if it does not converge nearby, the given corners with their correlation. None if
        part of the tag lies outside the picture, or the corners do not form a convex ring.
    """
    if not _convex(corners):
        return None
    cell = _cell(corners, family)
    patch, shift = _patch(image, corners, cell, smooth=(BLURS[0] * cell) ** 2 - LENS_BLUR**2)
    blur = nearest_blur(LENS_BLUR / cell)
    pattern = pattern_of(family, tag, blur)
    sampled = _sample(patch, _through(np.array(from_square((corners - shift).tolist())), pattern.points))
    if sampled is None:
        return None
    limit = 1.0 + 0.5 * cell
    coarse = _settle(pattern, patch, corners - shift, limit, plain=True)
    settled = coarse
    if coarse is not None:
        fitted_blur = nearest_blur(blur + coarse.wider)  # sharper or softer than assumed
        pattern = pattern_of(family, tag, fitted_blur)
        settled = _settle(pattern, patch, coarse.corners, limit) or coarse
        weights = _weights_of(settled.residual, settled.gain) if settled is not coarse else None
        if weights is not None:
            settled = (
                _settle(pattern, patch, settled.corners, limit, solver=_solver(pattern, weights)) or settled
            )
    if coarse is None or settled is None:
        return TagFit(corners, _correlation(pattern.values, sampled), float(np.ptp(sampled)))
    return TagFit(settled.corners + shift, settled.correlation, coarse.gain)


@dataclass(frozen=True, eq=False)
class _Settled:
    """Position on the patch to which a pattern converged."""

    corners: Array
    """(4, 2)."""
    gain: float
    """White minus black, in gray levels or relative to the local contrast."""
    wider: float
    """Difference between the picture's blur and the pattern's [cells]."""
    residual: Array
    """Residual of the pattern, in the same unit, (n,)."""
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
    """Fit by Gauss-Newton from a start; `plain` converges from farther away, in unnormalized gray, and ends sooner.

    Return None if a corner moves by more than the limit [px] or out of the patch, or if the fit does not converge.
    """
    solver = pattern.plain if plain else pattern.solver if solver is None else solver
    H = np.array(from_square(start.tolist()))
    here = start
    for _ in range(STEPS):
        sampled = _sample(patch, _through(H, pattern.points))
        if sampled is None:
            return None
        sampled = sampled if plain else pattern.even(sampled)
        solution = solver @ sampled
        gain = float(solution[-1])
        if not gain > 0.0 or np.abs(solution[:8]).max() > 0.3 * gain:
            return None
        a, b, c, d, e, f, g, h = (solution[:8] / gain).tolist()  # motion of the pattern
        H = H @ adjugate([[1.0 + a, b, c], [d, 1.0 + e, f], [g, h, 1.0]])
        before, here = here, _through(H, _SQUARE).T
        if not np.abs(here - start).max() < limit:
            return None
        if np.abs(here - before).max() < (COARSE if plain else SETTLED):
            predicted = pattern.values if plain else pattern.columns @ solution
            return _Settled(
                here, gain, float(solution[-2]) / gain, sampled - predicted, _correlation(predicted, sampled)
            )
    return None


def _weights_of(residual: Array, gain: float) -> Array | None:
    """Return weights of the points, small where glare, a shadow's edge or a finger covers the tag; None if
    nothing does."""
    scale = max(1.48 * float(np.median(np.abs(residual))), SMALLEST_RESIDUAL * gain)
    far = (residual / (3.0 * scale)) ** 2
    if np.mean(far > 1.0) < 0.01:
        return None
    return np.asarray(1.0 / (1.0 + far) ** 2)


def _solver(pattern: Pattern, weights: Array) -> Array:
    """Return the weighted pseudo-inverse, (10, n)."""
    weighted = pattern.columns * weights[:, None]
    return np.asarray(np.linalg.solve(weighted.T @ pattern.columns, weighted.T))


def _correlation(a: Array, b: Array) -> float:
    a, b = a - a.mean(), b - b.mean()
    return float(a @ b) / max(float(np.sqrt((a @ a) * (b @ b))), 1e-12)


def _convex(corners: Array) -> bool:
    """Return whether the corners form a convex ring that runs clockwise in the picture (v down)."""
    side = np.roll(corners, -1, axis=0) - corners
    after = np.roll(side, -1, axis=0)
    return bool(np.all(side[:, 0] * after[:, 1] - side[:, 1] * after[:, 0] > 1.0))


def _cell(corners: Array, family: str) -> float:
    """Return the mean side of a cell [px]."""
    sides = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    return float(sides.mean()) / family_named(family).border


def _patch(image: Gray, corners: Array, cell: float, smooth: float) -> tuple[Array, Array]:
    """Return the picture around a tag, blurred by a variance [px²] if it is positive, and the patch's top
    left pixel."""
    reach = 3.0 * cell + 4.0
    low = np.maximum(np.floor(corners.min(axis=0) - reach), 0.0)
    high = np.ceil(corners.max(axis=0) + reach).astype(int) + 1
    x, y = low.astype(int)
    patch = image[y : high[1], x : high[0]].astype(np.float64)
    if smooth > 0.0:
        from scipy.ndimage import gaussian_filter

        patch = gaussian_filter(patch, np.sqrt(smooth), mode="nearest", truncate=3.0)
    return patch, low


def _sample(patch: Array, points: Array) -> Array | None:
    """Return the gray at points between pixels (2, n), bilinear, (n,); None if a point lies outside the patch."""
    height, width = patch.shape
    x, y = points
    if not (points.min() >= 0.0 and x.max() < width - 1 and y.max() < height - 1):
        return None
    cells = points.astype(np.intp)
    a, b = points - cells
    flat = patch.ravel()
    at = cells[1] * width + cells[0]
    upper, lower = flat.take(at), flat.take(at + width)
    upper += a * (flat.take(at + 1) - upper)
    lower += a * (flat.take(at + width + 1) - lower)
    return np.asarray(upper + b * (lower - upper))


def from_square(corners: list[list[float]]) -> list[list[float]]:
    """Return the homography that maps the unit square, x right and y down, to four corners [px], (3, 3); the
    identity if the square spanned by the corners is degenerate.

    The last row (g, h, 1) solves g (b - c) + h (d - c) = a - b + c - d.
    """
    (ax, ay), (bx, by), (cx, cy), (dx, dy) = corners
    ux, uy, vx, vy = bx - cx, by - cy, dx - cx, dy - cy
    wx, wy = ax - bx + cx - dx, ay - by + cy - dy
    area = ux * vy - uy * vx
    if not abs(area) > 1e-9:
        return [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    g, h = (wx * vy - wy * vx) / area, (ux * wy - uy * wx) / area
    return [[bx - ax + g * bx, dx - ax + h * dx, ax], [by - ay + g * by, dy - ay + h * dy, ay], [g, h, 1.0]]


def adjugate(H: list[list[float]]) -> list[list[float]]:
    """Return the adjugate of a homography [-], its inverse up to a factor, which does not matter, (3, 3)."""
    (a, b, c), (d, e, f), (g, h, i) = H
    return [
        [e * i - f * h, c * h - b * i, b * f - c * e],
        [f * g - d * i, a * i - c * g, c * d - a * f],
        [d * h - e * g, b * g - a * h, a * e - b * d],
    ]


def _through(H: Array, points: Array) -> Array:
    """Return points (n, 2) mapped by a homography, (2, n): in rows, which NumPy processes several times faster."""
    p = H[:, :2] @ points.T + H[:, 2:]
    return np.asarray(p[:2] / p[2])


Region = tuple[int, int, int, int]
"""Part of a picture: left, top, right, bottom [px], right and bottom just outside."""

LEAST_CORRELATION = 0.7
"""Least correlation with the picture of a detected tag; below it the tag counts as absent [-]."""


REFINEMENTS = ("fit", *EDGES)
"""Methods of locating the corners."""


@dataclass(frozen=True)
class Detector:
    """Detector of the tags of one family, made by `detector`."""

    family: str
    refine: str
    gamma: float
    """Exponent gamma of the pictures' encoding: 1 linear, 2.2 video."""
    max_hamming: int

    def detect(self, image: npt.ArrayLike, region: Region | None = None) -> list[Detection]:
        """Return the tags in a picture.

        Args:
            image: Gray, uint8, (h, w).
            region: Region to search, clipped to the picture; None: the full picture.

        Returns:
            Detections with corners in pixels of the full picture, integers at pixel centres, in the order top-left,
            top-right, bottom-right, bottom-left as AprilTag 3 prints the tag. An id may occur twice.

        Raises:
            LocalizationError: The picture is not an array of gray bytes.
        """
        gray = np.asarray(image)
        if gray.ndim != 2 or gray.dtype != np.uint8:
            raise LocalizationError(
                f"the picture is an array of {gray.dtype} of shape {gray.shape}, expected gray bytes (h, w)"
            )
        left, top, right, bottom = _clipped(region, gray)
        if left >= right or top >= bottom:
            return []
        part = gray[top:bottom, left:right]
        if self.refine == "fit":
            detections = find_tags(part, self.family, "edges", self.max_hamming)
        else:
            light = _linear(part, self.gamma)
            bytes_ = part if light is part else np.rint(light).astype(np.uint8)
            detections = find_tags(bytes_, self.family, self.refine, self.max_hamming)
        corner = np.array([left, top], float)
        moved = [replace(d, corners=d.corners + corner) for d in detections]
        return self._fitted(gray, moved) if self.refine == "fit" else moved

    def _fitted(self, gray: Image, detections: list[Detection]) -> list[Detection]:
        """Return the detections with fitted corners, without the tags that the fit rejects."""
        light = _linear(gray, self.gamma) if self.gamma != 1.0 and detections else gray
        fitted = []
        for tag in detections:
            fit = fit_tag(light, tag.family, tag.tag, tag.corners)
            if fit is None:
                fitted.append(tag)
            elif fit.correlation >= LEAST_CORRELATION:
                fitted.append(replace(tag, corners=fit.corners))
        return fitted


def detector(family: str, *, refine: str = "fit", gamma: float = 1.0, max_hamming: int = 1) -> Detector:
    """Return a detector of one family.

    Args:
        family: Family such as `tag25h9` or `tagStandard41h12`.
        refine: Method of locating corners: `fit` fits the complete known tag to the picture (the most accurate);
            `edges` is AprilTag's own edge refinement, `none` uses its unrefined corners.
        gamma: Encoding of the picture, gray ~ light^(1/gamma): 2.2 for most cameras, 1 for raw sensors. A wrong
            value moves blurred edges of encoded gray into the black by up to half a pixel.
        max_hamming: Greatest number of bits that may be corrected.

    Raises:
        LocalizationError: The family or refinement is unknown, or gamma is out of range.
    """
    if refine not in REFINEMENTS:
        raise LocalizationError(f"unknown refinement '{refine}'; available: {', '.join(REFINEMENTS)}")
    if not 0.2 <= gamma <= 5.0:
        raise LocalizationError(
            f"gamma is {gamma}, expected 0.2 to 5: 1 for linear pictures, 2.2 for most cameras"
        )
    return Detector(family_named(family).name, refine, float(gamma), int(max_hamming))


def _clipped(region: Region | None, gray: Image) -> Region:
    height, width = gray.shape
    if region is None:
        return 0, 0, width, height
    left, top, right, bottom = (int(x) for x in region)
    return max(left, 0), max(top, 0), min(right, width), min(bottom, height)


def _linear(gray: Image, gamma: float) -> npt.NDArray[Any]:
    """Return gray proportional to light, 0 to 255; the picture itself if it is linear already."""
    if gamma == 1.0:
        return gray
    table = 255.0 * (np.arange(256) / 255.0) ** gamma
    return np.asarray(table.astype(np.float32)[gray])


# Tags in a stream of pictures: the expected regions, a few percent of the picture, are searched first.

BESIDE = 0.6
"""Padding for the white around a tag that its detection needs, and for a change of its pose [edges]."""
LEAST = 8.0
"""Smallest padding [px]."""
PER_LOSS = 0.5
"""Growth of the padding with every picture in which the tag was not detected [edges]."""
MAX_LOST = 30
"""Number of pictures after which a lost tag is searched only in full pictures."""
AHEAD = 1.5
"""Extent of a region ahead of the tag's last position, relative to its predicted motion since; it starts at
the last position, in case the tag stopped [-]."""


@dataclass
class _Remembered:
    """Last known state of a tag."""

    corners: Array
    time: float
    velocity: Array = field(default_factory=lambda: np.zeros(2))
    """Velocity of the centre [px/s]."""
    lost: int = 0
    """Number of pictures since the last detection."""


class RegionTracker:
    """Tag detector for a sequence of pictures that predicts the region of each tag from its last position and
    velocity."""

    def __init__(
        self, detector: Detector, tags: Collection[int] | None = None, *, search_every: int = 15
    ) -> None:
        """
        Args:
            detector: Detector of tags in a picture or a region of it.
            tags: Ids to detect; others are left out. None: all.
            search_every: Number of pictures between searches of the full picture while a tag is missing (always if
                `tags` is None). If no tag is detected at all, the full picture is searched at once.
        """
        self._detector = detector
        self._tags = None if tags is None else frozenset(tags)
        self._search_every = search_every
        self._seen: dict[int, _Remembered] = {}
        self._since_whole = search_every
        self._last_time = math.nan

    def detect(self, image: npt.NDArray[np.uint8], time: float = math.nan) -> list[Detection]:
        """Return the tags in the next picture, each id once, searched between their last and their predicted
        positions.

        Args:
            image: Gray, (h, w).
            time: Time of the picture [s]; pictures without a time count as one second apart.

        Raises:
            LocalizationError: The picture is not an array of gray bytes.
        """
        now = time if math.isfinite(time) else (0.0 if math.isnan(self._last_time) else self._last_time + 1.0)
        regions = merged(self._regions(now))
        detections = [d for region in regions for d in self._search(image, region)]
        here = {d.tag for d in detections}
        self._since_whole += 1
        missing = self._tags is None or not self._tags <= here
        if not here or (missing and self._since_whole >= self._search_every):
            detections += self._search(image, None)
            self._since_whole = 0
        best = best_detections(detections)
        self._remember(best, now)
        return best

    def _search(self, image: npt.NDArray[np.uint8], region: Region | None) -> list[Detection]:
        detections = self._detector.detect(image, region)
        return [d for d in detections if self._tags is None or d.tag in self._tags]

    def _regions(self, now: float) -> list[Region]:
        regions = []
        for _, tag in sorted(self._seen.items()):
            if tag.lost <= MAX_LOST:
                ahead = tag.corners + AHEAD * tag.velocity * (now - tag.time)
                regions.append(region_around(np.vstack([tag.corners, ahead]), tag.lost))
        return regions

    def _remember(self, detections: list[Detection], now: float) -> None:
        for remembered in self._seen.values():
            remembered.lost += 1
        for tag in detections:
            before = self._seen.get(tag.tag)
            velocity = np.zeros(2)
            if before is not None and before.lost <= 3 and now > before.time:
                velocity = (tag.corners - before.corners).mean(axis=0) / (now - before.time)
            self._seen[tag.tag] = _Remembered(tag.corners, now, velocity)
        self._last_time = now


def region_around(corners: Array, lost: int = 0) -> Region:
    """Return the region of a picture in which a tag is searched.

    Args:
        corners: Expected corners [px], (n, 2).
        lost: Number of pictures since the tag was last detected.
    """
    low, high = corners.min(axis=0), corners.max(axis=0)
    edge = float(np.linalg.norm(corners[1] - corners[0]) + np.linalg.norm(corners[2] - corners[1])) / 2.0
    padding = max(LEAST, BESIDE * edge) + PER_LOSS * lost * edge
    left, top = np.floor(low - padding).astype(int).tolist()
    right, bottom = (np.ceil(high + padding).astype(int) + 1).tolist()
    return left, top, right, bottom


def merged(regions: list[Region]) -> list[Region]:
    """Return non-overlapping regions that cover the given ones: overlapping regions are replaced by their
    bounding box."""
    separate: list[Region] = []
    for region in regions:
        joined = region
        while True:
            touching = next((other for other in separate if _overlap(joined, other)), None)
            if touching is None:
                break
            separate.remove(touching)
            joined = (
                min(joined[0], touching[0]),
                min(joined[1], touching[1]),
                max(joined[2], touching[2]),
                max(joined[3], touching[3]),
            )
        separate.append(joined)
    return separate


def _overlap(a: Region, b: Region) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]
