"""One thruster of a vehicle file."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field

from finssim.vehicles.part import Axis, Negative, NonNegative, NonPositive, Part, Positive, Vector3


class Thruster(Part):
    """Where a thruster sits, its steady thrust T = c± ω|ω| (paper, eq. 16) and how it follows commands."""

    position: Vector3
    """Of the propeller disc, from the body origin, body frame [m], (3,)."""
    axis: Axis
    """Direction of the force on the vehicle for positive thrust, body frame, unit length, (3,)."""
    force_min: Negative
    """Strongest reverse thrust [N]."""
    force_max: Positive
    """Strongest forward thrust [N]."""
    c_plus: Positive
    """T = c_plus ω² for ω > 0 [N s²/rad²]."""
    c_minus: Positive
    """T = -c_minus ω² for ω < 0 [N s²/rad²]."""
    rpm_min: Negative
    """Fastest reverse shaft speed [rpm]."""
    rpm_max: Positive
    """Fastest forward shaft speed [rpm]."""
    dead_rpm_minus: NonPositive = 0.0
    """Slowest reverse speed that turns the shaft [rpm]."""
    dead_rpm_plus: NonNegative = 0.0
    """Slowest forward speed that turns the shaft [rpm]."""
    domain: Literal["force", "speed"]
    """The quantity on which lag and slew limit act: thrust [N] or shaft speed [rad/s]."""
    time_constant: Positive
    """Of the first-order lag [s]."""
    delay: NonNegative = 0.0
    """Pure delay of the command [s]."""
    slew: Positive = math.inf
    """Fastest change, N/s (`domain: force`) or rad/s² (`domain: speed`); no limit where the file gives none."""
    group: str = ""
    """Name of the `thruster_groups` entry that gave the common numbers."""
    motor_index: Annotated[int, Field(strict=True, ge=0)] | None = None
    """Output of the motor controller that drives this thruster, from 0."""
    motor_sign: Literal[-1, 1] | None = None
    """Sign between positive thrust and the controller's positive command."""
