"""Ways to measure a pose from the tags of one picture, by name."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Protocol

import numpy as np
import numpy.typing as npt

from finssim.localization.detection.detections import Detection
from finssim.localization.pool import Pool
from finssim.localization.poses.bundle import refractive_bundle
from finssim.localization.poses.measurement import Constraints, Measurement
from finssim.localization.poses.pinhole import pinhole, pinhole_depth
from finssim.localization.poses.planar_fit import planar_fit
from finssim.localization.poses.weighted_fit import weighted_fit

__all__ = ["METHODS", "NEEDS_DEPTH", "Constraints", "Measurement", "Method"]

Array = npt.NDArray[np.float64]


class Method(Protocol):
    """What a method is: a pure function that refuses bad measurements with a reason and raises nothing for them."""

    def __call__(
        self,
        detections: Iterable[Detection],
        pool: Pool,
        tags_b: Mapping[int, Array],
        constraints: Constraints | None,
        pixel_std: float,
    ) -> Measurement:
        """
        Args:
            detections: Tags of one picture.
            pool: Camera and water.
            tags_b: Tag id -> corners in the body frame [m], (4, 3).
            constraints: What is known of height and tilt, or None.
            pixel_std: Standard deviation of a corner, per axis [px].
        """


METHODS: dict[str, Method] = {
    "refractive": planar_fit,
    "refractive-weighted": weighted_fit,
    "pinhole": pinhole,
    "pinhole-depth": pinhole_depth,
    "refractive-6dof": refractive_bundle,
}
NEEDS_DEPTH = frozenset({"refractive", "refractive-weighted", "pinhole-depth"})
"""Methods that refuse to work without constraints."""
