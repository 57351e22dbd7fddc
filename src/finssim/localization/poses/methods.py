"""Ways to measure a pose from the tags of one picture, by name."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from finssim.core.least_squares import Step, descend
from finssim.core.optics import Camera, Lens, Status, back_project, count_rejections, projection_jacobians
from finssim.core.rotations import matrix_to_quat, quat_from_rotvec, quat_to_matrix, quat_to_rotvec, skew
from finssim.localization import LocalizationError
from finssim.localization.detection.detections import Detection
from finssim.localization.detection.families import tag_corners_b
from finssim.localization.overhead_camera import Pool
from finssim.localization.poses import (
    Constraints,
    Correspondences,
    PoseMeasurement,
    axes_of_up,
    correspondences,
    refused,
    tilt_matrix,
)
from finssim.vehicles.equipment import Tags

__all__ = [
    "Constraints", "METHODS", "NEEDS_DEPTH", "TagLocator", "check_method", "planar_fit", "plane_pose",
    "refine_pose", "through_lens",
]  # fmt: skip


# A rigid motion in the plane that lays one set of points on another, measured in pixels.

_MAX_STEPS = 30
_MAX_TURNS = 8
_STILL_PLANE = 1e-13
"""A step that changes the misses by less than the root of this [px²] is the last."""


@dataclass(frozen=True, eq=False)
class RigidFit:
    """The motion found, and what its uncertainty follows from."""

    xi: tuple[float, float, float]
    """x, y [m], psi [rad]."""
    inverse: Array
    """Inverse of the weighted J'J [m², rad² per px²], (3, 3)."""
    weighted_J: Array
    """The curvature of rho times J [-, m], (n, 2, 3)."""
    A: Array
    """[px/m], (n, 2, 2)."""
    missed: Array
    """Distance of each point from its place [px], (n,)."""
    iterations: int
    converged: bool

    @property
    def rms(self) -> float:
        """Root mean square of `missed` [px]."""
        return math.sqrt(float(self.missed @ self.missed) / len(self.missed))

    def response(self, shared: Array) -> Array:
        """Return how the motion changes with errors that move many points together.

        Args:
            shared: Change of each point Q - P per unit of each error, (k, n, 2).

        Returns:
            Changes [m, m, rad] per unit of the errors, (3, k).
        """
        in_pixels = (self.A @ shared[..., None])[..., 0].reshape(len(shared), -1)
        return np.asarray(-self.inverse @ (in_pixels @ self.weighted_J.reshape(-1, 3)).T)

    def inflation(self, std: float) -> float:
        """Factor on the variance where the misses are larger than noise of `std` [px] explains."""
        return _inflation(self.missed, 3, std)


def _inflation(missed: Array, parameters: int, std: float) -> float:
    """Factor on a variance where misses are larger than noise of `std` [px] explains.

    It is 1 up to the 99 % quantile of chi² (Wilson and Hilferty's approximation), and the ratio to it beyond.
    """
    dof = max(2 * len(missed) - parameters, 1)
    k = 2.0 / (9.0 * dof)
    quantile = dof * (1.0 - k + 2.326 * math.sqrt(k)) ** 3
    return max(1.0, float(missed @ missed) / std**2 / quantile)


def rigid_fit(Q: Array, points: Array, A: Array, huber: float) -> RigidFit | None:
    """Find xi = (x, y, psi) that minimises sum_i rho(|A_i (Q_i - R(psi) points_i - [x, y])|).

    Levenberg and Marquardt's method with the analytic Jacobian -A [I, R'(psi) points], from the minimum of the plain
    sum of squares: where no point misses by `huber` or more, its first step is its last.

    Args:
        Q: Where the points are seen [m], (n, 2).
        points: Where they are on the body [m], (n, 2).
        A: Metres to pixels [px/m], (n, 2, 2).
        huber: Distance [px] from which on Huber's rho grows linearly.

    Returns:
        The fit, or None where the points are too close together to tell the angle.
    """

    def linearise(now: _State) -> Step[_State]:
        def stepped(damping: float) -> tuple[_State | None, float]:
            inverse = _damped_inverse(now.H, damping)
            if inverse is None:
                return None, math.inf
            step = -inverse @ now.g
            xi = (now.xi[0] + step[0], now.xi[1] + step[1], now.xi[2] + step[2])
            return _evaluate(xi, Q, points, A, huber), float(-(step @ now.g))

        return stepped

    start = _evaluate(_least_squares(Q, points, A), Q, points, A, huber)
    now, _, steps, converged = descend(
        start, lambda now: now.cost, linearise, steps=_MAX_STEPS, still=_STILL_PLANE, damping=1e-6
    )
    inverse = _damped_inverse(now.H, 0.0)
    if inverse is None:
        return None
    pose = (float(now.xi[0]), float(now.xi[1]), math.remainder(float(now.xi[2]), math.tau))
    return RigidFit(pose, inverse, now.weighted_J, A, now.missed, steps, converged)


