"""Derivatives of `project` and `back_project`, by the implicit function theorem."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import numpy.typing as npt

from finssim.geometry.optics.back_projection import back_project
from finssim.geometry.optics.camera import Camera
from finssim.geometry.optics.errors import OpticsError
from finssim.geometry.optics.interface import Interface
from finssim.geometry.optics.projection import Projection, refract, seen_at

__all__ = ["Jacobians", "back_project_jacobian", "plane_jacobian", "projection_jacobians"]

Array = npt.NDArray[np.float64]


def projection_jacobians(camera: Camera, interface: Interface, points_p: npt.ArrayLike) -> Jacobians:
    """Derivatives of the pixels of points, (..., 3) [m] in the pool frame, with respect to all they depend on."""
    return Jacobians(camera, interface, np.asarray(points_p, float))


class Jacobians:
    """Derivatives of the pixels of points, each computed when it is asked for; meaningless where a point is not seen.

    The ray leaves the camera along v = k rho - n, where rho is the point minus the camera, less its part along the
    normal n, and k(rho², camera's distance h, point's distance d, indices) solves Snell's law.
    """

    def __init__(self, camera: Camera, interface: Interface, points_p: Array) -> None:
        self._camera, self._interface, self._points = camera, interface, points_p
        with np.errstate(all="ignore"):
            self._found = found = refract(camera, interface, points_p)
            self._direction, self._rho = found.direction, found.across
            self._direction_c = found.direction @ camera.R_pc
            self._change = found.stack.derivatives()
            self._by_v = camera.lens.project_jacobian(self._direction_c) @ camera.R_pc.T
            self._by_k = (self._by_v @ found.across[..., None])[..., 0]

    @cached_property
    def projection(self) -> Projection:
        """What `project` returns, from the rays that are found already."""
        return seen_at(self._camera, self._found)

    @cached_property
    def point(self) -> Array:
        """With respect to the point, pool frame [px/m], (..., 2, 3)."""
        with np.errstate(all="ignore"):
            aside = self._outward - self._change.by_far[..., None] * self._interface.normal
            return self._by_k[..., None] * aside[..., None, :] + self._flat

    @cached_property
    def pose(self) -> Array:
        """With respect to C_p [px/m] and a turn delta of the camera about pool axes, R_pc <- exp([delta]x) R_pc
        [px/rad], (..., 2, 6)."""
        with np.errstate(all="ignore"):
            out = np.empty((*self._by_v.shape[:-1], 6))
            aside = self._change.by_near[..., None] * self._interface.normal - self._outward
            out[..., :3] = self._by_k[..., None] * aside[..., None, :] - self._flat
            out[..., 3:] = _cross(self._by_v, self._direction[..., None, :])
            return out

    @cached_property
    def interface(self) -> Array:
        """With respect to tilt_x, tilt_y (n <- n + tilt_x e1 + tilt_y e2, with `Interface.tangents`) [px/rad] and the
        offset b [px/m], (..., 2, 3)."""
        n, rho, change, by_v = self._interface.normal, self._rho, self._change, self._by_v
        centre = self._camera.position
        with np.errstate(all="ignore"):
            along = (self._points - centre) @ n
            k, by_n = change.k[..., None], by_v @ n
            columns = []
            for e in self._interface.tangents():
                # n <- n + e: h changes by e . C, d by -e . X, rho by -(rho . e) n - along e.
                aslant = rho @ e
                dk = change.by_near * (e @ centre) - change.by_far * (self._points @ e)
                dk = dk - 2.0 * change.by_r2 * along * aslant
                by_e = by_v @ e
                turned = aslant[..., None] * by_n + along[..., None] * by_e
                columns.append(self._by_k * dk[..., None] - k * turned - by_e)
            columns.append(self._by_k * (change.by_near - change.by_far)[..., None])
            return np.stack(columns, axis=-1)

    @cached_property
    def index(self) -> Array:
        """With respect to index_far [px], (..., 2)."""
        with np.errstate(all="ignore"):
            return np.asarray(self._by_k * self._change.by_far_index[..., None])

    @cached_property
    def lens(self) -> Array:
        """With respect to fx, fy, cx, cy and the distortion coefficients, (..., 2, 4 + k)."""
        return self._camera.lens.parameter_jacobian(self._direction_c)

    @cached_property
    def _outward(self) -> Array:
        """dk/d(rho), (..., 3)."""
        return np.asarray((2.0 * self._change.by_r2)[..., None] * self._rho)

    @cached_property
    def _flat(self) -> Array:
        """Derivative of the pixel with respect to rho where k stays, (..., 2, 3)."""
        n = self._interface.normal
        return np.asarray(self._change.k[..., None, None] * (self._by_v - (self._by_v @ n)[..., None] * n))


def back_project_jacobian(
    camera: Camera, interface: Interface, pixels: npt.ArrayLike, z: npt.ArrayLike
) -> tuple[Array, Array]:
    """How the point that a pixel sees at height z moves with the pixel and with z.

    Args:
        pixels: (..., 2).
        z: Height of the point, pool frame [m], one for all or (...).

    Returns:
        d(x, y)/d(u, v) [m/px], (..., 2, 2), and d(x, y)/dz [-], (..., 2); NaN where the pixel sees no such point.
    """
    points, _ = back_project(camera, interface, pixels).at_z(z)
    whole = plane_jacobian(camera, interface, points, (0.0, 0.0, 1.0))
    return whole[..., :2, :2], whole[..., :2, 2]


def plane_jacobian(
    camera: Camera, interface: Interface, points_p: npt.ArrayLike, normal: npt.ArrayLike
) -> Array:
    """How the point that a pixel sees on a plane moves with the pixel and with the plane.

    Pixel and plane fix the point, so this is the inverse of the three derivatives that a point's move has on them.

    Args:
        points_p: Points on the plane, as back-projection found them, pool frame [m], (..., 3).
        normal: Of the plane, of any length [-], pool frame, (3,).

    Returns:
        dX/d(u, v, shift), (..., 3, 3) [m/px, m/px, m/m]: the shift moves the plane along its normal; NaN where the
        point is, or where the plane is seen edge on.

    Raises:
        OpticsError: The normal is zero or not finite.
    """
    n = np.asarray(normal, float)
    size = float(np.linalg.norm(n))
    if not (np.isfinite(size) and size > 0.0):
        raise OpticsError(f"plane has normal {n}, expected a direction")
    by_point = projection_jacobians(camera, interface, points_p).point
    # The inverse by cross products of its rows: no exception where it is singular, but NaN.
    a, b, c = by_point[..., 0, :], by_point[..., 1, :], n / size
    out = np.empty((*by_point.shape[:-2], 3, 3))
    out[..., 0], out[..., 1], out[..., 2] = _cross(b, c), _cross(c, a), _cross(a, b)
    with np.errstate(all="ignore"):
        determinant = np.einsum("...i,...i", a, out[..., 0])[..., None, None]
        return np.where(determinant != 0.0, out / determinant, np.nan)


def _cross(a: Array, b: Array) -> Array:
    """a x b, as numpy.cross, which takes several times longer for a few vectors."""
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[..., i] = a[..., j] * b[..., k] - a[..., k] * b[..., j]
    return out
