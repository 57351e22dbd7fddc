"""Methods of measuring a pose from the tags of one picture, by name."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from finssim.core.optics import Camera, back_project
from finssim.core.rotations import nearest_rotation, skew
from finssim.localization import LocalizationError
from finssim.localization.detection.detections import Detection
from finssim.localization.detection.families import tag_corners_b
from finssim.localization.overhead_camera import Pool
from finssim.localization.poses import (
    Constraints,
    Correspondences,
    PoseMeasurement,
    about_up,
    axes_of_up,
    correspondences,
    refused,
    tilt_matrix,
)
from finssim.localization.poses.planar import WORST, planar_fit
from finssim.localization.poses.refinement import (
    BestMinimum,
    ExtraRows,
    RefinedPose,
    choose,
    measured,
    minima_from,
    mirrored,
    refine_pose,
    tag_poses,
    through_lens,
    through_water,
)
from finssim.vehicles.equipment import Tags

Array = npt.NDArray[np.float64]

# Pose from tags without refraction: the baseline, alone or with known height and tilt.


def pinhole(
    detections: Iterable[Detection],
    pool: Pool,
    tags_b: Mapping[int, Array],
    constraints: Constraints | None,
    pixel_std: float = 0.5,
) -> PoseMeasurement:
    """Measure all six degrees of freedom with straight rays (perspective-n-point), as if there were no water.

    A flat tag allows two attitudes; the one with the smaller residuals is selected. If `constraints` are
    given, their roll and pitch contribute to this choice. Their height is not used.

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
        return refused(method, pairs.too_few_reason, pairs.rejected)
    minima = pinhole_poses(pairs, pool.camera, pixel_std)
    if not minima:
        return refused(method, "the corners show no pose", pairs.rejected, tags=pairs.tags)
    choice = choose(minima, constraints, pixel_std)
    return measured(method, choice.best, choice.covariance(pixel_std), pairs)


def pinhole_depth(
    detections: Iterable[Detection],
    pool: Pool,
    tags_b: Mapping[int, Array],
    constraints: Constraints | None,
    pixel_std: float = 0.5,
) -> PoseMeasurement:
    """Measure x, y [m] and yaw [rad] at known height and tilt with straight rays, as if there were no water.

    It is `planar_fit` without refraction; arguments as in `planar_fit`.
    """
    return planar_fit(detections, pool, tags_b, constraints, pixel_std, straight=True)


def pinhole_poses(pairs: Correspondences, camera: Camera, pixel_std: float) -> list[RefinedPose]:
    """Return all distinct minima of the reprojection error without refraction, the best first."""
    rays, valid = camera.lens.rays(pairs.pixels)
    rays_p = rays @ camera.R_pc.T
    starts = []
    for i in range(len(pairs.tags)):
        four = slice(4 * i, 4 * i + 4)
        if valid[four].all():
            starts += tag_poses(rays_p[four], camera.position, pairs.points_b[four])
    return minima_from(
        through_lens(camera.lens, camera.R_pc, camera.position), pairs, starts, 2.5 * pixel_std
    )


# All six degrees of freedom from tags through the water, without depth or IMU.

SURE = 9.0
"""Difference of chi² from which a second attitude is excluded [-]."""
NEAR = math.radians(30.0)
"""Angle up to which two attitudes are one measurement, whose covariance spans both [rad]."""


