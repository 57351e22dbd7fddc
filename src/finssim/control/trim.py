"""An integral in front of a policy: what a policy without memory cannot do, hold its place against a steady current.

A policy that sees only its present error needs an error to push with. Shifting the reference it is shown by the
integral of the true error makes that error vanish, with the policy and its observation as they were trained.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from finssim.control import ControlError
from finssim.control.guidance import Measured
from finssim.control.policy_description import ObservationSchema
from finssim.geometry.rotations import quat_inverse_rotate

__all__ = ["Trim"]

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Trim:
    """shift_dot = rate (p* - p) near the reference, |shift| <= limit on each axis, world frame."""

    rate: float = 0.3
    """[1/s]: slow beside the policy's own response of about a second, so that the two do not ring."""
    limit: float = 0.15
    """[m]"""
    reach: float = 0.20
    """Farther from the reference than this nothing is collected [m]: a way to go is no disturbance."""

    def __post_init__(self) -> None:
        for name, value in (("rate", self.rate), ("limit", self.limit), ("reach", self.reach)):
            if not (np.isfinite(value) and value >= 0.0):
                raise ControlError(f"trim: {name} is {value}, expected 0 or more")

    def reset(self, n: int | None = None) -> Array:
        """No shift, for one vehicle or for a batch of n."""
        return np.zeros(3 if n is None else (n, 3))

    def update(self, shift: Array, measured: Measured, goal_position: npt.ArrayLike, period: float) -> Array:
        """The shift after a control period.

        Args:
            shift: Before, world frame [m], (..., 3).
            measured: The vehicle's state.
            goal_position: Where it should be now, world frame [m], (..., 3).
            period: Time between two actions [s].
        """
        error = np.asarray(goal_position, float) - np.asarray(measured.position, float)
        near = np.linalg.norm(error, axis=-1, keepdims=True) <= self.reach
        return np.clip(shift + np.where(near, self.rate * period * error, 0.0), -self.limit, self.limit)

    def shown(
        self, observation: npt.ArrayLike, measured: Measured, shift: Array, schema: ObservationSchema
    ) -> Array:
        """The observation with every offset to the reference shifted, (..., size).

        Args:
            observation: As the task defines it.
            measured: The vehicle's state.
            shift: World frame [m], (..., 3).
            schema: Tells which of its numbers are offsets, and their scale.

        Raises:
            ControlError: It has no offset, body frame.
        """
        entries = [entry for entry in schema.entries if "offset" in entry.name and len(entry.indices) == 3]
        if not entries:
            raise ControlError("trim: the observation has no offset to shift: use it with t1 or t2")
        out = np.array(observation, dtype=float)
        body = quat_inverse_rotate(np.asarray(measured.quaternion, float), shift)
        for entry in entries:
            out[..., list(entry.indices)] += body / entry.scale
        return out
