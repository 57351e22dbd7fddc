"""Scaling of a task's lengths and speeds to a vehicle; those of the paper's vehicle are the published ones."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from finssim.control.axis_model import axis_model
from finssim.sim import RectangularPool
from finssim.tasks.measurement import TRAINING, MeasurementNoise
from finssim.tasks.task import Task
from finssim.vehicles import Vehicle
from finssim.vehicles.capability import coefficients_of, terminal_speeds
from finssim.vehicles.defaults import POOL, room

Array = NDArray[np.float64]

SLOWEST_SPEED = 0.22
"""Terminal speed of FinsROV in heave, its slowest direction [m/s]: reference of the published speeds."""

ACCELERATION, TURNING = 1.0, 20.0
"""Largest acceleration that an agent can command [m/s², rad/s²]: slightly more than FinsROV's limits allow, 0.45 to
0.72 m/s² and 8 to 17 rad/s²."""

MASS = 12.11
"""Mass of FinsROV [kg]."""


@dataclass(frozen=True)
class TaskScaling:
    """Factors on a task's dimensions relative to FinsROV."""

    size: float = 1.0
    """Factor on lengths."""
    pace: float = 1.0
    """Factor on speeds and accelerations."""
    weight: float = 1.0
    """Factor on masses and stiffnesses."""

    def pool(self) -> RectangularPool:
        """Return the paper's pool, scaled, with walls of the same relative stiffness as for FinsROV."""
        length, width, depth = (self.size * side for side in POOL)
        return RectangularPool(
            length=length,
            width=width,
            depth=depth,
            stiffness=4000.0 * self.weight,
            damping=100.0 * self.weight,
        )


def authority(vehicle: Vehicle) -> Array:
    """Return the fraction of each wrench limit that corresponds to an action of 1, (6,), at most 1.

    It is the wrench that accelerates the vehicle, with added mass, by `ACCELERATION` times its `room`, or rotates it by
    `TURNING`: all of FinsROV's limits, and a fifth of the limits of a vehicle that is five times as strong for its
    mass. With the full limits, policies learn gains that oscillate on delayed estimates.
    """
    limits = np.asarray(vehicle.wrench_limits)
    limit = np.array([ACCELERATION * room(vehicle.body.size)] * 3 + [TURNING] * 3)
    inertia = axis_model(vehicle, coefficients_of(vehicle)).inertia
    return np.asarray(np.minimum(1.0, np.divide(limit * inertia, limits, out=np.ones(6), where=limits > 0.0)))


def driven_axes(vehicle: Vehicle) -> tuple[int, ...]:
    """Return the indices of surge, sway and heave that the thrusters control."""
    names = ("surge", "sway", "heave")
    limits = vehicle.wrench_limits
    return tuple(i for i, name in enumerate(names) if limits[i] > 0.0 and name in vehicle.controlled_axes)


def fit(vehicle: Vehicle) -> TaskScaling:
    """Return the scaling of a task: lengths by the vehicle's length, speeds by that or by its terminal speed, the
    lesser."""
    size = room(vehicle.body.size)
    speeds = terminal_speeds(vehicle, coefficients_of(vehicle))[list(driven_axes(vehicle))]
    slowest = float(speeds.min()) if len(speeds) else 0.0
    return TaskScaling(size, min(size, slowest / SLOWEST_SPEED), max(1.0, float(vehicle.body.mass) / MASS))


@dataclass(frozen=True, kw_only=True)
class FittedTask(Task):
    """Base class of the tasks in the paper's pool, with lengths and speeds scaled to the vehicle."""

    needs: ClassVar[tuple[str, ...]] = ("surge", "sway", "heave")

    fit: TaskScaling = TaskScaling()
    """Scaling factors for the vehicle; the environment sets them."""
    tilt: float = math.radians(20.0)
    """Largest roll and pitch at the start [rad]."""
    ceiling: float = 0.3
    """Height above which the episode ends [m]."""
    training_noise: MeasurementNoise = TRAINING

    def fitted(self, vehicles: Sequence[Vehicle]) -> FittedTask:
        """Return the task with lengths and speeds scaled to the vehicle."""
        return replace(self, fit=fit(vehicles[0]))

    def arena(self) -> RectangularPool:
        """Return the pool; see `TaskScaling.pool`."""
        return self.fit.pool()


@dataclass(frozen=True, kw_only=True)
class PoolTask(FittedTask):
    """Base class of the tasks that start at a random position in the pool."""

    spawn_low: tuple[float, float, float] = (-1.4, -0.6, -0.80)
    """Corner of the box in which the vehicle starts, with any heading [m]."""
    spawn_high: tuple[float, float, float] = (1.4, 0.6, -0.20)
    """Opposite corner of this box [m]."""
    bounds: tuple[float, float] = (2.5, 1.5)
    """Limits of |x| and |y| beyond which the episode ends [m]."""
    depth: float = 1.5
    """Depth below which the episode ends [m]."""
