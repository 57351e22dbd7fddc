"""Fixes between the pool's frame, in which the estimator works, and the map, in which they travel."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from finssim.geometry.rotations import (
    matrix_to_quat,
    quat_conjugate,
    quat_from_euler,
    quat_multiply,
    quat_to_euler,
)
from finssim.localization.fusion.estimator import Estimator
from finssim.localization.fusion.streams import VisionSample
from finssim.localization.pool import Pool
from finssim.localization.poses import axes_of_up
from finssim.ros2.nodes.conversions import xyz, xyzw

__all__ = ["FixFrame"]

Array = npt.NDArray[np.float64]

KNOWN = [0, 1, 2, 5]
"""x, y, z and yaw among the six of a pose's covariance."""
UNKNOWN = 1.0e6
"""Variance of a heading that is not known [rad²]."""
TILT_VARIANCE = 0.02
"""Of roll and pitch, which are the attitude filter's [rad²]."""


class FixFrame:
    """One pool's frames. Height and tilt, which a fix does not measure, go along as what was used for it."""

    def __init__(self, pool: Pool, estimator: Estimator) -> None:
        self._T_wp = pool.T_wp
        R = self._T_wp[:3, :3]
        self._q_wg = matrix_to_quat(R @ axes_of_up(estimator.site.up))
        self._turn = np.eye(4)
        self._turn[:3, :3] = R
        self._height_variance = estimator.settings.depth_std**2

    def to_map(self, fix: VisionSample, estimator: Estimator) -> tuple[Array, Array, Array]:
        """Position [m], quaternion xyzw and covariance (6, 6) in the map.

        Args:
            fix: Pool frame.
            estimator: Knows height and tilt at its time.
        """
        near = estimator.at(fix.time)
        height = float(estimator.estimate(fix.time).x[2])
        place = np.array([*fix.position, height if math.isfinite(height) else 0.0])
        roll, pitch = (a if math.isfinite(a) else 0.0 for a in (near.roll, near.pitch))
        level = quat_from_euler(roll, pitch, fix.yaw or 0.0)
        P = np.diag([0.0, 0.0, self._height_variance, UNKNOWN if fix.yaw is None else 0.0])
        if fix.covariance is not None:
            P[np.ix_([0, 1, 3], [0, 1, 3])] += np.array(fix.covariance)
        full = np.diag([0.0, 0.0, 0.0, TILT_VARIANCE, TILT_VARIANCE, 0.0])
        full[np.ix_(KNOWN, KNOWN)] = self._turn @ P @ self._turn.T
        q = np.asarray(quat_multiply(self._q_wg, level))
        return self._T_wp[:3, :3] @ place + self._T_wp[:3, 3], q, full

    def from_map(self, message: Any, time: float, now: float) -> VisionSample:
        """The fix in a PoseWithCovarianceStamped; whether its numbers are fit to be used is the estimator's to say.

        Args:
            message: Map frame.
            time: Of its stamp [s].
            now: [s]
        """
        pose = message.pose.pose
        place = self._T_wp[:3, :3].T @ (np.array(xyz(pose.position)) - self._T_wp[:3, 3])
        level = quat_multiply(quat_conjugate(self._q_wg), np.array(xyzw(pose.orientation)))
        P = np.array(message.pose.covariance, float).reshape(6, 6)[np.ix_(KNOWN, KNOWN)]
        R = (self._turn.T @ P @ self._turn)[np.ix_([0, 1, 3], [0, 1, 3])]
        rows = tuple((float(row[0]), float(row[1]), float(row[2])) for row in 0.5 * (R + R.T))
        yaw = float(quat_to_euler(level)[2])
        return VisionSample(time, (float(place[0]), float(place[1])), yaw, rows, now)
