"""A lens: from a direction in the optical frame to a pixel and back, with derivatives.

Optical frame: x right, y down, z along the view. Pixels: u right, v down, integer coordinates at pixel centres, as
OpenCV. All functions take a leading `...` batch.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from finssim.geometry.optics.errors import OpticsError
from finssim.geometry.optics.fisheye import Fisheye
from finssim.geometry.optics.radial_tangential import RadialTangential

__all__ = ["LENS_MODELS", "Lens"]

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

LENS_MODELS: dict[str, tuple[type[RadialTangential] | type[Fisheye], tuple[int, ...]]] = {
    "plumb_bob": (RadialTangential, (0, 4, 5)),
    "rational": (RadialTangential, (0, 8)),
    "fisheye": (Fisheye, (0, 4)),
}
"""Model -> its distortion, and how many coefficients it takes."""


@dataclass(frozen=True)
class Lens:
    """Intrinsics of a camera.

    Raises:
        OpticsError: A number is not finite, a size or focal length not positive, the model unknown, or it takes another
            number of coefficients.
    """

    width: int
    """Image width [px]."""
    height: int
    """Image height [px]."""
    fx: float
    """Focal length along u [px]."""
    fy: float
    """Focal length along v [px]."""
    cx: float
    """Principal point, u [px]."""
    cy: float
    """Principal point, v [px]."""
    model: str = "plumb_bob"
    """plumb_bob (k1 k2 p1 p2 [k3]), rational (k1 k2 p1 p2 k3 k4 k5 k6) or fisheye (k1 k2 k3 k4), as OpenCV."""
    distortion: tuple[float, ...] = ()
    """Coefficients in OpenCV's order; none for a lens without distortion."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "distortion", tuple(float(k) for k in self.distortion))
        if self.model not in LENS_MODELS:
            raise OpticsError(f"unknown lens model '{self.model}'; available: {', '.join(LENS_MODELS)}")
        counts = LENS_MODELS[self.model][1]
        if len(self.distortion) not in counts:
            expected = " or ".join(str(n) for n in counts)
            raise OpticsError(
                f"distortion has {len(self.distortion)} coefficients, expected {expected} for {self.model}"
            )
        for name in ("width", "height", "fx", "fy"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise OpticsError(f"{name} is {getattr(self, name)}, expected a positive number of pixels")
        if not all(math.isfinite(x) for x in (self.cx, self.cy, *self.distortion)):
            raise OpticsError(
                f"lens has cx {self.cx}, cy {self.cy}, distortion {self.distortion}, expected finite numbers"
            )

    @property
    def K(self) -> Array:
        """Camera matrix [px], (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def project(self, points_c: npt.ArrayLike) -> tuple[Array, Flags]:
        """Pixels of points or directions of any length.

        Args:
            points_c: Optical frame [m], (..., 3).

        Returns:
            Pixels (..., 2), and whether the lens sees the point, (...): NaN where it is behind the camera or beyond the
            range in which the distortion maps one to one. The pixel may lie outside the image.
        """
        points = np.asarray(points_c, float)
        with np.errstate(all="ignore"):
            image, ok = self._optics.project(points)
            pixels = image * self._focal + self._centre
            if not ok.all():
                pixels[~ok] = np.nan
        return pixels, ok

    def project_jacobian(self, points_c: npt.ArrayLike) -> Array:
        """Derivative of the pixel with respect to the point [px/m], (..., 2, 3)."""
        with np.errstate(all="ignore"):
            return np.asarray(self._optics.jacobian(np.asarray(points_c, float)) * self._focal[:, None])

    def parameter_jacobian(self, points_c: npt.ArrayLike) -> Array:
        """Derivative of the pixel with respect to fx, fy, cx, cy and the coefficients, (..., 2, 4 + k)."""
        points = np.asarray(points_c, float)
        with np.errstate(all="ignore"):
            image, _ = self._optics.project(points)
            out = np.zeros((*points.shape[:-1], 2, 4 + len(self.distortion)))
            out[..., 0, 0], out[..., 1, 1] = image[..., 0], image[..., 1]
            out[..., 0, 2] = out[..., 1, 3] = 1.0
            out[..., 4:] = self._optics.parameter_jacobian(points) * self._focal[:, None]
        return out

    def rays(self, pixels: npt.ArrayLike) -> tuple[Array, Flags]:
        """Directions that pixels look in.

        Args:
            pixels: (..., 2), inside the image or not.

        Returns:
            Unit rays in the optical frame (..., 3), and whether there is one, (...): NaN for a pixel that no ray within
            the one-to-one range of the distortion reaches.
        """
        with np.errstate(all="ignore"):
            rays, ok = self._optics.rays((np.asarray(pixels, float) - self._centre) / self._focal)
            if not ok.all():
                rays[~ok] = np.nan
        return rays, ok

    def inside(self, pixels: npt.ArrayLike) -> Flags:
        """Whether pixels lie within the image, half a pixel around its outer pixel centres included, (...)."""
        scaled = np.abs((np.asarray(pixels, float) - self._middle) / self._half)
        return np.asarray((scaled[..., 0] <= 1.0) & (scaled[..., 1] <= 1.0))

    @property
    def field_of_view(self) -> float:
        """Largest angle from the optical axis at which the distortion still maps one to one [rad]."""
        fold = self._optics.fold
        return fold if self.model == "fisheye" else math.atan(fold)

    @cached_property
    def _optics(self) -> RadialTangential | Fisheye:
        return LENS_MODELS[self.model][0](self.distortion)

    @cached_property
    def _focal(self) -> Array:
        return np.array([self.fx, self.fy])

    @cached_property
    def _centre(self) -> Array:
        return np.array([self.cx, self.cy])

    @cached_property
    def _middle(self) -> Array:
        return np.array([0.5 * (self.width - 1), 0.5 * (self.height - 1)])

    @cached_property
    def _half(self) -> Array:
        return np.array([0.5 * self.width, 0.5 * self.height])