@dataclass(frozen=True, eq=False)
class _State:
    xi: tuple[float, float, float]
    cost: float
    H: Array
    g: Array
    weighted_J: Array
    missed: Array


def _damped_inverse(H: Array, damping: float) -> Array | None:
    """Inverse of H + damping diag(H) by its adjugate, None where it is singular: np.linalg costs four times as much."""
    (a, d, e), (_, b, f), (_, _, c) = H.tolist()
    scale = a * b * c
    a, b, c = a * (1.0 + damping), b * (1.0 + damping), c * (1.0 + damping)
    A, D, E = b * c - f * f, e * f - c * d, d * f - b * e
    determinant = a * A + d * D + e * E
    if not determinant > 1e-12 * scale:
        return None
    B, F, C = a * c - e * e, d * e - a * f, a * b - d * d
    return np.asarray(np.array([[A, D, E], [D, B, F], [E, F, C]]) / determinant)


def _procrustes(centre: Array, middle: Array, q: Array, p: Array) -> tuple[float, float, float]:
    """The closed form for equal weights, of the middles of both sets of points and where they are from them."""
    along = float(np.vdot(p, q))
    across = float(p[:, 0] @ q[:, 1] - p[:, 1] @ q[:, 0])
    psi = math.atan2(across, along)
    c, s = math.cos(psi), math.sin(psi)
    return (
        float(centre[0] - c * middle[0] + s * middle[1]),
        float(centre[1] - s * middle[0] - c * middle[1]),
        psi,
    )


def _least_squares(Q: Array, points: Array, A: Array) -> tuple[float, float, float]:
    """The minimum of sum_i |A_i (Q_i - R(psi) points_i - [x, y])|², beside the closed form for equal weights.

    The misses are linear in (x, y, cos psi, sin psi), so the sum is a quadratic form. Without x and y, which it decides
    for each psi, it is K over (cos psi, sin psi, 1): Newton's method finds its minimum in plain numbers.
    """
    n = len(Q)
    centre, middle = Q.sum(axis=0) / n, points.sum(axis=0) / n
    q, p = Q - centre, points - middle
    columns = np.zeros((n, 2, 5))  # of x, y, cos psi and sin psi in R points + [x, y], and -Q
    columns[:, 0, 0] = columns[:, 1, 1] = 1.0
    columns[:, :, 2] = p
    columns[:, 0, 3], columns[:, 1, 3] = -p[:, 1], p[:, 0]
    columns[:, :, 4] = -q
    in_pixels = (A @ columns).reshape(-1, 5)
    G = (in_pixels.T @ in_pixels).tolist()
    (a, b), d = G[0][:2], G[1][1]
    determinant = a * d - b * b
    if not determinant > 0.0:
        return _procrustes(centre, middle, q, p)
    # Where x and y are for each of cos psi, sin psi, 1; and what is left of the form.
    x = [-(d * G[0][k] - b * G[1][k]) / determinant for k in (2, 3, 4)]
    y = [-(a * G[1][k] - b * G[0][k]) / determinant for k in (2, 3, 4)]
    cc, ss, cs, c1, s1 = (
        G[i + 2][j + 2] + G[i + 2][0] * x[j] + G[i + 2][1] * y[j]
        for i, j in ((0, 0), (1, 1), (0, 1), (0, 2), (1, 2))
    )
    _, _, psi = begin = _procrustes(centre, middle, q, p)
    for _ in range(_MAX_TURNS):
        c, s = math.cos(psi), math.sin(psi)
        slope = (ss - cc) * c * s + cs * (c * c - s * s) - c1 * s + s1 * c
        curvature = (ss - cc) * (c * c - s * s) - 4.0 * cs * c * s - c1 * c - s1 * s
        if not curvature > 0.0:
            return begin
        psi -= slope / curvature
        if abs(slope) < 1e-8 * curvature:  # the error is the square of this, once the step is taken
            break
    c, s = math.cos(psi), math.sin(psi)
    (qx, qy), (px, py) = centre.tolist(), middle.tolist()
    return (
        x[0] * c + x[1] * s + x[2] + qx - (c * px - s * py),
        y[0] * c + y[1] * s + y[2] + qy - (s * px + c * py),
        psi,
    )


