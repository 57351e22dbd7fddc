"""Rays through a planar interface: projection of points, back-projection of pixels, and the derivatives of
both."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property

import numpy as np
import numpy.typing as npt

from finssim.core.optics.interface import Interface
from finssim.core.optics.lens import Camera, OpticsError

# Reasons why a pixel has no ray in the water, or a point has no pixel.

StatusArray = npt.NDArray[np.int8]


class Status(IntEnum):
    """Status of a pixel or a point; the numbers are valid for OK and OUTSIDE_IMAGE, and NaN otherwise."""

    OK = 0
    NO_RAY = 1
    """The lens has no ray for the pixel, or no pixel for the ray: it lies beyond the one-to-one range of the
    distortion."""
    PARALLEL = 2
    """The ray is parallel to the plane."""
    TOTAL_REFLECTION = 3
    """The ray is totally reflected at a face."""
    AWAY = 4
    """The ray points away from the plane."""
    BEHIND_CAMERA = 5
    """The light arrives from behind the camera."""
    WRONG_SIDE = 6
    """The point is not on the far side of the interface, or the camera not on the near side."""
    OUTSIDE_IMAGE = 7
    """The pixel, which is returned, lies outside the image."""


def count_rejections(status: npt.ArrayLike) -> dict[str, int]:
    """Count the statuses other than OK by name; those that do not occur are omitted."""
    counts = np.bincount(np.ravel(np.asarray(status, int)), minlength=len(Status))
    return {Status(i).name: int(n) for i, n in enumerate(counts) if n and i != Status.OK}


# From points behind an interface to pixels, by solving Snell's law.

# The ray between two points across a stack of plane-parallel layers.
#
# Snell's law conserves n_i sin(theta_i) along the ray. With u = tan(theta) in the medium of least index n_m and
# a_i = n_i/n_m, layer i of thickness t_i shifts the ray sideways by t_i u / s_i, s_i = sqrt(a_i² + (a_i² - 1) u²). The
# ray with the total shift r follows from g = u/r:
#
#     phi(g) = sum_i t_i g / s_i - 1 = 0
#
# phi is increasing and concave for g >= 0, so Newton's method converges monotonically from any start left of the root,
# for any indices; as only r² occurs, there is no singularity at r = 0.

_STEPS = 100
_THINNEST = 1e-15
"""Least thickness of a layer [m]: at zero thickness the angle of a grazing ray would be undefined."""


@dataclass(frozen=True, eq=False)
class LayerRays:
    """Solution of Snell's law: thicknesses, indices, and the ray through the layers."""

    thickness: list[Array | float]
    """Thickness t_i of each layer [m], (...) each."""
    index: list[float]
    r2: Array
    """Squared lateral distance [m²], (...)."""
    g: Array
    """u/r [1/m], (...)."""

    @property
    def near_slope(self) -> Array:
        """Return k_0 = tan(theta)/r next to the camera [1/m], (...)."""
        return self.g if self.index[0] == min(self.index) else self.g / self._s(self.index[0])

    def _s(self, index: float) -> Array:
        a2 = (index / min(self.index)) ** 2
        return np.asarray(np.sqrt(a2 + (a2 - 1.0) * self.r2 * self.g**2))

    def derivatives(self) -> StackDerivatives:
        """Return the derivatives of k_0, the slope next to the camera (implicit function theorem).

        With P = sin(theta_i) n_i/r, the same in all layers, c_i = n_i cos(theta_i): k_i = P/c_i and
        sum t_i k_i = 1.
        """
        omega = np.sqrt(1.0 + self.r2 * self.g * self.g)
        P = self.g * (min(self.index) / omega)
        c = [self._s(n) * (min(self.index) / omega) for n in self.index]
        thin = [t / (x * x * x) for t, x in zip(self.thickness, c, strict=True)]  # t_i/c_i³
        by_P = sum(t * n**2 for t, n in zip(thin, self.index, strict=True))
        half = 0.5 * P * P * P
        steep = 1.0 / (c[0] * c[0] * c[0])
        towards = -(self.index[0] ** 2) * steep / by_P
        return StackDerivatives(
            k=self.near_slope,
            by_r2=half * (steep + towards * sum(thin)),
            by_near=towards * P / c[0],
            by_far=towards * P / c[-1],
            by_far_index=-towards * thin[-1] * P * self.index[-1],
        )


@dataclass(frozen=True, eq=False)
class StackDerivatives:
    """Slope k = tan(theta)/r next to the camera, and its derivatives, (...) each."""

    k: Array
    """tan(theta)/r next to the camera [1/m]."""
    by_r2: Array
    """Derivative with respect to r² [1/m³]."""
    by_near: Array
    """Derivative with respect to the camera's distance from the interface [1/m²]."""
    by_far: Array
    """Derivative with respect to the point's distance from the far face [1/m²]."""
    by_far_index: Array
    """Derivative with respect to the refractive index beyond the far face [1/m]."""


