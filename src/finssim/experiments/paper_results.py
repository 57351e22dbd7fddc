"""The paper's own results on its real vehicle, of T1 and T2: for orientation beside simulated ones."""

from __future__ import annotations

from types import MappingProxyType
from typing import Any

__all__ = ["PAPER_T1", "PAPER_T2", "paper_row", "paper_t2_row"]

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