def _evaluate(xi: tuple[float, float, float], Q: Array, points: Array, A: Array, huber: float) -> _State:
    c, s = math.cos(xi[2]), math.sin(xi[2])
    turned = points @ np.array([[c, s], [-s, c]])
    change = np.empty((len(Q), 2, 4))  # columns: Q - P, and P's derivatives by x, y, psi
    change[:, :, 0] = Q - turned - xi[:2]
    change[:, :, 1:3] = -_UNIT
    change[:, 0, 3], change[:, 1, 3] = turned[:, 1], -turned[:, 0]
    in_pixels = A @ change
    miss, J = in_pixels[:, :, 0], in_pixels[:, :, 1:]
    squares = (miss * miss) @ _ONES
    missed = np.sqrt(squares)
    flat = J.reshape(-1, 3)
    if missed.max() <= huber:
        return _State(xi, float(squares.sum()), flat.T @ flat, flat.T @ miss.ravel(), J, missed)
    far = missed > huber
    weight = np.where(far, huber / np.maximum(missed, huber), 1.0)
    cost = float(np.where(far, huber * (2.0 * missed - huber), squares).sum())
    # Where rho grows linearly it curves across the miss only; with weights alone the steps would shrink but slowly.
    towards = np.where(far, 1.0 / np.maximum(missed, huber), 0.0)[:, None] * miss
    across = J - towards[:, :, None] * np.einsum("ij,ijk->ik", towards, J)[:, None, :]
    weighted = weight[:, None, None] * across
    g = flat.T @ (weight[:, None] * miss).ravel()
    return _State(xi, cost, weighted.reshape(-1, 3).T @ flat, g, weighted, missed)


_UNIT, _ONES = np.eye(2), np.ones(2)


# Where on its known height each corner lies that a picture shows: eq. 12 of the paper, in the medium it is in.

_STEP = 0.1
"""Step of the derivative with respect to the pixel [px]: optics change over hundreds of pixels: its error is 1e-4."""
_STEPS = np.array([[[0.0, 0.0]], [[_STEP, 0.0]], [[0.0, _STEP]]])
_GRAZING = 1e-3
"""Angle between a ray and the plane of heights below which the ray does not locate the corner [rad]."""


@dataclass(frozen=True, eq=False)
class CornerPoints:
    """Corners on their heights, in a frame g whose z axis points up."""

    Q: Array
    """Horizontal coordinates [m], (n, 2); NaN where the status is not OK."""
    per_pixel: Array
    """dQ/d(u, v) [m/px], (n, 2, 2)."""
    per_height: Array
    """dQ/dz [-], (n, 2)."""
    status: npt.NDArray[np.int8]
    """(n,)"""
    in_air: npt.NDArray[np.bool_]
    """True if the corner is on the camera's side of the water, (n,)."""


def corner_points(pool: Pool, R_pg: Array, pixels: Array, heights: Array, *, straight: bool) -> CornerPoints:
    """Meet each pixel's ray with the plane on which its corner is.

    Q = S + (z - e3 . S) / (e3 . r) r                                                       (paper, eq. 12)

    The ray is bent at the interface unless it meets the plane before it: then the corner is in the air, and the ray
    straight.

    Args:
        pool: Camera and interface.
        R_pg: Rotation matrix from frame g, whose z axis points up, to the pool frame, (3, 3).
        pixels: (n, 2).
        heights: Along the z axis of g, from the pool's origin [m], (n,).
        straight: Leave the water out.
    """
    beside = pixels + _STEPS
    with np.errstate(all="ignore"):
        if straight:
            air_points = _points(*_air(pool, R_pg, beside), heights)
            return _corner_points(*air_points, np.ones(len(pixels), bool))
        rays = back_project(pool.camera, pool.interface, beside)
        origin, direction = rays.origin @ R_pg, rays.direction @ R_pg
        centre = float(pool.camera.position @ R_pg[:, 2])
        # Part of the way from the camera to the water at which the height is reached.
        part = (heights - centre) / (origin[0, :, 2] - centre)
        in_air = (part > 0.0) & (part < 1.0)
        points, slope, status = _points(origin, direction, rays.status, heights)
        if in_air.any():
            above = _points(*_air(pool, R_pg, beside[:, in_air]), heights[in_air])
            points[:, in_air], slope[in_air], status[in_air] = above
        return _corner_points(points, slope, status, in_air)


def _air(pool: Pool, R_pg: Array, pixels: Array) -> tuple[Array, Array, npt.NDArray[np.int8]]:
    """Straight rays: origin, direction in g, status."""
    rays, valid = pool.camera.lens.rays(pixels)
    status = np.where(valid, np.int8(Status.OK), np.int8(Status.NO_RAY)).astype(np.int8)
    return pool.camera.position @ R_pg, rays @ (pool.camera.R_pc.T @ R_pg), status


def _points(
    origin: Array, direction: Array, status: npt.NDArray[np.int8], heights: Array
) -> tuple[Array, Array, npt.NDArray[np.int8]]:
    """Horizontal coordinates (3, n, 2), their change with height (n, 2) and status (n,)."""
    steep = direction[..., 2]
    length = (heights - origin[..., 2]) / steep
    points = origin[..., :2] + length[..., None] * direction[..., :2]
    slope = direction[0, :, :2] / steep[0, :, None]
    met = (length > -1e-9).all(axis=0) & (np.abs(steep[0]) > _GRAZING)
    worst = status.max(axis=0)
    if met.all() and not worst.any():
        return points, slope, worst
    reason = np.where(np.abs(steep[0]) > _GRAZING, np.int8(Status.AWAY), np.int8(Status.PARALLEL))
    return points, slope, np.where((worst == 0) & ~met, reason, worst).astype(np.int8)


