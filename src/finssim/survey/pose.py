"""Poses of one frame in another, for the fits of a survey."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from finssim.core.rotations import quat_from_rotvec, quat_to_matrix

Array = NDArray[np.float64]


class Pose(NamedTuple):
    """Pose of a frame in another frame."""

    R: Array
    """Rotation matrix from the inner to the outer frame, (3, 3)."""
    t: Array
    """Origin of the inner frame in the outer one [m], (3,)."""

    def at(self, points: Array) -> Array:
        """Return points of the inner frame in the outer one, (..., 3) [m]."""
        return np.asarray(points @ self.R.T + self.t)

    def then(self, inner: Pose) -> Pose:
        """Return the pose of a frame that has the pose `inner` in this one."""
        return Pose(self.R @ inner.R, self.R @ inner.t + self.t)

    @property
    def inverse(self) -> Pose:
        """Return the pose of the outer frame in the inner one."""
        return Pose(self.R.T.copy(), -self.R.T @ self.t)

    def stepped(self, step: Array) -> Pose:
        """Return the pose after a small rotation about the outer axes [rad] (3) and a shift [m] (3)."""
        return Pose(quat_to_matrix(quat_from_rotvec(step[:3])) @ self.R, self.t + step[3:])
