"""Six-degree-of-freedom poses from corners: initial poses, refinement to the nearest minimum, and choice of a
minimum."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from finssim.core.least_squares import Step, descend, huber_loss, huber_weight
from finssim.core.optics import Lens, projection_jacobians
from finssim.core.rotations import (
    matrix_to_quat,
    nearest_rotation,
    quat_from_rotvec,
    quat_to_matrix,
    quat_to_rotvec,
    skew,
)
from finssim.localization.overhead_camera import Pool
from finssim.localization.poses import (
    Constraints,
    Correspondences,
    PoseMeasurement,
    axes_of_up,
    inflation,
    tilt_matrix,
)

Array = npt.NDArray[np.float64]

# Initial poses of a flat board from the rays to its points, without refraction.


def plane_pose(rays: Array, points: Array) -> tuple[Array, Array] | None:
    """Return R and t of a plane relative to a camera, from the rays to its points.

    Least squares of ray x H point = 0 with H = [r_1 r_2 t] up to a positive scale (Hartley and Zisserman
    2004, 4.1).

    Args:
        rays: Rays of any length and direction, camera frame [-], (n, 3), n >= 4.
        points: Points on the plane, in its own frame [m], (n, 2).

    Returns:
        R (3, 3) and t [m] (3,) of the plane in the camera frame; None if the points lie on one line.
    """
    centre = points.mean(axis=0)
    size = float(np.abs(points - centre).max())
    flat = np.column_stack([(points - centre) / size, np.ones(len(points))])
    rows = np.einsum("nij,nk->nijk", skew(rays), flat).reshape(-1, 9)
    if not np.isfinite(rows).all():
        return None
    _, values, vectors = np.linalg.svd(rows, full_matrices=False)
    if values[-2] < 1e-9 * values[0]:
        return None
    H = vectors[-1].reshape(3, 3)
    H = H * np.sign(np.median(np.sum(rays * (flat @ H.T), axis=1)))
    r1, r2, t = (H / (0.5 * (np.linalg.norm(H[:, 0]) + np.linalg.norm(H[:, 1])))).T
    R = nearest_rotation(np.column_stack([r1, r2, np.cross(r1, r2)]))
    return R, np.asarray(t * size - R[:, :2] @ centre)


def tag_poses(rays_p: Array, centre_p: Array, points_b: Array) -> list[tuple[Array, Array]]:
    """Return both poses of a body that are consistent with one of its tags, without refraction.

    Seen from far, a flat tag looks the same with its attitude mirrored about the line of sight: the second pose.

    Args:
        rays_p: Unit rays to its corners, pool frame [-], (4, 3).
        centre_p: C_p: camera, pool frame [m], (3,).
        points_b: Its corners, body frame [m], (4, 3).

    Returns:
        t_pb [m] and R_pb of each; empty if the corners do not form a square.
    """
    x, y = points_b[1] - points_b[0], points_b[0] - points_b[3]
    x, z = x / np.linalg.norm(x), np.cross(x, y)
    z = z / np.linalg.norm(z)
    R_bt, t_bt = np.stack([x, np.cross(z, x), z], axis=1), points_b.mean(axis=0)
    pose = plane_pose(rays_p, ((points_b - t_bt) @ R_bt)[:, :2])
    if pose is None:
        return []
    R_pb, sight = pose[0] @ R_bt.T, pose[1] / np.linalg.norm(pose[1])
    return [(centre_p + pose[1] - R @ t_bt, R) for R in (R_pb, mirrored(R_pb, sight, z))]


def mirrored(R_pb: Array, sight_p: Array, normal_b: Array) -> Array:
    """Return the other attitude in which a flat object looks the same from far.

    Args:
        R_pb: Rotation matrix of the first attitude, (3, 3).
        sight_p: Unit vector along the line of sight, pool frame [-], (3,).
        normal_b: Unit normal of the flat object, body frame [-], (3,).
    """
    return (
        (np.eye(3) - 2.0 * np.outer(sight_p, sight_p))
        @ R_pb
        @ (np.eye(3) - 2.0 * np.outer(normal_b, normal_b))
    )


# Refinement of a pose with all six degrees of freedom, by the reprojection error.

ProjectionFunction = Callable[[Array], tuple[Array, Array, npt.NDArray[np.bool_]]]
"""Function of points, pool frame (n, 3), that returns pixels (n, 2), derivatives by the point (n, 2, 3), and
a visibility mask (n,)."""
ExtraRows = Callable[[Array, Array, Array], tuple[Array, Array]]
"""Function of t_pb, R_pb and a shift of the picture [px] that returns residuals of prior knowledge (m,) and
derivatives (m, 8), [px]."""

_COST_TOLERANCE = 1e-10
"""Decrease of the cost below which a step is the last [px²]."""
_RELATIVE_COST_TOLERANCE = 1e-6
"""Relative decrease of the cost below which a step is the last [-]: a thousandth of the residuals."""


@dataclass(frozen=True, eq=False)
class RefinedPose:
    """Pose at a minimum of the reprojection error."""

    position: Array
    """t_pb [m], (3,)."""
    rotation: Array
    """R_pb, (3, 3)."""
    shift: Array
    """Shift of the complete picture [px], (2,); zero without prior knowledge."""
    cost: float
    """Sum of Huber's rho over the points, and of the squared residuals of prior knowledge [px²]."""
    residual_norms: Array
    """Reprojection error of each point, as a distance [px], (n,)."""
    H: Array
    """Weighted J'J by position [m], rotation about pool axes [rad] and, with prior knowledge, the shift, (6,
    6) or (8, 8)."""
    curvature: Array
    """Matrix of the steps, as H; with prior knowledge it omits the component along the residual of outliers, where
    Huber's rho is not curved. The units are those of `H`."""
    g: Array
    """Gradient of half the cost by the unknowns of `H`, per unit of these, (6,) or (8,)."""
    iterations: int = 0
    converged: bool = False

    @property
    def rms(self) -> float:
        """Root mean square of `residual_norms` [px]."""
        return math.sqrt(float(self.residual_norms @ self.residual_norms) / len(self.residual_norms))

    def covariance(self, pixel_std: float) -> Array:
        """Return the covariance of position [m] and rotation about pool axes [rad], (6, 6).

        Without prior knowledge it is enlarged if the residuals clearly exceed the noise.
        """
        factor = inflation(self.residual_norms, 6, pixel_std) if len(self.H) == 6 else 1.0
        scale = 1.0 / np.sqrt(np.diagonal(self.H))
        inverse = np.linalg.pinv(self.H * scale[:, None] * scale, hermitian=True) * scale[:, None] * scale
        return np.asarray(inverse[:6, :6] * (pixel_std**2 * factor))


