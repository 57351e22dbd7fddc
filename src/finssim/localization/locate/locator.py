"""Poses of a vehicle from the tags of one picture after the other, with what else is known at each exposure."""

from __future__ import annotations

import math
from functools import cache

from finssim.localization.detection.detections import Frame
from finssim.localization.detection.families import family_named
from finssim.localization.detection.tags import tag_corners_b
from finssim.localization.errors import LocalizationError
from finssim.localization.locate.localize_known import Known
from finssim.localization.pool import Pool
from finssim.localization.poses.measurement import Measurement, refused
from finssim.localization.poses.methods import METHODS, NEEDS_DEPTH
from finssim.vehicles import Vehicle

__all__ = ["Locator"]


class Locator:
    """Measures the pose in one picture after the other; it remembers nothing of them."""

    def __init__(
        self,
        pool: Pool,
        vehicle: Vehicle,
        known: Known,
        *,
        method: str = "refractive",
        pixel_std: float = 0.5,
        family: str | None = None,
    ) -> None:
        """
        Args:
            pool: Camera and water.
            vehicle: Its tags.
            known: Height and tilt over time.
            method: A name of `METHODS`.
            pixel_std: Standard deviation of a corner, per axis [px].
            family: Of the tags; None: that of the vehicle file.

        Raises:
            LocalizationError: Unknown method, no depth where it needs one, a vehicle without tags, or no error at all.
        """
        if method not in METHODS:
            raise LocalizationError(f"unknown method '{method}'; available: {', '.join(METHODS)}")
        if method in NEEDS_DEPTH and known.depth is None:
            raise LocalizationError(
                f"method {method} needs --depth FILE (columns t, depth) or --depth METRES, the depth of the pressure "
                "port; --method refractive-6dof does without"
            )
        tags = vehicle.file_tags
        if tags is None:
            raise LocalizationError(
                f"{vehicle.name}: the vehicle file has no tags: add a section tags: with family, edge and mounts"
            )
        if not (math.isfinite(pixel_std) and pixel_std > 0.0):
            raise LocalizationError(
                f"pixel_std is {pixel_std}, expected the error of a corner in pixels, such as 0.3"
            )
        self.known, self.family = known, family_named(family or tags.family).name
        self._pool, self._method, self._pixel_std = pool, method, pixel_std
        self._tags_b = tag_corners_b(tags)

    @property
    def tags(self) -> tuple[int, ...]:
        """Ids of the vehicle's tags."""
        return tuple(self._tags_b)

    def locate(self, frame: Frame) -> Measurement:
        """The pose in one picture, or why there is none."""
        seen = [found for found in frame.detections if _name(found.family) in ("", self.family)]
        needs_height = self._method in NEEDS_DEPTH
        constraints = None
        if seen:
            known = self.known.at(frame.time - self._pool.latency, needs_height=needs_height)
            if isinstance(known, str):
                return refused(self._method, known)
            constraints = known
        elif frame.detections:
            other = ", ".join(sorted({found.family for found in frame.detections}))
            return refused(self._method, f"no tag of family {self.family} seen: {other}")
        return METHODS[self._method](seen, self._pool, self._tags_b, constraints, self._pixel_std)


@cache
def _name(family: str) -> str:
    """The family's own name, such as `tag25h9` for `25h9`; unknown ones as they are."""
    try:
        return family_named(family).name if family else ""
    except LocalizationError:
        return family
