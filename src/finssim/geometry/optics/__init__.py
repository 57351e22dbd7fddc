"""Camera optics: lenses, planar refracting interfaces with or without a window, and both ways through them."""

from finssim.geometry.optics.back_projection import WaterRays, back_project
from finssim.geometry.optics.camera import Camera
from finssim.geometry.optics.errors import OpticsError
from finssim.geometry.optics.interface import Interface, Layer
from finssim.geometry.optics.jacobians import (
    Jacobians,
    back_project_jacobian,
    plane_jacobian,
    projection_jacobians,
)
from finssim.geometry.optics.lens import LENS_MODELS, Lens
from finssim.geometry.optics.projection import Projection, project
from finssim.geometry.optics.status import Status, count_rejections

__all__ = [
    "LENS_MODELS",
    "Camera",
    "Interface",
    "Jacobians",
    "Layer",
    "Lens",
    "OpticsError",
    "Projection",
    "Status",
    "WaterRays",
    "back_project",
    "back_project_jacobian",
    "count_rejections",
    "plane_jacobian",
    "project",
    "projection_jacobians",
]
