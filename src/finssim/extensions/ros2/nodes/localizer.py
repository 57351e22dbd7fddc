"""Localizer node: poses in the map from tags in pictures through the refracting water."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np

from finssim.extensions.ros2.nodes.conversions import (
    compressed_of,
    image_of,
    nanoseconds,
    tags_of,
    telemetry_of,
)
from finssim.extensions.ros2.nodes.frames import FixFrame
from finssim.extensions.ros2.nodes.robot_node import RobotNode
from finssim.localization.detection.detections import Frame
from finssim.localization.detection.detector import RegionTracker, detector
from finssim.localization.fusion.estimator import Estimator, Fixes
from finssim.localization.fusion.streams import VisionSample
from finssim.localization.overhead_camera import load_pool
from finssim.robot.messages import Picture, TagCorners
from finssim.robot.perception import Perception

FORMS = {"raw": ("image", image_of), "compressed": ("picture", compressed_of)}


class Localizer(RobotNode):
    """Node that receives pictures, or tags detected by the camera itself, and telemetry for height and tilt."""

    def __init__(self) -> None:
        super().__init__("localizer")
        file = self.parameter("pool_file", "pool.yaml")
        if file == "none":
            raise ValueError("pool_file is none, but a localizer needs one: start none where no camera looks")
        self.pool = load_pool(self.await_file(file))
        method = self.parameter("method", "refractive")
        self.perception = Perception(self.vehicle, self.pool, method=method)
        self.perception.fixes = self.fixes = _Kept(self.perception.fixes)
        self.frame = FixFrame(self.pool, self.perception.estimator)
        tags = self.vehicle.tags
        assert tags is not None  # Perception refuses a vehicle without tags
        self._tracker = RegionTracker(detector(tags.family), set(tags.mounts))
        self.verdicts: Counter[str] = Counter()
        self.sequence = 0
        self.sends("fix", "tags", "diagnostics", "event")
        self.hears("telemetry", self._on_telemetry)
        self.hears("tags", self._on_tags)
        form = self.parameter("image_transport", "raw")
        if form not in FORMS:
            raise ValueError(f"image_transport is '{form}', expected {' or '.join(FORMS)}")
        key, self._unpack = FORMS[form]
        self.hears(key, self._on_image)
        self.create_timer(1.0, self._publish_diagnostics)

    def _on_telemetry(self, message: Any) -> None:
        times = self.seconds(message.received), self.seconds(message.header.stamp)
        self.perception.telemetry(times[0], telemetry_of(message), times[1])

    def _on_tags(self, message: Any) -> None:
        decoded = tags_of(message)
        if decoded is None:
            self.verdicts["malformed tags"] += 1
        elif decoded[1] != self.get_name():
            self._locate(decoded[0], decoded[2])

    def _on_image(self, message: Any) -> None:
        image, lens = self._unpack(message), self.pool.camera.lens
        if image is None or image.shape != (lens.height, lens.width):
            self.verdicts["not a picture of this camera"] += 1
            return
        stamp = nanoseconds(message.header.stamp)
        detections = self._tracker.detect(image, (stamp - self.base) * 1e-9)
        self.sequence += 1
        picture = Picture(0.0, self.sequence, None, tuple(TagCorners(d.tag, d.corners) for d in detections))
        self.send("tags", self.make.found_tags(stamp, picture, self.get_name()))
        self._locate(stamp, picture)

    def _locate(self, stamp: int, picture: Picture) -> None:
        """Localize in a picture stamped with the middle of its exposure [ns]; the robot's picture times are
        those of arrival."""
        arrival = (stamp - self.base) * 1e-9 + self.pool.latency
        self.fixes.newest = None
        verdict = self.perception.picture(self.now(), replace(picture, time=arrival))
        self.verdicts[verdict] += 1
        fix = self.fixes.newest
        if fix is not None:
            position, quaternion, covariance = self.frame.to_map(fix, self.perception.estimator)
            self.send("fix", self.make.fix(self.ns(fix.time), position, quaternion, covariance))

    def _publish_diagnostics(self) -> None:
        fixes = sum(self.verdicts[word] for word in ("accepted", "initialized", "reacquired"))
        self.diagnose("fixes", "ok" if fixes else "stale", f"{fixes} fixes", dict(self.verdicts))
        self.verdicts.clear()


class _Kept:
    """Source of fixes that stores the newest one."""

    def __init__(self, fixes: Fixes) -> None:
        self._fixes = fixes
        self.newest: VisionSample | None = None

    def fix(self, frame: Frame, estimator: Estimator) -> VisionSample | str:
        """Return the result of `Fixes.fix`."""
        result = self._fixes.fix(frame, estimator)
        valid = isinstance(result, VisionSample) and bool(np.isfinite(result.position).all())
        self.newest = result if isinstance(result, VisionSample) and valid else None
        return result
