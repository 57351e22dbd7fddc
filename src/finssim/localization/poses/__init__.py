"""Pose of the vehicle from one picture, and prior knowledge of it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from finssim.core.rotations import matrix_to_quat
from finssim.localization.detection.detections import Detection, best_detections

__all__ = [
    "Constraints", "Correspondences", "PoseMeasurement", "about_up", "axes_of_up", "correspondences", "inflation",
    "refused", "tilt_matrix",
]  # fmt: skip

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Constraints:
    """Prior knowledge of height and tilt of the vehicle, from pressure sensor and IMU.

    Both refer to the vertical `up`. If the survey's z axis is not exactly vertical, `up` is the normal of the
    water surface; `z_b` is then the height of the body origin along it, up . t_pb.
    """

    z_b: float
    """Height of the body origin in the pool frame, measured along `up` [m]."""
    z_std: float = 0.01
    """Standard deviation of the height of `port` [m]."""
    roll: float = 0.0
    """Roll [rad]."""
    pitch: float = 0.0
    """Pitch [rad], positive nose down."""
    tilt_std: float = math.radians(0.5)
    """Standard deviation of roll and of pitch [rad]."""
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Unit vector against gravity, pool frame."""
    port: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Body point whose height was measured [m]: a tilt error also moves the origin relative to it."""
    shared_pixel_std: float = 0.0
    """Standard deviation of an error common to all corners of a picture, per axis [px]: waves, the camera's pose."""


@dataclass(frozen=True, eq=False)
class PoseMeasurement:
    """Pose of the vehicle from one picture, pool frame; NaN if it was refused."""

    method: str
    """A key of `METHODS`."""
    ok: bool
    reason: str
    """Reason for a refusal; empty if it was accepted."""
    position: Array
    """t_pb: body origin [m], (3,)."""
    rotation: Array
    """R_pb: body to pool, (3, 3)."""
    covariance: Array
    """Covariance of (x, y, yaw) [m, m, rad], (3, 3)."""
    residual_px: float
    """Root mean square reprojection error of the corners used [px]."""
    tags: tuple[int, ...] = ()
    """Tags used."""
    corners: int = 0
    """Corners used."""
    rejected: Mapping[str, int] = field(default_factory=dict)
    """Number of corners not used, by reason."""
    iterations: int = 0
    medium: str = ""
    """Medium of the corners: `water`, `air` or `both`."""
    pose_covariance: Array | None = None
    """Covariance of position and rotation about pool axes [m, rad], (6, 6), from methods that measure all six."""

    @property
    def x(self) -> float:
        """Position x [m]."""
        return float(self.position[0])

    @property
    def y(self) -> float:
        """Position y [m]."""
        return float(self.position[1])

    @property
    def z(self) -> float:
        """Position z [m]."""
        return float(self.position[2])

    @property
    def yaw(self) -> float:
        """Heading of the body's x axis about the pool's z axis [rad], in [-pi, pi]."""
        return math.atan2(self.rotation[1, 0], self.rotation[0, 0])

    @property
    def pitch(self) -> float:
        """Pitch [rad], positive nose down."""
        return math.atan2(-self.rotation[2, 0], math.hypot(self.rotation[2, 1], self.rotation[2, 2]))

    @property
    def roll(self) -> float:
        """Roll [rad]."""
        return math.atan2(self.rotation[2, 1], self.rotation[2, 2])

    @property
    def quaternion(self) -> Array:
        """Return the quaternion q_pb, xyzw, (4,)."""
        return matrix_to_quat(self.rotation)

    @property
    def std(self) -> Array:
        """Standard deviations of x, y [m] and yaw [rad], (3,)."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance)))


def refused(
    method: str, reason: str, rejected: Mapping[str, int] | None = None, *, tags: tuple[int, ...] = ()
) -> PoseMeasurement:
    """Return a refused measurement with its reason."""
    position, matrix = np.full(3, np.nan), np.full((3, 3), np.nan)
    return PoseMeasurement(
        method, False, reason, position, matrix, matrix, math.nan, tags, 0, dict(rejected or {})
    )


def tilt_matrix(roll: float, pitch: float) -> Array:
    """Return R_y(pitch) R_x(roll) for angles in [rad], (3, 3)."""
    cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
    return np.array([[cp, sp * sr, sp * cr], [0.0, cr, -sr], [-sp, cp * sr, cp * cr]])


def about_up(angle: float) -> Array:
    """Return the rotation matrix about z by an angle [rad], (3, 3)."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def axes_of_up(up: npt.ArrayLike) -> Array:
    """Return the rotation matrix R_pg of a frame g with z along the vector `up`, (3, 3).

    It is the smallest rotation from the pool frame; if `up` points down, a half turn about x.
    """
    x, y, z = (float(a) for a in np.asarray(up, float))
    if z < -1.0 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    k = 1.0 / (1.0 + z)
    return np.array([[1.0 - k * x * x, -k * x * y, x], [-k * x * y, 1.0 - k * y * y, y], [-x, -y, z]])