def _corner_points(
    points: Array, slope: Array, status: npt.NDArray[np.int8], in_air: npt.NDArray[np.bool_]
) -> CornerPoints:
    per_pixel = np.empty((points.shape[1], 2, 2))
    per_pixel[..., 0] = (points[1] - points[0]) / _STEP
    per_pixel[..., 1] = (points[2] - points[0]) / _STEP
    return CornerPoints(points[0], per_pixel, slope, status, in_air)


Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

FEWEST = 3
"""Corners without which there is no measurement."""
WORST = 4.0
"""A corner that misses its place by more than this [px], and by more than 8 standard deviations, is an outlier."""
WORST_WITHOUT_WATER = 40.0
"""Limit for methods without water, which alone may cost many pixels."""
_SUSPECTS = (
    "check the tag's id, edge and mount, the depth, the tilt and the pool file",
    "the tags contradict each other: check their ids and mounts, the depth, the tilt and the pool file",
)


def planar_fit(
    detections: Iterable[Detection],
    pool: Pool,
    tags_b: Mapping[int, Array],
    constraints: Constraints | None,
    pixel_std: float = 0.5,
    *,
    straight: bool = False,
) -> PoseMeasurement:
    """Measure x, y and yaw of a vehicle whose height, roll and pitch are known.

    Each corner's height z_i = z_b + e3 . R_y(θ) R_x(φ) P_b,i does not depend on the yaw sought, so that its ray meets
    its height once, at Q_i; then

        xi* = argmin sum_i rho(| A_i (Q_i - P_i(xi)) |),   P_i = R_z(psi) R_y R_x P_b,i + [x, y, z_b]   (paper, eq. 13)

    with A_i = (dQ_i/d(u, v))^-1, which counts the miss in the pixels where the detector made it, and Huber's rho.

    Args:
        detections: Tags of one picture.
        pool: Camera and water.
        tags_b: Tag id -> corners in the body frame [m], (4, 3).
        constraints: Height and tilt; without them the measurement is refused.
        pixel_std: Standard deviation of a corner, per axis [px].
        straight: Leave the water out: the rays go straight through it.

    Returns:
        The measurement, with the covariance that pixels, height and tilt give it; or why there is none.
    """
    method = "pinhole-depth" if straight else "refractive"
    pairs = correspondences(detections, tags_b)
    if not pairs.tags:
        return refused(method, pairs.too_few_reason, pairs.rejected)
    if constraints is None:
        return refused(method, "height and tilt are not known: give a depth", pairs.rejected, tags=pairs.tags)
    R_pg = _frame_of(constraints.up)
    level = pairs.points_b @ tilt_matrix(constraints.roll, constraints.pitch).T
    corners = corner_points(pool, R_pg, pairs.pixels, constraints.z_b + level[:, 2], straight=straight)
    limit = max(WORST_WITHOUT_WATER if straight else WORST, 8.0 * pixel_std)
    solved = _solve(corners, level, pixel_std, limit, len(pairs.tags))
    rejected = {**pairs.rejected, **solved.rejected}
    fit = solved.fit
    if fit is None:
        return refused(method, solved.reason, rejected, tags=pairs.tags)
    return PoseMeasurement(
        method,
        True,
        "",
        R_pg @ np.array([fit.xi[0], fit.xi[1], constraints.z_b]),
        R_pg @ _about_up(fit.xi[2]) @ tilt_matrix(constraints.roll, constraints.pitch),
        _covariance(fit, corners, level, solved.used, constraints, R_pg, pixel_std),
        fit.rms,
        _tags(pairs, solved.used),
        int(solved.used.sum()),
        rejected,
        fit.iterations,
        _medium(corners.in_air[solved.used]) if not straight else "",
    )


@lru_cache(maxsize=16)
def _frame_of(up: tuple[float, float, float]) -> Array:
    """R_pg of `axes_of_up` for a direction of any length, (3, 3)."""
    return axes_of_up(np.asarray(up) / np.linalg.norm(up))


@dataclass(frozen=True, eq=False)
class _Solved:
    fit: RigidFit | None
    used: Flags
    rejected: dict[str, int]
    reason: str = ""


