"""From pixels to rays in the water, and to points on a plane (paper, eq. 7-12)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from finssim.geometry.optics.camera import Camera
from finssim.geometry.optics.errors import OpticsError
from finssim.geometry.optics.interface import Interface
from finssim.geometry.optics.status import Status, StatusArray

__all__ = ["PARALLEL_COSINE", "WaterRays", "back_project"]

Array = npt.NDArray[np.float64]

PARALLEL_COSINE = 1e-6
"""A ray is parallel to a plane when it makes less than this angle with it [rad]."""
_BEHIND = -1e-9
"""A plane this little behind the start of a ray [m] still counts as met: points may lie on the interface itself."""


@dataclass(frozen=True, eq=False)
class WaterRays:
    """Rays X(lambda) = S_p + lambda r_p on the far side; NaN where the status is not OK."""

    origin: Array
    """S_p: where the ray leaves the far face, pool frame [m], (..., 3)."""
    direction: Array
    """r_p: unit vector away from the camera, pool frame, (..., 3)."""
    status: StatusArray
    """(...)"""

    def at_z(self, z: npt.ArrayLike) -> tuple[Array, StatusArray]:
        """Where the rays meet a horizontal plane (paper, eq. 12).

        Args:
            z: Height of the plane, pool frame [m], one for all or (...).

        Returns:
            Points, pool frame [m], (..., 3), NaN where the status (...) is not OK.
        """
        height = np.asarray(z, float)
        with np.errstate(all="ignore"):
            length = (height - self.origin[..., 2]) / self.direction[..., 2]
            points, status = self._at(length, self.direction[..., 2])
            points[..., 2] = np.where(status == 0, height, np.nan)  # exactly, not but for rounding
        return points, status

    def at_plane(self, normal: npt.ArrayLike, offset: npt.ArrayLike) -> tuple[Array, StatusArray]:
        """Where the rays meet a plane normal . X + offset = 0.

        Args:
            normal: Of any length [-], pool frame, (3,) or (..., 3).
            offset: [m], times the length of the normal, scalar or (...).

        Returns:
            Points, pool frame [m], (..., 3), NaN where the status (...) is not OK.

        Raises:
            OpticsError: The normal is zero or not finite.
        """
        n = np.asarray(normal, float)
        size = np.linalg.norm(n, axis=-1)
        if not (np.isfinite(size).all() and (size > 0.0).all()):
            raise OpticsError(f"plane has normal {n}, expected a direction")
        with np.errstate(all="ignore"):
            towards = np.sum(n * self.direction, axis=-1) / size
            length = -(np.sum(n * self.origin, axis=-1) + np.asarray(offset, float)) / size / towards
            return self._at(length, towards)

    def _at(self, length: Array, towards: Array) -> tuple[Array, StatusArray]:
        points = self.origin + length[..., None] * self.direction
        good = (length >= _BEHIND) & (np.abs(towards) > PARALLEL_COSINE)
        shape = good.shape
        if good.all():
            return points, np.broadcast_to(self.status, shape).copy()
        why = np.where(np.abs(towards) > PARALLEL_COSINE, np.int8(Status.AWAY), np.int8(Status.PARALLEL))
        status = np.where((self.status == 0) & ~good, why, self.status).astype(np.int8)
        points[status != 0] = np.nan
        return points, status


def back_project(camera: Camera, interface: Interface, pixels: npt.ArrayLike) -> WaterRays:
    """The rays on the far side of the interface that pixels see (paper, eq. 7-11).

    Args:
        camera: On the near side.
        interface: With or without a window; each layer bends the ray in its turn.
        pixels: (..., 2), distorted, as the detector found them.

    Returns:
        Rays with a status each: NO_RAY, PARALLEL, TOTAL_REFLECTION and AWAY have none.
    """
    rays_c, seen = camera.lens.rays(pixels)
    n = interface.normal
    height = float(n @ camera.position) + interface.offset
    with np.errstate(all="ignore"):
        ray = rays_c @ camera.R_pc.T  # eq. 7
        cosine = -(ray @ n)
        sine2 = 1.0 - cosine * cosine
        along = ray + cosine[..., None] * n
        reach = height / cosine  # eq. 8: s; its part along the plane is s times `along`
        worst: Array | float = np.inf
        depth = height
        for layer in interface.window:
            eta = interface.index_near / layer.index
            kappa = 1.0 - eta * eta * sine2
            worst = np.minimum(worst, kappa)
            reach = reach + layer.thickness * eta / np.sqrt(kappa)
            depth += layer.thickness
        eta = interface.index_near / interface.index_far
        kappa = 1.0 - eta * eta * sine2  # eq. 9
        direction = eta * along - np.sqrt(kappa)[..., None] * n
        origin = camera.position + reach[..., None] * along - depth * n
        worst = np.minimum(worst, kappa)
        good = (cosine > PARALLEL_COSINE) & (worst > 0.0)
        if height >= 0.0 and good.all():
            return WaterRays(origin, direction, np.zeros(cosine.shape, np.int8))
        status = _rejected(seen, cosine, worst, height)
    bad = status != 0
    origin[bad] = direction[bad] = np.nan
    return WaterRays(origin, direction, status)


def _rejected(seen: npt.NDArray[np.bool_], cosine: Array, kappa: Array, height: float) -> StatusArray:
    status = np.where(kappa > 0.0, np.int8(Status.OK), np.int8(Status.TOTAL_REFLECTION))
    status = np.where((cosine < 0.0) | (height < 0.0), np.int8(Status.AWAY), status)
    status = np.where(np.abs(cosine) <= PARALLEL_COSINE, np.int8(Status.PARALLEL), status)
    return np.asarray(np.where(seen, status, np.int8(Status.NO_RAY)), np.int8)
