"""From points behind an interface to pixels, by solving Snell's law."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from finssim.geometry.optics.camera import Camera
from finssim.geometry.optics.interface import Interface
from finssim.geometry.optics.snell import Stack, solve_stack
from finssim.geometry.optics.status import Status, StatusArray

__all__ = ["Projection", "Refraction", "project", "refract", "seen_at"]

Array = npt.NDArray[np.float64]

_ON_THE_FACE = -1e-9
"""A point this little on the wrong side of the far face [m] lies on it."""


@dataclass(frozen=True, eq=False)
class Projection:
    """Where points appear."""

    pixels: Array
    """(..., 2), NaN where the status is neither OK nor OUTSIDE_IMAGE."""
    status: StatusArray
    """(...)"""
    surface_p: Array
    """Where the ray crosses the near face, pool frame [m], (..., 3); NaN for WRONG_SIDE."""


@dataclass(frozen=True, eq=False)
class Refraction:
    """The rays from a camera to points, before they meet the lens."""

    across: Array
    """Point minus camera, without its part along the normal, pool frame [m], (..., 3)."""
    height: float
    """Distance of the camera from the near face [m]."""
    stack: Stack
    slope: Array
    """k: tangent of the incidence angle over |across| [1/m], (...)."""
    direction: Array
    """From the camera to the surface, pool frame, (..., 3); its part along the normal is -1."""
    right_side: npt.NDArray[np.bool_]
    """Whether camera and point lie on their sides, (...)."""


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
    """Pixels at which points on the far side of the interface appear.

    Args:
        camera: On the near side.
        interface: With or without a window.
        points_p: Pool frame [m], (..., 3), on the far side or on the far face itself.

    Returns:
        Pixels with a status each: WRONG_SIDE, BEHIND_CAMERA and NO_RAY have none, OUTSIDE_IMAGE has.
    """
    with np.errstate(all="ignore"):
        return seen_at(camera, refract(camera, interface, np.asarray(points_p, float)))


def seen_at(camera: Camera, found: Refraction) -> Projection:
    """Pixels of rays that are already found."""
    with np.errstate(all="ignore"):
        surface = camera.position + found.height * found.direction
        direction_c = found.direction @ camera.R_pc
        pixels, seen = camera.lens.project(direction_c)
        inside = camera.lens.inside(pixels)
        if inside.all() and found.right_side.all():
            return Projection(pixels, np.zeros(inside.shape, np.int8), surface)
        status = np.where(inside, np.int8(Status.OK), np.int8(Status.OUTSIDE_IMAGE))
        behind = np.where(direction_c[..., 2] <= 0.0, np.int8(Status.BEHIND_CAMERA), np.int8(Status.NO_RAY))
        status = np.where(seen, status, behind)
        status = np.asarray(np.where(found.right_side, status, np.int8(Status.WRONG_SIDE)), np.int8)
    wrong = status == Status.WRONG_SIDE
    surface[wrong] = pixels[wrong] = np.nan
    return Projection(pixels, status, surface)