def _solve(corners: CornerPoints, level: Array, pixel_std: float, limit: float, tags: int) -> _Solved:
    """Fit the corners that have a point, once more without those that miss by far."""
    used = corners.status == 0
    rejected = {} if used.all() else _reasons(corners)
    if used.sum() < FEWEST:
        text = ", ".join(f"{n} {name}" for name, n in rejected.items())
        return _Solved(
            None, used, rejected, f"fewer than {FEWEST} corners have a ray to their height ({text})"
        )
    fit = _fit(corners, level, used, pixel_std)
    if fit is not None and fit.missed.max() > limit:
        far = fit.missed > limit
        few = 2 * int(far.sum()) < len(far) and len(far) - int(far.sum()) >= FEWEST
        retained = (
            _without(used, far) if few else _without_a_tag(corners, level, used, pixel_std, limit, tags)
        )
        if retained is None:
            text = f"{int(far.sum())} of {len(far)} corners miss by more than {limit:.1f} px"
            return _Solved(None, used, rejected, f"residual too large: {text}: {_SUSPECTS[tags > 1]}")
        rejected["outlier" if few else "contradicting tag"] = int(used.sum() - retained.sum())
        used = retained
        fit = _fit(corners, level, used, pixel_std)
    if fit is None:
        return _Solved(None, used, rejected, "the corners are too close together to determine the heading")
    if not fit.converged:
        return _Solved(None, used, rejected, f"did not converge in {fit.iterations} steps")
    if fit.missed.max() > limit:
        return _Solved(None, used, rejected, f"residual too large: {fit.rms:.1f} px even without outliers")
    return _Solved(fit, used, rejected)


def _reasons(corners: CornerPoints) -> dict[str, int]:
    return {name.lower().replace("_", " "): n for name, n in count_rejections(corners.status).items()}


def _without(used: Flags, far: Flags) -> Flags:
    retained = used.copy()
    retained[np.flatnonzero(used)[far]] = False
    return retained


def _without_a_tag(
    corners: CornerPoints, level: Array, used: Flags, pixel_std: float, limit: float, tags: int
) -> Flags | None:
    """The corners without one tag, if they agree then, and do so for that tag only."""
    agreeing = []
    for i in range(tags if tags > 1 else 0):
        retained = used.copy()
        retained[4 * i : 4 * i + 4] = False
        fit = _fit(corners, level, retained, pixel_std) if FEWEST <= retained.sum() < used.sum() else None
        if fit is not None and fit.converged and fit.missed.max() <= limit:
            agreeing.append(retained)
    return agreeing[0] if len(agreeing) == 1 else None


def _fit(corners: CornerPoints, level: Array, used: Flags, pixel_std: float) -> RigidFit | None:
    A = _inverse(corners.per_pixel)
    if not used.all():
        return rigid_fit(corners.Q[used], level[used, :2], A[used], 2.5 * pixel_std)
    return rigid_fit(corners.Q, level[:, :2], A, 2.5 * pixel_std)


def _inverse(D: Array) -> Array:
    """Inverse of 2x2 matrices, (n, 2, 2)."""
    out = np.empty_like(D)
    out[:, 0, 0], out[:, 1, 1], out[:, 0, 1], out[:, 1, 0] = D[:, 1, 1], D[:, 0, 0], -D[:, 0, 1], -D[:, 1, 0]
    with np.errstate(all="ignore"):
        return out / (D[:, 0, 0] * D[:, 1, 1] - D[:, 0, 1] * D[:, 1, 0])[:, None, None]


def _covariance(
    fit: RigidFit,
    corners: CornerPoints,
    level: Array,
    used: Flags,
    constraints: Constraints,
    R_pg: Array,
    pixel_std: float,
) -> Array:
    """Return the covariance of (x, y, yaw), pool frame: pixels, each independent; height and tilt, which move all
    corners.

    With the miss e_i = Q_i - P_i, an error δ that all share moves the solution by -H^-1 sum_i J_i' w_i A_i de_i/dδ.
    """
    slope, level = corners.per_height[used], level[used]
    cp, sp = math.cos(constraints.pitch), math.sin(constraints.pitch)
    # Crossed with the axes of roll, R_y e1 = (cp, 0, -sp), and of pitch, e2: R_g p -> axis x R_g p, side by side.
    turned = (
        level
        @ np.array(
            [[0.0, -sp, 0.0, 0.0, 0.0, -1.0], [sp, 0.0, cp, 0.0, 0.0, 0.0], [0.0, -cp, 0.0, 1.0, 0.0, 0.0]]
        )
    ).reshape(-1, 2, 3)
    x, y, _ = (tilt_matrix(constraints.roll, constraints.pitch) @ constraints.port).tolist()
    raised = np.array([1.0, -cp * y, x, 0.0, 0.0])  # dz_b
    turn = _about_up(fit.xi[2])[:2, :2]
    shared = np.empty((5, len(slope), 2))
    shared[0] = slope
    shared[1:3] = (
        slope[:, None] * (turned[:, :, 2] + raised[1:3])[:, :, None] - turned[:, :, :2] @ turn.T
    ).transpose(1, 0, 2)
    shared[3:] = corners.per_pixel[used].transpose(2, 0, 1)
    moved = np.empty((4, 5))  # x, y, psi, z_b by height, roll, pitch, u, v
    moved[:3] = fit.response(shared)
    moved[3] = raised
    std = constraints.tilt_std
    spread = moved * np.array(
        [constraints.z_std, std, std, constraints.shared_pixel_std, constraints.shared_pixel_std]
    )
    P = spread @ spread.T
    P[:3, :3] += fit.inverse * (pixel_std**2 * fit.inflation(pixel_std))
    to_pool = np.zeros((3, 4))
    to_pool[:2, :2], to_pool[:2, 3], to_pool[2, 2] = R_pg[:2, :2], R_pg[:2, 2], R_pg[2, 2]
    return np.asarray(to_pool @ P @ to_pool.T)


