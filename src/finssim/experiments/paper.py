"""What the paper has: its eight setpoints and the start of T1 in our frames, and its results on its real vehicle."""

from __future__ import annotations

import math
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.vehicles import Vehicle
from finssim.vehicles.defaults import room

__all__ = ["PAPER_T2", "T1_SETPOINTS", "T1_START", "in_room", "paper_row", "paper_t2_row"]

T1_PUBLISHED = MappingProxyType(
    {
        "P01": (1.0, -0.5, 0.3, 0.0),
        "P02": (1.0, -0.5, -0.3, -90.0),
        "P03": (-1.0, -0.5, -0.3, 90.0),
        "P04": (-1.0, -0.5, 0.3, 180.0),
        "P05": (1.0, -0.8, 0.3, 0.0),
        # Yaw as in the hardware trials; the published simulation list says -90.
        "P06": (1.0, -0.8, -0.3, 0.0),
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


KEYS = ("e_p_m", "e_y_m", "e_psi_deg", "success", "trials", "t_s_s", "J_p_m", "J_psi_deg")

PAPER_T1 = MappingProxyType(
    {
        "calibrated": (0.077, 0.027, 6.54, 7, 8, 20.16, 0.032, 2.35),
        "calibrated + DR": (0.092, 0.043, 5.42, 7, 8, 36.92, 0.034, 2.06),
        "calibrated, localisation noise": (0.658, 0.079, 13.53, 2, 8, 41.16, 0.025, 3.98),
        "without EKF": (0.069, 0.025, 13.48, 7, 8, 29.52, 0.035, 2.60),
        "without thruster dynamics": (0.055, 0.030, 3.82, 6, 8, 24.41, 0.034, 2.12),
        "mesh": (0.746, 0.108, 12.19, 0, 8, None, None, None),
        "mesh + DR": (0.197, 0.103, 8.62, 0, 8, None, None, None),
        "simplified": (0.598, 0.504, 23.37, 0, 8, None, None, None),
        "simplified + DR": (0.609, 0.564, 5.48, 0, 8, None, None, None),
        "PID": (0.176, 0.101, 44.08, 0, 8, None, None, None),
    }
)
"""Table of T1: the model trained in (DR: domain randomisation) -> the figures in the order of `KEYS`, on hardware."""


def paper_row(name: str) -> dict[str, Any]:
    """One row with the keys of our own results, and `name`."""
    return {"name": name, **dict(zip(KEYS, PAPER_T1[name], strict=True))}


T2_KEYS = ("horizontal_rmse_m", "vertical_rmse_m", "p95_m")

PAPER_T2 = MappingProxyType(
    {
        "calibrated + DR": {
            "straight": (0.068, 0.129, 0.409),
            "broken": (0.086, 0.084, 0.265),
            "ellipse": (0.091, 0.080, 0.366),
            "lemniscate": (0.051, 0.073, 0.134),
        },
        "calibrated": {
            "straight": (0.135, 0.139, 0.406),
            "broken": (0.136, 0.133, 0.310),
            "ellipse": (0.166, 0.102, 0.338),
            "lemniscate": (0.163, 0.103, 0.305),
        },
        "PID": {
            "straight": (0.182, 0.146, 0.405),
            "broken": (0.196, 0.152, 0.426),
            "ellipse": (0.174, 0.134, 0.433),
            "lemniscate": (0.207, 0.170, 0.514),
        },
    }
)
"""Table of T2: controller -> trajectory -> horizontal RMSE, vertical RMSE and 95th percentile of the distance [m]."""


def paper_t2_row(name: str, trajectory: str) -> dict[str, Any]:
    """One controller on one trajectory, with the keys of our own results."""
    return dict(zip(T2_KEYS, PAPER_T2[name][trajectory], strict=True))
