"""The box a vehicle may move in: near a face thrust may only push inwards."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from finssim.control.allocator import Allocator
from finssim.geometry.rotations import quat_to_matrix
from finssim.vehicles import Vehicle

__all__ = ["Workspace"]

Array = npt.NDArray[np.float64]

ROUNDING = 1e-3
"""Outward force that is left to the rounding of the allocation [N]."""


class Workspace:
    """A box in the world frame with a margin to both sides of each face."""

    def __init__(self, vehicle: Vehicle, lower: npt.ArrayLike, upper: npt.ArrayLike, margin: float) -> None:
        """
        Args:
            vehicle: Whose thrusters push.
            lower: Corner, world frame [m], (3,).
            upper: Opposite corner [m], (3,).
            margin: Half width of the band around each face in which thrust may only push inwards [m].
        """
        self.lower: Array = np.array(lower, float)
        self.upper: Array = np.array(upper, float)
        self.margin = margin
        self._inner = self.lower + margin, self.upper - margin
        self._outer = self.lower - margin, self.upper + margin
        self._allocator = Allocator.from_vehicle(vehicle)

    def left(self, position: Array) -> str:
        """Which face lies more than the margin behind the vehicle; "" while it is inside. World frame [m], (3,)."""
        for axis, name in enumerate("xyz"):
            if not self._outer[0][axis] <= position[axis] <= self._outer[1][axis]:
                box = f"{self.lower[axis]:g} to {self.upper[axis]:g}"
                return f"{name} is {position[axis]:.2f} m, outside {box} m by more than {self.margin:g} m"
        return ""

    def outward(self, position: Array) -> Array:
        """Direction out of the box on each axis where the vehicle is near a face, else 0: -1, 0 or 1, (3,).

        Args:
            position: World frame [m], (3,).
        """
        return (position > self._inner[1]).astype(float) - (position < self._inner[0])

    def inward_only(self, force: Array, position: Array, quaternion: Array) -> Array:
        """Thrusts without the part of their net force that pushes further out; the moment is kept.

        tau = B f,   the outward components of R tau_F are removed,   f = allocate(tau)

        Args:
            force: Canonical order, within the limits [N], (n,).
            position: World frame [m], (3,).
            quaternion: Body to world, xyzw, (4,).

        Returns:
            (n,); zeros where the thrusters cannot give the wrench without pushing out.
        """
        outward = self.outward(position)
        if not outward.any():
            return force
        R = quat_to_matrix(quaternion)
        tau = self._allocator.achieved(force)
        push = R @ tau[:3]
        out = push * outward > ROUNDING
        if not out.any():
            return force
        push[out] = 0.0
        allocated, _ = self._allocator.allocate(np.concatenate([R.T @ push, tau[3:]]))
        still = (R @ self._allocator.achieved(allocated)[:3]) * outward
        return allocated if bool((still <= ROUNDING).all()) else np.zeros_like(force)
