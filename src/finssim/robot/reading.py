"""State of a robot's vehicle at one time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from finssim.control.guidance import Track
from finssim.robot.messages import Picture

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Reading:
    """State of the vehicle at one time, with the attributes of a `control.guidance.Measured`."""

    time: float
    """Time on the robot's clock [s]."""
    position: Array
    """Body origin, world frame (z = 0 on the still water) [m], (3,); NaN while unknown."""
    quaternion: Array
    """Body to world, xyzw, (4,)."""
    nu: Array
    """Velocity of the body origin and angular velocity, body frame [m/s, rad/s], (6,)."""
    ready: bool
    """True if a controller may use the state."""
    mode: str = "fresh"
    """State of vision: uninitialized, fresh, coast, hold or lost."""
    reason: str = ""
    """Reason why the state is not ready; empty if it is."""
    std: Array = field(default_factory=lambda: np.full(7, np.nan))
    """Standard deviations of position [m], velocity [m/s] and yaw [rad], (7,)."""
    tracks: Mapping[str, Track] = field(default_factory=dict)
    """States of other vehicles, by name."""
    pictures: Mapping[str, Picture] = field(default_factory=dict)
    """The latest reading of each of the vehicle's own cameras, sonars and altimeters, by name."""
