"""Where a vehicle is, roughly, from one tag, its tilt and the file's mounts: enough for least squares to begin."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.vision.mounts.mount_model import Moment, MountState, Pose, Rig
from finssim.geometry.optics import back_project

__all__ = ["start_pose", "start_state"]

Array = NDArray[np.float64]

HALVINGS = 40
DEEPEST = 20.0
"""Distance below the surface up to which a tag is looked for [m]."""


def start_state(
    rig: Rig, mounts: Mapping[int, Pose], moments: Sequence[Moment]
) -> tuple[MountState, list[int]]:
    """First guess, and which moments it holds: those with a tag whose mount is known and whose corners meet the water.

    A tag without a mount gets that of the first moment that shows it beside one with a mount, as if all were level.
    """
    mounts = dict(mounts)
    _place_unknown(rig, mounts, moments)
    reference = mounts[rig.reference]
    poses, kept = [], []
    for i, moment in enumerate(moments):
        pose = start_pose(rig, mounts, moment)
        if pose is not None:
            poses.append(pose)
            kept.append(i)
    others = {tag: reference.inverse.then(mounts[tag]) for tag in sorted(mounts) if tag != rig.reference}
    return MountState(reference=reference, others=others, poses=poses), kept


def start_pose(rig: Rig, mounts: Mapping[int, Pose], moment: Moment) -> Pose | None:
    """Body in the pool: position and heading of a tag seen as if it were parallel to the surface, tilt by the IMU."""
    for tag in sorted(moment.corners, key=lambda tag: tag != rig.reference):
        level = level_tag(rig, moment.corners[tag]) if tag in mounts else None
        if level is None:
            continue
        R = level.R @ mounts[tag].R.T  # of a body whose tag is level
        up_p, up_b = rig.pool.interface.normal, moment.up
        R = _least_turn(R @ (R.T @ up_p if up_b is None else up_b), up_p) @ R
        return Pose(R, level.t - R @ mounts[tag].t)
    return None


def level_tag(rig: Rig, pixels: Array) -> Pose | None:
    """Tag in the pool as if it lay parallel to the surface, at the depth at which its edges have their length."""
    rays = back_project(rig.pool.camera, rig.pool.interface, pixels)
    if not np.isfinite(rays.direction).all():
        return None
    n, b = rig.pool.interface.normal, rig.pool.interface.offset
    edge = float(np.linalg.norm(rig.corners_t[0] - rig.corners_t[1]))

    def at(depth: float) -> Array:
        down = (-depth - b - rays.origin @ n) / (rays.direction @ n)
        return np.asarray(rays.origin + down[:, None] * rays.direction)

    def size(depth: float) -> float:
        points = at(depth)
        return float(np.mean(np.linalg.norm(points - np.roll(points, -1, axis=0), axis=1)))

    low, high = 0.0, DEEPEST
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if size(middle) < edge else (low, middle)
    points = at(0.5 * (low + high))
    right = points[1] + points[2] - points[0] - points[3]
    x = right - (right @ n) * n
    x /= np.linalg.norm(x)
    return Pose(np.column_stack([x, np.cross(n, x), n]), points.mean(axis=0))


def _place_unknown(rig: Rig, mounts: dict[int, Pose], moments: Sequence[Moment]) -> None:
    seen = {tag for moment in moments for tag in moment.corners}
    for tag in sorted(seen - mounts.keys()):
        for moment in moments:
            beside = [other for other in moment.corners if other in mounts]
            if tag not in moment.corners or not beside:
                continue
            known, new = level_tag(rig, moment.corners[beside[0]]), level_tag(rig, moment.corners[tag])
            if known is not None and new is not None:
                mounts[tag] = mounts[beside[0]].then(known.inverse.then(new))
                break


def _least_turn(a: Array, b: Array) -> Array:
    """Smallest rotation that takes unit vector a to b, (3, 3)."""
    v, c = np.cross(a, b), float(a @ b)
    if c < -0.999:  # opposite: about any axis across
        across = np.linalg.svd(a[None])[2][1]
        return np.asarray(2.0 * np.outer(across, across) - np.eye(3))
    S = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    return np.asarray(np.eye(3) + S + S @ S / (1.0 + c))