def solve_stack(r2: Array, thickness: Sequence[Array | float], index: list[float]) -> LayerRays:
    """Find the ray that crosses all layers with the total lateral shift r.

    Args:
        r2: Squared lateral distance [m²], (...).
        thickness: Thickness of each layer, from the camera to the point [m], (...) each or one number; negative values
            count as zero.
        index: Refractive index of each layer.
    """
    least = min(index)
    layers = [max(t, _THINNEST) if isinstance(t, float) else np.maximum(t, _THINNEST) for t in thickness]
    square = [(n / least) ** 2 for n in index]
    thin = sum(t for t, a2 in zip(layers, square, strict=True) if a2 == 1.0)
    denser = [(t, a2, (a2 - 1.0) * r2) for t, a2 in zip(layers, square, strict=True) if a2 != 1.0]
    # Small-angle start: phi is concave, so the step from zero ends left of the root.
    g = lowest = 1.0 / (thin + sum(t / math.sqrt(a2) for t, a2, _ in denser) + 0.0 * r2)
    for _ in range(_STEPS if denser else 0):
        g2 = g * g
        moved, slope = thin, thin
        for t, a2, b in denser:
            s2 = a2 + b * g2
            part = t / np.sqrt(s2)
            moved = moved + part
            slope = slope + part * (a2 / s2)
        step = (moved * g - 1.0) / slope
        g = np.maximum(g - step, lowest)
        # The error after a step is at most 1.5 times its square: further steps would not reduce it.
        if not (np.abs(step) > 3e-8 * g).any():
            break
    return LayerRays(layers, index, r2, g)


Array = npt.NDArray[np.float64]

_ON_THE_FACE = -1e-9
"""Largest distance of a point on the wrong side of the far face that still counts as on the face [m]."""


@dataclass(frozen=True, eq=False)
class Projection:
    """Image points of points under water."""

    pixels: Array
    """Pixels (..., 2), NaN where the status is neither OK nor OUTSIDE_IMAGE."""
    status: StatusArray
    """Status of each point, (...)."""


@dataclass(frozen=True, eq=False)
class Refraction:
    """Rays from a camera to points, before their projection by the lens."""

    across: Array
    """Point minus camera, without its component along the normal, pool frame [m], (..., 3)."""
    height: float
    """Distance of the camera from the near face [m]."""
    stack: LayerRays
    slope: Array
    """k: tangent of the incidence angle over |across| [1/m], (...)."""
    direction: Array
    """Direction from the camera to the surface, pool frame, (..., 3); its component along the unit normal is
    -1."""
    right_side: npt.NDArray[np.bool_]
    """True if camera and point are on the correct sides of the interface, (...)."""


def refract(camera: Camera, interface: Interface, points_p: Array) -> Refraction:
    """Solve Snell's law from the camera to each point (..., 3) [m], pool frame."""
    n = interface.normal
    height = float(n @ camera.position) + interface.offset
    between = points_p - camera.position
    along = between @ n
    across = between - along[..., None] * n
    thickness = interface.thickness
    depth = -along - (height + thickness)
    right_side = (depth >= _ON_THE_FACE) & (height >= 0.0)
    stack = solve_stack(
        np.einsum("...i,...i", across, across),
        [height, *(layer.thickness for layer in interface.window), depth],
        [interface.index_near, *(layer.index for layer in interface.window), interface.index_far],
    )
    slope = stack.near_slope
    return Refraction(across, height, stack, slope, slope[..., None] * across - n, right_side)


def project(camera: Camera, interface: Interface, points_p: npt.ArrayLike) -> Projection:
    """Return the pixels of points on the far side of the interface.

    Args:
        camera: Camera on the near side.
        interface: Interface with or without a window.
        points_p: Points in the pool frame [m], (..., 3), on the far side or on the far face.

    Returns:
        Pixels with a status each: pixels are NaN for WRONG_SIDE, BEHIND_CAMERA and NO_RAY, but not for OUTSIDE_IMAGE.
    """
    with np.errstate(all="ignore"):
        return refracted_pixels(camera, refract(camera, interface, np.asarray(points_p, float)))


def refracted_pixels(camera: Camera, refraction: Refraction) -> Projection:
    """Return the pixels of rays that are already computed."""
    with np.errstate(all="ignore"):
        direction_c = refraction.direction @ camera.R_pc
        pixels, visible = camera.lens.project(direction_c)
        inside = camera.lens.inside(pixels)
        if inside.all() and refraction.right_side.all():
            return Projection(pixels, np.zeros(inside.shape, np.int8))
        status = np.where(inside, np.int8(Status.OK), np.int8(Status.OUTSIDE_IMAGE))
        behind = np.where(direction_c[..., 2] <= 0.0, np.int8(Status.BEHIND_CAMERA), np.int8(Status.NO_RAY))
        status = np.where(visible, status, behind)
        status = np.asarray(np.where(refraction.right_side, status, np.int8(Status.WRONG_SIDE)), np.int8)
    pixels[status == Status.WRONG_SIDE] = np.nan
    return Projection(pixels, status)


