"""Tags found by OpenCV (cv2.aruco), in our conventions."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from finssim.localization.detection.detections import Detection
from finssim.localization.detection.families import bitmap, family_named

__all__ = ["REFINEMENTS", "find"]

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.uint8]

REFINEMENTS = {
    "none": ("CORNER_REFINE_NONE", 0.0),
    "subpix": ("CORNER_REFINE_SUBPIX", 0.0),
    "contour": ("CORNER_REFINE_CONTOUR", 0.0),
    "apriltag": ("CORNER_REFINE_APRILTAG", 0.5),
}
"""Name -> OpenCV's name, and the coordinate that it gives the centre of the first pixel."""

SMALLEST = 10.0
"""Shortest edge that is looked for [px]."""


def find(image: Image, family: str, refine: str, max_hamming: int) -> list[Detection]:
    """Tags of a family in a picture.

    Args:
        image: Gray, (h, w).
        family: Name of a family that OpenCV has.
        refine: One of `REFINEMENTS`.
        max_hamming: Most bits that may be corrected.
    """
    library = _library(family, refine)
    # OpenCV takes the shortest outline as a share of the picture: without this, a tag vanishes in a large one.
    settings = library.getDetectorParameters()
    settings.minMarkerPerimeterRate = min(0.03, 4.0 * SMALLEST / max(image.shape))
    library.setDetectorParameters(settings)
    rings, ids, _ = library.detectMarkers(np.ascontiguousarray(image))
    if ids is None:
        return []
    shift = REFINEMENTS[refine][1]
    found = []
    for ring, tag in zip(rings, ids.ravel().tolist(), strict=True):
        # OpenCV's dictionaries hold AprilTag's tags turned by half a turn.
        corners = np.roll(np.asarray(ring[0], np.float64), 2, axis=0) - shift
        hamming, margin = _read(image, family, int(tag), corners)
        if hamming <= max_hamming:
            found.append(Detection(int(tag), corners, margin, hamming, family))
    return found


def _read(image: Image, family: str, tag: int, corners: Array) -> tuple[int, float]:
    """Cells that differ from the tag's, and mean distance of their gray from the threshold [gray levels]."""
    import cv2

    n = family_named(family).cells
    k = 4  # samples along a cell; the outer ones of each are left aside
    square = np.array([[0, 0], [n, 0], [n, n], [0, n]], np.float32) * k - 0.5
    H = cv2.getPerspectiveTransform(corners.astype(np.float32), square.astype(np.float32))
    flat = cv2.warpPerspective(image, H, (n * k, n * k), flags=cv2.INTER_LINEAR).astype(float)
    gray = flat.reshape(n, k, n, k)[:, 1 : k - 1, :, 1 : k - 1].mean(axis=(1, 3))
    cells = bitmap(family, tag).astype(bool)
    if not cells.any():
        return n * n, 0.0
    threshold = 0.5 * (gray[cells].mean() + gray[~cells].mean())
    above = np.where(cells, gray - threshold, threshold - gray)
    return int(np.count_nonzero(above < 0.0)), float(np.abs(above).mean())


@cache
def _library(family: str, refine: str) -> Any:
    """OpenCV's detector, made once."""
    import cv2

    settings = cv2.aruco.DetectorParameters()
    # With OpenCV's 0.125 the outline of a plate with a narrow white margin counts as its tag's, and hides it.
    settings.minMarkerDistanceRate = 0.05
    settings.cornerRefinementMethod = getattr(cv2.aruco, REFINEMENTS[refine][0])
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, family_named(family).opencv))
    return cv2.aruco.ArucoDetector(dictionary, settings)
