"""How far a programme takes a vehicle along one axis, by the damping of its file."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from finssim.vehicles import AXES, Vehicle
from finssim.vehicles.hydrodynamics import HydrodynamicSet
from finssim.vehicles.vehicle import Axis

__all__ = ["travel", "within"]

Array = NDArray[np.float64]


def travel(force: Array, rate: float, axis: Axis, vehicle: Vehicle) -> float:
    """Way from the nearest to the farthest point along one axis alone, from rest [m].

    m v_dot = force - (d1 + d2 |v|) v, of the set `calibrated` or else the first; without damping where that is a mesh.

    Args:
        force: Along the axis, body frame, held over each row [N], (n,).
        rate: Of the rows [Hz].
        axis: surge, sway or heave.
        vehicle: Whose mass and damping count.
    """
    i = AXES.index(axis)
    name = "calibrated" if "calibrated" in vehicle.hydrodynamics else next(iter(vehicle.hydrodynamics))
    chosen = vehicle.hydrodynamics[name]
    m, h = float(vehicle.mass_matrix(name)[i, i]), 1.0 / rate
    d1 = d2 = 0.0
    if isinstance(chosen, HydrodynamicSet):
        d1, d2 = float(chosen.linear_damping[i, i]), float(chosen.quadratic_damping[i, i])
    v = x = near = far = 0.0
    for f in force:
        # Implicit in the damping, so that a light and draggy vehicle does not ring.
        v = (v + h * f / m) / (1.0 + h * (d1 + d2 * abs(v)) / m)
        x += h * v
        near, far = min(near, x), max(far, x)
    return float(far - near)


def within(room: float, force: Array, rate: float, axis: Axis, vehicle: Vehicle) -> float:
    """Factor up to 1 on a force that keeps the way along one axis within a room.

    Args:
        room: Longest way [m].
        force: Along the axis, body frame, held over each row [N], (n,).
        rate: Of the rows [Hz].
        axis: surge, sway or heave.
        vehicle: Whose mass and damping count.
    """
    low, high = 0.0, 1.0
    if travel(force, rate, axis, vehicle) <= room:
        return high
    for _ in range(8):
        middle = 0.5 * (low + high)
        fits = travel(middle * force, rate, axis, vehicle) <= room
        low, high = (middle, high) if fits else (low, middle)
    return low
