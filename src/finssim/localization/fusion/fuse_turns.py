"""Rotations of one state at a time, hundreds of times a second.

The same functions as in `finssim.geometry.rotations`, as products with constant matrices: several times quicker for a
single rotation, where the calls cost more than the arithmetic.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

__all__ = ["matrix_of", "product", "skew", "turn_of"]

Array = npt.NDArray[np.float64]

_SKEW = np.array(
    [[0, 0, 0, 0, 0, -1, 0, 1, 0], [0, 0, 1, 0, 0, 0, -1, 0, 0], [0, -1, 0, 1, 0, 0, 0, 0, 0]], dtype=float
)
"""Row k: the matrix [e_k]x, row by row."""
_LEFT = np.array(
    [
        [0, 0, 0, 1, 0, 0, -1, 0, 0, 1, 0, 0, -1, 0, 0, 0],
        [0, 0, 1, 0, 0, 0, 0, 1, -1, 0, 0, 0, 0, -1, 0, 0],
        [0, -1, 0, 0, 1, 0, 0, 0, 0, 0, 0, 1, 0, 0, -1, 0],
        [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1],
    ],
    dtype=float,
)
"""Row k: the matrix of multiplying from the left by the k-th unit quaternion (xyzw), row by row."""
_I = np.eye(3)


def skew(a: Array) -> Array:
    """Matrix S(a) with S(a) b = a x b, (..., 3) -> (..., 3, 3)."""
    return np.asarray((a @ _SKEW).reshape(*a.shape, 3))


def matrix_of(q: Array) -> Array:
    """Rotation matrix of a unit quaternion xyzw, (..., 4) -> (..., 3, 3)."""
    S = skew(q[..., :3])
    return np.asarray(_I + 2.0 * (q[..., 3, None, None] * S + S @ S))


def product(a: Array, b: Array) -> Array:
    """Composition of quaternions xyzw, (..., 4)."""
    return np.asarray(((a @ _LEFT).reshape(*a.shape, 4) @ b[..., None])[..., 0])


def turn_of(v: Array) -> Array:
    """Quaternion xyzw of a rotation vector [rad], (..., 3) -> (..., 4)."""
    half = 0.5 * np.sqrt(np.sum(v * v, axis=-1, keepdims=True))
    # sin(x)/x by its series near zero: the next term is x⁴/120.
    small = half < 1e-3
    ratio = np.where(small, 1.0 - half * half / 6.0, np.sin(half) / np.where(small, 1.0, half))
    return np.concatenate([0.5 * ratio * v, np.cos(half)], axis=-1)
