"""Derivatives of `project` and `back_project`, by the implicit function theorem."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from finssim.geometry.optics.back_projection import back_project
from finssim.geometry.optics.camera import Camera
from finssim.geometry.optics.errors import OpticsError
from finssim.geometry.optics.interface import Interface
from finssim.geometry.optics.projection import refract
from finssim.geometry.rotations import skew

__all__ = ["Jacobians", "back_project_jacobian", "plane_jacobian", "projection_jacobians"]

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Jacobians:
    """Derivatives of the pixel; meaningless where the point cannot be seen."""

    point: Array
    """With respect to the point, pool frame [px/m], (..., 2, 3)."""
    pose: Array
    """With respect to C_p [px/m] and a turn delta of the camera about pool axes, R_pc <- exp([delta]x) R_pc [px/rad],
    (..., 2, 6)."""
    interface: Array
    """With respect to tilt_x, tilt_y (n <- n + tilt_x e1 + tilt_y e2, with `Interface.tangents`) [px/rad] and the
    offset b [px/m], (..., 2, 3)."""
    index: Array
    """With respect to index_far [px], (..., 2)."""
    lens: Array
    """With respect to fx, fy, cx, cy and the distortion coefficients, (..., 2, 4 + k)."""


def projection_jacobians(camera: Camera, interface: Interface, points_p: npt.ArrayLike) -> Jacobians:
    """Derivatives of the pixels of points, (..., 3) [m] in the pool frame, with respect to all they depend on.

    The ray leaves the camera along v = k rho - n, where rho is the point minus the camera, less its part along the
    normal n, and k(rho², camera's distance h, point's distance d, indices) solves Snell's law.
    """
    points = np.asarray(points_p, float)
    with np.errstate(all="ignore"):
        found = refract(camera, interface, points)
        direction_c = found.direction @ camera.R_pc
        by_v = camera.lens.project_jacobian(direction_c) @ camera.R_pc.T
        n, rho, change = interface.normal, found.across, found.stack.derivatives()
        k, along = change.k[..., None, None], (points - camera.position) @ n
        by_k = (by_v @ rho[..., None])[..., 0]  # pixel per change of k
        flat = k * (by_v - (by_v @ n)[..., None] * n)
        outward = 2.0 * change.by_r2[..., None] * rho
        point = _outer(by_k, outward - change.by_far[..., None] * n) + flat
        centre = _outer(by_k, change.by_near[..., None] * n - outward) - flat
        turn = by_v @ skew(found.direction)
        tilts = []
        for e in interface.tangents():
            # n <- n + e: h changes by e . C, d by -e . X, rho by -(rho . e) n - along e.
            aslant = rho @ e
            dk = change.by_near * (e @ camera.position) - change.by_far * (points @ e)
            dk = dk - 2.0 * change.by_r2 * along * aslant
            across = -k[..., 0] * (aslant[..., None] * n + along[..., None] * e) - e
            tilts.append(by_k * dk[..., None] + (by_v @ across[..., None])[..., 0])
        lift = by_k * (change.by_near - change.by_far)[..., None]
        return Jacobians(
            point=point,
            pose=np.concatenate([centre, turn], axis=-1),
            interface=np.stack([*tilts, lift], axis=-1),
            index=by_k * change.by_far_index[..., None],
            lens=camera.lens.parameter_jacobian(direction_c),
        )


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
        normal: Of the plane, of any length, pool frame, (3,).

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
    points = np.asarray(points_p, float)
    rows = np.empty((*points.shape[:-1], 3, 3))
    rows[..., :2, :] = projection_jacobians(camera, interface, points).point
    rows[..., 2, :] = n / size
    # The inverse by cross products of its rows: no exception where it is singular, but NaN.
    a, b, c = rows[..., 0, :], rows[..., 1, :], rows[..., 2, :]
    columns = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=-1)
    with np.errstate(all="ignore"):
        determinant = np.sum(a * columns[..., 0], axis=-1)[..., None, None]
        return np.where(determinant != 0.0, columns / determinant, np.nan)


def _outer(a: Array, b: Array) -> Array:
    return np.asarray(a[..., :, None] * b[..., None, :])
