"""Localization by a camera above the pool: tag detection, poses through the water surface, and sensor fusion."""

from typing import TYPE_CHECKING

from finssim.core.lazy import exports

if TYPE_CHECKING:
    from finssim.localization.detection.detections import Detection
    from finssim.localization.detection.detector import RegionTracker, detector
    from finssim.localization.detection.families import bitmap, printable, tag_corners_b
    from finssim.localization.detection.pictures import pictures, write_picture
    from finssim.localization.fusion.estimator import Estimator
    from finssim.localization.fusion.fuse_settings import Site, site_of
    from finssim.localization.fusion.sensors import SENSORS, SensorModel
    from finssim.localization.fusion.streams import DepthSample, ImuSample, VisionSample
    from finssim.localization.overhead_camera import Pool, load_pool, write_pool
    from finssim.localization.poses import Constraints
    from finssim.localization.poses.methods import METHODS

__all__ = [
    "Constraints",
    "DepthSample",
    "Detection",
    "Estimator",
    "ImuSample",
    "LocalizationError",
    "METHODS",
    "Pool",
    "RegionTracker",
    "SENSORS",
    "SensorModel",
    "Site",
    "VisionSample",
    "bitmap",
    "detector",
    "load_pool",
    "pictures",
    "printable",
    "site_of",
    "tag_corners_b",
    "write_picture",
    "write_pool",
]

__getattr__, __dir__ = exports(__name__)


class LocalizationError(ValueError):
    """A camera, pool, detection or log cannot be used; the message states what, where and what to do."""