def inflation(residual_norms: Array, parameters: int, std: float) -> float:
    """Return the factor [-] on a variance if residuals are larger than noise explains.

    It is 1 up to the 99 % quantile of chi² (Wilson and Hilferty's approximation), and the ratio to that
    quantile beyond.

    Args:
        missed: Residual of each point, as a distance [px], (n,).
        parameters: Number of fitted parameters.
        std: Standard deviation of a point, per axis [px].
    """
    dof = max(2 * len(residual_norms) - parameters, 1)
    k = 2.0 / (9.0 * dof)
    quantile = dof * (1.0 - k + 2.326 * math.sqrt(k)) ** 3
    return max(1.0, float(residual_norms @ residual_norms) / std**2 / quantile)


# Correspondences between corners in a picture and corners on the vehicle.

UNKNOWN_TAG = "unknown tag"
TWICE = "tag seen twice"
NO_SQUARE = "corners not clockwise"
SMALLEST = 4.0
"""Least cross product of adjacent edges of a tag [px²]: that of a tag 2 px wide."""


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Corners in the picture with their positions on the vehicle, four consecutive ones per tag."""

    pixels: Array
    """Pixels (u, v), (n, 2)."""
    points_b: Array
    """Positions, body frame [m], (n, 3)."""
    tags: tuple[int, ...]
    """Tag of each group of four corners."""
    rejected: Mapping[str, int]
    """Number of excluded corners, by reason."""

    @property
    def too_few_reason(self) -> str:
        """Sentence for a picture without any corner of the vehicle."""
        if NO_SQUARE in self.rejected:
            return (
                "the corners of no known tag run clockwise around a square: expected top-left, top-right, "
                "bottom-right, bottom-left of the print"
            )
        if UNKNOWN_TAG in self.rejected:
            return "no tag of the vehicle among those seen"
        return "no tag seen"


def correspondences(detections: Iterable[Detection], tags_b: Mapping[int, Array]) -> Correspondences:
    """Match the tags of a picture with those of a vehicle.

    Unknown tags are counted as rejected, and so are those whose corners do not run clockwise around a convex
    quadrangle, as those of a tag seen from its printed side do; of an id seen twice, the more certain one is used.

    Args:
        detections: Tags of one picture.
        tags_b: Tag id -> corners in the body frame [m], (4, 3), as `tag_corners_b`.
    """
    all_detections = list(detections)
    recognised = [detection for detection in all_detections if detection.tag in tags_b]
    rejected: dict[str, int] = {}
    if len(recognised) < len(all_detections):
        rejected[UNKNOWN_TAG] = 4 * (len(all_detections) - len(recognised))
    square = [detection for detection in recognised if _clockwise(detection.corners)]
    if len(square) < len(recognised):
        rejected[NO_SQUARE] = 4 * (len(recognised) - len(square))
        recognised = square
    if len({detection.tag for detection in recognised}) < len(recognised):
        best = {detection.tag: detection for detection in reversed(best_detections(recognised))}
        rejected[TWICE] = 4 * (len(recognised) - len(best))
        recognised = list(best.values())
    if not recognised:
        return Correspondences(np.empty((0, 2)), np.empty((0, 3)), (), rejected)
    return Correspondences(
        np.concatenate([detection.corners for detection in recognised]),
        np.concatenate([tags_b[detection.tag] for detection in recognised]),
        tuple(detection.tag for detection in recognised),
        rejected,
    )


def _clockwise(corners: Array) -> bool:
    """Return whether the corners turn right (v down), each with a cross product of its edges of more than
    `SMALLEST`."""
    if np.shape(corners) != (4, 2):
        return False
    (a, b), (c, d), (e, f), (g, h) = np.asarray(corners, float).tolist()
    return bool(
        (c - a) * (f - d) - (d - b) * (e - c) > SMALLEST
        and (e - c) * (h - f) - (f - d) * (g - e) > SMALLEST
        and (g - e) * (b - h) - (h - f) * (a - g) > SMALLEST
        and (a - g) * (d - b) - (b - h) * (c - a) > SMALLEST
    )
