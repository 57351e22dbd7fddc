"""The limits of a bridge: from the safety section of a vehicle file, or changed one by one."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from finssim.vehicles import Vehicle

__all__ = ["BridgeError", "BridgeSettings"]

Array = npt.NDArray[np.float64]

FULL_RANGE = 0.1
"""Time from full reverse to full forward where the vehicle file gives no slew limit of the thrust [s]."""


class BridgeError(ValueError):
    """A bridge was set up with limits it cannot keep: the message says which and what to give."""


@dataclass(frozen=True, kw_only=True)
class BridgeSettings:
    """Limits that stop the thrusters. Make them with `of`; `math.inf` switches a watchdog off."""

    slew: Array
    """Fastest change of each thrust, canonical order [N/s], (n,)."""
    command_timeout: float = 0.5
    """Longest silence of the commander [s]."""
    telemetry_timeout: float = 0.5
    """Longest silence of the motor controller [s]."""
    state_timeout: float = 0.5
    """Oldest reading to act on [s]."""
    frozen_limit: float = 0.3
    """Longest time that gyro or accelerometer may repeat its numbers to the last bit [s]."""
    max_tilt: float = math.inf
    """[rad]"""
    max_tilt_duration: float = 1.0
    """Longest time above `max_tilt` [s]."""
    workspace_lower: Array
    """Lower corner of the allowed box, world frame [m], (3,)."""
    workspace_upper: Array
    """Upper corner [m], (3,)."""
    workspace_margin: float = 0.1
    """Thrust may only push inwards this near to a face, on either side; further outside is a fault [m]."""
    hold_limit: float = 5.0
    """Longest hold before it becomes a fault, unless the operator asked for it [s]."""
    clock_step: float = 1.0
    """Longest step of the clock forward between two calls [s]."""
    reject_limit: float = 0.5
    """Longest time that the motor controller may refuse every command, or not hear any [s]."""
    need_reading: bool = True
    """Whether the estimator must be ready; False lets an operator drive without localization."""
    vision_modes: tuple[str, ...] = ("fresh", "coast")
    """Modes of vision in which a reading may be acted on."""

    def __post_init__(self) -> None:
        for name in DURATIONS:
            if not getattr(self, name) > 0.0:
                raise BridgeError(f"{name} is {getattr(self, name)}, expected a number above 0")
        if not self.workspace_margin >= 0.0:
            raise BridgeError(f"workspace_margin is {self.workspace_margin}, expected 0 m or more")
        if np.shape(self.workspace_lower) != (3,) or np.shape(self.workspace_upper) != (3,):
            raise BridgeError("workspace_lower and workspace_upper must be points of three numbers [m]")
        if not np.less(self.workspace_lower, self.workspace_upper).all():
            raise BridgeError("workspace_lower must be below workspace_upper on every axis")
        if np.ndim(self.slew) != 1 or not np.greater(self.slew, 0.0).all():
            raise BridgeError("slew must be one rate above 0 N/s per thruster")

    @classmethod
    def of(cls, vehicle: Vehicle, **changes: Any) -> BridgeSettings:
        """Limits of a vehicle's `safety` section.

        Args:
            vehicle: Its `safety` section and the slew limits of its thrusters are read.
            changes: Fields by name that shall differ.

        Raises:
            BridgeError: A limit that cannot be kept, or no field of that name.
        """
        known = {field.name for field in fields(cls)}
        if not changes.keys() <= known:
            unknown = sorted(changes.keys() - known)
            raise BridgeError(
                f"no bridge setting {', '.join(unknown)}; available: {', '.join(sorted(known))}"
            )
        own: dict[str, Any] = {"slew": _slew(vehicle)}
        own.update({name: getattr(vehicle.safety, name) for name in FROM_FILE})
        return replace(cls(**own), **changes) if changes else cls(**own)


FROM_FILE = (
    "command_timeout",
    "telemetry_timeout",
    "state_timeout",
    "max_tilt",
    "max_tilt_duration",
    "workspace_lower",
    "workspace_upper",
)
"""Fields that the safety section of a vehicle file gives under the same name."""
DURATIONS = (
    "command_timeout",
    "telemetry_timeout",
    "state_timeout",
    "frozen_limit",
    "max_tilt",
    "hold_limit",
    "clock_step",
    "reject_limit",
)


def _slew(vehicle: Vehicle) -> Array:
    """Fastest change of each thrust [N/s], (n,): the file's own where it limits thrust, else from range and time."""
    lower, upper = vehicle.force_limits
    own = np.array([t.slew if t.domain == "force" else math.inf for t in vehicle.thrusters.values()])
    return np.where(np.isfinite(own), own, (upper - lower) / FULL_RANGE)
