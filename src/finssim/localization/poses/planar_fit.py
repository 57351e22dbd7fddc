"""Position and heading from tags whose height and tilt are known (paper, eq. 12-13)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from finssim.geometry.optics import count_rejections
from finssim.localization.detection.detections import Detection
from finssim.localization.pool import Pool
from finssim.localization.poses.corner_points import CornerPoints, corner_points
from finssim.localization.poses.correspondences import Correspondences, correspondences
from finssim.localization.poses.measurement import Constraints, Measurement, axes_of_up, refused, tilt_matrix
from finssim.localization.poses.rigid_fit import RigidFit, rigid_fit

__all__ = ["planar_fit"]

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

FEWEST = 3
"""Corners without which there is no measurement."""
WORST = 4.0
"""A corner that misses its place by more than this [px], and by more than 8 standard deviations, is an outlier."""
WORST_WITHOUT_WATER = 40.0
"""The same where the water is left out, which alone may cost many pixels."""
_SUSPECTS = (
    "look at the tag's id, edge and mount, the depth, the tilt and the pool file",
    "the tags contradict each other: look at their ids and mounts, the depth, the tilt and the pool file",
)


def planar_fit(
    detections: Iterable[Detection],
    pool: Pool,
    tags_b: Mapping[int, Array],
    constraints: Constraints | None,
    pixel_std: float = 0.5,
    *,
    straight: bool = False,
) -> Measurement:
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
        return refused(method, pairs.why_too_few, pairs.rejected)
    if constraints is None:
        return refused(method, "height and tilt are not known: give a depth", pairs.rejected, tags=pairs.tags)
    R_pg = _frame_of(constraints.up)
    level = pairs.points_b @ tilt_matrix(constraints.roll, constraints.pitch).T
    seen = corner_points(pool, R_pg, pairs.pixels, constraints.z_b + level[:, 2], straight=straight)
    limit = max(WORST_WITHOUT_WATER if straight else WORST, 8.0 * pixel_std)
    solved = _solve(seen, level, pixel_std, limit, len(pairs.tags))
    rejected = {**pairs.rejected, **solved.rejected}
    fit = solved.fit
    if fit is None:
        return refused(method, solved.reason, rejected, tags=pairs.tags)
    return Measurement(
        method,
        True,
        "",
        R_pg @ np.array([fit.xi[0], fit.xi[1], constraints.z_b]),
        R_pg @ _about_up(fit.xi[2]) @ tilt_matrix(constraints.roll, constraints.pitch),
        _covariance(fit, seen, level, solved.used, constraints, R_pg, pixel_std),
        fit.rms,
        _tags(pairs, solved.used),
        int(solved.used.sum()),
        rejected,
        fit.iterations,
        _medium(seen.in_air[solved.used]) if not straight else "",
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


def _solve(seen: CornerPoints, level: Array, pixel_std: float, limit: float, tags: int) -> _Solved:
    """Fit the corners that have a point, once more without those that miss by far."""
    used = seen.status == 0
    rejected = {} if used.all() else _reasons(seen)
    if used.sum() < FEWEST:
        words = ", ".join(f"{n} {name}" for name, n in rejected.items())
        return _Solved(
            None, used, rejected, f"fewer than {FEWEST} corners have a ray to their height ({words})"
        )
    fit = _fit(seen, level, used, pixel_std)
    if fit is not None and fit.missed.max() > limit:
        far = fit.missed > limit
        few = 2 * int(far.sum()) < len(far) and len(far) - int(far.sum()) >= FEWEST
        kept = _without(used, far) if few else _without_a_tag(seen, level, used, pixel_std, limit, tags)
        if kept is None:
            words = f"{int(far.sum())} of {len(far)} corners miss by more than {limit:.1f} px"
            return _Solved(None, used, rejected, f"residual too large: {words}: {_SUSPECTS[tags > 1]}")
        rejected["outlier" if few else "contradicting tag"] = int(used.sum() - kept.sum())
        used = kept
        fit = _fit(seen, level, used, pixel_std)
    if fit is None:
        return _Solved(None, used, rejected, "the corners lie too close together to tell the heading")
    if not fit.converged:
        return _Solved(None, used, rejected, f"did not converge in {fit.iterations} steps")
    if fit.missed.max() > limit:
        return _Solved(None, used, rejected, f"residual too large: {fit.rms:.1f} px even without outliers")
    return _Solved(fit, used, rejected)


def _reasons(seen: CornerPoints) -> dict[str, int]:
    return {name.lower().replace("_", " "): n for name, n in count_rejections(seen.status).items()}


def _without(used: Flags, far: Flags) -> Flags:
    kept = used.copy()
    kept[np.flatnonzero(used)[far]] = False
    return kept


def _without_a_tag(
    seen: CornerPoints, level: Array, used: Flags, pixel_std: float, limit: float, tags: int
) -> Flags | None:
    """The corners without one tag, if they agree then, and do so for that tag only."""
    agreeing = []
    for i in range(tags if tags > 1 else 0):
        kept = used.copy()
        kept[4 * i : 4 * i + 4] = False
        fit = _fit(seen, level, kept, pixel_std) if FEWEST <= kept.sum() < used.sum() else None
        if fit is not None and fit.converged and fit.missed.max() <= limit:
            agreeing.append(kept)
    return agreeing[0] if len(agreeing) == 1 else None


def _fit(seen: CornerPoints, level: Array, used: Flags, pixel_std: float) -> RigidFit | None:
    A = _inverse(seen.per_pixel)
    if not used.all():
        return rigid_fit(seen.Q[used], level[used, :2], A[used], 2.5 * pixel_std)
    return rigid_fit(seen.Q, level[:, :2], A, 2.5 * pixel_std)


def _inverse(D: Array) -> Array:
    """Inverse of 2x2 matrices, (n, 2, 2)."""
    out = np.empty_like(D)
    out[:, 0, 0], out[:, 1, 1], out[:, 0, 1], out[:, 1, 0] = D[:, 1, 1], D[:, 0, 0], -D[:, 0, 1], -D[:, 1, 0]
    with np.errstate(all="ignore"):
        return out / (D[:, 0, 0] * D[:, 1, 1] - D[:, 0, 1] * D[:, 1, 0])[:, None, None]


def _covariance(
    fit: RigidFit,
    seen: CornerPoints,
    level: Array,
    used: Flags,
    constraints: Constraints,
    R_pg: Array,
    pixel_std: float,
) -> Array:
    """Covariance of (x, y, yaw), pool frame: pixels, each for itself; height and tilt, which move all corners at once.

    With the miss e_i = Q_i - P_i, an error δ that all share moves the solution by -H^-1 sum_i J_i' w_i A_i de_i/dδ.
    """
    slope, level = seen.per_height[used], level[used]
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
    shared[3:] = seen.per_pixel[used].transpose(2, 0, 1)
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
