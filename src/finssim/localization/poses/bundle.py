"""All six degrees of freedom from tags through the water: neither depth nor inertia is needed."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping

import numpy as np
import numpy.typing as npt

from finssim.geometry.optics import back_project, project, projection_jacobians
from finssim.localization.detection.detections import Detection
from finssim.localization.pool import Pool
from finssim.localization.poses.correspondences import Correspondences, correspondences
from finssim.localization.poses.measurement import Constraints, Measurement, axes_of_up, refused
from finssim.localization.poses.pinhole import pinhole_poses
from finssim.localization.poses.planar_fit import WORST
from finssim.localization.poses.pose_choice import Choice, choose, measured, minima_from
from finssim.localization.poses.pose_refinement import RefinedPose, See
from finssim.localization.poses.pose_start import mirrored

__all__ = ["refractive_bundle", "through_water"]

Array = npt.NDArray[np.float64]

SURE = 9.0
"""A second attitude counts as excluded when its chi² is larger by this."""
NEAR = math.radians(30.0)
"""Two attitudes within this angle are one measurement, whose covariance spans both."""


def refractive_bundle(
    detections: Iterable[Detection],
    pool: Pool,
    tags_b: Mapping[int, Array],
    constraints: Constraints | None,
    pixel_std: float = 0.5,
) -> Measurement:
    """Measure all six degrees of freedom by the reprojection error through the water.

    Starts are the poses that a pinhole camera would see, moved to their true depth, the same mirrored at the line of
    sight, and upright; the minima that they lead to are compared. A picture that two attitudes explain equally well is
    refused as ambiguous, unless they are near to each other, or the roll and pitch of `constraints` decide.

    Args:
        detections: Tags of one picture.
        pool: Camera and water.
        tags_b: Tag id -> corners in the body frame [m], (4, 3).
        constraints: Roll and pitch that decide between two attitudes, or None; their height is not used.
        pixel_std: Standard deviation of a corner, per axis [px].
    """
    method = "refractive-6dof"
    pairs = correspondences(detections, tags_b)
    if not pairs.tags:
        return refused(method, pairs.why_too_few, pairs.rejected)
    minima = minima_from(through_water(pool), pairs, _starts(pairs, pool, pixel_std), 2.5 * pixel_std)
    if not minima:
        return refused(method, "the corners show no pose in the water", pairs.rejected, tags=pairs.tags)
    choice = choose(minima, constraints, pixel_std)
    reason = _doubt(choice, pixel_std)
    if reason:
        return refused(method, reason, pairs.rejected, tags=pairs.tags)
    return measured(method, choice, pairs, pixel_std)


def _doubt(choice: Choice, pixel_std: float) -> str:
    """Why the best pose is not to be believed; empty where it is."""
    best, second = choice.best, choice.second
    if not best.converged:
        return f"did not converge in {best.iterations} steps"
    limit = max(WORST, 8.0 * pixel_std)
    far, count = int((best.missed > limit).sum()), len(best.missed)
    if 4 * far > count:
        return f"residual too large: {far} of {count} corners miss by more than {limit:.1f} px"
    if second is not None and choice.gap < SURE and choice.turned > NEAR:
        one, other = (math.degrees(math.acos(min(1.0, abs(a.rotation[2, 2])))) for a in (best, second))
        return (
            f"ambiguous: attitudes tilted by {one:.0f} and {other:.0f} degrees explain the corners equally well: "
            "give roll and pitch, or a depth for the refractive method"
        )
    return ""


def _starts(pairs: Correspondences, pool: Pool, pixel_std: float) -> Iterator[tuple[Array, Array]]:
    """Poses t_pb, R_pb to refine."""
    normal_b = np.cross(pairs.points_b[1] - pairs.points_b[0], pairs.points_b[3] - pairs.points_b[0])
    normal_b = normal_b / np.linalg.norm(normal_b)
    up = pool.interface.normal if pool.is_surface else np.array([0.0, 0.0, 1.0])
    middle = pairs.points_b.mean(axis=0)
    for seen in pinhole_poses(pairs, pool.camera, pixel_std)[:2]:
        lowered = _deepened(seen, pairs, pool)
        if lowered is None:
            continue
        position, rotation = lowered
        centre = position + rotation @ middle
        sight = (centre - pool.camera.position) / np.linalg.norm(centre - pool.camera.position)
        for R in (rotation, mirrored(rotation, sight, normal_b), _upright(rotation, up)):
            yield centre - R @ middle, R


def _upright(rotation: Array, up: Array) -> Array:
    """The attitude without roll and pitch, of the same heading."""
    R_pg = axes_of_up(up)
    forward = R_pg.T @ rotation[:, 0]
    psi = math.atan2(forward[1], forward[0])
    c, s = math.cos(psi), math.sin(psi)
    return np.asarray(R_pg @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]))


def _deepened(seen: RefinedPose, pairs: Correspondences, pool: Pool) -> tuple[Array, Array] | None:
    """Where a body is that appears at a pose: its corners, at their apparent depth times the ratio of the indices on
    the refracted rays, and the rigid motion that fits these."""
    interface = pool.interface
    apparent = pairs.points_b @ seen.rotation.T + seen.position
    rays = back_project(pool.camera, interface, pairs.pixels)
    depth = -interface.distance(apparent)
    ratio = interface.index_far / interface.index_near
    with np.errstate(all="ignore"):
        along = np.maximum(depth - interface.thickness, 0.0) * ratio / -(rays.direction @ interface.normal)
        under = rays.origin + along[:, None] * rays.direction
    points = np.where((depth > 0.0)[:, None], under, apparent)
    if not np.isfinite(points).all():
        return None
    middle_p, middle_b = points.mean(axis=0), pairs.points_b.mean(axis=0)
    U, _, Vt = np.linalg.svd((points - middle_p).T @ (pairs.points_b - middle_b))
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return np.asarray(middle_p - R @ middle_b), np.asarray(R)


def through_water(pool: Pool) -> See:
    """What tells where points appear: bent at the interface, or straight where they are on the camera's side of it."""
    camera, interface = pool.camera, pool.interface

    def see(points_p: Array) -> tuple[Array, Array, npt.NDArray[np.bool_]]:
        in_air = interface.distance(points_p) > 0.0
        pixels = project(camera, interface, points_p).pixels
        by_point = projection_jacobians(camera, interface, points_p).point
        if in_air.any():
            points_c = (points_p[in_air] - camera.position) @ camera.R_pc
            pixels[in_air] = camera.lens.project(points_c)[0]
            by_point[in_air] = camera.lens.project_jacobian(points_c) @ camera.R_pc.T
        return pixels, by_point, np.asarray(np.isfinite(pixels).all(axis=1))

    return see
