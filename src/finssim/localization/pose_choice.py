"""Which of several poses that explain a picture is the vehicle's."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from finssim.localization.correspondences import Correspondences
from finssim.localization.measurement import Constraints, Measurement, axes_of_up, tilt_matrix
from finssim.localization.pose_refinement import RefinedPose, See, refine_pose

__all__ = ["choose", "measured", "minima_from"]

Array = npt.NDArray[np.float64]


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


def choose(
    minima: list[RefinedPose], constraints: Constraints | None, pixel_std: float
) -> tuple[RefinedPose, float]:
    """The best of the minima, and by how much chi² the next one is worse (infinite where there is none).

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
    gap = float(scored[order[1]] - scored[order[0]]) if len(minima) > 1 else np.inf
    return minima[int(order[0])], gap


def measured(method: str, pose: RefinedPose, pairs: Correspondences, pixel_std: float) -> Measurement:
    """The measurement that a pose is."""
    whole = pose.covariance(pixel_std)
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
    turned = float(np.arccos(np.clip(0.5 * (np.trace(a.rotation.T @ b.rotation) - 1.0), -1.0, 1.0)))
    return turned > 0.01 or float(np.linalg.norm(a.position - b.position)) > 0.005
