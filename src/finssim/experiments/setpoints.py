"""The eight pre-registered setpoints of station keeping (T1), and the pose every trial starts from, in our frames."""

from __future__ import annotations

import math
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from finssim.vehicles import Vehicle
from finssim.vehicles.defaults import room

__all__ = ["T1_PUBLISHED", "T1_SETPOINTS", "T1_START", "from_published", "in_room"]

T1_PUBLISHED = MappingProxyType(
    {
        "P01": (1.0, -0.5, 0.3, 0.0),
        "P02": (1.0, -0.5, -0.3, -90.0),
        "P03": (-1.0, -0.5, -0.3, 90.0),
        "P04": (-1.0, -0.5, 0.3, 180.0),
        "P05": (1.0, -0.8, 0.3, 0.0),
        "P06": (
            1.0,
            -0.8,
            -0.3,
            0.0,
        ),  # yaw as in the hardware trials; the published simulation list says -90
        "P07": (-1.0, -0.8, -0.3, 90.0),
        "P08": (-1.0, -0.8, 0.3, 180.0),
    }
)
"""Name -> (x, y, z [m], yaw [deg]) as published: controller frame, x forward, y up from the surface, z left."""


def from_published(setpoint: tuple[float, float, float, float]) -> NDArray[np.float64]:
    """A setpoint of the paper's controller frame in our world frame.

    The controller frame is our world with y and z exchanged, p_c = B p, det B = -1. Positions follow B. Angles turn as
    axial vectors do, omega_c = det(B) B omega = [-omega_x, -omega_z, -omega_y]: a yaw about the controller's y has the
    opposite sign of ours about z, so its +90 deg is a turn to the right, our -90 deg.

    Args:
        setpoint: (x, y up, z left [m], yaw [deg]) in the controller frame.

    Returns:
        [x, y left, z up [m], yaw in (-pi, pi] [rad]] in the world frame, z = 0 at the surface, shape (4,).
    """
    x, up, left, yaw_deg = setpoint
    yaw = -math.radians(yaw_deg)
    return np.array([x, left, up, math.pi if yaw == -math.pi else yaw])


T1_SETPOINTS = MappingProxyType({name: from_published(setpoint) for name, setpoint in T1_PUBLISHED.items()})
"""Name -> [x, y, z [m], yaw [rad]], world frame."""

T1_START = from_published((0.0, -0.5, 0.0, 0.0))
"""Pose at the start of every trial [x, y, z [m], yaw [rad]], world frame, at rest and level."""


def in_room(pose: NDArray[np.float64], vehicle: Vehicle) -> NDArray[np.float64]:
    """A published pose [x, y, z [m], yaw [rad]] in the pool that this vehicle needs: places grow with it, yaw stays."""
    size = room(vehicle.body.size)
    return pose * np.array([size, size, size, 1.0])