def _about_up(angle: float) -> Array:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _tags(pairs: Correspondences, used: Flags) -> tuple[int, ...]:
    return tuple(tag for i, tag in enumerate(pairs.tags) if used[4 * i : 4 * i + 4].any())


def _medium(in_air: Flags) -> str:
    return "air" if in_air.all() else "both" if in_air.any() else "water"


# Ways to measure a pose from the tags of one picture, by name.


# Poses to start from: of a flat board from the rays to its points, without regard to water.


def plane_pose(rays: Array, points: Array) -> tuple[Array, Array] | None:
    """R and t of a plane before an eye, from the rays on which its points are seen.

    Least squares of ray x H point = 0 with H = [r_1 r_2 t] up to a positive scale (Hartley and Zisserman 2004, 4.1).

    Args:
        rays: Of any length and direction, frame of the eye [-], (n, 3), n >= 4.
        points: On the plane, its own frame [m], (n, 2).

    Returns:
        R (3, 3) and t [m] (3,) of the plane in the frame of the eye; None where the points lie on one line.
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
    U, _, Vt = np.linalg.svd(np.column_stack([r1, r2, np.cross(r1, r2)]))
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return np.asarray(R), np.asarray(t * size - R[:, :2] @ centre)


def tag_poses(rays_p: Array, centre_p: Array, points_b: Array) -> list[tuple[Array, Array]]:
    """Both poses of a body that one tag on it shows, without regard to water.

    Seen from far, a flat tag looks the same with its attitude mirrored at the line of sight, which gives the other.

    Args:
        rays_p: Unit rays to its corners, pool frame [-], (4, 3).
        centre_p: C_p: camera, pool frame [m], (3,).
        points_b: Its corners, body frame [m], (4, 3).

    Returns:
        t_pb [m] and R_pb of each; none where the corners show no square.
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
    """The other attitude in which something flat looks the same from far.

    Args:
        R_pb: Rotation matrix of the one, (3, 3).
        sight_p: Unit vector along the line of sight, pool frame [-], (3,).
        normal_b: Unit normal of the flat thing, body frame [-], (3,).
    """
    return (
        (np.eye(3) - 2.0 * np.outer(sight_p, sight_p))
        @ R_pb
        @ (np.eye(3) - 2.0 * np.outer(normal_b, normal_b))
    )


# A pose with all six degrees of freedom that puts a body's points where the pixels are.

See = Callable[[Array], tuple[Array, Array, npt.NDArray[np.bool_]]]
"""Points, pool frame (n, 3) -> pixels (n, 2), derivatives by the point (n, 2, 3), and which are seen (n,)."""
ExtraRows = Callable[[Array, Array, Array], tuple[Array, Array]]
"""Function of t_pb, R_pb and a shift of the picture [px] -> residuals of prior knowledge (m,) and derivatives (m, 8),
[px]."""

_STILL = 1e-10
"""A step that lowers the cost by less than this [px²] is the last,"""
_STILL_SHARE = 1e-6
"""or by less than this share of it: a thousandth of the misses, and of a standard deviation."""


@dataclass(frozen=True, eq=False)
class RefinedPose:
    """A minimum of the misses."""

    position: Array
    """t_pb [m], (3,)."""
    rotation: Array
    """R_pb, (3, 3)."""
    shift: Array
    """Shift of the complete picture [px], (2,); zero without prior knowledge."""
    cost: float
    """Sum of Huber's rho over the points, and of the squares of prior knowledge [px²]."""
    missed: Array
    """Distance of each point from its pixel [px], (n,)."""
    H: Array
    """Weighted J'J by position [m], a turn about pool axes [rad] and, with prior knowledge, the shift, (6, 6) or (8,
    8)."""
    curvature: Array
    """Matrix of the steps, as H: with prior knowledge it is without the part along the residual of far points, where
    Huber's rho is not curved. The units are those of `H`."""
    g: Array
    """Slope of half the cost by the unknowns of `H`, per unit of these, (6,) or (8,)."""
    iterations: int = 0
    converged: bool = False

    @property
    def rms(self) -> float:
        """Root mean square of `missed` [px]."""
        return math.sqrt(float(self.missed @ self.missed) / len(self.missed))

    def covariance(self, pixel_std: float) -> Array:
        """Return the covariance of position [m] and a turn about pool axes [rad], (6, 6).

        Without prior knowledge it is enlarged if the residuals exceed the noise by far.
        """
        factor = _inflation(self.missed, 6, pixel_std) if len(self.H) == 6 else 1.0
        scale = 1.0 / np.sqrt(np.diagonal(self.H))
        inverse = np.linalg.pinv(self.H * scale[:, None] * scale, hermitian=True) * scale[:, None] * scale
        return np.asarray(inverse[:6, :6] * (pixel_std**2 * factor))


