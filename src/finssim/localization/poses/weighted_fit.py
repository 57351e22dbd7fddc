"""All six degrees of freedom from corners, depth and tilt together, each trusted as far as it is sure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from finssim.geometry.rotations import quat_from_rotvec, quat_to_matrix, skew
from finssim.localization.detection.detections import Detection
from finssim.localization.pool import Pool
from finssim.localization.poses.bundle import through_water
from finssim.localization.poses.correspondences import correspondences
from finssim.localization.poses.measurement import Constraints, Measurement, refused, tilt_matrix
from finssim.localization.poses.planar_fit import planar_fit
from finssim.localization.poses.pose_refinement import See

__all__ = ["weighted_fit"]

Array = npt.NDArray[np.float64]

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
