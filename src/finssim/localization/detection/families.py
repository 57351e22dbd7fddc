"""AprilTags: families, bitmaps, detection by AprilTag 3, and tag corners in space."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache
from threading import Lock
from typing import Any

import numpy as np
import numpy.typing as npt

from finssim.core.rotations import quat_rotate
from finssim.localization import LocalizationError
from finssim.localization.detection.detections import Detection
from finssim.vehicles.equipment import Tags

# Tag detection by AprilTag 3, through pupil-apriltags, in FinsSim's conventions.

Image = npt.NDArray[np.uint8]

MANY = 10_000
"""Number of tags in a family from which one wrong bit is corrected instead of two."""
EDGES = {"edges": 1, "none": 0}
"""Name of a refinement -> the library's `refine_edges`."""

_LOCK = Lock()
"""Lock around the library: it uses memory inside the detector, and ctypes releases the interpreter lock."""


def find_tags(image: Image, family: str, refine: str, max_hamming: int) -> list[Detection]:
    """Return the tags of a family in a picture.

    Args:
        image: Gray, (h, w).
        family: Name of the family.
        refine: One of `EDGES`.
        max_hamming: Greatest number of bits that may be corrected.
    """
    # The library reads two pixels around the sides of candidate squares; a picture of a few pixels contains no tag.
    if min(image.shape) < 16:
        return []
    with _LOCK:
        detections = _library(family, refine).detect(np.ascontiguousarray(image))
    return [
        Detection(
            tag=int(tag.tag_id),
            # Counter-clockwise from the bottom left, pixel centres at half integers.
            corners=np.asarray(tag.corners[::-1] - 0.5),
            margin=float(tag.decision_margin),
            hamming=int(tag.hamming),
            family=family,
        )
        for tag in detections
        if tag.hamming <= max_hamming
    ]


@cache
def family_table(family: str) -> tuple[npt.NDArray[np.uint64], npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Return the codes of a family, first bit highest, and column and row of each bit's cell from the
    measured edge's corner.

    Cells outside the measured edge have indices that are negative or beyond the edge.
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
    """Return the library's detector, created once.

    It is never destroyed: pupil-apriltags frees the family before the detector that still refers to it, which
    corrupts memory.
    """
    import ctypes

    import pupil_apriltags

    class Kept(pupil_apriltags.Detector):  # type: ignore[misc]
        def __del__(self) -> None:
            pass

    options = {"nthreads": 1, "quad_decimate": 1.0, "refine_edges": EDGES[refine]}
    if FAMILIES[family].count < MANY:
        return Kept(families=family, **options)
    # The table for two wrong bits takes 4.6 GB and 24 s (tagCustom48h12), that for one 140 MB and 0.2 s.
    detector = Kept(families="tag16h5", **options)
    library, pointer = detector.libc, detector.tag_detector_ptr
    library.apriltag_detector_remove_family.restype = None
    library.apriltag_detector_remove_family(pointer, detector.tag_families.pop("tag16h5"))
    create = getattr(library, f"{family}_create")
    create.restype = library.tag16h5_create.restype
    detector.tag_families[family] = create()
    library.apriltag_detector_add_family_bits(pointer, detector.tag_families[family], ctypes.c_int(1))
    return detector


Cells = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class TagFamily:
    """Layout of the tags of a family."""

    name: str
    cells: int
    """Number of cells along the edge of the complete bitmap."""
    border: int
    """Number of cells along the measured edge, the `edge` of a vehicle or survey file: the outside of the
    black border, or the line between the black and white rings if the border is reversed."""
    count: int
    """Number of ids."""
    distance: int
    """Smallest Hamming distance of two tags [bits]."""

    @property
    def outside(self) -> int:
        """Cells of the bitmap that lie outside the measured edge, on each side."""
        return (self.cells - self.border) // 2


FAMILIES = {
    family.name: family
    for family in (
        TagFamily("tag16h5", 6, 6, 30, 5),
        TagFamily("tag25h9", 7, 7, 35, 9),
        TagFamily("tag36h11", 8, 8, 587, 11),
        TagFamily("tagStandard41h12", 9, 5, 2115, 12),
        TagFamily("tagStandard52h13", 10, 6, 48714, 13),
        TagFamily("tagCustom48h12", 10, 6, 42211, 12),
        TagFamily("tagCircle21h7", 9, 5, 38, 7),
        TagFamily("tagCircle49h12", 11, 5, 65535, 12),
    )
}
"""Name -> family."""


def family_named(name: str) -> TagFamily:
    """Return the family of a name; `25h9`, `Tag25h9` and `DICT_APRILTAG_25h9` are accepted too.

    Raises:
        LocalizationError: No family has that name.
    """
    plain = _bare(name.lower().removeprefix("dict_apriltag_"))
    for family in FAMILIES.values():
        if _bare(family.name.lower()) == plain:
            return family
    raise LocalizationError(f"unknown tag family '{name}'; available: {', '.join(FAMILIES)}")


def _bare(name: str) -> str:
    """Return a family's name in lower case without its prefix: `41h12` of `tagstandard41h12`."""
    return re.sub(r"^(tag)?(standard|custom|circle)?", "", name)


@cache
def bitmap(family: str, tag: int) -> Cells:
    """Return the cells of a tag, rows from the top, 1 white and 0 black, (n, n) with n = `TagFamily.cells`.

    The black border is included, the white margin around it is not.

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
    """Return a printable picture of a tag with its white margin, gray 0 or 255, (side, side).

    Args:
        family: Name of the family.
        tag: Id within it.
        pixels_per_cell: Side of a cell [px].
        margin: Width of the white margin [cells].

    Raises:
        LocalizationError: Unknown family or id.
    """
    cells = np.kron(bitmap(family, tag), np.full((pixels_per_cell, pixels_per_cell), 255, np.uint8))
    return np.pad(cells, round(margin * pixels_per_cell), constant_values=255)


# Corners of a tag in its own frame and on the vehicle that carries it.

Array = npt.NDArray[np.float64]

_SIGNS = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])


def corners(edge: float) -> Array:
    """Return the corners of the black border in the tag frame [m], (4, 3).

    Tag frame: x to the right and y up in the printed image, z out of the printed side. Order: top-left, top-right,
    bottom-right, bottom-left as printed.

    Args:
        edge: Length of an edge of the border [m]; for tagStandard41h12, of the line where its black ring meets
            the white square inside, as AprilTag 3 measures it.
    """
    return np.asarray(edge * _SIGNS)


def tag_corners_b(tags: Tags) -> dict[int, Array]:
    """Return the corners of a vehicle's tags in the body frame [m]: tag id -> (4, 3), in the order of `corners`."""
    return {
        tag: np.asarray(
            np.asarray(mount.position)
            + quat_rotate(np.asarray(mount.orientation), corners(tags.edge_of(tag)))
        )
        for tag, mount in tags.mounts.items()
    }