def refine_pose(
    see: See,
    points_b: Array,
    pixels: Array,
    position: Array,
    rotation: Array,
    huber: float,
    *,
    extra_rows: ExtraRows | None = None,
    max_steps: int = 50,
) -> RefinedPose | None:
    """Minimise the reprojection error by Levenberg and Marquardt's method, with analytic Jacobians and Huber's rho.

    Args:
        see: Where points appear.
        points_b: Body frame [m], (n, 3).
        pixels: (n, 2).
        position: t_pb to start from, pool frame [m], (3,).
        rotation: R_pb to start from, (3, 3).
        huber: Distance [px] from which on Huber's rho grows linearly.
        extra_rows: What else counts; then a shift of the whole picture is sought too.
        max_steps: Give up after so many.

    Returns:
        The minimum, or None where the start cannot be seen.
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
    share, damping = (_STILL_SHARE, 1e-3) if extra_rows is None else (0.0, 1e-6)
    now, _, steps, converged = descend(
        start, lambda now: now.cost, linearise, steps=max_steps, still=_STILL, share=share, damping=damping
    )
    return replace(now, iterations=steps, converged=converged)


def _linearised(
    see: See,
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
    missed = np.sqrt(np.sum(miss * miss, axis=1))
    parts = [by_point, -by_point @ skew(arms)]
    if extra_rows is not None:
        parts.append(np.broadcast_to(np.eye(2), (len(miss), 2, 2)))
    J = np.concatenate(parts, axis=-1)
    far = missed > huber
    weight = np.where(far, huber / np.maximum(missed, huber), 1.0)
    cost = float(np.where(far, huber * (2.0 * missed - huber), missed * missed).sum())
    weighted = (weight[:, None, None] * J).reshape(-1, J.shape[-1])
    H, g = weighted.T @ J.reshape(-1, J.shape[-1]), weighted.T @ miss.ravel()
    curvature = H
    if extra_rows is not None:
        # From nearby Newton's curvature is quicker; from afar, where most of the points are, weights alone are safer.
        along = np.where(far, np.sqrt(weight) / np.maximum(missed, huber), 0.0)[:, None] * miss
        flat = np.einsum("ij,ijk->ik", along, J)
        r, K = extra_rows(position, rotation, shift)
        cost, g, H = cost + float(r @ r), g + K.T @ r, H + K.T @ K
        curvature = H - flat.T @ flat
    return RefinedPose(position, rotation, shift, cost, missed, H, curvature, g)


def through_lens(lens: Lens, R: Array | None = None, position: Array | None = None) -> See:
    """Return the function to image points without water: in the optical frame, or in one in which the camera has a
    pose.

    Args:
        lens: Of the camera.
        R: Rotation matrix from optical axes to those of the points, (3, 3).
        position: Of the camera in their frame [m], (3,).
    """
    R, position = np.eye(3) if R is None else R, np.zeros(3) if position is None else position

    def see(points: Array) -> tuple[Array, Array, npt.NDArray[np.bool_]]:
        points_c = (points - position) @ R
        pixels, visible = lens.project(points_c)
        return pixels, lens.project_jacobian(points_c) @ R.T, visible

    return see


def through_water(pool: Pool) -> See:
    """Return the function to image points: refracted at the interface, or straight on the camera's side of it."""
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


# Which of several poses that explain a picture is the vehicle's.


def _distinct(poses: Iterable[RefinedPose | None]) -> list[RefinedPose]:
    """The minima among what was found, each once, the best first."""
    minima: list[RefinedPose] = []
    for pose in sorted((pose for pose in poses if pose is not None), key=lambda pose: pose.cost):
        if all(_separation(pose, other) for other in minima):
            minima.append(pose)
    return minima


def minima_from(
    see: See, pairs: Correspondences, starts: Iterable[tuple[Array, Array]], huber: float
) -> list[RefinedPose]:
    """The distinct minima that starts lead to, the best first: a few steps each, to the end only where they differ.

    Args:
        see: Where points appear.
        pairs: The corners.
        starts: t_pb [m] and R_pb of each.
        huber: Distance [px] from which on Huber's rho grows linearly.
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
    """Difference of chi² of the second solution; infinite if there is none [-]."""

    @property
    def turned(self) -> float:
        """Angle between the two attitudes [rad]."""
        return 0.0 if self.second is None else _angle(self.best.rotation, self.second.rotation)

    def covariance(self, pixel_std: float) -> Array:
        """Return the covariance of position and a turn about pool axes, (6, 6): that of the best, and the probability
        of the second.

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
        return BestMinimum(minima[0], None, math.inf)
    first, second = int(order[0]), int(order[1])
    return BestMinimum(minima[first], minima[second], float(scored[second] - scored[first]))


