"""Calibration from pictures: lens, camera pose and water plane, tags on the vehicle, mounts of its sensors."""

from typing import TYPE_CHECKING

from finssim.core.lazy import exports

if TYPE_CHECKING:
    from finssim.survey.boards import Board, BoardView
    from finssim.survey.camera_fit import calibrate_camera

__all__ = [
    "Board",
    "BoardView",
    "calibrate_camera",
]

__getattr__, __dir__ = exports(__name__)
