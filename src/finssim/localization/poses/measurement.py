"""What one picture says about the vehicle's pose, and what is known of it beforehand."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from finssim.geometry.rotations import matrix_to_quat

__all__ = ["Constraints", "Measurement", "axes_of_up", "refused", "tilt_matrix"]

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Constraints:
    """Height and tilt of the vehicle, from pressure and inertia.

    They refer to the vertical `up`. Where the survey's z axis is not quite that of gravity, up is the normal of the
    water; then `z_b` is the height of the body origin along it, up . t_pb.
    """

    z_b: float
    """Height of the body origin in the pool frame, measured along `up` [m]."""
    z_std: float = 0.01
    """Standard deviation of the height of `port` [m]."""
    roll: float = 0.0
    """[rad]"""
    pitch: float = 0.0
    """[rad], positive nose down."""
    tilt_std: float = math.radians(0.5)
    """Standard deviation of roll and of pitch [rad]."""
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Unit vector against gravity, pool frame."""
    port: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Body point whose height was measured [m]: an error of tilt also moves the origin relative to it."""
    shared_pixel_std: float = 0.0
    """Error that all corners of a picture share, per axis [px]: waves, the camera's pose."""


@dataclass(frozen=True, eq=False)
class Measurement:
    """Pose of the vehicle from one picture, pool frame; NaN where it was refused."""

    method: str
    """A key of `METHODS`."""
    ok: bool
    reason: str
    """Why it was refused; empty when it was not."""
    position: Array
    """t_pb: body origin [m], (3,)."""
    rotation: Array
    """R_pb: body to pool, (3, 3)."""
    covariance: Array
    """Of (x, y, yaw) [m, m, rad], (3, 3)."""
    residual_px: float
    """Root mean square distance of the corners used from where the pose puts them [px]."""
    tags: tuple[int, ...] = ()
    """Tags used."""
    corners: int = 0
    """Corners used."""
    rejected: Mapping[str, int] = field(default_factory=dict)
    """Corners not used, by reason."""
    iterations: int = 0
    medium: str = ""
    """Where the corners are: `water`, `air` or `both`."""
    pose_covariance: Array | None = None
    """Of position and a turn about pool axes [m, rad], (6, 6), from methods that measure all six."""

    @property
    def x(self) -> float:
        """[m]"""
        return float(self.position[0])

    @property
    def y(self) -> float:
        """[m]"""
        return float(self.position[1])

    @property
    def z(self) -> float:
        """[m]"""
        return float(self.position[2])

    @property
    def yaw(self) -> float:
        """Heading of the body's x axis about the pool's z axis [rad], in [-pi, pi]."""
        return math.atan2(self.rotation[1, 0], self.rotation[0, 0])

    @property
    def pitch(self) -> float:
        """[rad], positive nose down."""
        return math.atan2(-self.rotation[2, 0], math.hypot(self.rotation[2, 1], self.rotation[2, 2]))

    @property
    def roll(self) -> float:
        """[rad]"""
        return math.atan2(self.rotation[2, 1], self.rotation[2, 2])

    @property
    def quaternion(self) -> Array:
        """q_pb, xyzw, (4,)."""
        return matrix_to_quat(self.rotation)

    @property
    def std(self) -> Array:
        """Standard deviations of x, y [m] and yaw [rad], (3,)."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance)))


def refused(
    method: str, reason: str, rejected: Mapping[str, int] | None = None, *, tags: tuple[int, ...] = ()
) -> Measurement:
    """The measurement that is none, and why."""
    position, matrix = np.full(3, np.nan), np.full((3, 3), np.nan)
    return Measurement(
        method, False, reason, position, matrix, matrix, math.nan, tags, 0, dict(rejected or {})
    )


def tilt_matrix(roll: float, pitch: float) -> Array:
    """R_y(pitch) R_x(roll) of angles [rad], (3, 3)."""
    cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
    return np.array([[cp, sp * sr, sp * cr], [0.0, cr, -sr], [-sp, cp * sr, cp * cr]])


def axes_of_up(up: npt.ArrayLike) -> Array:
    """R_pg: a frame g with z along `up`, turned as little as possible from the pool frame, (3, 3).

    Straight upside down it is a half turn about x.
    """
    x, y, z = (float(a) for a in np.asarray(up, float))
    if z < -1.0 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    k = 1.0 / (1.0 + z)
    return np.array([[1.0 - k * x * x, -k * x * y, x], [-k * x * y, 1.0 - k * y * y, y], [-x, -y, z]])
