"""Corners of a tag: on its own plate and on the vehicle that carries it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from finssim.geometry.rotations import quat_rotate
from finssim.vehicles.equipment import Tags

__all__ = ["corners", "tag_corners_b"]

Array = npt.NDArray[np.float64]

_SIGNS = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])


def corners(edge: float) -> Array:
    """Corners of the black border in the tag frame [m], (4, 3).

    Tag frame: x to the right and y up in the printed image, z out of the printed side. Order: top-left, top-right,
    bottom-right, bottom-left as printed.

    Args:
        edge: Length of an edge of the border [m]; for tagStandard41h12 of the line where its black ring meets
            the white square inside, as AprilTag 3 measures it.
    """
    return np.asarray(edge * _SIGNS)


def tag_corners_b(tags: Tags) -> dict[int, Array]:
    """Corners of a vehicle's tags in the body frame [m]: tag id -> (4, 3), in the order of `corners`."""
    flat = corners(tags.edge)
    return {
        tag: np.asarray(np.asarray(mount.position) + quat_rotate(np.asarray(mount.orientation), flat))
        for tag, mount in tags.mounts.items()
    }
