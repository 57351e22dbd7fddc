"""Rotations in float64 NumPy over a leading `...` batch; quaternions are xyzw, body to world unless stated otherwise.

Euler angles are ZYX (yaw, then pitch, then roll). With y left and z up, a positive pitch is nose DOWN and a positive
yaw is a LEFT turn.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

_CONJUGATE = np.array([-1.0, -1.0, -1.0, 1.0])


def _components(a: npt.ArrayLike) -> tuple[Any, ...]:
    """Return the components of one vector as plain floats, ten times faster than NumPy's, or the columns of a
    batch."""
    a = np.asarray(a, float)
    return tuple(a.tolist()) if a.ndim == 1 else tuple(a[..., i] for i in range(a.shape[-1]))


def _vector(*components: Any) -> Array:
    """Return the vector, or the batch of vectors, with these components."""
    if {*map(type, components)} == {float}:
        return np.array(components)
    shape = np.broadcast(*components).shape
    if not shape:
        return np.array(components)
    out = np.empty((*shape, len(components)))
    for i, component in enumerate(components):
        out[..., i] = component
    return out


def wrap_angle(angle: npt.ArrayLike) -> Array:
    """Return an angle in [-pi, pi) [rad], (...,)."""
    return np.asarray(np.remainder(np.asarray(angle, float) + np.pi, 2.0 * np.pi) - np.pi)


def cross(a: npt.ArrayLike, b: npt.ArrayLike) -> Array:
    """Return a x b, (..., 3) each, in the product of their units; for a pair faster than `np.cross`."""
    return _vector(*_cross(_components(a), _components(b)))


def _cross(a: tuple[Any, ...], b: tuple[Any, ...]) -> tuple[Any, Any, Any]:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def skew(a: npt.ArrayLike) -> Array:
    """Return the matrix S(a) with S(a) b = a x b, (..., 3) -> (..., 3, 3). The unit is unchanged."""
    x, y, z = _components(a)
    S = _vector(0.0, -z, y, z, 0.0, -x, -y, x, 0.0)
    return S.reshape(*S.shape[:-1], 3, 3)


def quat_multiply(q_ab: npt.ArrayLike, q_bc: npt.ArrayLike) -> Array:
    """Return the composition q_ac = q_ab q_bc of quaternions, (..., 4)."""
    a, b = _components(q_ab), _components(q_bc)
    x, y, z = _cross(a, b)
    return _vector(
        a[3] * b[0] + b[3] * a[0] + x,
        a[3] * b[1] + b[3] * a[1] + y,
        a[3] * b[2] + b[3] * a[2] + z,
        a[3] * b[3] - (a[0] * b[0] + a[1] * b[1] + a[2] * b[2]),
    )


def quat_conjugate(q: npt.ArrayLike) -> Array:
    """Return the inverse rotation of a unit quaternion, (..., 4)."""
    return np.asarray(np.asarray(q, float) * _CONJUGATE)


def quat_rotate(q_ab: npt.ArrayLike, vector_b: npt.ArrayLike) -> Array:
    """Return a vector of any unit, given in frame b, in frame a: (..., 4), (..., 3) -> (..., 3)."""
    q, v = _components(q_ab), _components(vector_b)
    x, y, z = _cross(q, v)
    twice = 2.0 * x, 2.0 * y, 2.0 * z
    x, y, z = _cross(q, twice)
    return _vector(v[0] + q[3] * twice[0] + x, v[1] + q[3] * twice[1] + y, v[2] + q[3] * twice[2] + z)


def quat_inverse_rotate(q_ab: npt.ArrayLike, vector_a: npt.ArrayLike) -> Array:
    """Return a vector of any unit, given in frame a, in frame b: (..., 4), (..., 3) -> (..., 3)."""
    return quat_rotate(quat_conjugate(q_ab), vector_a)


def quat_to_matrix(q_ab: npt.ArrayLike) -> Array:
    """Return the rotation matrix R_ab of a unit quaternion, (..., 4) -> (..., 3, 3)."""
    x, y, z, w = _components(q_ab)
    # 1 + 2 w S + 2 S S with S = S(x, y, z).
    R = _vector(
        *(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        *(2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        *(2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
    return R.reshape(*R.shape[:-1], 3, 3)


def matrix_to_quat(R_ab: npt.ArrayLike) -> Array:
    """Return the unit quaternion of a rotation matrix, with w >= 0, (..., 3, 3) -> (..., 4)."""
    R = np.asarray(R_ab, float)
    xx, yy, zz = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    yx, zx, zy = R[..., 1, 0] + R[..., 0, 1], R[..., 2, 0] + R[..., 0, 2], R[..., 2, 1] + R[..., 1, 2]
    xw, yw, zw = R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]
    # Four times q q^T: every row is proportional to q, and the one with the largest diagonal loses no digits.
    outer = np.empty((*R.shape[:-2], 4, 4))
    outer[..., 0, 0], outer[..., 1, 1] = 1.0 + xx - yy - zz, 1.0 - xx + yy - zz
    outer[..., 2, 2], outer[..., 3, 3] = 1.0 - xx - yy + zz, 1.0 + xx + yy + zz
    for i, j, value in ((0, 1, yx), (0, 2, zx), (0, 3, xw), (1, 2, zy), (1, 3, yw), (2, 3, zw)):
        outer[..., i, j] = outer[..., j, i] = value
    largest = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(outer, largest[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.asarray(np.where(q[..., 3:] < 0.0, -q, q))


def nearest_rotation(matrix: npt.ArrayLike) -> Array:
    """Return the rotation matrix nearest to a matrix (3, 3) of any unit: R that maximises tr(Rᵀ M) (Kabsch 1976)."""
    U, _, right = np.linalg.svd(np.asarray(matrix, float))
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ right)]) @ right)


def quat_from_euler(roll: npt.ArrayLike, pitch: npt.ArrayLike, yaw: npt.ArrayLike) -> Array:
    """Return the quaternion of R_z(yaw) R_y(pitch) R_x(roll) [rad], (...) each -> (..., 4)."""
    r, p, y = (0.5 * np.asarray(angle, float) for angle in (roll, pitch, yaw))
    cr, cp, cy, sr, sp, sy = np.cos(r), np.cos(p), np.cos(y), np.sin(r), np.sin(p), np.sin(y)
    return _vector(
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )


def quat_to_euler(q: npt.ArrayLike) -> tuple[Array, Array, Array]:
    """Return roll in [-pi, pi], pitch in [-pi/2, pi/2], yaw in [-pi, pi], all [rad], (..., 4) -> (...) each.

    Note:
        At a pitch of +-90 degrees only roll -+ yaw is defined; its split into roll and yaw is arbitrary.
    """
    R = quat_to_matrix(q)
    roll = np.arctan2(R[..., 2, 1], R[..., 2, 2])
    pitch = np.arctan2(-R[..., 2, 0], np.hypot(R[..., 2, 1], R[..., 2, 2]))
    return roll, pitch, np.arctan2(R[..., 1, 0], R[..., 0, 0])


def quat_from_yaw(yaw: npt.ArrayLike) -> Array:
    """Return the quaternion of a rotation about the vertical, left positive [rad], (...) -> (..., 4)."""
    half = 0.5 * np.asarray(yaw, float)
    return _vector(0.0, 0.0, np.sin(half), np.cos(half))


def quat_yaw(q: npt.ArrayLike) -> Array:
    """Return the heading of the body x axis, left positive [rad], (..., 4) -> (...)."""
    return quat_to_euler(q)[2]


def quat_from_rotvec(rotvec: npt.ArrayLike) -> Array:
    """Return the quaternion of a rotation vector (axis times angle) [rad], (..., 3) -> (..., 4)."""
    x, y, z = _components(rotvec)
    square = x * x + y * y + z * z
    if type(square) is float:
        half = 0.5 * math.sqrt(square)
        ratio = 0.5 * math.sin(half) / half if half else 0.5
        return np.array((ratio * x, ratio * y, ratio * z, math.cos(half)))
    half = 0.5 * np.sqrt(square)
    ratio = 0.5 * np.sinc(half / np.pi)  # sinc(x) = sin(pi x)/(pi x) stays exact through zero
    return _vector(ratio * x, ratio * y, ratio * z, np.cos(half))


def quat_to_rotvec(q: npt.ArrayLike) -> Array:
    """Return the rotation vector of the shorter rotation, length [rad] in [0, pi], (..., 4) -> (..., 3)."""
    q = np.asarray(q, float)
    q = np.where(q[..., 3:] < 0.0, -q, q)
    sine = np.linalg.norm(q[..., :3], axis=-1, keepdims=True)
    half = np.arctan2(sine, q[..., 3:])
    ratio = np.divide(half, sine, out=np.ones_like(half), where=sine > 0.0)
    return np.asarray(2.0 * ratio * q[..., :3])