def measured(
    method: str, pose: RefinedPose, covariance: Array, pairs: Correspondences, medium: str = ""
) -> PoseMeasurement:
    """The measurement that a pose is, with its covariance (6, 6). The covariance is in [m] and [rad]."""
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
    """Angle between up as the pose has it in the body, and as roll and pitch have it [rad]."""
    R_pg = axes_of_up(constraints.up)
    up_b = pose.rotation.T @ R_pg[:, 2]
    up = tilt_matrix(constraints.roll, constraints.pitch)[2]
    return float(np.arctan2(np.linalg.norm(np.cross(up_b, up)), up_b @ up))


def _separation(a: RefinedPose, b: RefinedPose) -> bool:
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
) -> PoseMeasurement:
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
    """Measure x, y [m] and yaw [rad] at a known height and tilt with straight rays, as if there were no water.

    It is `planar_fit` with rays that do not bend; arguments as of `planar_fit`.
    """
    return planar_fit(detections, pool, tags_b, constraints, pixel_std, straight=True)


def pinhole_poses(pairs: Correspondences, camera: Camera, pixel_std: float) -> list[RefinedPose]:
    """All distinct minima of the reprojection error without water, the best first."""
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
) -> PoseMeasurement:
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
        return refused(method, pairs.too_few_reason, pairs.rejected)
    minima = minima_from(through_water(pool), pairs, _starts(pairs, pool, pixel_std), 2.5 * pixel_std)
    if not minima:
        return refused(method, "the corners show no pose in the water", pairs.rejected, tags=pairs.tags)
    choice = choose(minima, constraints, pixel_std)
    reason = _doubt(choice, pixel_std)
    if reason:
        return refused(method, reason, pairs.rejected, tags=pairs.tags)
    return measured(method, choice.best, choice.covariance(pixel_std), pairs)


def _doubt(choice: BestMinimum, pixel_std: float) -> str:
    """Return why the best pose is doubtful; empty if it is not."""
    best, second = choice.best, choice.second
    if not best.converged:
        return f"did not converge in {best.iterations} steps"
    limit = max(WORST, 8.0 * pixel_std)
    far, count = int((best.missed > limit).sum()), len(best.missed)
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
    """Poses t_pb, R_pb to refine."""
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
    """The attitude without roll and pitch, of the same heading."""
    R_pg = axes_of_up(up)
    forward = R_pg.T @ rotation[:, 0]
    psi = math.atan2(forward[1], forward[0])
    c, s = math.cos(psi), math.sin(psi)
    return np.asarray(R_pg @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]))


def _deepened(apparent_pose: RefinedPose, pairs: Correspondences, pool: Pool) -> tuple[Array, Array] | None:
    """Return the pose of a body that appears at a pose: its corners, at their apparent depth times the ratio of the
    indices on the refracted rays, and the rigid motion that fits these."""
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
    U, _, Vt = np.linalg.svd((points - middle_p).T @ (pairs.points_b - middle_b))
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return np.asarray(middle_p - R @ middle_b), np.asarray(R)


# All six degrees of freedom from corners, depth and tilt together, each trusted as far as it is sure.

METHOD = "refractive-weighted"
HUBER = 2.5
"""Miss in standard deviations from which on Huber's rho grows linearly."""
SUREST = 1e-6
"""Standard deviation of prior knowledge that is given as exact [m, rad, px]."""
MAX_STEPS = 30


def weighted_fit(
    detections: Iterable[Detection],
    pool: Pool,
    tags_b: Mapping[int, Array],
    constraints: Constraints | None,
    pixel_std: float = 0.5,
) -> PoseMeasurement:
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
    """Misses of height, tilt and shift, (6,), and their derivatives, in pixels: over their deviations, times that of a
    pixel."""
    up, port_b = np.asarray(constraints.up, float), np.asarray(constraints.port, float)
    level = tilt_matrix(constraints.roll, constraints.pitch)
    height, m = constraints.z_b + float((level @ port_b)[2]), level[2]  # of the port, as it was measured
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
"""Function of the tags of one picture, pool, tag id -> corners in the body frame [m] (4, 3), prior knowledge of height
and tilt, and the standard deviation of a corner per axis [px] -> the measurement; it refuses a bad picture with a
reason and raises nothing."""

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
    """Refuse a word that is no name of `METHODS`.

    Raises:
        LocalizationError: It is none; the sentence lists them.
    """
    if method not in METHODS:
        raise LocalizationError(f"unknown method '{method}'; available: {', '.join(METHODS)}")


class TagLocator:
    """Measures poses of one vehicle before one camera by one method; it remembers nothing of them."""

    def __init__(
        self, pool: Pool, tags: Tags | None, *, method: str = "refractive", pixel_std: float = 0.5
    ) -> None:
        """
        Args:
            pool: Camera and water.
            tags: Of the vehicle; None is refused.
            method: A name of `METHODS`.
            pixel_std: Standard deviation of a corner, per axis [px].

        Raises:
            LocalizationError: Unknown method, a vehicle without tags, or no error at all.
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
        """The pose in one picture, or why there is none."""
        return METHODS[self.method](detections, self.pool, self.tags_b, constraints, self._pixel_std)