# From pixels to rays in the water, and to points on a plane (paper, eq. 7-12).

PARALLEL_COSINE = 1e-6
"""Angle below which a ray counts as parallel to a plane [rad]."""
_BEHIND = -1e-9
"""Smallest distance along a ray [m] that still counts as an intersection: points may lie on the interface
itself."""


@dataclass(frozen=True, eq=False)
class WaterRays:
    """Rays X(lambda) = S_p + lambda r_p on the far side; NaN where the status is not OK."""

    origin: Array
    """S_p: point at which the ray leaves the far face, pool frame [m], (..., 3)."""
    direction: Array
    """r_p: unit vector away from the camera, pool frame, (..., 3)."""
    status: StatusArray
    """Status of each ray, (...)."""

    def at_z(self, z: npt.ArrayLike) -> tuple[Array, StatusArray]:
        """Return the intersections of the rays with a horizontal plane (paper, eq. 12).

        Args:
            z: Height of the plane, pool frame [m], one for all rays or (...).

        Returns:
            Points, pool frame [m], (..., 3), NaN where the status (...) is not OK.
        """
        height = np.asarray(z, float)
        with np.errstate(all="ignore"):
            length = (height - self.origin[..., 2]) / self.direction[..., 2]
            points, status = self._at(length, self.direction[..., 2])
            points[..., 2] = np.where(status == 0, height, np.nan)  # exact, without rounding
        return points, status

    def at_plane(self, normal: npt.ArrayLike, offset: npt.ArrayLike) -> tuple[Array, StatusArray]:
        """Return the intersections of the rays with a plane normal . X + offset = 0.

        Args:
            normal: Normal of any length [-], pool frame, (3,) or (..., 3).
            offset: Offset [m], times the length of the normal, scalar or (...).

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
        reason = np.where(np.abs(towards) > PARALLEL_COSINE, np.int8(Status.AWAY), np.int8(Status.PARALLEL))
        status = np.where((self.status == 0) & ~good, reason, self.status).astype(np.int8)
        points[status != 0] = np.nan
        return points, status


def back_project(camera: Camera, interface: Interface, pixels: npt.ArrayLike) -> WaterRays:
    """Return the rays on the far side of the interface that belong to pixels (paper, eq. 7-11).

    Args:
        camera: Camera on the near side.
        interface: Interface with or without a window; each layer refracts the ray.
        pixels: Distorted pixels, as detected, (..., 2).

    Returns:
        Rays with a status each: rays are NaN for NO_RAY, PARALLEL, TOTAL_REFLECTION and AWAY.
    """
    rays_c, valid = camera.lens.rays(pixels)
    n = interface.normal
    height = float(n @ camera.position) + interface.offset
    with np.errstate(all="ignore"):
        ray = rays_c @ camera.R_pc.T  # eq. 7
        cosine = -(ray @ n)
        sine2 = 1.0 - cosine * cosine
        along = ray + cosine[..., None] * n
        reach = height / cosine  # eq. 8: s; the component along the plane is s times `along`
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
        status = _rejected(valid, cosine, worst, height)
    bad = status != 0
    origin[bad] = direction[bad] = np.nan
    return WaterRays(origin, direction, status)


def _rejected(valid: npt.NDArray[np.bool_], cosine: Array, kappa: Array, height: float) -> StatusArray:
    status = np.where(kappa > 0.0, np.int8(Status.OK), np.int8(Status.TOTAL_REFLECTION))
    status = np.where((cosine < 0.0) | (height < 0.0), np.int8(Status.AWAY), status)
    status = np.where(np.abs(cosine) <= PARALLEL_COSINE, np.int8(Status.PARALLEL), status)
    return np.asarray(np.where(valid, status, np.int8(Status.NO_RAY)), np.int8)


# Derivatives of `project` and `back_project`, by the implicit function theorem.


def projection_jacobians(camera: Camera, interface: Interface, points_p: npt.ArrayLike) -> Jacobians:
    """Return the derivatives of the pixels of points, (..., 3) [m] in the pool frame, with respect to all
    parameters."""
    return Jacobians(camera, interface, np.asarray(points_p, float))


class Jacobians:
    """Derivatives of the pixels of points, computed on access; meaningless where a point is not visible.

    The ray leaves the camera along v = k rho - n, where rho is the point minus the camera without its component along
    the normal n, and k(rho², camera's distance h, point's distance d, indices) solves Snell's law.
    """

    def __init__(self, camera: Camera, interface: Interface, points_p: Array) -> None:
        self._camera, self._interface, self._points = camera, interface, points_p
        with np.errstate(all="ignore"):
            self._found = refraction = refract(camera, interface, points_p)
            self._direction, self._rho = refraction.direction, refraction.across
            self._direction_c = refraction.direction @ camera.R_pc
            self._change = refraction.stack.derivatives()
            self._by_v = camera.lens.project_jacobian(self._direction_c) @ camera.R_pc.T
            self._by_k = (self._by_v @ refraction.across[..., None])[..., 0]

    @cached_property
    def projection(self) -> Projection:
        """Return the result of `project`, from the rays that are already computed."""
        return refracted_pixels(self._camera, self._found)

    @cached_property
    def point(self) -> Array:
        """Return the derivative with respect to the point, pool frame [px/m], (..., 2, 3)."""
        with np.errstate(all="ignore"):
            aside = self._outward - self._change.by_far[..., None] * self._interface.normal
            return self._by_k[..., None] * aside[..., None, :] + self._flat

    @cached_property
    def pose(self) -> Array:
        """Return the derivative with respect to C_p [px/m] and a rotation delta of the camera about pool axes, R_pc <-
        exp([delta]x) R_pc [px/rad], (..., 2, 6)."""
        with np.errstate(all="ignore"):
            out = np.empty((*self._by_v.shape[:-1], 6))
            aside = self._change.by_near[..., None] * self._interface.normal - self._outward
            out[..., :3] = self._by_k[..., None] * aside[..., None, :] - self._flat
            out[..., 3:] = _cross(self._by_v, self._direction[..., None, :])
            return out

    @cached_property
    def interface(self) -> Array:
        """Return the derivative with respect to tilt_x, tilt_y (n <- n + tilt_x e1 + tilt_y e2, with
        `Interface.tangents`) [px/rad] and the offset b [px/m], (..., 2, 3)."""
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
        """Return the derivative with respect to index_far [px], (..., 2)."""
        with np.errstate(all="ignore"):
            return np.asarray(self._by_k * self._change.by_far_index[..., None])

    @cached_property
    def lens(self) -> Array:
        """Return the derivative with respect to fx, fy, cx, cy and the distortion coefficients, (..., 2, 4 + k).

        Each is in pixels per unit of the number.
        """
        return self._camera.lens.parameter_jacobian(self._direction_c)

    @cached_property
    def _outward(self) -> Array:
        """Return dk/d(rho), (..., 3)."""
        return np.asarray((2.0 * self._change.by_r2)[..., None] * self._rho)

    @cached_property
    def _flat(self) -> Array:
        """Return the derivative of the pixel with respect to rho at constant k, (..., 2, 3)."""
        n = self._interface.normal
        return np.asarray(self._change.k[..., None, None] * (self._by_v - (self._by_v @ n)[..., None] * n))


def plane_jacobian(
    camera: Camera, interface: Interface, points_p: npt.ArrayLike, normal: npt.ArrayLike
) -> Array:
    """Return the derivatives of the point at which a pixel's ray meets a plane, with respect to the pixel and
    the plane.

    Pixel and plane determine the point, so this is the inverse of their derivatives with respect to the point.

    Args:
        points_p: Points on the plane, from back-projection, pool frame [m], (..., 3).
        normal: Normal of the plane, of any length [-], pool frame, (3,).

    Returns:
        dX/d(u, v, shift), (..., 3, 3) [m/px, m/px, m/m]; the shift moves the plane along its normal. NaN
        where the point is NaN or the plane is seen edge on.

    Raises:
        OpticsError: The normal is zero or not finite.
    """
    n = np.asarray(normal, float)
    size = float(np.linalg.norm(n))
    if not (np.isfinite(size) and size > 0.0):
        raise OpticsError(f"plane has normal {n}, expected a direction")
    by_point = projection_jacobians(camera, interface, points_p).point
    # The inverse by cross products of its rows: NaN instead of an exception where it is singular.
    a, b, c = by_point[..., 0, :], by_point[..., 1, :], n / size
    out = np.empty((*by_point.shape[:-2], 3, 3))
    out[..., 0], out[..., 1], out[..., 2] = _cross(b, c), _cross(c, a), _cross(a, b)
    with np.errstate(all="ignore"):
        determinant = np.einsum("...i,...i", a, out[..., 0])[..., None, None]
        return np.where(determinant != 0.0, out / determinant, np.nan)


def _cross(a: Array, b: Array) -> Array:
    """Return a x b, as numpy.cross, which takes several times longer for a few vectors."""
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[..., i] = a[..., j] * b[..., k] - a[..., k] * b[..., j]
    return out
