"""Position and yaw of a vehicle of known height and tilt, from the viewing rays of the corners of its tags."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from finssim.core.least_squares import Step, descend, huber_loss, huber_weight
from finssim.core.optics import Status, back_project, count_rejections
from finssim.localization.detection.detections import Detection
from finssim.localization.overhead_camera import Pool
from finssim.localization.poses import (
    Constraints,
    Correspondences,
    PoseMeasurement,
    about_up,
    axes_of_up,
    correspondences,
    inflation,
    refused,
    tilt_matrix,
)

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

# Rigid motion in the plane that aligns two sets of points, with residuals in pixels.

_MAX_STEPS = 30
_MAX_TURNS = 8
_PLANE_COST_TOLERANCE = 1e-13
"""Change of the cost below which a step is the last [px²]."""


@dataclass(frozen=True, eq=False)
class RigidFit:
    """Estimated rigid motion, and the quantities that determine its uncertainty."""

    xi: tuple[float, float, float]
    """Motion x, y [m], psi [rad]."""
    inverse: Array
    """Inverse of the weighted J'J [m², rad² per px²], (3, 3)."""
    weighted_J: Array
    """Jacobian J weighted by the curvature of rho [-, m], (n, 2, 3)."""
    A: Array
    """Scale from metres to pixels [px/m], (n, 2, 2)."""
    residual_norms: Array
    """Residual of each point, as a distance [px], (n,)."""
    iterations: int
    converged: bool

    @property
    def rms(self) -> float:
        """Root mean square of `residual_norms` [px]."""
        return math.sqrt(float(self.residual_norms @ self.residual_norms) / len(self.residual_norms))

    def response(self, shared: Array) -> Array:
        """Return the sensitivity of the motion to errors that move many points jointly.

        Args:
            shared: Change of each point Q - P per unit of each error, (k, n, 2).

        Returns:
            Changes [m, m, rad] per unit of the errors, (3, k).
        """
        in_pixels = (self.A @ shared[..., None])[..., 0].reshape(len(shared), -1)
        return np.asarray(-self.inverse @ (in_pixels @ self.weighted_J.reshape(-1, 3)).T)

    def inflation(self, std: float) -> float:
        """Return the factor on the variance if the residuals exceed noise of `std` [px]."""
        return inflation(self.residual_norms, 3, std)


def rigid_fit(Q: Array, points: Array, A: Array, huber: float) -> RigidFit | None:
    """Estimate xi = (x, y, psi) that minimises sum_i rho(|A_i (Q_i - R(psi) points_i - [x, y])|).

    Levenberg-Marquardt with the analytic Jacobian -A [I, R'(psi) points], from the minimum of the plain
    sum of squares: if all residuals are below `huber`, its first step is its last.

    Args:
        Q: Observed positions of the points [m], (n, 2).
        points: Positions of the points on the body [m], (n, 2).
        A: Scale from metres to pixels [px/m], (n, 2, 2).
        huber: Residual [px] beyond which Huber's rho grows linearly.

    Returns:
        The fit, or None if the points are too close together to determine the angle.
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
        start,
        lambda now: now.cost,
        linearise,
        steps=_MAX_STEPS,
        tolerance=_PLANE_COST_TOLERANCE,
        damping=1e-6,
    )
    inverse = _damped_inverse(now.H, 0.0)
    if inverse is None:
        return None
    pose = (float(now.xi[0]), float(now.xi[1]), math.remainder(float(now.xi[2]), math.tau))
    return RigidFit(pose, inverse, now.weighted_J, A, now.residual_norms, steps, converged)


@dataclass(frozen=True, eq=False)
class _State:
    xi: tuple[float, float, float]
    cost: float
    H: Array
    g: Array
    weighted_J: Array
    residual_norms: Array


def _damped_inverse(H: Array, damping: float) -> Array | None:
    """Return the inverse of H + damping diag(H) by its adjugate, None if it is singular; np.linalg takes four
    times as long."""
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
    """Return the closed-form solution for equal weights, from the centroids of both sets and the centred points."""
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
    """Return the minimum of sum_i |A_i (Q_i - R(psi) points_i - [x, y])|², starting from the closed form for
    equal weights.

    The residuals are linear in (x, y, cos psi, sin psi), so the sum is a quadratic form. Eliminating x and y
    leaves a quadratic form in (cos psi, sin psi, 1), which Newton's method minimizes with plain numbers.
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
    # x and y as linear functions of (cos psi, sin psi, 1); and the remaining quadratic form.
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
        if abs(slope) < 1e-8 * curvature:  # the error after this step is of second order
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
    residual_norms = np.sqrt(squares)
    flat = J.reshape(-1, 3)
    if residual_norms.max() <= huber:
        return _State(xi, float(squares.sum()), flat.T @ flat, flat.T @ miss.ravel(), J, residual_norms)
    weight, cost = huber_weight(residual_norms, huber), float(huber_loss(residual_norms, huber).sum())
    # Where rho grows linearly, it curves only across the residual; weights alone would converge slowly.
    towards = np.where(residual_norms > huber, 1.0 / np.maximum(residual_norms, huber), 0.0)[:, None] * miss
    across = J - towards[:, :, None] * np.einsum("ij,ijk->ik", towards, J)[:, None, :]
    weighted = weight[:, None, None] * across
    g = flat.T @ (weight[:, None] * miss).ravel()
    return _State(xi, cost, weighted.reshape(-1, 3).T @ flat, g, weighted, residual_norms)


