"""Tags of a stream of pictures, searched first where they are expected: a few percent of the picture, at its rate."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from finssim.localization.detection.detections import Detection, most_certain
from finssim.localization.detection.detector import Detector, Region

__all__ = ["RegionTracker", "SearchCounts"]

Array = npt.NDArray[np.float64]

BESIDE = 0.6
"""White that a tag needs around it to be found, and a change of its pose [edges]."""
LEAST = 8.0
"""Smallest padding [px]."""
PER_LOSS = 0.5
"""Growth of the padding with every picture in which the tag was not found [edges]."""
MOST_LOST = 30
"""Pictures after which a lost tag is searched in the whole picture alone."""
AHEAD = 1.5
"""Regions reach from the last place of a tag, should it have stopped, to this many times its motion since."""
SIGMAS = 3.0
"""Standard deviations of a prediction that the padding takes in."""


@dataclass
class SearchCounts:
    """What a tracker did."""

    pictures: int = 0
    regions: int = 0
    """Parts of pictures that were searched."""
    whole: int = 0
    """Pictures that were searched entirely."""
    found: int = 0
    """Tags, summed over pictures."""
    recovered: int = 0
    """Tags that only the search of the whole picture found."""
    pixels: int = 0
    """Searched, summed over pictures."""
    pixels_given: int = 0
    """Of all pictures."""

    @property
    def share(self) -> float:
        """Searched part of all pixels; above 1 where whole pictures were searched after regions."""
        return self.pixels / max(self.pixels_given, 1)


@dataclass
class _Seen:
    """The last that is known of a tag."""

    corners: Array
    time: float
    velocity: Array = field(default_factory=lambda: np.zeros(2))
    """Of the centre [px/s]."""
    lost: int = 0
    """Pictures since."""


class RegionTracker:
    """Detects tags picture after picture; remembers where they were and how they moved."""

    def __init__(
        self, detector: Detector, tags: Collection[int] | None = None, *, search_every: int = 15
    ) -> None:
        """
        Args:
            detector: Finds tags in a picture or a part of it.
            tags: Ids that are looked for, others are left out; None: all that there are.
            search_every: Pictures between searches of the whole one while a tag is missing (always, where `tags` is
                None). If none is found at all, the whole picture is searched at once.
        """
        self.counts = SearchCounts()
        self._detector = detector
        self._tags = None if tags is None else frozenset(tags)
        self._search_every = search_every
        self._seen: dict[int, _Seen] = {}
        self._since_whole = search_every
        self._last_time = math.nan

    def detect(
        self,
        image: npt.NDArray[np.uint8],
        time: float = math.nan,
        *,
        predicted: Mapping[int, npt.ArrayLike] | None = None,
        predicted_std: float = 5.0,
    ) -> list[Detection]:
        """Tags in the next picture, each id once.

        Args:
            image: Gray, (h, w).
            time: Of the picture [s]; pictures without a time count as one second apart.
            predicted: Tag id -> corners where a filter expects it [px], (4, 2); the others are expected between
                their last places and where their velocity takes them.
            predicted_std: Standard deviation of those corners [px].

        Raises:
            LocalizationError: The picture is not one of gray bytes.
        """
        now = time if math.isfinite(time) else (0.0 if math.isnan(self._last_time) else self._last_time + 1.0)
        self.counts.pictures += 1
        self.counts.pixels_given += image.size
        regions = merged(self._regions(now, predicted or {}, predicted_std))
        found = [d for region in regions for d in self._search(image, region)]
        here = {d.tag for d in found}
        self._since_whole += 1
        due = self._since_whole >= self._search_every and self._incomplete(here)
        if not here or due:
            found += self._search(image, None)
            self._since_whole = 0
            self.counts.recovered += len({d.tag for d in found} - here)
        best = most_certain(found)
        self._remember(best, now)
        self.counts.found += len(best)
        return best

    def _incomplete(self, here: set[int]) -> bool:
        return self._tags is None or not self._tags <= here

    def _search(self, image: npt.NDArray[np.uint8], region: Region | None) -> list[Detection]:
        height, width = image.shape
        left, top, right, bottom = region or (0, 0, width, height)
        inside = max(min(right, width) - max(left, 0), 0) * max(min(bottom, height) - max(top, 0), 0)
        self.counts.pixels += inside
        self.counts.whole += region is None
        self.counts.regions += region is not None
        found = self._detector.detect(image, region)
        return [d for d in found if self._tags is None or d.tag in self._tags]

    def _regions(
        self, now: float, predicted: Mapping[int, npt.ArrayLike], predicted_std: float
    ) -> list[Region]:
        regions = []
        for tag in sorted(self._seen.keys() | predicted.keys()):
            seen = self._seen.get(tag)
            lost = seen.lost if seen else 0
            if tag in predicted:
                corners = np.asarray(predicted[tag], float)
                if np.isfinite(corners).all():
                    regions.append(region_around(corners, SIGMAS * predicted_std, lost))
            elif seen and lost <= MOST_LOST:
                ahead = seen.corners + AHEAD * seen.velocity * (now - seen.time)
                regions.append(region_around(np.vstack([seen.corners, ahead]), 0.0, lost))
        return regions

    def _remember(self, found: list[Detection], now: float) -> None:
        for seen in self._seen.values():
            seen.lost += 1
        for tag in found:
            before = self._seen.get(tag.tag)
            velocity = np.zeros(2)
            if before is not None and before.lost <= 3 and now > before.time:
                velocity = (tag.corners - before.corners).mean(axis=0) / (now - before.time)
            self._seen[tag.tag] = _Seen(tag.corners, now, velocity)
        self._last_time = now


def region_around(corners: Array, uncertainty: float = 0.0, lost: int = 0) -> Region:
    """The part of a picture in which a tag is searched.

    Args:
        corners: Where it is expected [px], (n, 2).
        uncertainty: Distance by which it may lie elsewhere [px].
        lost: Pictures since it was last found.
    """
    low, high = corners.min(axis=0), corners.max(axis=0)
    edge = float(np.linalg.norm(corners[1] - corners[0]) + np.linalg.norm(corners[2] - corners[1])) / 2.0
    padding = max(LEAST, BESIDE * edge) + uncertainty + PER_LOSS * lost * edge
    left, top = np.floor(low - padding).astype(int).tolist()
    right, bottom = (np.ceil(high + padding).astype(int) + 1).tolist()
    return left, top, right, bottom


def merged(regions: list[Region]) -> list[Region]:
    """The same places in regions of which no two overlap: those that do become one around both."""
    apart: list[Region] = []
    for region in regions:
        joined = region
        while True:
            touching = next((other for other in apart if _overlap(joined, other)), None)
            if touching is None:
                break
            apart.remove(touching)
            joined = (
                min(joined[0], touching[0]),
                min(joined[1], touching[1]),
                max(joined[2], touching[2]),
                max(joined[3], touching[3]),
            )
        apart.append(joined)
    return apart


def _overlap(a: Region, b: Region) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]
