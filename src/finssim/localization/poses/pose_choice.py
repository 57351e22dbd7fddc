"""Which of several poses that explain a picture is the vehicle's."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from finssim.geometry.rotations import matrix_to_quat, quat_to_rotvec
from finssim.localization.poses.correspondences import Correspondences
from finssim.localization.poses.measurement import Constraints, Measurement, axes_of_up, tilt_matrix
from finssim.localization.poses.pose_refinement import RefinedPose, See, refine_pose

__all__ = ["Choice", "choose", "measured", "minima_from"]

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
