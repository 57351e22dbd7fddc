"""Sizes and speeds of a task for a vehicle: lengths and speeds that are the published ones for the paper's vehicle."""

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
"""Terminal speed of FinsROV's slowest direction, heave [m/s]: the published speeds are a part of it."""

ACCELERATION, TURNING = 1.0, 20.0
"""Largest acceleration that an agent may ask for [m/s², rad/s²]: somewhat more than FinsROV's limits give it, 0.45 to
0.72 m/s² and 8 to 17 rad/s²."""

MASS = 12.11
"""FinsROV's [kg]."""


@dataclass(frozen=True)
class TaskScaling:
    """Factors on what a task is for FinsROV."""

    size: float = 1.0
    """Factor on lengths."""
    pace: float = 1.0
    """Factor on speeds and accelerations."""
    weight: float = 1.0
    """Factor on masses and stiffnesses."""

    def pool(self) -> RectangularPool:
        """The paper's pool, in proportion, with walls as stiff for the vehicle as they are for FinsROV."""
        length, width, depth = (self.size * side for side in POOL)
        return RectangularPool(
            length=length,
            width=width,
            depth=depth,
            stiffness=4000.0 * self.weight,
            damping=100.0 * self.weight,
        )


def authority(vehicle: Vehicle) -> Array:
    """Return the share of each wrench limit that an agent's action of 1 means, (6,), up to 1.

    What accelerates the vehicle, added mass included, by `ACCELERATION` times its `room`, or turns it by `TURNING`: all
    of FinsROV's limits, and a fifth of those of a vehicle that is five times as strong for its mass. With all of them
    gains are learnt that ring on estimates, which lag.
    """
    limits = np.asarray(vehicle.wrench_limits)
    limit = np.array([ACCELERATION * room(vehicle.body.size)] * 3 + [TURNING] * 3)
    inertia = axis_model(vehicle, coefficients_of(vehicle)).inertia
    return np.asarray(np.minimum(1.0, np.divide(limit * inertia, limits, out=np.ones(6), where=limits > 0.0)))


def driven_axes(vehicle: Vehicle) -> tuple[int, ...]:
    """Return which of surge, sway and heave the thrusters control."""
    names = ("surge", "sway", "heave")
    limits = vehicle.wrench_limits
    return tuple(i for i, name in enumerate(names) if limits[i] > 0.0 and name in vehicle.controlled_axes)


def fit(vehicle: Vehicle) -> TaskScaling:
    """Room in proportion to the vehicle's length, speeds in proportion to the room or to what it can do, the lesser."""
    size = room(vehicle.body.size)
    speeds = terminal_speeds(vehicle, coefficients_of(vehicle))[list(driven_axes(vehicle))]
    slowest = float(speeds.min()) if len(speeds) else 0.0
    return TaskScaling(size, min(size, slowest / SLOWEST_SPEED), max(1.0, float(vehicle.body.mass) / MASS))


@dataclass(frozen=True, kw_only=True)
class FittedTask(Task):
    """Base of the tasks in the paper's pool: as large and as fast as suits the vehicle."""

    needs: ClassVar[tuple[str, ...]] = ("surge", "sway", "heave")

    fit: TaskScaling = TaskScaling()
    """Factors of the vehicle; the environment sets them."""
    tilt: float = math.radians(20.0)
    """Largest roll and pitch at the start [rad]."""
    ceiling: float = 0.3
    """Rising above this height ends the episode [m]."""
    training_noise: MeasurementNoise = TRAINING

    def fitted(self, vehicles: Sequence[Vehicle]) -> FittedTask:
        """Return the task in the size and speed that suit the vehicle."""
        return replace(self, fit=fit(vehicles[0]))

    def arena(self) -> RectangularPool:
        """See `TaskScaling.pool`."""
        return self.fit.pool()


@dataclass(frozen=True, kw_only=True)
class PoolTask(FittedTask):
    """Base of those that start anywhere in the pool."""

    spawn_low: tuple[float, float, float] = (-1.4, -0.6, -0.80)
    """The vehicle starts in this box, with any heading [m]."""
    spawn_high: tuple[float, float, float] = (1.4, 0.6, -0.20)
    """Opposite corner of this box [m]."""
    bounds: tuple[float, float] = (2.5, 1.5)
    """Leaving |x|, |y| beyond these ends the episode [m]."""
    depth: float = 1.5
    """So does sinking below this depth [m]."""
