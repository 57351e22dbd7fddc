"""Rigid bodies that importers assemble: poses of their links, and combined mass and inertia."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["IDENTITY", "LinkPose", "combined", "flu_of_frd", "plain"]

Array = NDArray[np.float64]


class LinkPose(NamedTuple):
    """Pose of one frame in another."""

    turn: Array
    """Rotation from the frame to the other [-], (3, 3)."""
    place: Array
    """Origin of the frame in the other [m], (3,)."""

    def after(self, inner: LinkPose) -> LinkPose:
        """Return the composition with a pose that is given in this frame."""
        return LinkPose(self.turn @ inner.turn, self.turn @ inner.place + self.place)

    def inverse(self) -> LinkPose:
        """Return the inverse pose."""
        return LinkPose(self.turn.T, -self.turn.T @ self.place)


IDENTITY = LinkPose(np.eye(3), np.zeros(3))


def combined(
    masses: Sequence[float], centres: Sequence[Array], tensors: Sequence[Array]
) -> tuple[float, Array, Array]:
    """Return mass [kg], centre of gravity (3,) [m] and inertia about it (3, 3) [kg m²] of rigidly connected parts.

    Args:
        masses: Masses of the parts [kg].
        centres: Centres of gravity in the body frame [m], (3,) each.
        tensors: Inertias about these centres, in body axes [kg m²], (3, 3) each.
    """
    centre = np.average(centres, axis=0, weights=masses)
    total = np.zeros((3, 3))
    for m, place, tensor in zip(masses, centres, tensors, strict=True):
        r = place - centre
        total += tensor + m * (r @ r * np.eye(3) - np.outer(r, r))
    return math.fsum(masses), centre, total


def plain(value: Any) -> Any:
    """Return a number or array, in its unit, with entries set to 0 that are rounding errors relative to the
    largest."""
    array = np.asarray(value, dtype=np.float64)
    cleaned = np.where(np.abs(array) < 1e-12 * np.abs(array).max(initial=0.0), 0.0, array)
    return float(cleaned) if cleaned.ndim == 0 else cleaned


def flu_of_frd(value: Any) -> Array:
    """Return a vector (3,) or (6,), or a matrix (3, 3) or (6, 6), in axes x forward, y left, z up, in its unit.

    Args:
        value: The same in axes x forward, y right, z down, in any unit.
    """
    array = np.asarray(value, dtype=np.float64)
    turn = np.tile([1.0, -1.0, -1.0], len(array) // 3)
    return np.asarray((turn[:, None] if array.ndim == 2 else 1.0) * array * turn) + 0.0
