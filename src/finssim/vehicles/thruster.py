"""One thruster of a vehicle file."""

from __future__ import annotations

import math
from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from finssim.vehicles.esc import Esc
from finssim.vehicles.part import (
    Axis,
    Negative,
    NonNegative,
    NonPositive,
    Part,
    Positive,
    Vector3,
    VehicleError,
)

Array = NDArray[np.float64]


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
    esc: Esc | None = None
    """Speed controller, for vehicles that log or take pulse widths."""

    def thrust(self, shaft_speed: ArrayLike) -> Array:
        """Steady thrust T = c± ω|ω| [N] (paper, eq. 16), positive along `axis`.

        Args:
            shaft_speed: ω [rad/s], (...,).

        Returns:
            (...,); force and speed limits and the dead zone do not enter.
        """
        omega = np.asarray(shaft_speed, dtype=np.float64)
        return np.where(omega >= 0.0, self.c_plus, self.c_minus) * omega * np.abs(omega)

    def speed(self, force: ArrayLike) -> Array:
        """Shaft speed [rad/s] whose steady thrust is `force`: the inverse of `thrust`.

        Args:
            force: Along `axis`, body frame [N], (...,).
        """
        wanted = np.asarray(force, dtype=np.float64)
        c = np.where(wanted >= 0.0, self.c_plus, self.c_minus)
        return np.sign(wanted) * np.sqrt(np.abs(wanted) / c)

    def shaft_speed(self, pulse_us: ArrayLike, voltage: ArrayLike | None = None) -> Array:
        """Steady shaft speed at a pulse width; where `motor_sign` is -1, small pulses are positive thrust.

        Args:
            pulse_us: [µs], (...,).
            voltage: Of the battery [V], (...,), broadcast with the other; that of the ESC's numbers where not given.

        Returns:
            [rad/s], (...,), positive for positive thrust.

        Raises:
            VehicleError: The vehicle file gives this thruster no `esc`.
        """
        esc = self._need_esc()
        pulse = np.asarray(pulse_us, dtype=np.float64)
        mirrored = np.where(pulse <= 0.0, pulse, 2.0 * esc.pulse_neutral - pulse)
        return esc.shaft_speed(mirrored if self.motor_sign == -1 else pulse, voltage)

    def pulse(self, shaft_speed: ArrayLike, voltage: ArrayLike | None = None) -> Array:
        """Pulse width [µs] that makes a steady shaft speed: the inverse of `shaft_speed`.

        Args:
            shaft_speed: [rad/s], (...,), positive for positive thrust.
            voltage: Of the battery [V], (...,), broadcast with the other; that of the ESC's numbers where not given.

        Raises:
            VehicleError: The vehicle file gives this thruster no `esc`.
        """
        esc = self._need_esc()
        pulse = esc.pulse(shaft_speed, voltage)
        return 2.0 * esc.pulse_neutral - pulse if self.motor_sign == -1 else pulse

    def _need_esc(self) -> Esc:
        if self.esc is None:
            raise VehicleError(
                "this thruster has no 'esc' section, so pulse widths cannot become shaft speeds: fit one with "
                "'finssim calibrate thruster', or give shaft speeds or thrusts instead"
            )
        return self.esc
