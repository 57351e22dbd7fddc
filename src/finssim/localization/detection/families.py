"""AprilTag families: the cells of every tag, as AprilTag 3 prints them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt

from finssim.localization.detection.detector_apriltag import family_table
from finssim.localization.errors import LocalizationError

__all__ = ["FAMILIES", "Family", "bitmap", "family_named", "printable"]

Cells = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class Family:
    """How the tags of a family are built."""

    name: str
    cells: int
    """Cells along the edge of the whole bitmap."""
    border: int
    """Cells along the edge that is measured, the `edge` of a vehicle or survey file: the outside of the black border,
    or the line between black and white ring where the border is reversed."""
    count: int
    """Number of ids."""
    distance: int
    """Bits in which two tags differ at least."""
    opencv: str = ""
    """Name of the family's dictionary in cv2.aruco; empty where OpenCV has none."""

    @property
    def outside(self) -> int:
        """Cells of the bitmap that lie outside the measured edge, on each side."""
        return (self.cells - self.border) // 2


FAMILIES = {
    family.name: family
    for family in (
        Family("tag16h5", 6, 6, 30, 5, "DICT_APRILTAG_16h5"),
        Family("tag25h9", 7, 7, 35, 9, "DICT_APRILTAG_25h9"),
        Family("tag36h11", 8, 8, 587, 11, "DICT_APRILTAG_36h11"),
        Family("tagStandard41h12", 9, 5, 2115, 12),
    )
}
"""Name -> family."""


def family_named(name: str) -> Family:
    """The family of that name; `25h9`, `Tag25h9` and `DICT_APRILTAG_25h9` are understood too.

    Raises:
        LocalizationError: There is none.
    """
    plain = name.lower().removeprefix("dict_apriltag_").removeprefix("tag").removeprefix("standard")
    for family in FAMILIES.values():
        if family.name.lower().removeprefix("tag").removeprefix("standard") == plain:
            return family
    raise LocalizationError(f"unknown tag family '{name}'; available: {', '.join(FAMILIES)}")


@cache
def bitmap(family: str, tag: int) -> Cells:
    """Cells of a tag, rows from the top, 1 white and 0 black, (n, n) with n = `Family.cells`.

    The black border is in it, the white margin around it is not.

    Args:
        family: Name of the family.
        tag: Id within it.

    Raises:
        LocalizationError: Unknown family or id.
    """
    kind = family_named(family)
    if not 0 <= tag < kind.count:
        raise LocalizationError(f"{kind.name} has no tag {tag}: its ids are 0 to {kind.count - 1}")
    codes, x, y = family_table(kind.name)
    cells = np.zeros((kind.cells, kind.cells), np.uint8)
    if kind.outside:  # the border is reversed: a white ring within the black one
        cells[kind.outside : -kind.outside, kind.outside : -kind.outside] = 1
    bits = (codes[tag] >> np.arange(len(x) - 1, -1, -1, dtype=np.uint64)) & np.uint64(1)
    cells[y + kind.outside, x + kind.outside] = bits
    cells.flags.writeable = False
    return cells


def printable(family: str, tag: int, *, pixels_per_cell: int = 40, margin: float = 1.0) -> Cells:
    """A picture of a tag with its white margin, ready to be printed, gray 0 or 255, (side, side).

    Args:
        family: Name of the family.
        tag: Id within it.
        pixels_per_cell: [px]
        margin: Width of the white margin [cells].

    Raises:
        LocalizationError: Unknown family or id.
    """
    cells = np.kron(bitmap(family, tag), np.full((pixels_per_cell, pixels_per_cell), 255, np.uint8))
    return np.pad(cells, round(margin * pixels_per_cell), constant_values=255)
