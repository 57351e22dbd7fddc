"""Camera optics: lenses, planar refracting interfaces with or without a window, and projection and back-projection
through them."""

from typing import TYPE_CHECKING

from finssim.core.lazy import exports

if TYPE_CHECKING:
    from finssim.core.optics.interface import Interface, Layer
    from finssim.core.optics.lens import COEFFICIENTS, LENS_MODELS, Camera, Lens, OpticsError, lens_model
    from finssim.core.optics.rays import (
        Jacobians,
        Projection,
        Status,
        WaterRays,
        back_project,
        count_rejections,
        plane_jacobian,
        project,
        projection_jacobians,
    )

__all__ = [
    "COEFFICIENTS",
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
    "count_rejections",
    "lens_model",
    "plane_jacobian",
    "project",
    "projection_jacobians",
]

__getattr__, __dir__ = exports(__name__)
