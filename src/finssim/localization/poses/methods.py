"""Ways to measure a pose from the tags of one picture, by name."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from finssim.geometry.optics import Camera, back_project, project, projection_jacobians
from finssim.geometry.rotations import matrix_to_quat, quat_from_rotvec, quat_to_matrix, quat_to_rotvec, skew
from finssim.localization.detection.detections import Detection
from finssim.localization.pool import Pool
from finssim.localization.poses.correspondences import Correspondences, correspondences
from finssim.localization.poses.measurement import Constraints, Measurement, axes_of_up, refused, tilt_matrix
from finssim.localization.poses.planar_fit import WORST, planar_fit
from finssim.localization.poses.pose_refinement import RefinedPose, See, refine_pose
from finssim.localization.poses.pose_start import mirrored, tag_poses

__all__ = [
    "METHODS",
    "NEEDS_DEPTH",
    "Constraints",
    "Measurement",
    "Method",
    "pinhole",
    "pinhole_depth",
    "refractive_bundle",
    "weighted_fit",
]

# Which of several poses that explain a picture is the vehicle's.


def _distinct(found: Iterable[RefinedPose | None]) -> list[RefinedPose]:
    """The minima among what was found, each once, the best first."""
    minima: list[RefinedPose] = []
    for pose in sorted((pose for pose in found if pose is not None), key=lambda pose: pose.cost):
        if all(_apart(pose, other) for other in minima):
            minima.append(pose)
    return minima


def minima_from(
    see: See, pairs: Correspondences, starts: Iterable[tuple[Array, Array]], huber: float
) -> list[RefinedPose]:
    """The distinct minima that starts lead to, the best first: a few steps each, to the end only where they differ.

    Args:
        see: Where points appear.
        pairs: The corners.
        starts: t_pb and R_pb of each.
        huber: Distance [px] from which on Huber's rho grows linearly.
    """
    points, pixels = pairs.points_b, pairs.pixels
    begun = _distinct(refine_pose(see, points, pixels, t, R, huber, most_steps=5) for t, R in starts)
    return _distinct(refine_pose(see, points, pixels, a.position, a.rotation, huber) for a in begun[:4])


@dataclass(frozen=True, eq=False)
class Choice:
    """The best of several minima."""

    best: RefinedPose
    second: RefinedPose | None
    gap: float
    """By how much chi² the second is worse; infinite where there is none."""

    @property
    def turned(self) -> float:
        """Angle between the two attitudes [rad]."""
        return 0.0 if self.second is None else _angle(self.best.rotation, self.second.rotation)

    def covariance(self, pixel_std: float) -> Array:
        """Of position and a turn about pool axes, (6, 6): that of the best, and the chance that it is the second.

        P = w1 P1 + w2 (P2 + d d'), w2/w1 = exp(-gap/2), with d from the best to the second.
        """
        P = self.best.covariance(pixel_std)
        if self.second is None or self.gap > 50.0:
            return P
        share = 1.0 / (1.0 + math.exp(0.5 * self.gap))
        turn = quat_to_rotvec(matrix_to_quat(self.second.rotation @ self.best.rotation.T))
        d = np.concatenate([self.second.position - self.best.position, turn])
        other = self.second.covariance(pixel_std) + np.outer(d, d)
        return np.asarray((1.0 - share) * P + share * other)


def choose(minima: list[RefinedPose], constraints: Constraints | None, pixel_std: float) -> Choice:
    """The best of the minima and the next one.

    Args:
        minima: Not empty.
        constraints: A known tilt counts with its standard deviation, no less than 3 degrees: water bends what the
            pinhole sees.
        pixel_std: Standard deviation of a corner, per axis [px].
    """
    scored = []
    for pose in minima:
        chi2 = pose.cost / pixel_std**2
        if constraints is not None:
            chi2 += float(_lean(pose, constraints) ** 2) / max(constraints.tilt_std, np.radians(3.0)) ** 2
        scored.append(chi2)
    order = np.argsort(scored, kind="stable")
    if len(minima) == 1:
        return Choice(minima[0], None, math.inf)
    first, second = int(order[0]), int(order[1])
    return Choice(minima[first], minima[second], float(scored[second] - scored[first]))


def measured(method: str, choice: Choice, pairs: Correspondences, pixel_std: float) -> Measurement:
    """The measurement that the best pose is."""
    pose, whole = choice.best, choice.covariance(pixel_std)
    rows = np.zeros((3, 6))
    rows[0, 0] = rows[1, 1] = 1.0
    rows[2, 3:] = pose.yaw_by_turn
    return Measurement(
        method,
        True,
        "",
        pose.position,
        pose.rotation,
        rows @ whole @ rows.T,
        pose.rms,
        pairs.tags,
        len(pairs.pixels),
        pairs.rejected,
        pose.iterations,
        "",
        whole,
    )


def _lean(pose: RefinedPose, constraints: Constraints) -> float:
    """Angle between up as the pose has it in the body, and as roll and pitch have it [rad]."""
    R_pg = axes_of_up(constraints.up)
    up_b = pose.rotation.T @ R_pg[:, 2]
    known = tilt_matrix(constraints.roll, constraints.pitch)[2]
    return float(np.arctan2(np.linalg.norm(np.cross(up_b, known)), up_b @ known))


def _apart(a: RefinedPose, b: RefinedPose) -> bool:
    far = float(np.linalg.norm(a.position - b.position)) > 0.005
    return far or _angle(a.rotation, b.rotation) > 0.01


def _angle(a: Array, b: Array) -> float:
    """Angle between two attitudes [rad]."""
    return float(np.arccos(np.clip(0.5 * (np.trace(a.T @ b) - 1.0), -1.0, 1.0)))


# Pose from tags as if there were no water: the baseline, alone or with the height and tilt known.


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


# All six degrees of freedom from tags through the water: neither depth nor inertia is needed.

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


# All six degrees of freedom from corners, depth and tilt together, each trusted as far as it is sure.

METHOD = "refractive-weighted"
HUBER = 2.5
"""Miss in standard deviations from which on Huber's rho grows linearly."""
SUREST = 1e-6
"""What is given as exact is held as tightly as this [m, rad, px]."""
MOST_STEPS = 30
STILL = 1e-8
"""A step that changes chi² by less is the last."""


def weighted_fit(
    detections: Iterable[Detection],
    pool: Pool,
    tags_b: Mapping[int, Array],
    constraints: Constraints | None,
    pixel_std: float = 0.5,
) -> Measurement:
    """Measure a pose by the reprojection error through the water, and by how far it is from measured height and tilt.

    Minimises sum_i rho(|u_i - s - pi(P_i)| / sigma_px) + ((up . (t + R port) - z) / sigma_z)²
    + (|R' up x m| / sigma_tilt)² + (|s| / sigma_shared)², with m the direction of up in the body by the inertial unit
    and s a shift that the whole picture shares. Where corners are sure they correct the depth; where waves blur them
    the depth holds the scale.

    Args:
        detections: Tags of one picture.
        pool: Camera and water.
        tags_b: Tag id -> corners in the body frame [m], (4, 3).
        constraints: Height and tilt with their standard deviations.
        pixel_std: Standard deviation of a corner, per axis [px].

    Returns:
        The measurement, or why there is none.
    """
    found = list(detections)
    start = planar_fit(found, pool, tags_b, constraints, pixel_std)
    if constraints is None or not start.ok:
        return refused(METHOD, start.reason, start.rejected, tags=start.tags)
    pairs = correspondences([d for d in found if d.tag in start.tags], tags_b)
    see = through_water(pool)
    now = _evaluate(see, pairs.points_b, pairs.pixels, constraints, pixel_std, _State.at(start))
    damping, converged, steps = 1e-6, False, 0
    while now is not None and steps < MOST_STEPS and not converged and damping < 1e9:
        steps += 1
        step = np.linalg.solve(now.curvature + damping * np.diag(np.diagonal(now.H)), -now.g)
        converged = bool(-(step @ now.g) < STILL)
        then = _evaluate(see, pairs.points_b, pairs.pixels, constraints, pixel_std, now.state.moved(step))
        if then is not None and (converged or then.cost <= now.cost):
            now, damping = then, max(0.1 * damping, 1e-12)
        else:
            damping *= 10.0
    if now is None or not converged:
        return refused(METHOD, f"did not converge in {steps} steps", start.rejected, tags=start.tags)
    return _measured(now, start, steps)


@dataclass(frozen=True, eq=False)
class _State:
    position: Array
    rotation: Array
    shift: Array
    """Of the whole picture [px], (2,)."""

    @classmethod
    def at(cls, start: Measurement) -> _State:
        return cls(start.position, start.rotation, np.zeros(2))

    def moved(self, step: npt.NDArray[np.floating[Any]]) -> _State:
        turn = quat_to_matrix(quat_from_rotvec(step[3:6]))
        return _State(self.position + step[:3], turn @ self.rotation, self.shift + step[6:])


@dataclass(frozen=True, eq=False)
class _Point:
    state: _State
    cost: float
    H: Array
    """Weighted J'J by position, turn about pool axes and shift, (8, 8)."""
    curvature: Array
    """H without what lies along the miss of far corners, where Huber's rho does not curve."""
    g: Array
    missed: Array
    """[px]"""


def _evaluate(
    see: See, points_b: Array, pixels: Array, known: Constraints, pixel_std: float, state: _State
) -> _Point | None:
    arms = points_b @ state.rotation.T
    found, by_point, seen = see(arms + state.position)
    if not seen.all():
        return None
    miss = (found + state.shift - pixels) / pixel_std
    J = np.empty((len(pixels), 2, 8))
    J[:, :, :3], J[:, :, 3:6], J[:, :, 6:] = by_point, -by_point @ skew(arms), np.eye(2)
    J /= pixel_std
    size = np.sqrt(np.sum(miss * miss, axis=1))
    far = size > HUBER
    weight = np.where(far, HUBER / np.maximum(size, HUBER), 1.0)
    cost = float(np.where(far, HUBER * (2.0 * size - HUBER), size * size).sum())
    weighted = (weight[:, None, None] * J).reshape(-1, 8)
    along = np.where(far, np.sqrt(weight) / np.maximum(size, HUBER), 0.0)[:, None] * miss
    flat = np.einsum("ij,ijk->ik", along, J)
    H, g = weighted.T @ J.reshape(-1, 8), weighted.T @ miss.ravel()
    curvature = H - flat.T @ flat
    r, K = _known(known, state)
    prior = K.T @ K
    return _Point(state, cost + float(r @ r), H + prior, curvature + prior, g + K.T @ r, pixel_std * size)


def _known(known: Constraints, state: _State) -> tuple[Array, Array]:
    """Misses of height, tilt and shift in standard deviations, (6,), and their derivatives, (6, 8)."""
    up = np.asarray(known.up, float)
    port = state.rotation @ np.asarray(known.port, float)
    level = tilt_matrix(known.roll, known.pitch)
    height = known.z_b + float((level @ np.asarray(known.port, float))[2])  # of the port, as it was measured
    m = level[2]
    up_b = state.rotation.T @ up
    r, K = np.zeros(6), np.zeros((6, 8))
    r[0] = up @ (state.position + port) - height
    K[0, :3], K[0, 3:6] = up, np.cross(port, up)
    r[1:4] = np.cross(up_b, m)
    K[1:4, 3:6] = -skew(m) @ state.rotation.T @ skew(up)
    r[4:], K[4:, 6:] = state.shift, np.eye(2)
    std = np.maximum([known.z_std, *3 * [known.tilt_std], *2 * [known.shared_pixel_std]], SUREST)
    return r / std, K / std[:, None]


def _measured(point: _Point, start: Measurement, steps: int) -> Measurement:
    whole = np.asarray(np.linalg.inv(point.H)[:6, :6], float)
    x, y, z = point.state.rotation[:, 0]
    rows = np.zeros((3, 6))
    rows[0, 0] = rows[1, 1] = 1.0
    rows[2, 3:] = np.array([-x * z, -y * z, x * x + y * y]) / (x * x + y * y)
    return Measurement(
        METHOD,
        True,
        "",
        point.state.position,
        point.state.rotation,
        rows @ whole @ rows.T,
        float(np.sqrt(np.mean(point.missed**2))),
        start.tags,
        len(point.missed),
        start.rejected,
        steps,
        start.medium,
        whole,
    )


Array = npt.NDArray[np.float64]


class Method(Protocol):
    """What a method is: a pure function that refuses bad measurements with a reason and raises nothing for them."""

    def __call__(
        self,
        detections: Iterable[Detection],
        pool: Pool,
        tags_b: Mapping[int, Array],
        constraints: Constraints | None,
        pixel_std: float,
    ) -> Measurement:
        """
        Args:
            detections: Tags of one picture.
            pool: Camera and water.
            tags_b: Tag id -> corners in the body frame [m], (4, 3).
            constraints: What is known of height and tilt, or None.
            pixel_std: Standard deviation of a corner, per axis [px].
        """


METHODS: dict[str, Method] = {
    "refractive": planar_fit,
    "refractive-weighted": weighted_fit,
    "pinhole": pinhole,
    "pinhole-depth": pinhole_depth,
    "refractive-6dof": refractive_bundle,
}
NEEDS_DEPTH = frozenset({"refractive", "refractive-weighted", "pinhole-depth"})
"""Methods that refuse to work without constraints."""