_UNIT, _ONES = np.eye(2), np.ones(2)


# Position of each corner at its known height, from its pixel: eq. 12 of the paper, in water or air.

_STEP = 0.1
"""Step of the derivative with respect to the pixel [px]; its relative error is about 1e-4, since optics vary
over hundreds of pixels."""
_STEPS = np.array([[[0.0, 0.0]], [[_STEP, 0.0]], [[0.0, _STEP]]])
_GRAZING = 1e-3
"""Sine of the angle between a ray and the horizontal plane below which the ray does not locate the corner [-]."""


@dataclass(frozen=True, eq=False)
class CornerPoints:
    """Horizontal positions of corners at their heights, in a frame g whose z axis points up."""

    Q: Array
    """Horizontal coordinates [m], (n, 2); NaN where the status is not OK."""
    per_pixel: Array
    """dQ/d(u, v) [m/px], (n, 2, 2)."""
    per_height: Array
    """dQ/dz [-], (n, 2)."""
    status: npt.NDArray[np.int8]
    """Status of each ray, (n,)."""
    in_air: npt.NDArray[np.bool_]
    """True if the corner is on the camera's side of the water, (n,)."""


def corner_points(pool: Pool, R_pg: Array, pixels: Array, heights: Array, *, straight: bool) -> CornerPoints:
    """Intersect each pixel's ray with the horizontal plane of its corner.

    Q = S + (z - e3 . S) / (e3 . r) r                                                       (paper, eq. 12)

    The ray is refracted at the interface unless it meets the plane before it: then the corner is in the air,
    and the ray straight.

    Args:
        pool: Camera and interface.
        R_pg: Rotation matrix from frame g, whose z axis points up, to the pool frame, (3, 3).
        pixels: Pixels (u, v), (n, 2).
        heights: Heights along the z axis of g, from the pool's origin [m], (n,).
        straight: True to ignore refraction.
    """
    beside = pixels + _STEPS
    with np.errstate(all="ignore"):
        if straight:
            air_points = _points(*_air(pool, R_pg, beside), heights)
            return _corner_points(*air_points, np.ones(len(pixels), bool))
        rays = back_project(pool.camera, pool.interface, beside)
        origin, direction = rays.origin @ R_pg, rays.direction @ R_pg
        centre = float(pool.camera.position @ R_pg[:, 2])
        # Fraction of the distance from camera to water at which the height is reached.
        part = (heights - centre) / (origin[0, :, 2] - centre)
        in_air = (part > 0.0) & (part < 1.0)
        points, slope, status = _points(origin, direction, rays.status, heights)
        if in_air.any():
            above = _points(*_air(pool, R_pg, beside[:, in_air]), heights[in_air])
            points[:, in_air], slope[in_air], status[in_air] = above
        return _corner_points(points, slope, status, in_air)


