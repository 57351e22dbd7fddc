"""A pose with all six degrees of freedom that puts a body's points where the pixels are."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from finssim.geometry.rotations import quat_from_rotvec, quat_to_matrix, skew

__all__ = ["RefinedPose", "See", "refine_pose"]

Array = npt.NDArray[np.float64]

See = Callable[[Array], tuple[Array, Array, npt.NDArray[np.bool_]]]
"""Points, pool frame (n, 3) -> pixels (n, 2), derivatives by the point (n, 2, 3), and which are seen (n,)."""

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
    cost: float
    """Sum of Huber's rho over the points [px²]."""
    missed: Array
    """Distance of each point from its pixel [px], (n,)."""
    H: Array
    """Weighted J'J with respect to position and a turn about pool axes, (6, 6)."""
    iterations: int
    converged: bool

    @property
    def rms(self) -> float:
        """Root mean square of `missed` [px]."""
        return math.sqrt(float(self.missed @ self.missed) / len(self.missed))

    @property
    def yaw_by_turn(self) -> Array:
        """Derivative of yaw by a turn about pool axes, (3,)."""
        x, y, z = self.rotation[:, 0]
        return np.asarray(np.array([-x * z, -y * z, x * x + y * y]) / (x * x + y * y))

    def covariance(self, pixel_std: float) -> Array:
        """Of position and a turn about pool axes, (6, 6), enlarged where the misses exceed the noise by far."""
        dof = max(2 * len(self.missed) - 6, 1)
        k = 2.0 / (9.0 * dof)
        quantile = dof * (1.0 - k + 2.326 * math.sqrt(k)) ** 3
        factor = max(1.0, float(self.missed @ self.missed) / pixel_std**2 / quantile)
        scale = 1.0 / np.sqrt(np.diagonal(self.H))
        inverse = np.linalg.pinv(self.H * scale[:, None] * scale, hermitian=True) * scale[:, None] * scale
        return np.asarray(inverse * (pixel_std**2 * factor))


def refine_pose(
    see: See,
    points_b: Array,
    pixels: Array,
    position: Array,
    rotation: Array,
    huber: float,
    *,
    most_steps: int = 50,
) -> RefinedPose | None:
    """Levenberg and Marquardt's method on the reprojection error, with analytic Jacobians and Huber's rho.

    The damping follows Nielsen (1999), "Damping parameter in Marquardt's method".

    Args:
        see: Where points appear.
        points_b: Body frame [m], (n, 3).
        pixels: (n, 2).
        position: t_pb to start from [m], (3,).
        rotation: R_pb to start from, (3, 3).
        huber: Distance [px] from which on Huber's rho grows linearly.
        most_steps: Give up after so many.

    Returns:
        The minimum, or None where the start cannot be seen.
    """
    now = _evaluate(see, points_b, pixels, position, rotation, huber)
    if now is None:
        return None
    damping, growth, converged, steps = 1e-3, 2.0, False, 0
    while steps < most_steps and not converged and damping < 1e12:
        steps += 1
        D = damping * np.maximum(np.diagonal(now.H), 1e-12)
        step = np.linalg.solve(now.H + np.diag(D), -now.g)
        promised = float(-(step @ now.g) + step @ (D * step))
        converged = promised < max(_STILL, _STILL_SHARE * now.cost)
        turn = quat_to_matrix(quat_from_rotvec(step[3:]))
        then = _evaluate(see, points_b, pixels, position + step[:3], turn @ rotation, huber)
        gain = -1.0 if then is None else (now.cost - then.cost) / max(promised, 1e-300)
        if then is not None and gain >= 0.0:
            position, rotation, now = position + step[:3], turn @ rotation, then
            # Nielsen's rule: the damping stays where steps keep half of what they promise, in flat valleys.
            damping, growth = max(damping * max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3), 1e-12), 2.0
        else:
            damping, growth = damping * growth, 2.0 * growth
    return RefinedPose(position, rotation, now.cost, now.missed, now.H, steps, converged)


@dataclass(frozen=True, eq=False)
class _State:
    cost: float
    H: Array
    g: Array
    missed: Array


def _evaluate(
    see: See, points_b: Array, pixels: Array, position: Array, rotation: Array, huber: float
) -> _State | None:
    arms = points_b @ rotation.T
    found, by_point, seen = see(arms + position)
    if not seen.all():
        return None
    miss = found - pixels
    missed = np.sqrt(np.sum(miss * miss, axis=1))
    weight = np.where(missed > huber, huber / np.maximum(missed, huber), 1.0)
    rho = np.where(missed > huber, huber * (2.0 * missed - huber), missed * missed)
    J = np.concatenate([by_point, -by_point @ skew(arms)], axis=-1)
    weighted = (weight[:, None, None] * J).reshape(-1, 6)
    return _State(float(rho.sum()), weighted.T @ J.reshape(-1, 6), weighted.T @ miss.ravel(), missed)
