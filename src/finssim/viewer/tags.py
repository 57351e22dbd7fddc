"""Tags found in a picture for the person who looks, where nobody else has told where they are."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from finssim.localization.detection.detector import RegionTracker, detector
from finssim.robot.messages import TagCorners
from finssim.vehicles import Vehicle

LONGEST_STEP = 0.5
"""A picture that is further from the one before is searched as a whole [s]."""


class TagLook:
    """A detector that is made when it is first needed; without its library nothing is found."""

    def __init__(self, vehicle: Vehicle) -> None:
        self._tags = vehicle.tags
        self._tracker: RegionTracker | None = None
        self._last = -np.inf

    def find(self, image: npt.NDArray[np.uint8], time: float) -> tuple[TagCorners, ...]:
        """The vehicle's tags in a grey picture of a time [s]."""
        if self._tags is None:
            return ()
        if self._tracker is None or not 0.0 <= time - self._last <= LONGEST_STEP:
            self._tracker = RegionTracker(detector(self._tags.family), set(self._tags.mounts))
        self._last = time
        try:
            found = self._tracker.detect(image, time)
        except ImportError:  # a view without the extra `vision` shows the picture alone
            self._tags = None
            return ()
        return tuple(TagCorners(d.tag, d.corners) for d in found)
