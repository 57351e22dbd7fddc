"""Tags found by AprilTag 3, through pupil-apriltags, in our conventions."""

from __future__ import annotations

from functools import cache
from threading import Lock
from typing import Any

import numpy as np
import numpy.typing as npt

from finssim.localization.detection.detections import Detection

__all__ = ["REFINEMENTS", "family_table", "find"]

Image = npt.NDArray[np.uint8]

REFINEMENTS = {"edges": 1, "none": 0}
"""Name -> the library's `refine_edges`."""

_ONE_AT_A_TIME = Lock()
"""The library keeps its memory in the detector, and ctypes lets other threads run meanwhile."""


def find(image: Image, family: str, refine: str, max_hamming: int) -> list[Detection]:
    """Tags of a family in a picture.

    Args:
        image: Gray, (h, w).
        family: Name of the family.
        refine: One of `REFINEMENTS`.
        max_hamming: Most bits that may be corrected.
    """
    # The library looks at squares whose sides are read two pixels around: a picture of a few pixels has none.
    if min(image.shape) < 16:
        return []
    with _ONE_AT_A_TIME:
        found = _library(family, refine).detect(np.ascontiguousarray(image))
    return [
        Detection(
            tag=int(tag.tag_id),
            # Counter-clockwise from the bottom left, pixel centres at half integers.
            corners=np.asarray(tag.corners[::-1] - 0.5),
            margin=float(tag.decision_margin),
            hamming=int(tag.hamming),
            family=family,
        )
        for tag in found
        if tag.hamming <= max_hamming
    ]


@cache
def family_table(family: str) -> tuple[npt.NDArray[np.uint64], npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Code words of a family, first bit highest, and column and row of each bit's cell from the measured edge's corner.

    Cells outside the measured edge have negative places, or such beyond it.
    """
    table = _library(family, "edges").tag_families[family].contents
    codes = np.array(table.codes[: table.ncodes], np.uint64)
    x, y = (
        np.array(bits[: table.nbits], np.uint32).view(np.int32).astype(np.int64)
        for bits in (table.bit_x, table.bit_y)
    )
    return codes, x, y


@cache
def _library(family: str, refine: str) -> Any:
    """The library's detector, made once.

    It is never destroyed: pupil-apriltags frees the family before the detector that still refers to it, which
    corrupts memory.
    """
    import pupil_apriltags

    class Kept(pupil_apriltags.Detector):  # type: ignore[misc]
        def __del__(self) -> None:
            pass

    return Kept(families=family, nthreads=1, quad_decimate=1.0, refine_edges=REFINEMENTS[refine])
