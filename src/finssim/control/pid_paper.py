"""The published controller of the paper's vehicle, as its configuration files state it: profile `pid-paper`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from finssim.control.errors import ControlError
from finssim.control.tracking import Goal, Measured
from finssim.geometry.frames import FROM_CONTROLLER, TO_CONTROLLER
from finssim.geometry.rotations import quat_inverse_rotate, quat_yaw, wrap_angle
from finssim.vehicles import Vehicle

__all__ = ["PAPER_PROFILE", "TRAJECTORY_PROFILE", "PaperMemory", "PaperPid", "PaperProfile"]

Array = npt.NDArray[np.float64]


class PaperProfile(NamedTuple):
    """Numbers as published: order depth, surge, sway, then yaw in degrees; a mixed system of units."""

    kp: tuple[float, float, float, float]
    ki: tuple[float, float, float, float]
    kd: tuple[float, float, float, float]
    output_limit: tuple[float, float, float, float]
    """Bound of each PID's output."""
    axis_range: tuple[float, float, float, float]
    """Divisor that turns each output into an effort in [-1, 1]: smaller is stronger."""
    integral_decay: float = 0.95
    """What a period leaves of the integral."""
    integral_limit: float = 100.0
    """Bound of the integral of the error."""
    derivative_memory: float = math.exp(-4.0)
    """What a period leaves of the filtered derivative."""
    yaw_dead_band: float = 5.0
    """Heading error that is ignored [deg]."""
    unit: float = 7.0
    """Force at an effort of one [N], and moment [N m]."""


PAPER_PROFILE = PaperProfile(
    kp=(4.0, 8.0, 8.0, 0.0006),
    ki=(0.005, 0.004, 0.004, 0.0),
    kd=(0.1, 0.5, 0.5, 0.0),
    output_limit=(250.0, 30.0, 30.0, 0.10),
    axis_range=(10.0, 20.0, 20.0, 5.0),
)
"""'Position + yaw (hardware)' of the published configuration; what it leaves out is the published core's default."""

TRAJECTORY_PROFILE = PaperProfile(
    kp=(12.0, 20.0, 20.0, 0.0),
    ki=(0.0, 0.1, 0.1, 0.0),
    kd=(1.0, 0.8, 0.8, 0.0),
    output_limit=(250.0, 30.0, 30.0, 0.10),
    axis_range=(20.0, 20.0, 20.0, 200.0),
    integral_decay=0.985,
    unit=19.8,
)
"""'Trajectory (hardware)' of the published configuration: what T2's baseline ran with; it leaves the heading alone.

An effort of one is read as all four slanted thrusters at their limit, 4 * 7 N * cos 45°: the errors in the simulator
are then 0.12 to 0.19 m, near the published 0.17 to 0.21 m; with 7 N they would be twice as large.
"""


@dataclass(frozen=True)
class PaperMemory:
    """What the controller remembers, order depth, surge, sway, yaw [m, deg]."""

    integral: Array
    """Decaying integral of the error, (..., 4)."""
    error: Array
    """Error at the last command; NaN before the first, (..., 4)."""
    derivative: Array
    """Filtered derivative of the error, (..., 4)."""


@dataclass(frozen=True, kw_only=True)
class PaperPid:
    """Three position loops in the body's axes and one heading loop, run in the paper's controller frame.

    effort = clip((kp e + ki int(e) + kd de/dt) / axis range, +-1),   wrench = effort * unit

    The published mixer is the pseudo-inverse of an idealised thruster matrix and acts on efforts; an effort of one on
    a thruster is its full thrust. So we read one unit of effort as one thruster limit of force (7 N), or of moment at
    one metre: nothing published states it outright.

    Note:
        The heading gain is per degree and the heading output is bounded by 0.10, a fiftieth of full effort: the
        published controller turns the vehicle very slowly.
    """

    reference: Array
    """Body point about which the wrench acts [m], (3,)."""
    profile: PaperProfile = PAPER_PROFILE
    unit: float = 7.0
    """Thrust at an effort of one [N]."""
    period: float = 1.0 / 60.0
    """Time between two commands [s]."""

    @classmethod
    def from_vehicle(
        cls,
        vehicle: Vehicle,
        hydrodynamics: str = "calibrated",
        period: float = 1.0 / 60.0,
        profile: PaperProfile = PAPER_PROFILE,
    ) -> PaperPid:
        """Controller of a vehicle; the published gains do not depend on its hydrodynamics.

        Args:
            vehicle: The vehicle.
            hydrodynamics: Not used.
            period: Time between two commands [s].
            profile: Published numbers.

        Raises:
            ControlError: The period is not positive.
        """
        if not period > 0.0:
            raise ControlError(f"period is {period}, expected a positive time in seconds")
        reference = np.asarray(vehicle.wrench_reference, float)
        return cls(reference=reference, period=period, profile=profile, unit=profile.unit)

    def reset(self, n: int | None = None) -> PaperMemory:
        """Memory before the first command, for one vehicle or for a batch of n."""
        shape = (4,) if n is None else (n, 4)
        return PaperMemory(np.zeros(shape), np.full(shape, np.nan), np.zeros(shape))

    def command(self, memory: PaperMemory, measured: Measured, goal: Goal) -> tuple[Array, PaperMemory]:
        """Wanted wrench about `reference`, body frame [N, N m], (..., 6), and the memory for the next command."""
        profile = self.profile
        error = self._error(measured, goal)
        integral = profile.integral_decay * memory.integral + self.period * error
        integral = np.clip(integral, -profile.integral_limit, profile.integral_limit)
        slope = np.where(np.isnan(memory.error), 0.0, (error - memory.error) / self.period)
        slope = profile.derivative_memory * memory.derivative + (1.0 - profile.derivative_memory) * slope

        output = np.array(profile.kp) * error + np.array(profile.ki) * integral + np.array(profile.kd) * slope
        output = np.clip(output, -np.array(profile.output_limit), profile.output_limit)
        depth, surge, sway, yaw = np.moveaxis(
            np.clip(output / np.array(profile.axis_range), -1.0, 1.0), -1, 0
        )
        zero = np.zeros_like(depth)
        # Controller axes: surge x, depth y (up), sway z (left); heading about y, right positive.
        effort = np.stack([surge, depth, sway, zero, yaw, zero], axis=-1)
        return FROM_CONTROLLER.twist(self.unit * effort), PaperMemory(integral, error, slope)

    def _error(self, measured: Measured, goal: Goal) -> Array:
        """Depth, surge, sway errors [m] and heading error [deg] in the controller frame, (..., 4)."""
        q = np.asarray(measured.quaternion, float)
        away = np.asarray(goal.position, float) - np.asarray(measured.position, float)
        x, y, z = np.moveaxis(TO_CONTROLLER.vector(quat_inverse_rotate(q, away)), -1, 0)
        heading = TO_CONTROLLER.yaw(wrap_angle(quat_yaw(goal.quaternion) - quat_yaw(q)))
        heading_deg = np.degrees(heading)
        heading_deg = np.where(np.abs(heading_deg) < self.profile.yaw_dead_band, 0.0, heading_deg)
        return np.stack(np.broadcast_arrays(y, x, z, heading_deg), axis=-1)