def refractive_bundle(
    detections: Iterable[Detection],
    pool: Pool,
    tags_b: Mapping[int, Array],
    constraints: Constraints | None,
    pixel_std: float = 0.5,
) -> PoseMeasurement:
    """Measure all six degrees of freedom by minimizing the reprojection error through the water.

    Starts are the poses from a pinhole camera, moved to their true depth, their mirror images about the line
    of sight, and upright poses; the minima reached from them are compared. A picture that two attitudes
    explain equally well is refused as ambiguous, unless they are close to each other, or the roll and pitch
    of `constraints` decide.

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
        return refused(method, pairs.too_few_reason, pairs.rejected)
    minima = minima_from(through_water(pool), pairs, _starts(pairs, pool, pixel_std), 2.5 * pixel_std)
    if not minima:
        return refused(method, "the corners show no pose in the water", pairs.rejected, tags=pairs.tags)
    choice = choose(minima, constraints, pixel_std)
    reason = _rejection(choice, pixel_std)
    if reason:
        return refused(method, reason, pairs.rejected, tags=pairs.tags)
    return measured(method, choice.best, choice.covariance(pixel_std), pairs)


def _rejection(choice: BestMinimum, pixel_std: float) -> str:
    """Return the reason why the best pose is not reliable; empty if it is."""
    best, second = choice.best, choice.second
    if not best.converged:
        return f"did not converge in {best.iterations} steps"
    limit = max(WORST, 8.0 * pixel_std)
    far, count = int((best.residual_norms > limit).sum()), len(best.residual_norms)
    if 4 * far > count:
        return f"residual too large: {far} of {count} corners miss by more than {limit:.1f} px"
    if second is not None and choice.gap < SURE and choice.turned > NEAR:
        first, other = (math.degrees(math.acos(min(1.0, abs(a.rotation[2, 2])))) for a in (best, second))
        return (
            f"ambiguous: attitudes tilted by {first:.0f} and {other:.0f} degrees explain the corners equally well: "
            "give roll and pitch, or a depth for the refractive method"
        )
    return ""


def _starts(pairs: Correspondences, pool: Pool, pixel_std: float) -> Iterator[tuple[Array, Array]]:
    """Return an iterator over initial poses t_pb, R_pb."""
    normal_b = np.cross(pairs.points_b[1] - pairs.points_b[0], pairs.points_b[3] - pairs.points_b[0])
    normal_b = normal_b / np.linalg.norm(normal_b)
    up = pool.interface.normal if pool.is_surface else np.array([0.0, 0.0, 1.0])
    middle = pairs.points_b.mean(axis=0)
    for apparent_pose in pinhole_poses(pairs, pool.camera, pixel_std)[:2]:
        lowered = _deepened(apparent_pose, pairs, pool)
        if lowered is None:
            continue
        position, rotation = lowered
        centre = position + rotation @ middle
        sight = (centre - pool.camera.position) / np.linalg.norm(centre - pool.camera.position)
        for R in (rotation, mirrored(rotation, sight, normal_b), _upright(rotation, up)):
            yield centre - R @ middle, R


def _upright(rotation: Array, up: Array) -> Array:
    """Return the attitude of the same heading with zero roll and pitch."""
    R_pg = axes_of_up(up)
    forward = R_pg.T @ rotation[:, 0]
    return np.asarray(R_pg @ about_up(math.atan2(forward[1], forward[0])))


def _deepened(apparent_pose: RefinedPose, pairs: Correspondences, pool: Pool) -> tuple[Array, Array] | None:
    """Return the true pose of a body from its apparent one: corners are placed on the refracted rays at their
    apparent depth times the ratio of the refractive indices, and a rigid motion is fitted."""
    interface = pool.interface
    apparent = pairs.points_b @ apparent_pose.rotation.T + apparent_pose.position
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
    R = nearest_rotation((points - middle_p).T @ (pairs.points_b - middle_b))
    return np.asarray(middle_p - R @ middle_b), R


# All six degrees of freedom from corners, depth and tilt jointly, each weighted by its uncertainty.

METHOD = "refractive-weighted"
HUBER = 2.5
"""Residual in standard deviations beyond which Huber's rho grows linearly."""
SUREST = 1e-6
"""Smallest standard deviation of prior knowledge, used if it is given as exact [m, rad, px]."""
MAX_STEPS = 30


def weighted_fit(
    detections: Iterable[Detection],
    pool: Pool,
    tags_b: Mapping[int, Array],
    constraints: Constraints | None,
    pixel_std: float = 0.5,
) -> PoseMeasurement:
    """Measure a pose by minimizing the reprojection error through the water and the deviation from measured
    height and tilt.

    Minimises sum_i rho(|u_i - s - pi(P_i)| / sigma_px) + ((up . (t + R port) - z) / sigma_z)²
    + (|R' up x m| / sigma_tilt)² + (|s| / sigma_shared)², with m the direction of up in the body from the IMU
    and s a shift of the complete picture. Accurate corners correct the depth; if waves blur them,
    the depth determines the scale.

    Args:
        detections: Tags of one picture.
        pool: Camera and water.
        tags_b: Tag id -> corners in the body frame [m], (4, 3).
        constraints: Height and tilt with their standard deviations.
        pixel_std: Standard deviation of a corner, per axis [px].

    Returns:
        The measurement, or a refusal with its reason.
    """
    all_detections = list(detections)
    start = planar_fit(all_detections, pool, tags_b, constraints, pixel_std)
    if constraints is None or not start.ok:
        return refused(METHOD, start.reason, start.rejected, tags=start.tags)
    pairs = correspondences([d for d in all_detections if d.tag in start.tags], tags_b)
    pose = refine_pose(
        through_water(pool),
        pairs.points_b,
        pairs.pixels,
        start.position,
        start.rotation,
        HUBER * pixel_std,
        extra_rows=_constraint_rows(constraints, pixel_std),
        max_steps=MAX_STEPS,
    )
    if pose is None or not pose.converged:
        steps = 0 if pose is None else pose.iterations
        return refused(METHOD, f"did not converge in {steps} steps", start.rejected, tags=start.tags)
    pairs = replace(pairs, rejected=start.rejected)
    return measured(METHOD, pose, pose.covariance(pixel_std), pairs, start.medium)


