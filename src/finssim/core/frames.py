"""The only module that converts coordinates between conventions.

| convention | body axes | world | angles |
| --- | --- | --- | --- |
| ours (ROS) | x forward, y left, z up | z up, z = 0 on the water surface | right-handed, xyzw |
| Fossen | x forward, y right, z down | z down (x shared with ours) | right-handed |
| paper's controller | x forward, y up, z left | y up, y = 0 on the water surface | LEFT-handed |
| camera optical | x right, y down, z along the view | - | right-handed |
| ArduSub's JSON, MuJoCo | - | - | wxyz |

`TO_X.vector(v)` converts our vector to X's axes, `FROM_X.vector(v)` converts it back. All functions accept
leading batch dimensions `...`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from finssim.core.rotations import (
    matrix_to_quat,
    quat_multiply,
)

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Axes:
    """Change of axes that applies to body and world alike: components change by x' = A x, with A orthogonal.

    An axial vector (angular velocity, moment) is also multiplied by det A: its sign changes in a left-handed
    frame.
    """

    rows: tuple[tuple[float, float, float], ...]
    """New axes in components of the old axes: the rows of A, unit vectors."""

    @property
    def A(self) -> Array:
        """Return the matrix A of unit vectors, (3, 3)."""
        return np.array(self.rows)

    @property
    def axial_map(self) -> Array:
        """Return det(A) A, which has no unit [-], (3, 3)."""
        return np.asarray(np.round(np.linalg.det(self.A)) * self.A)

    @property
    def twist_map(self) -> Array:
        """Return diag(A, det(A) A), which has no unit [-], (6, 6)."""
        o = np.zeros((3, 3))
        return np.block([[self.A, o], [o, self.axial_map]])

    @property
    def inverse(self) -> Axes:
        """Return the inverse change of axes."""
        return Axes(tuple(tuple(row) for row in self.A.T.tolist()))

    def vector(self, v: npt.ArrayLike) -> Array:
        """Return a polar vector in the new axes, in its own unit: position, velocity, acceleration, force,
        (..., 3)."""
        return np.asarray(np.asarray(v, float) @ self.A.T)

    def axial(self, w: npt.ArrayLike) -> Array:
        """Return an axial vector in the new axes, in its own unit: angular velocity, moment, rotation vector,
        (..., 3)."""
        return np.asarray(np.asarray(w, float) @ self.axial_map.T)

    def twist(self, x: npt.ArrayLike) -> Array:
        """Return a twist or wrench in the new axes, in its own units: three polar, then three axial
        components, (..., 6)."""
        return np.asarray(np.asarray(x, float) @ self.twist_map.T)

    def rotation(self, R: npt.ArrayLike) -> Array:
        """Return a rotation matrix, body to world, in both new sets of axes: A R A', (..., 3, 3)."""
        return np.asarray(self.A @ np.asarray(R, float) @ self.A.T)

    def quaternion(self, q: npt.ArrayLike) -> Array:
        """Return a quaternion xyzw, body to world, in both new sets of axes, (..., 4): its vector part is
        axial."""
        q = np.asarray(q, float)
        return np.concatenate([self.axial(q[..., :3]), q[..., 3:]], axis=-1)

    def yaw(self, yaw: npt.ArrayLike) -> Array:
        """Return a heading in the new axes [rad], (...,): left-positive in ours, right-positive in Fossen's and the
        controller's frames."""
        return np.asarray(np.asarray(yaw, float) * np.sum(self.axial([0.0, 0.0, 1.0])))

    def covariance(self, S: npt.ArrayLike) -> Array:
        """Return a covariance, inertia or damping matrix in the new axes, in its own unit.

        The shape is (..., 3, 3) for polar vectors and (..., 6, 6) for twists or wrenches.
        """
        S = np.asarray(S, float)
        M = self.A if S.shape[-1] == 3 else self.twist_map
        return np.asarray(M @ S @ M.T)


TO_FOSSEN = Axes(((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0)))
"""Ours to Fossen's, in body (FRD) and world (z down): half a turn about x."""

FROM_FOSSEN = TO_FOSSEN.inverse

TO_CONTROLLER = Axes(((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)))
"""Ours to the paper's controller frame, in body and world: y and z are exchanged, which changes handedness."""

FROM_CONTROLLER = TO_CONTROLLER.inverse

TO_OPTICAL = Axes(((0.0, -1.0, 0.0), (0.0, 0.0, -1.0), (1.0, 0.0, 0.0)))
"""A camera's x-forward, y-left, z-up axes to its optical axes. Only the camera's axes change, the world's do not: use
`vector` and `axial` for vectors in camera axes, and `optical_from_camera` for its attitude."""

FROM_OPTICAL = TO_OPTICAL.inverse


def optical_from_camera(q_wc: npt.ArrayLike) -> Array:
    """Return the attitude q_wo (xyzw) of the optical axes from the attitude of a camera's x-forward, z-up
    axes, (..., 4)."""
    return quat_multiply(q_wc, matrix_to_quat(FROM_OPTICAL.A))


def camera_from_optical(q_wo: npt.ArrayLike) -> Array:
    """Return the attitude q_wc (xyzw) of a camera's x-forward, z-up axes from the attitude of its optical
    axes, (..., 4)."""
    return quat_multiply(q_wo, matrix_to_quat(TO_OPTICAL.A))


def wxyz_from_xyzw(q: npt.ArrayLike) -> Array:
    """Return a quaternion (xyzw) in the order wxyz, which ArduSub's JSON and MuJoCo use, (..., 4)."""
    return np.roll(np.asarray(q, float), 1, axis=-1)
