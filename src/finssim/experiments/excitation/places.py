"""Where in its water a programme begins, and how far it may go, so that no wall, floor or surface is met."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.excitation.programmes import Programme
from finssim.pool.plant_spec import Basin
from finssim.vehicles import AXES, Vehicle
from finssim.vehicles.defaults import room

__all__ = ["Box", "Place", "box_of", "place_of"]

Box = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Lower and upper corner of the water that a vehicle may be in, world frame [m]."""

Array = NDArray[np.float64]

WALL, SURFACE, FLOOR = 0.35, 0.15, 0.12
"""Water kept between the vehicle's envelope and these at the ends of a run [m]; these three grow with `room`."""
STOPPING = {"surge": 0.35, "sway": 0.3, "heave": 0.06}
"""Of the way, kept for the coast after an excitation [m]."""
LEAST_ROOM = 0.15
"""Way on which nothing can be learnt [m]."""


@dataclass(frozen=True)
class Place:
    """Where a programme begins."""

    position: tuple[float, float, float]
    """Body origin, world frame [m]."""
    yaw: float
    """[rad]"""
    room: float | None
    """Way after which the excitation ends [m]; None where it goes nowhere."""


def box_of(where: Basin | Vehicle) -> Box:
    """The water of a basin, or the workspace of a vehicle, which is taken for walls."""
    if isinstance(where, Basin):
        half = 0.5 * where.length, 0.5 * where.width
        return (-half[0], -half[1], -where.depth), (*half, 0.0)
    lower, upper = where.safety.workspace_lower, where.safety.workspace_upper
    return tuple(map(float, lower)), tuple(map(float, upper))  # type: ignore[return-value]


def place_of(programme: Programme, vehicle: Vehicle, box: Box) -> Place:
    """The start of a programme: its way then lies in the middle of the water, surge and sway along x.

    One that goes both ways begins in the middle itself, and has half of the way to either side.

    Args:
        programme: On one axis; several at once begin in the middle.
        vehicle: Whose envelope keeps off the walls.
        box: The water.

    Raises:
        CalibrationError: The water has no room for it.
    """
    (x0, y0, z0), (x1, y1, z1) = box
    length, width, height = vehicle.body.size
    scale = room(vehicle.body.size)
    top, bottom = z1 - 0.5 * height - scale * SURFACE, z0 + 0.5 * height + scale * FLOOR
    x, y, z = 0.5 * (x0 + x1), 0.5 * (y0 + y1), 0.5 * (top + bottom)
    if len(programme.axes) != 1 or programme.axes[0] in ("roll", "pitch", "yaw"):
        return Place((x, y, z), 0.0, 0.5 * (y1 - y0) - 0.5 * math.hypot(length, width))
    axis = programme.axes[0]
    sign = _sign(programme)
    if axis == "heave":
        way = top - bottom
        start = Place(
            (x, y, z - 0.5 * sign * way), 0.0, way * (1.0 if sign else 0.5) - scale * STOPPING[axis]
        )
    else:
        half = 0.5 * (x1 - x0) - 0.5 * (length if axis == "surge" else width) - scale * WALL
        # Heading along x for surge; across it for sway, so that its left is where x falls.
        ahead = 1.0 if axis == "surge" else -1.0
        yaw = 0.0 if axis == "surge" else 0.5 * math.pi
        start = Place(
            (x - sign * ahead * half, y, z), yaw, half * (2.0 if sign else 1.0) - scale * STOPPING[axis]
        )
    if start.room is None or not start.room >= LEAST_ROOM:
        raise CalibrationError(
            f"{programme.name}: the pool leaves {start.room or 0.0:.2f} m to go along {axis}, expected {LEAST_ROOM} m "
            "or more: use a larger pool"
        )
    return start


def _sign(programme: Programme) -> float:
    """Direction in which a programme goes along its only axis; 0 where it goes both ways."""
    column = programme.tau_desired[:, AXES.index(programme.axes[0])]
    return float(column.max() > 0.0) - float(column.min() < 0.0)