def _constraint_rows(constraints: Constraints, pixel_std: float) -> ExtraRows:
    """Return the function of residuals of height, tilt and shift, (6,), and their derivatives, scaled to pixels."""
    up, port_b = np.asarray(constraints.up, float), np.asarray(constraints.port, float)
    level = tilt_matrix(constraints.roll, constraints.pitch)
    height, m = constraints.z_b + float((level @ port_b)[2]), level[2]  # of the port, as measured
    std = [constraints.z_std, *3 * [constraints.tilt_std], *2 * [constraints.shared_pixel_std]]
    scale = pixel_std / np.maximum(std, SUREST)

    def known(position: Array, rotation: Array, shift: Array) -> tuple[Array, Array]:
        port = rotation @ port_b
        r, K = np.zeros(6), np.zeros((6, 8))
        r[0] = up @ (position + port) - height
        K[0, :3], K[0, 3:6] = up, np.cross(port, up)
        r[1:4] = np.cross(rotation.T @ up, m)
        K[1:4, 3:6] = -skew(m) @ rotation.T @ skew(up)
        r[4:], K[4:, 6:] = shift, np.eye(2)
        return r * scale, K * scale[:, None]

    return known


Method: TypeAlias = Callable[
    [Iterable[Detection], Pool, Mapping[int, Array], Constraints | None, float], PoseMeasurement
]
"""Function of the tags of one picture, pool, tag id -> corners in the body frame [m] (4, 3), prior knowledge
of height and tilt, and the standard deviation of a corner per axis [px] that returns the measurement; it
refuses a bad picture with a reason and raises no exception."""

METHODS: dict[str, Method] = {
    "refractive": planar_fit,
    "refractive-weighted": weighted_fit,
    "pinhole": pinhole,
    "pinhole-depth": pinhole_depth,
    "refractive-6dof": refractive_bundle,
}
NEEDS_DEPTH = frozenset({"refractive", "refractive-weighted", "pinhole-depth"})
"""Methods that refuse to work without constraints."""


def check_method(method: str) -> None:
    """Refuse an unknown method.

    Raises:
        LocalizationError: The method is not in `METHODS`; the message lists them.
    """
    if method not in METHODS:
        raise LocalizationError(f"unknown method '{method}'; available: {', '.join(METHODS)}")


class TagLocator:
    """Pose measurement of one vehicle with one camera and one method; it keeps no state between pictures."""

    def __init__(
        self, pool: Pool, tags: Tags | None, *, method: str = "refractive", pixel_std: float = 0.5
    ) -> None:
        """
        Args:
            pool: Camera and water.
            tags: Tags of the vehicle; None is refused.
            method: A name in `METHODS`.
            pixel_std: Standard deviation of a corner, per axis [px].

        Raises:
            LocalizationError: The method is unknown, the vehicle has no tags, or the standard deviation is
                not positive.
        """
        check_method(method)
        if tags is None:
            raise LocalizationError(
                "the vehicle file has no tags: add a section tags: with family, edge and mounts"
            )
        if not (math.isfinite(pixel_std) and pixel_std > 0.0):
            raise LocalizationError(
                f"pixel_std is {pixel_std}, expected the error of a corner in pixels, such as 0.3"
            )
        self.pool, self.method, self.needs_height = pool, method, method in NEEDS_DEPTH
        self.tags_b, self.family, self._pixel_std = tag_corners_b(tags), tags.family, pixel_std

    def __call__(self, detections: Iterable[Detection], constraints: Constraints | None) -> PoseMeasurement:
        """Return the pose in one picture, or a refusal with its reason."""
        return METHODS[self.method](detections, self.pool, self.tags_b, constraints, self._pixel_std)
