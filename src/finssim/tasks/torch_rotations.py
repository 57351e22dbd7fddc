"""Rotations as torch tensors over a leading `...` batch: unit quaternions xyzw, as everywhere in FinsSim.

On a CPU, `torch.atan2`, `hypot` and general powers round the last rows of a batch differently from the others, so that
a world would depend on the number of worlds. This module avoids them; `arctangent` replaces the first.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor


def multiply(p: Tensor, q: Tensor) -> Tensor:
    """Return the quaternion of the rotation q, then p, (..., 4)."""
    px, py, pz, pw = p.unbind(-1)
    qx, qy, qz, qw = q.unbind(-1)
    return torch.stack(
        (
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
            pw * qw - px * qx - py * qy - pz * qz,
        ),
        dim=-1,
    )


def conjugate(q: Tensor) -> Tensor:
    """Return the quaternion of the inverse rotation, (..., 4)."""
    return torch.cat((-q[..., :3], q[..., 3:]), dim=-1)


def rotate(q: Tensor, v: Tensor) -> Tensor:
    """Transform a vector from body to world frame, (..., 3); q is body to world. The unit is kept."""
    axis, w = q[..., :3], q[..., 3:]
    twice = 2.0 * torch.linalg.cross(axis, v)
    return v + w * twice + torch.linalg.cross(axis, twice)


def rotate_inverse(q: Tensor, v: Tensor) -> Tensor:
    """Transform a vector from world to body frame, (..., 3); q is body to world. The unit is kept."""
    return rotate(conjugate(q), v)


def matrix(q: Tensor) -> Tensor:
    """Return the rotation matrix, (..., 3, 3)."""
    x, y, z, w = q.unbind(-1)
    rows = (
        *(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)),
        *(2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)),
        *(2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)),
    )
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def about_axis(axis: int, angle: Tensor) -> Tensor:
    """Return the rotation about x (0), y (1) or z (2) by an angle [rad], (..., 4)."""
    parts = [torch.zeros_like(angle)] * 3
    parts[axis] = torch.sin(0.5 * angle)
    return torch.stack((*parts, torch.cos(0.5 * angle)), dim=-1)


def angle(q: Tensor) -> Tensor:
    """Return the angle of a rotation about any axis [rad], in [0, π], (...)."""
    return 2.0 * torch.atan(torch.linalg.vector_norm(q[..., :3], dim=-1) / q[..., 3].abs())


def heading(q: Tensor) -> Tensor:
    """Return the yaw of the body x axis about world z [rad], (...)."""
    x, y, z, w = q.unbind(-1)
    return arctangent(2.0 * (x * y + z * w), 1.0 - 2.0 * (y * y + z * z))


def arctangent(y: Tensor, x: Tensor) -> Tensor:
    """Return the angle of the point (x, y) [rad], in [-π, π]; 0 at the origin."""
    r = torch.sqrt(x * x + y * y)
    half = torch.atan(y / (r + x.abs()).clamp(min=torch.finfo(y.dtype).tiny))
    return torch.where(x >= 0.0, 2.0 * half, torch.copysign(torch.full_like(y, math.pi), y) - 2.0 * half)


def wrapped(angle: Tensor) -> Tensor:
    """Wrap an angle [rad] to [-π, π], (...,)."""
    return angle - 2.0 * math.pi * torch.round(angle / (2.0 * math.pi))
