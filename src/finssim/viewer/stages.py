"""The box of water that is drawn."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from finssim.vehicles import Vehicle
from finssim.worlds import World

Array = npt.NDArray[np.float64]

AROUND = 4.0
"""The viewpoint of a world, to each side [m]."""
MARGIN = 0.5
"""Around a motion that nothing bounds [m]."""


def box_of(
    vehicle: Vehicle, basin: tuple[float, float, float] | None, positions: Array
) -> tuple[Array, Array]:
    """Lower and upper corner of a pool; without one of the vehicle's workspace, or of the motion [m], (3,).

    Args:
        vehicle: Its file may bound where it moves.
        basin: Length, width and depth [m], centred on the world's z axis under z = 0.
        positions: That are to be seen, world frame [m], (k, 3).
    """
    if basin is not None:
        half = np.array([0.5 * basin[0], 0.5 * basin[1]])
        return np.array([*-half, -basin[2]]), np.array([*half, 0.0])
    if "safety" not in vehicle.defaults:
        lower = np.array(vehicle.safety.workspace_lower, float)
        upper = np.array(vehicle.safety.workspace_upper, float)
        if np.isfinite([lower, upper]).all():
            upper[2] = 0.0
            return lower, upper
    known = positions[np.isfinite(positions).all(axis=1)] if len(positions) else np.zeros((1, 3))
    lower, upper = known.min(axis=0) - MARGIN, known.max(axis=0) + MARGIN
    upper[2] = 0.0
    return lower, upper


def box_of_world(world: World) -> tuple[Array, Array]:
    """Lower and upper corner of a world: its basin, or about its viewpoint down to the seabed [m], (3,)."""
    if world.basin is not None:
        length, width, depth = world.basin.size
        return np.array([-0.5 * length, -0.5 * width, -depth]), np.array([0.5 * length, 0.5 * width, 0.0])
    x, y, z = world.viewpoint.position
    depth = 2.0 * abs(z) if world.seabed is None else world.seabed.depth
    return np.array([x - AROUND, y - AROUND, -depth]), np.array([x + AROUND, y + AROUND, 0.0])