def _air(pool: Pool, R_pg: Array, pixels: Array) -> tuple[Array, Array, npt.NDArray[np.int8]]:
    """Return the origin, direction in g and status of straight rays."""
    rays, valid = pool.camera.lens.rays(pixels)
    status = np.where(valid, np.int8(Status.OK), np.int8(Status.NO_RAY)).astype(np.int8)
    return pool.camera.position @ R_pg, rays @ (pool.camera.R_pc.T @ R_pg), status


def _points(
    origin: Array, direction: Array, status: npt.NDArray[np.int8], heights: Array
) -> tuple[Array, Array, npt.NDArray[np.int8]]:
    """Return horizontal coordinates (3, n, 2), their change with height (n, 2) and status (n,)."""
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


FEWEST = 3
"""Least number of corners of a measurement."""
WORST = 4.0
"""Residual beyond which a corner is an outlier [px], if it also exceeds 8 standard deviations."""
WORST_WITHOUT_WATER = 40.0
"""Limit for methods without refraction, whose residuals may be many pixels [px]."""
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

    Each corner's height z_i = z_b + e3 . R_y(θ) R_x(φ) P_b,i does not depend on the unknown yaw, so its ray meets
    its height at one point Q_i; then

        xi* = argmin sum_i rho(| A_i (Q_i - P_i(xi)) |),   P_i = R_z(psi) R_y R_x P_b,i + [x, y, z_b]
        (paper, eq. 13)

    with A_i = (dQ_i/d(u, v))^-1, which converts the residual to pixels, in which the detector's error arises,
    and Huber's rho.

    Args:
        detections: Tags of one picture.
        pool: Camera and water.
        tags_b: Tag id -> corners in the body frame [m], (4, 3).
        constraints: Height and tilt; without them the measurement is refused.
        pixel_std: Standard deviation of a corner, per axis [px].
        straight: True to ignore refraction.

    Returns:
        The measurement, with the covariance due to errors of pixels, height and tilt; or a refusal with its reason.
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
    fit, used, unfit = _solve(corners, level, pixel_std, limit, len(pairs.tags))
    rejected = {**pairs.rejected, **unfit}
    if isinstance(fit, str):
        return refused(method, fit, rejected, tags=pairs.tags)
    return PoseMeasurement(
        method,
        True,
        "",
        R_pg @ np.array([fit.xi[0], fit.xi[1], constraints.z_b]),
        R_pg @ about_up(fit.xi[2]) @ tilt_matrix(constraints.roll, constraints.pitch),
        _covariance(fit, corners, level, used, constraints, R_pg, pixel_std),
        fit.rms,
        _tags(pairs, used),
        int(used.sum()),
        rejected,
        fit.iterations,
        _medium(corners.in_air[used]) if not straight else "",
    )


@lru_cache(maxsize=16)
def _frame_of(up: tuple[float, float, float]) -> Array:
    """Return R_pg of `axes_of_up` for a direction of any length, (3, 3)."""
    return axes_of_up(np.asarray(up) / np.linalg.norm(up))


def _solve(
    corners: CornerPoints, level: Array, pixel_std: float, limit: float, tags: int
) -> tuple[RigidFit | str, Flags, dict[str, int]]:
    """Fit the corners that have a point, and once more without outliers.

    Returns:
        The fit, or the reason for having none; a mask of the corners used; the number of excluded ones by reason.
    """
    used = corners.status == 0
    reasons = count_rejections(corners.status)
    rejected = {name.lower().replace("_", " "): n for name, n in reasons.items()}
    if used.sum() < FEWEST:
        text = ", ".join(f"{n} {name}" for name, n in rejected.items())
        return f"fewer than {FEWEST} corners have a ray to their height ({text})", used, rejected
    fit = _fit(corners, level, used, pixel_std)
    if fit is not None and fit.residual_norms.max() > limit:
        far = fit.residual_norms > limit
        few = 2 * int(far.sum()) < len(far) and len(far) - int(far.sum()) >= FEWEST
        retained = (
            _without(used, far) if few else _without_a_tag(corners, level, used, pixel_std, limit, tags)
        )
        if retained is None:
            text = f"{int(far.sum())} of {len(far)} corners miss by more than {limit:.1f} px"
            return f"residual too large: {text}: {_SUSPECTS[tags > 1]}", used, rejected
        rejected["outlier" if few else "contradicting tag"] = int(used.sum() - retained.sum())
        used = retained
        fit = _fit(corners, level, used, pixel_std)
    if fit is None:
        return "the corners are too close together to determine the heading", used, rejected
    if not fit.converged:
        return f"did not converge in {fit.iterations} steps", used, rejected
    if fit.residual_norms.max() > limit:
        return f"residual too large: {fit.rms:.1f} px even without outliers", used, rejected
    return fit, used, rejected