def refine_pose(
    see: ProjectionFunction,
    points_b: Array,
    pixels: Array,
    position: Array,
    rotation: Array,
    huber: float,
    *,
    extra_rows: ExtraRows | None = None,
    max_steps: int = 50,
) -> RefinedPose | None:
    """Minimise the reprojection error by Levenberg-Marquardt, with analytic Jacobians and Huber's rho.

    Args:
        see: Function that images points.
        points_b: Points, body frame [m], (n, 3).
        pixels: Pixels (u, v), (n, 2).
        position: Initial t_pb, pool frame [m], (3,).
        rotation: Initial R_pb, (3, 3).
        huber: Residual [px] beyond which Huber's rho grows linearly.
        extra_rows: Function of the residuals of prior knowledge; with it, a shift of the picture is estimated too.
        max_steps: Greatest number of steps.

    Returns:
        The minimum, or None if points are not visible from the initial pose.
    """

    def at(position: Array, rotation: Array, shift: Array) -> RefinedPose | None:
        return _linearised(see, points_b, pixels, huber, extra_rows, position, rotation, shift)

    def linearise(now: RefinedPose) -> Step[RefinedPose]:
        def stepped(damping: float) -> tuple[RefinedPose | None, float]:
            D = damping * np.maximum(np.diagonal(now.H), 1e-12)
            step = np.linalg.solve(now.curvature + np.diag(D), -now.g)
            turn = quat_to_matrix(quat_from_rotvec(step[3:6]))
            shift = now.shift + step[6:] if extra_rows else now.shift
            trial = at(now.position + step[:3], turn @ now.rotation, shift)
            return trial, float(-(step @ now.g) + step @ (D * step))

        return stepped

    start = at(position, rotation, np.zeros(2))
    if start is None:
        return None
    relative, damping = (_RELATIVE_COST_TOLERANCE, 1e-3) if extra_rows is None else (0.0, 1e-6)
    now, _, steps, converged = descend(
        start,
        lambda now: now.cost,
        linearise,
        steps=max_steps,
        tolerance=_COST_TOLERANCE,
        relative_tolerance=relative,
        damping=damping,
    )
    return replace(now, iterations=steps, converged=converged)


