"""A picture source whose tags are found on a thread of its own, so that the control loop never waits for a detector."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from finssim.localization.detection.detector import detector
from finssim.localization.detection.region import RegionTracker
from finssim.robot.messages import Picture, TagCorners
from finssim.vehicles import Vehicle

if TYPE_CHECKING:
    from finssim.robot.picture_source import PictureSource

__all__ = ["TagFinder"]

LOG = logging.getLogger(__name__)
POLL = 0.002
"""Time between two looks for a new picture [s]."""
WAITING = 8
"""Pictures that wait for the loop."""


class TagFinder:
    """Pictures in, pictures with their tags out; one without tags comes out without its image."""

    def __init__(
        self,
        source: PictureSource,
        vehicle: Vehicle,
        *,
        size: tuple[int, int],
        library: str | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Start looking.

        Args:
            source: Where pictures come from; it belongs to the finder from now on.
            vehicle: Its tags are looked for.
            size: Rows and columns of the camera's pictures; others are passed on as they are, to be refused.
            library: Detector: apriltag or opencv; apriltag if None.
            clock: The robot's [s].
        """
        assert vehicle.tags is not None
        self._source, self._size, self._clock = source, size, clock
        self._tracker = RegionTracker(
            detector(vehicle.tags.family, library=library), set(vehicle.tags.mounts)
        )
        self._found: deque[Picture] = deque(maxlen=WAITING)
        self._over = threading.Event()
        self.problem = ""
        """Why a picture could not be searched, as the detector said it first; it passed as one without tags."""
        self.skipped = 0
        """Pictures that were left out because newer ones had come meanwhile."""
        self._thread = threading.Thread(target=self._look, name="tag finder", daemon=True)
        self._thread.start()

    def receive(self, now: float) -> list[Picture]:
        """What has been looked at since the last call."""
        found = []
        while self._found:
            found.append(self._found.popleft())
        return found

    def describe(self) -> str:
        """The source and how it fares, in a few words."""
        problem = f", {self.problem}" if self.problem else ""
        return f"{self._source.describe()}, {self.skipped} skipped{problem}"

    def close(self) -> None:
        """Stop looking and let go of the source."""
        self._over.set()
        self._thread.join()
        self._source.close()

    def _look(self) -> None:
        while not self._over.wait(POLL):
            pictures = self._source.receive(self._clock())
            if pictures:
                self.skipped += len(pictures) - 1
                self._found.append(self._with_tags(pictures[-1]))

    def _with_tags(self, picture: Picture) -> Picture:
        image = picture.image
        if image is None or picture.tags or image.shape != self._size or image.dtype != np.uint8:
            return picture
        try:
            found = self._tracker.detect(image, picture.time)
        except Exception as error:  # whatever it is: the next picture may be better
            if not self.problem:
                self.problem = f"tags cannot be sought: {type(error).__name__}: {error}"
                LOG.warning(self.problem)
            return replace(picture, image=None)
        tags = tuple(TagCorners(d.tag, d.corners) for d in found)
        return replace(picture, tags=tags, image=image if tags else None)
