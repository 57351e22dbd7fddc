"""Fixes from tags found in pictures, while the estimator runs: height and tilt are those of the exposure."""

from __future__ import annotations

import math

import numpy as np

from finssim.localization.detection.detections import Frame
from finssim.localization.detection.tags import tag_corners_b
from finssim.localization.errors import LocalizationError
from finssim.localization.fusion.attitude import height_above_origin
from finssim.localization.fusion.estimator import Estimator
from finssim.localization.fusion.fuse_log import counted
from finssim.localization.fusion.streams import VisionSample
from finssim.localization.pool import Pool
from finssim.localization.poses.measurement import Constraints
from finssim.localization.poses.methods import METHODS, NEEDS_DEPTH
from finssim.vehicles import Vehicle

__all__ = ["NO_TAGS", "Fixes", "check_method"]

NO_TAGS = "the vehicle file has no tags: add a section tags: with family, edge and mounts"


def check_method(method: str) -> None:
    """Refuse a word that is no name of `METHODS`.

    Raises:
        LocalizationError: It is none; the sentence lists them.
    """
    if method not in METHODS:
        raise LocalizationError(f"unknown method '{method}'; available: {', '.join(METHODS)}")


class Fixes:
    """Makes a fix of each picture."""

    def __init__(
        self, pool: Pool, vehicle: Vehicle, *, method: str = "refractive", pixel_std: float = 0.5
    ) -> None:
        """
        Args:
            pool: Camera and water.
            vehicle: Its tags.
            method: A name of `METHODS`.
            pixel_std: Standard deviation of a corner [px].

        Raises:
            LocalizationError: Unknown method, a vehicle without tags, or no error at all.
        """
        check_method(method)
        if vehicle.tags is None:
            raise LocalizationError(NO_TAGS)
        if not (math.isfinite(pixel_std) and pixel_std > 0.0):
            raise LocalizationError(
                f"pixel_std is {pixel_std}, expected the error of a corner in pixels, such as 0.3"
            )
        self._pool, self._method, self._pixel_std = pool, method, pixel_std
        self._tags = tag_corners_b(vehicle.tags)

    def fix(self, frame: Frame, estimator: Estimator) -> VisionSample | str:
        """The fix of one picture, or why there is none.

        Args:
            frame: The picture's tags; its stamp is that of its arrival.
            estimator: Knows depth and tilt at the exposure, of the samples that have arrived.
        """
        if not math.isfinite(frame.time):
            return "time not finite"
        if not frame.detections:
            return "no tag"
        time = frame.time - self._pool.latency
        constraints = self._constraints(time, estimator)
        if constraints is None and self._method in NEEDS_DEPTH:
            return "no depth or tilt"
        found = METHODS[self._method](frame.detections, self._pool, self._tags, constraints, self._pixel_std)
        if not found.ok:
            return counted(found.reason)
        R = np.asarray(found.covariance, float)
        rows = tuple((float(row[0]), float(row[1]), float(row[2])) for row in 0.5 * (R + R.T))
        return VisionSample(time, (found.x, found.y), found.yaw, rows, frame.time)

    def _constraints(self, time: float, estimator: Estimator) -> Constraints | None:
        near, site = estimator.at(time), estimator.site
        if math.isnan(near.depth) or math.isnan(near.roll) or math.isnan(near.pitch):
            return None
        lever = height_above_origin(site.depth_port, near.roll, near.pitch)
        return Constraints(
            z_b=-near.depth - site.offset - lever,
            z_std=estimator.settings.depth_std,
            roll=near.roll,
            pitch=near.pitch,
            up=site.up,
            port=site.depth_port,
        )
