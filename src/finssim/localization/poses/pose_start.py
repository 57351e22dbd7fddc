"""Poses to start from: each tag alone, seen without water, in both attitudes that a flat square leaves open."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

__all__ = ["mirrored", "tag_poses"]

Array = npt.NDArray[np.float64]


def tag_poses(rays_p: Array, centre_p: Array, points_b: Array) -> list[tuple[Array, Array]]:
    """Both poses of a body that one tag on it shows, without regard to water.

    The homography between the tag's plane and an image across its middle ray gives one; seen from far, a flat tag looks
    the same with its attitude mirrored at the line of sight, which gives the other.

    Args:
        rays_p: Unit rays to its corners, pool frame, (4, 3).
        centre_p: C_p: camera [m], (3,).
        points_b: Its corners, body frame [m], (4, 3).

    Returns:
        t_pb and R_pb of each; none where the corners show no square.
    """
    R_pv = _looking_along(rays_p.sum(axis=0))
    rays_v = rays_p @ R_pv
    if not (np.isfinite(rays_v).all() and (rays_v[:, 2] > 0.1).all()):
        return []
    t_bt = points_b.mean(axis=0)
    R_bt = _tag_axes(points_b)
    flat = (points_b - t_bt) @ R_bt
    pose = _planar_pose(flat[:, :2], rays_v[:, :2] / rays_v[:, 2:])
    if pose is None:
        return []
    R_vt, t_vt = pose
    R_pb = R_pv @ R_vt @ R_bt.T
    t_pt = centre_p + R_pv @ t_vt
    sight = (t_pt - centre_p) / np.linalg.norm(t_pt - centre_p)
    poses = [R_pb, mirrored(R_pb, sight, R_bt[:, 2])]
    return [(t_pt - R @ t_bt, R) for R in poses]


def mirrored(R_pb: Array, sight_p: Array, normal_b: Array) -> Array:
    """The other attitude in which something flat looks the same from far.

    Args:
        R_pb: The one, (3, 3).
        sight_p: Unit vector along the line of sight, pool frame, (3,).
        normal_b: Unit normal of the flat thing, body frame [-], (3,).
    """
    return (
        (np.eye(3) - 2.0 * np.outer(sight_p, sight_p))
        @ R_pb
        @ (np.eye(3) - 2.0 * np.outer(normal_b, normal_b))
    )


def _looking_along(direction: Array) -> Array:
    """Axes of a camera whose z axis has that direction, (3, 3)."""
    z = direction / np.linalg.norm(direction)
    aside = np.eye(3)[int(np.argmin(np.abs(z)))]
    x = np.cross(aside, z)
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def _tag_axes(points_b: Array) -> Array:
    """R_bt from the corners in their order: x to the right, y up as printed, (3, 3)."""
    x = points_b[1] - points_b[0]
    x = x / np.linalg.norm(x)
    y = points_b[0] - points_b[3]
    z = np.cross(x, y)
    z = z / np.linalg.norm(z)
    return np.stack([x, np.cross(z, x), z], axis=1)


def _planar_pose(points: Array, image: Array) -> tuple[Array, Array] | None:
    """R and t with image ~ R [X, Y, 0] + t, from the homography of four points (X, Y) and their images."""
    size = float(np.abs(points).max())
    X, Y = (points / size).T
    u, v = image.T
    o, i = np.zeros(4), np.ones(4)
    rows = np.concatenate(
        [np.stack([X, Y, i, o, o, o, -u * X, -u * Y], 1), np.stack([o, o, o, X, Y, i, -v * X, -v * Y], 1)]
    )
    try:
        H = np.append(np.linalg.solve(rows, np.concatenate([u, v])), 1.0).reshape(3, 3)
    except np.linalg.LinAlgError:
        return None
    scale = np.sqrt(np.linalg.norm(H[:, 0]) * np.linalg.norm(H[:, 1]))
    if not (np.isfinite(scale) and scale > 0.0):
        return None
    columns = np.stack([H[:, 0], H[:, 1], np.cross(H[:, 0], H[:, 1]) / scale], axis=1) / scale
    U, _, Vt = np.linalg.svd(columns)
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return R, np.asarray(H[:, 2] / scale * size)