def _without(used: Flags, far: Flags) -> Flags:
    retained = used.copy()
    retained[np.flatnonzero(used)[far]] = False
    return retained


def _without_a_tag(
    corners: CornerPoints, level: Array, used: Flags, pixel_std: float, limit: float, tags: int
) -> Flags | None:
    """Return the corners without one tag, if the others then agree, and only for this tag."""
    agreeing = []
    for i in range(tags if tags > 1 else 0):
        retained = used.copy()
        retained[4 * i : 4 * i + 4] = False
        fit = _fit(corners, level, retained, pixel_std) if FEWEST <= retained.sum() < used.sum() else None
        if fit is not None and fit.converged and fit.residual_norms.max() <= limit:
            agreeing.append(retained)
    return agreeing[0] if len(agreeing) == 1 else None


def _fit(corners: CornerPoints, level: Array, used: Flags, pixel_std: float) -> RigidFit | None:
    A = _inverse(corners.per_pixel)
    if not used.all():
        return rigid_fit(corners.Q[used], level[used, :2], A[used], 2.5 * pixel_std)
    return rigid_fit(corners.Q, level[:, :2], A, 2.5 * pixel_std)


def _inverse(D: Array) -> Array:
    """Return the inverse of 2x2 matrices, (n, 2, 2)."""
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
    """Return the covariance of (x, y, yaw), pool frame, from independent errors of pixels and from errors of
    height, tilt and a shared shift, which move all corners.

    With the residual e_i = Q_i - P_i, a shared error δ moves the solution by -H^-1 sum_i J_i' w_i A_i de_i/dδ.
    """
    slope, level = corners.per_height[used], level[used]
    cp, sp = math.cos(constraints.pitch), math.sin(constraints.pitch)
    # Cross products with the axes of roll, R_y e1 = (cp, 0, -sp), and pitch, e2: R_g p -> axis x R_g p, side by side.
    turned = (
        level
        @ np.array(
            [[0.0, -sp, 0.0, 0.0, 0.0, -1.0], [sp, 0.0, cp, 0.0, 0.0, 0.0], [0.0, -cp, 0.0, 1.0, 0.0, 0.0]]
        )
    ).reshape(-1, 2, 3)
    x, y, _ = (tilt_matrix(constraints.roll, constraints.pitch) @ constraints.port).tolist()
    raised = np.array([1.0, -cp * y, x, 0.0, 0.0])  # dz_b
    turn = about_up(fit.xi[2])[:2, :2]
    shared = np.empty((5, len(slope), 2))
    shared[0] = slope
    shared[1:3] = (
        slope[:, None] * (turned[:, :, 2] + raised[1:3])[:, :, None] - turned[:, :, :2] @ turn.T
    ).transpose(1, 0, 2)
    shared[3:] = corners.per_pixel[used].transpose(2, 0, 1)
    moved = np.empty((4, 5))  # rows x, y, psi, z_b; columns height, roll, pitch, u, v
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


def _tags(pairs: Correspondences, used: Flags) -> tuple[int, ...]:
    return tuple(tag for i, tag in enumerate(pairs.tags) if used[4 * i : 4 * i + 4].any())


def _medium(in_air: Flags) -> str:
    return "air" if in_air.all() else "both" if in_air.any() else "water"
