"""Where a board stands before a camera: a closed form from viewing rays, then least squares on the pixels."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from finssim.geometry.optics import Lens
from finssim.geometry.rotations import quat_from_rotvec, quat_to_matrix, skew

__all__ = ["BoardPose", "board_pose", "pose_from_rays", "pose_jacobian", "pose_residuals", "turned"]

Array = NDArray[np.float64]

STEPS = 40


class BoardPose(NamedTuple):
    """Pose of a board in the optical frame (x right, y down, z along the view)."""

    R_cb: Array
    """Board axes to optical axes, (3, 3)."""
    t_cb: Array
    """Board's origin [m], (3,)."""

    def points_c(self, points_b: Array) -> Array:
        """Board points in the optical frame [m], (n, 3)."""
        return np.asarray(points_b @ self.R_cb.T + self.t_cb)


def pose_from_rays(rays_c: Array, points_b: Array) -> BoardPose | None:
    """Pose of a plane's points from the rays they are seen on, by the direct linear transformation.

    ray × (H (x, y, 1)) = 0,  H = [r_1 r_2 t] up to scale               (Hartley and Zisserman 2004, §4.1)

    Args:
        rays_c: Optical frame, any length, (n, 3), n >= 4; more than 90 degrees off the axis is no trouble.
        points_b: On z = 0 [m], (n, 3).

    Returns:
        The pose, or None if the points lie on one line.
    """
    size = float(np.abs(points_b[:, :2] - points_b[:, :2].mean(axis=0)).max())
    centre = points_b[:, :2].mean(axis=0)
    flat = np.column_stack([(points_b[:, :2] - centre) / size, np.ones(len(points_b))])
    rows = np.einsum("nij,nk->nijk", skew(rays_c), flat).reshape(-1, 9)
    _, values, vectors = np.linalg.svd(rows, full_matrices=False)
    if values[-2] < 1e-9 * values[0]:
        return None
    H = vectors[-1].reshape(3, 3)
    H *= np.sign(np.sum(rays_c * (flat @ H.T)))
    scale = 0.5 * (np.linalg.norm(H[:, 0]) + np.linalg.norm(H[:, 1]))
    r1, r2, t = (H / scale).T
    left, _, right = np.linalg.svd(np.column_stack([r1, r2, np.cross(r1, r2)]))
    R = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    return BoardPose(R, t * size - R[:, :2] @ centre)


def pose_residuals(lens: Lens, pose: BoardPose, points_b: Array, pixels: Array) -> tuple[Array, Array]:
    """Measured less predicted pixels (n, 2), NaN where the lens cannot, and the points in the optical frame (n, 3)."""
    points_c = pose.points_c(points_b)
    predicted, ok = lens.project(points_c)
    return np.where(ok[:, None], pixels - predicted, np.nan), points_c


def pose_jacobian(lens: Lens, pose: BoardPose, points_c: Array) -> Array:
    """d pixel / d (turn, shift) with R <- exp([turn]x) R and t <- t + shift, optical axes, (n, 2, 6)."""
    J = lens.project_jacobian(points_c)
    return np.concatenate([-J @ skew(points_c - pose.t_cb), J], axis=-1)


def turned(pose: BoardPose, step: Array) -> BoardPose:
    """The pose after a step of `pose_jacobian`'s six coordinates."""
    return BoardPose(quat_to_matrix(quat_from_rotvec(step[:3])) @ pose.R_cb, pose.t_cb + step[3:])


def board_pose(
    lens: Lens, points_b: Array, pixels: Array, start: BoardPose | None = None
) -> BoardPose | None:
    """The pose with least squared pixel residuals, by Levenberg-Marquardt.

    Args:
        lens: The lens.
        points_b: On z = 0 [m], (n, 3).
        pixels: Where they are seen, (n, 2).
        start: Where to begin; from the rays if None.

    Returns:
        None if neither the rays nor the start lead to a pose before the camera.
    """
    if start is None:
        rays, ok = lens.rays(pixels)
        if ok.sum() < 4:
            return None
        start = pose_from_rays(rays[ok], points_b[ok])
        if start is None:
            return None
    pose, damping = start, 1e-4
    residual, points_c = pose_residuals(lens, pose, points_b, pixels)
    cost = float(np.sum(residual**2))
    if not np.isfinite(cost):
        return None
    for _ in range(STEPS):
        J = pose_jacobian(lens, pose, points_c).reshape(-1, 6)
        normal, gradient = J.T @ J, J.T @ residual.ravel()
        step = np.linalg.solve(normal + damping * np.diag(np.diagonal(normal)), gradient)
        candidate = turned(pose, step)
        residual_new, points_new = pose_residuals(lens, candidate, points_b, pixels)
        cost_new = float(np.sum(residual_new**2))
        if cost_new < cost:
            done = cost - cost_new < 1e-10 * cost
            pose, residual, points_c, cost = candidate, residual_new, points_new, cost_new
            damping = max(0.2 * damping, 1e-10)
            if done:
                break
        else:
            damping = max(10.0 * damping, 1e-8)
            if damping > 1e8:
                break
    return pose
