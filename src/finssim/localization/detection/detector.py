"""Finding tags in a picture: two libraries behind one interface, with the same corners in the same convention."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from finssim.localization.detection import detector_apriltag, detector_opencv
from finssim.localization.detection.detections import Detection
from finssim.localization.detection.detector_fit import fit_tag
from finssim.localization.detection.families import FAMILIES, family_named
from finssim.localization.errors import LocalizationError

__all__ = ["LIBRARIES", "Detector", "Library", "Region", "detector"]

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.uint8]

Region = tuple[int, int, int, int]
"""Part of a picture: left, top, right, bottom [px], right and bottom just outside."""

LEAST_CORRELATION = 0.7
"""Of a picture with the tag that a library says is there; below it there is none."""


@dataclass(frozen=True)
class Library:
    """One library that finds tags."""

    find: Callable[[Image, str, str, int], list[Detection]]
    """Picture, family, refinement and most corrected bits -> tags."""
    refinements: tuple[str, ...]
    """Its own ways to place corners."""
    before_fit: str
    """The one from which our fit starts."""


LIBRARIES: Mapping[str, Library] = {
    "apriltag": Library(detector_apriltag.find, tuple(detector_apriltag.REFINEMENTS), "edges"),
    "opencv": Library(detector_opencv.find, tuple(detector_opencv.REFINEMENTS), "subpix"),
}
"""Name -> library."""


@dataclass(frozen=True)
class Detector:
    """Finds the tags of one family. Made by `detector`."""

    family: str
    library: str
    refine: str
    gamma: float
    max_hamming: int

    def detect(self, image: npt.ArrayLike, region: Region | None = None) -> list[Detection]:
        """Tags in a picture.

        Args:
            image: Gray, uint8, (h, w).
            region: The part that is searched; None: all of it. Clipped to the picture.

        Returns:
            Detections with corners in pixels of the whole picture, integers at pixel centres, in the order top-left,
            top-right, bottom-right, bottom-left as AprilTag 3 prints the tag. An id may be there twice.

        Raises:
            LocalizationError: The picture is not one of gray bytes.
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
        library = LIBRARIES[self.library]
        if self.refine != "fit":
            light = _linear(part, self.gamma)
            bytes_ = part if light is part else np.rint(light).astype(np.uint8)
            found = library.find(bytes_, self.family, self.refine, self.max_hamming)
        else:
            found = library.find(part, self.family, library.before_fit, self.max_hamming)
        corner = np.array([left, top], float)
        moved = [replace(d, corners=d.corners + corner) for d in found]
        return self._fitted(gray, moved) if self.refine == "fit" else moved

    def _fitted(self, gray: Image, found: list[Detection]) -> list[Detection]:
        """The detections with corners from the fit; a tag that the fit denies is left out."""
        light = _linear(gray, self.gamma) if self.gamma != 1.0 and found else gray
        fitted = []
        for tag in found:
            fit = fit_tag(light, tag.family, tag.tag, tag.corners)
            if fit is None:
                fitted.append(tag)
            elif fit.correlation >= LEAST_CORRELATION:
                fitted.append(replace(tag, corners=fit.corners))
        return fitted


def detector(
    family: str, *, library: str | None = None, refine: str = "fit", gamma: float = 1.0, max_hamming: int = 1
) -> Detector:
    """A detector of one family.

    Args:
        family: Such as `tag25h9` or `tagStandard41h12`.
        library: `apriltag` or `opencv`; None: `apriltag`, which has every family.
        refine: How corners are placed: `fit` lays the whole known tag over the picture (the most accurate); else what
            the library has: `edges`, `none` (apriltag); `none`, `subpix`, `contour`, `apriltag` (opencv).
        gamma: Encoding of the picture, gray ~ light^(1/gamma): 2.2 for what most cameras deliver, 1 for raw sensors. It
            matters because a blurred edge of encoded gray lies in the black by up to half a pixel.
        max_hamming: Most bits that may be corrected.

    Raises:
        LocalizationError: Unknown family, library or refinement, one that does not go with the other, or a gamma out of
            range.
    """
    name = family_named(family).name
    chosen = library or "apriltag"
    if chosen not in LIBRARIES:
        raise LocalizationError(f"unknown library '{chosen}'; available: {', '.join(LIBRARIES)}")
    if chosen == "opencv" and not FAMILIES[name].opencv:
        raise LocalizationError(f"OpenCV has no {name}: use the library 'apriltag'")
    ways = ("fit", *LIBRARIES[chosen].refinements)
    if refine not in ways:
        raise LocalizationError(f"unknown refinement '{refine}' of {chosen}; available: {', '.join(ways)}")
    if not 0.2 <= gamma <= 5.0:
        raise LocalizationError(
            f"gamma is {gamma}, expected 0.2 to 5: 1 for linear pictures, 2.2 for most cameras"
        )
    return Detector(name, chosen, refine, float(gamma), int(max_hamming))


def _clipped(region: Region | None, gray: Image) -> Region:
    height, width = gray.shape
    if region is None:
        return 0, 0, width, height
    left, top, right, bottom = (int(x) for x in region)
    return max(left, 0), max(top, 0), min(right, width), min(bottom, height)


def _linear(gray: Image, gamma: float) -> npt.NDArray[Any]:
    """Gray in proportion to light, 0 to 255; the picture itself where it is so."""
    if gamma == 1.0:
        return gray
    table = 255.0 * (np.arange(256) / 255.0) ** gamma
    return np.asarray(table.astype(np.float32)[gray])
