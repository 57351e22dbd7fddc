"""How far a body turned between two times, from its attitude and from a gyro."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.motion.smoothing import longest_step
from finssim.geometry.rotations import quat_conjugate, quat_from_rotvec, quat_multiply, quat_to_rotvec

__all__ = ["Attitude", "Gyro", "TurnPairs", "turn_pairs"]

Array = NDArray[np.float64]

THIN = 0.1
"""Least time between the starts of two windows [s]: denser ones tell the same."""


@dataclass(frozen=True, kw_only=True)
class Attitude:
    """Attitude of the body as something other than the IMU saw it."""

    t: Array
    """Increasing [s], (n,)."""
    quaternion: Array
    """Body to an upright frame that does not turn, xyzw, (n, 4)."""


@dataclass(frozen=True, kw_only=True)
class Gyro:
    """Angular rate in the sensor's own axes."""

    t: Array
    """Increasing [s], (m,)."""
    rate: Array
    """[rad/s], (m, 3)."""

    def turn(self, start: Array, end: Array) -> Array:
        """Sensor axes at `end` to sensor axes at `start`, xyzw, (k, 4); NaN outside the record and across its gaps."""
        product, gaps = self._integrated()
        first, last = self._at(start, product), self._at(end, product)
        known = (start >= self.t[0]) & (end <= self.t[-1])
        known &= np.interp(start, self.t, gaps) == np.interp(end, self.t, gaps)
        turned = quat_multiply(quat_conjugate(first), last)
        return np.where(known[:, None], turned, np.nan)

    def _integrated(self) -> tuple[Array, Array]:
        """Product of all turns up to each sample (m, 4), and the number of gaps until then (m,)."""
        dt = np.diff(self.t)[:, None]
        turns = quat_from_rotvec(0.5 * (self.rate[1:] + self.rate[:-1]) * dt)
        product = np.concatenate([[[0.0, 0.0, 0.0, 1.0]], turns])
        shift = 1
        while shift < len(product):  # running product by doubling
            product[shift:] = quat_multiply(product[:-shift], product[shift:])
            shift *= 2
        gaps = np.concatenate([[0.0], np.cumsum(dt[:, 0] > longest_step(self.t))])
        return product / np.linalg.norm(product, axis=-1, keepdims=True), gaps

    def _at(self, t: Array, product: Array) -> Array:
        k = np.clip(np.searchsorted(self.t, t, side="right") - 1, 0, len(self.t) - 2)
        part = np.clip(t - self.t[k], 0.0, None)[:, None]
        slope = (self.rate[k + 1] - self.rate[k]) / (self.t[k + 1] - self.t[k])[:, None]
        return quat_multiply(product[k], quat_from_rotvec((self.rate[k] + 0.5 * slope * part) * part))


@dataclass(frozen=True, kw_only=True)
class TurnPairs:
    """Turns of the body over many windows, and the windows, so that a gyro can be laid beside them."""

    start: Array
    """[s], (k,)."""
    end: Array
    """[s], (k,)."""
    body: Array
    """Rotation vectors, body axes [rad], (k, 3)."""

    def sensor(self, gyro: Gyro, offset: float) -> Array:
        """Rotation vectors by the gyro over the same windows, sensor axes [rad], (k, 3).

        Args:
            gyro: The gyro.
            offset: What is to be added to its times [s].
        """
        turned = gyro.turn(self.start - offset, self.end - offset)
        known = np.isfinite(turned[:, 0])
        vectors = np.full((len(turned), 3), np.nan)
        vectors[known] = quat_to_rotvec(turned[known])
        return vectors


def turn_pairs(attitude: Attitude, window: float) -> TurnPairs:
    """Turns of the body over windows of about the same length, at most ten a second.

    R_b(t) R_b(t + T)⁻¹ is the same rotation for every frame fixed to the body but for the axes it is written in, so
    that attitude and gyro are compared without a derivative (the rotation part of A X = X B; Park and Martin 1994).

    Args:
        attitude: The attitude.
        window: T [s].
    """
    t = attitude.t
    starts = np.unique(np.searchsorted(t, np.arange(t[0], t[-1] - window, THIN)))
    ends = np.searchsorted(t, t[starts] + window)
    ends = np.minimum(ends, len(t) - 1)
    earlier = np.maximum(ends - 1, 0)
    nearer = np.abs(t[earlier] - t[starts] - window) < np.abs(t[ends] - t[starts] - window)
    ends = np.where(nearer, earlier, ends)
    good = np.abs(t[ends] - t[starts] - window) < 0.25 * window
    starts, ends = starts[good], ends[good]
    q = attitude.quaternion
    body = quat_to_rotvec(quat_multiply(quat_conjugate(q[starts]), q[ends]))
    return TurnPairs(start=t[starts], end=t[ends], body=body)
