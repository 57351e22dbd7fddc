"""Why a pixel has no ray in the water, or a point no pixel."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
import numpy.typing as npt

__all__ = ["Status", "StatusArray", "count_rejections"]

StatusArray = npt.NDArray[np.int8]


class Status(IntEnum):
    """What became of a pixel or a point; numbers come with OK and OUTSIDE_IMAGE only, NaN with the others."""

    OK = 0
    NO_RAY = 1
    """The lens has no ray for the pixel, or no pixel for the ray: beyond the range in which it maps one to one."""
    PARALLEL = 2
    """The ray runs along the plane that it should meet."""
    TOTAL_REFLECTION = 3
    """The ray is thrown back at a face."""
    AWAY = 4
    """The ray heads away from the plane that it should meet."""
    BEHIND_CAMERA = 5
    """The light arrives from behind the camera."""
    WRONG_SIDE = 6
    """The point is not on the far side of the interface, or the camera not on the near side."""
    OUTSIDE_IMAGE = 7
    """The pixel, which is given, lies outside the image."""


def count_rejections(status: npt.ArrayLike) -> dict[str, int]:
    """How often each reason but OK occurs, by name; reasons that do not occur are left out."""
    counts = np.bincount(np.ravel(np.asarray(status, int)), minlength=len(Status))
    return {Status(i).name: int(n) for i, n in enumerate(counts) if n and i != Status.OK}