def _linearised(
    see: ProjectionFunction,
    points_b: Array,
    pixels: Array,
    huber: float,
    extra_rows: ExtraRows | None,
    position: Array,
    rotation: Array,
    shift: Array,
) -> RefinedPose | None:
    arms = points_b @ rotation.T
    projected, by_point, visible = see(arms + position)
    if not visible.all():
        return None
    miss = projected + shift - pixels
    residual_norms = np.sqrt(np.sum(miss * miss, axis=1))
    parts = [by_point, -by_point @ skew(arms)]
    if extra_rows is not None:
        parts.append(np.broadcast_to(np.eye(2), (len(miss), 2, 2)))
    J = np.concatenate(parts, axis=-1)
    weight, cost = huber_weight(residual_norms, huber), float(huber_loss(residual_norms, huber).sum())
    weighted = (weight[:, None, None] * J).reshape(-1, J.shape[-1])
    H, g = weighted.T @ J.reshape(-1, J.shape[-1]), weighted.T @ miss.ravel()
    curvature = H
    if extra_rows is not None:
        # Close to the minimum Newton's curvature converges faster; far away, weights alone are more robust.
        along = (
            np.where(residual_norms > huber, np.sqrt(weight) / np.maximum(residual_norms, huber), 0.0)[
                :, None
            ]
            * miss
        )
        flat = np.einsum("ij,ijk->ik", along, J)
        r, K = extra_rows(position, rotation, shift)
        cost, g, H = cost + float(r @ r), g + K.T @ r, H + K.T @ K
        curvature = H - flat.T @ flat
    return RefinedPose(position, rotation, shift, cost, residual_norms, H, curvature, g)


def through_lens(lens: Lens, R: Array | None = None, position: Array | None = None) -> ProjectionFunction:
    """Return the function that images points without refraction, in the optical frame or in one with a given
    camera pose.

    Args:
        lens: Lens of the camera.
        R: Rotation matrix from optical axes to those of the points, (3, 3).
        position: Position of the camera in the frame of the points [m], (3,).
    """
    R, position = np.eye(3) if R is None else R, np.zeros(3) if position is None else position

    def see(points: Array) -> tuple[Array, Array, npt.NDArray[np.bool_]]:
        points_c = (points - position) @ R
        pixels, visible = lens.project(points_c)
        return pixels, lens.project_jacobian(points_c) @ R.T, visible

    return see


def through_water(pool: Pool) -> ProjectionFunction:
    """Return the function that images points, refracted at the interface, or straight on the camera's side of it."""
    camera, interface = pool.camera, pool.interface
    straight = through_lens(camera.lens, camera.R_pc, camera.position)

    def see(points_p: Array) -> tuple[Array, Array, npt.NDArray[np.bool_]]:
        of = projection_jacobians(camera, interface, points_p)
        pixels, by_point = of.projection.pixels, of.point
        in_air = interface.distance(points_p) > 0.0
        if in_air.any():
            pixels[in_air], by_point[in_air], _ = straight(points_p[in_air])
        return pixels, by_point, np.asarray(np.isfinite(pixels).all(axis=1))

    return see


# Choice among several poses that explain a picture.


