"""Pose from tags as if there were no water: the baseline, alone or with the height and tilt known."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
import numpy.typing as npt

from finssim.geometry.optics import Camera
from finssim.localization.detection.detections import Detection
from finssim.localization.pool import Pool
from finssim.localization.poses.correspondences import Correspondences, correspondences
from finssim.localization.poses.measurement import Constraints, Measurement, refused
from finssim.localization.poses.planar_fit import planar_fit
from finssim.localization.poses.pose_choice import choose, measured, minima_from
from finssim.localization.poses.pose_refinement import RefinedPose, See
from finssim.localization.poses.pose_start import tag_poses

__all__ = ["pinhole", "pinhole_depth", "pinhole_poses"]

Array = npt.NDArray[np.float64]


def pinhole(
    detections: Iterable[Detection],
    pool: Pool,
    tags_b: Mapping[int, Array],
    constraints: Constraints | None,
    pixel_std: float = 0.5,
) -> Measurement:
    """Measure all six degrees of freedom with straight rays (perspective-n-point), as if there were no water.

    Of two attitudes that a flat tag leaves open, the one with the smaller misses is taken; roll and pitch of
    `constraints`, where they are given, count in it. Their height is not used.

    Args:
        detections: Tags of one picture.
        pool: Camera; its water is not used.
        tags_b: Tag id -> corners in the body frame [m], (4, 3).
        constraints: Roll and pitch that decide between two attitudes, or None.
        pixel_std: Standard deviation of a corner, per axis [px].
    """
    method = "pinhole"
    pairs = correspondences(detections, tags_b)
    if not pairs.tags:
        return refused(method, pairs.why_too_few, pairs.rejected)
    minima = pinhole_poses(pairs, pool.camera, pixel_std)
    if not minima:
        return refused(method, "the corners show no pose", pairs.rejected, tags=pairs.tags)
    return measured(method, choose(minima, constraints, pixel_std), pairs, pixel_std)


def pinhole_depth(
    detections: Iterable[Detection],
    pool: Pool,
    tags_b: Mapping[int, Array],
    constraints: Constraints | None,
    pixel_std: float = 0.5,
) -> Measurement:
    """Measure x, y and yaw at a known height and tilt with straight rays, as if there were no water.

    It is `planar_fit` with rays that do not bend; arguments as there.
    """
    return planar_fit(detections, pool, tags_b, constraints, pixel_std, straight=True)


def pinhole_poses(pairs: Correspondences, camera: Camera, pixel_std: float) -> list[RefinedPose]:
    """All distinct minima of the reprojection error without water, the best first."""
    rays, seen = camera.lens.rays(pairs.pixels)
    rays_p = rays @ camera.R_pc.T
    starts = []
    for i in range(len(pairs.tags)):
        four = slice(4 * i, 4 * i + 4)
        if seen[four].all():
            starts += tag_poses(rays_p[four], camera.position, pairs.points_b[four])
    return minima_from(_straight(camera), pairs, starts, 2.5 * pixel_std)


def _straight(camera: Camera) -> See:
    def see(points_p: Array) -> tuple[Array, Array, npt.NDArray[np.bool_]]:
        points_c = (points_p - camera.position) @ camera.R_pc
        pixels, seen = camera.lens.project(points_c)
        return pixels, camera.lens.project_jacobian(points_c) @ camera.R_pc.T, seen

    return see
