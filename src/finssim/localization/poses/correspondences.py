"""Which corner of the vehicle each corner in a picture is."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from finssim.localization.detection.detections import Detection, most_certain

__all__ = ["UNKNOWN_TAG", "Correspondences", "correspondences"]

Array = npt.NDArray[np.float64]

UNKNOWN_TAG = "unknown tag"
TWICE = "tag seen twice"
NO_SQUARE = "corners not clockwise"
SMALLEST = 4.0
"""[px²]: a tag 2 px wide."""


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Corners with their places, four in a row for each tag."""

    pixels: Array
    """(n, 2)"""
    points_b: Array
    """Body frame [m], (n, 3)."""
    tags: tuple[int, ...]
    """Tag of each four corners."""
    rejected: dict[str, int]
    """Corners left aside, by reason."""

    @property
    def why_too_few(self) -> str:
        """The sentence for a picture without any corner of the vehicle."""
        if NO_SQUARE in self.rejected:
            return (
                "the corners of no known tag run clockwise around a square: expected top-left, top-right, "
                "bottom-right, bottom-left of the print"
            )
        if UNKNOWN_TAG in self.rejected:
            return "no tag of the vehicle among those seen"
        return "no tag seen"


def correspondences(detections: Iterable[Detection], tags_b: Mapping[int, Array]) -> Correspondences:
    """Pair the tags of a picture with those of a vehicle.

    Tags that the vehicle has not are counted, and so are those whose corners do not run clockwise around a convex
    quadrangle, as those of a tag seen from its printed side do; of an id seen twice the more certain one is taken.

    Args:
        detections: Tags of one picture.
        tags_b: Tag id -> corners in the body frame [m], (4, 3), as `tag_corners_b`.
    """
    found = list(detections)
    known = [detection for detection in found if detection.tag in tags_b]
    rejected: dict[str, int] = {}
    if len(known) < len(found):
        rejected[UNKNOWN_TAG] = 4 * (len(found) - len(known))
    square = [detection for detection in known if _clockwise(detection.corners)]
    if len(square) < len(known):
        rejected[NO_SQUARE] = 4 * (len(known) - len(square))
        known = square
    if len({detection.tag for detection in known}) < len(known):
        best = {detection.tag: detection for detection in reversed(most_certain(known))}
        rejected[TWICE] = 4 * (len(known) - len(best))
        known = list(best.values())
    if not known:
        return Correspondences(np.empty((0, 2)), np.empty((0, 3)), (), rejected)
    return Correspondences(
        np.concatenate([detection.corners for detection in known]),
        np.concatenate([tags_b[detection.tag] for detection in known]),
        tuple(detection.tag for detection in known),
        rejected,
    )


def _clockwise(corners: Array) -> bool:
    """Whether each corner turns right, by at least `SMALLEST` twice the area of its triangle, as seen with v down."""
    if np.shape(corners) != (4, 2):
        return False
    (a, b), (c, d), (e, f), (g, h) = np.asarray(corners, float).tolist()
    return bool(
        (c - a) * (f - d) - (d - b) * (e - c) > SMALLEST
        and (e - c) * (h - f) - (f - d) * (g - e) > SMALLEST
        and (g - e) * (b - h) - (h - f) * (a - g) > SMALLEST
        and (a - g) * (d - b) - (b - h) * (c - a) > SMALLEST
    )
