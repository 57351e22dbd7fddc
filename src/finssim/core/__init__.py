"""Rotations, frames, camera optics and hull meshes."""

from typing import TYPE_CHECKING

from finssim.core.lazy import exports

if TYPE_CHECKING:
    from finssim.core.frames import TO_FOSSEN
    from finssim.core.optics.interface import Interface, Layer
    from finssim.core.optics.lens import Camera, Lens
    from finssim.core.optics.rays import Status, back_project, project
    from finssim.core.quiet import start_warp
    from finssim.core.registry import ACTUATORS, SENSORS, TERMS
    from finssim.core.rotations import (
        matrix_to_quat,
        quat_from_euler,
        quat_inverse_rotate,
        quat_multiply,
        quat_to_matrix,
        wrap_angle,
    )

__all__ = [
    "ACTUATORS",
    "Camera",
    "Interface",
    "Layer",
    "Lens",
    "SENSORS",
    "Status",
    "TERMS",
    "TO_FOSSEN",
    "back_project",
    "matrix_to_quat",
    "project",
    "quat_from_euler",
    "quat_inverse_rotate",
    "quat_multiply",
    "quat_to_matrix",
    "start_warp",
    "wrap_angle",
]

__getattr__, __dir__ = exports(__name__)