def _distinct(poses: Iterable[RefinedPose | None]) -> list[RefinedPose]:
    """Return the distinct minima among the poses, the best first."""
    minima: list[RefinedPose] = []
    for pose in sorted((pose for pose in poses if pose is not None), key=lambda pose: pose.cost):
        if all(_separation(pose, other) for other in minima):
            minima.append(pose)
    return minima


def minima_from(
    see: ProjectionFunction, pairs: Correspondences, starts: Iterable[tuple[Array, Array]], huber: float
) -> list[RefinedPose]:
    """Return the distinct minima reached from the starts, the best first: after a few steps, only distinct
    ones continue.

    Args:
        see: Function that images points.
        pairs: The corners.
        starts: Initial poses t_pb [m] and R_pb.
        huber: Residual [px] beyond which Huber's rho grows linearly.
    """
    points, pixels = pairs.points_b, pairs.pixels
    begun = _distinct(refine_pose(see, points, pixels, t, R, huber, max_steps=5) for t, R in starts)
    return _distinct(refine_pose(see, points, pixels, a.position, a.rotation, huber) for a in begun[:4])


@dataclass(frozen=True, eq=False)
class BestMinimum:
    """The best of several minima."""

    best: RefinedPose
    second: RefinedPose | None
    gap: float
    """Difference of chi² to the second minimum; infinite if there is none [-]."""

    @property
    def turned(self) -> float:
        """Angle between the two attitudes [rad]."""
        return 0.0 if self.second is None else _angle(self.best.rotation, self.second.rotation)

    def covariance(self, pixel_std: float) -> Array:
        """Return the covariance of position and rotation about pool axes, (6, 6), including the probability
        of the second minimum.

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


def choose(minima: list[RefinedPose], constraints: Constraints | None, pixel_std: float) -> BestMinimum:
    """Return the best of the minima and the next one.

    Args:
        minima: Minima; at least one.
        constraints: Prior tilt, weighted with its standard deviation, but at least 3 degrees, since
            refraction distorts pinhole poses.
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
        return BestMinimum(minima[0], None, math.inf)
    first, second = int(order[0]), int(order[1])
    return BestMinimum(minima[first], minima[second], float(scored[second] - scored[first]))


def measured(
    method: str, pose: RefinedPose, covariance: Array, pairs: Correspondences, medium: str = ""
) -> PoseMeasurement:
    """Return the measurement of a pose with covariance (6, 6) in [m] and [rad]."""
    x, y, z = pose.rotation[:, 0]
    rows = np.zeros((3, 6))
    rows[0, 0] = rows[1, 1] = 1.0
    rows[2, 3:] = np.array([-x * z, -y * z, x * x + y * y]) / (x * x + y * y)
    return PoseMeasurement(
        method=method,
        ok=True,
        reason="",
        position=pose.position,
        rotation=pose.rotation,
        covariance=rows @ covariance @ rows.T,
        residual_px=pose.rms,
        tags=pairs.tags,
        corners=len(pairs.pixels),
        rejected=pairs.rejected,
        iterations=pose.iterations,
        medium=medium,
        pose_covariance=covariance,
    )


def _lean(pose: RefinedPose, constraints: Constraints) -> float:
    """Return the angle between the body's up direction of the pose and that of roll and pitch [rad]."""
    R_pg = axes_of_up(constraints.up)
    up_b = pose.rotation.T @ R_pg[:, 2]
    up = tilt_matrix(constraints.roll, constraints.pitch)[2]
    return float(np.arctan2(np.linalg.norm(np.cross(up_b, up)), up_b @ up))


def _separation(a: RefinedPose, b: RefinedPose) -> bool:
    far = float(np.linalg.norm(a.position - b.position)) > 0.005
    return far or _angle(a.rotation, b.rotation) > 0.01


def _angle(a: Array, b: Array) -> float:
    """Return the angle between two attitudes [rad]."""
    return float(np.arccos(np.clip(0.5 * (np.trace(a.T @ b) - 1.0), -1.0, 1.0)))
