"""From points behind an interface to pixels, by solving Snell's law."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from finssim.geometry.optics.camera import Camera
from finssim.geometry.optics.interface import Interface
from finssim.geometry.optics.status import Status, StatusArray

__all__ = ["Projection", "Refraction", "project", "refract", "seen_at", "solve_stack"]

# The ray between two points across a stack of plane-parallel layers.
#
# Snell's law keeps n_i sin(theta_i) along the ray. With u = tan(theta) in the medium of least index n_m and
# a_i = n_i/n_m, layer i of thickness t_i moves the ray sideways by t_i u / s_i, s_i = sqrt(a_i² + (a_i² - 1) u²). The
# ray that moves by r in all is found from g = u/r:
#
#     phi(g) = sum_i t_i g / s_i - 1 = 0
#
# phi rises and is concave in g >= 0, so Newton's method started left of the root walks to it without ever passing it,
# from anywhere and for any indices; and as only r² enters, nothing happens at r = 0.

_STEPS = 100
_THINNEST = 1e-15
"""Least thickness of a layer [m]: with none at all a grazing ray would have no angle."""


@dataclass(frozen=True, eq=False)
class Stack:
    """The solution: thicknesses, indices, and the ray through them."""

    thickness: list[Array | float]
    """t_i [m], (...) each."""
    index: list[float]
    r2: Array
    """Squared sideways distance [m²], (...)."""
    g: Array
    """u/r [1/m], (...)."""

    @property
    def near_slope(self) -> Array:
        """k_0 = tan(theta)/r next to the camera [1/m], (...)."""
        return self.g if self.index[0] == min(self.index) else self.g / self._s(self.index[0])

    def _s(self, index: float) -> Array:
        a2 = (index / min(self.index)) ** 2
        return np.asarray(np.sqrt(a2 + (a2 - 1.0) * self.r2 * self.g**2))

    def derivatives(self) -> StackDerivatives:
        """How k_0, the slope next to the camera, changes (implicit function theorem).

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
    """k = tan(theta)/r next to the camera, and its derivatives, (...) each."""

    k: Array
    by_r2: Array
    by_near: Array
    """With respect to the camera's distance from the interface."""
    by_far: Array
    """With respect to the point's distance from the far face."""
    by_far_index: Array


def solve_stack(r2: Array, thickness: Sequence[Array | float], index: list[float]) -> Stack:
    """Find the ray that crosses all layers and moves sideways by r in all.

    Args:
        r2: Squared sideways distance [m²], (...).
        thickness: Of each layer, from the camera to the point [m], (...) each or one number; negative counts as none.
        index: Refractive index of each layer.
    """
    least = min(index)
    layers = [max(t, _THINNEST) if isinstance(t, float) else np.maximum(t, _THINNEST) for t in thickness]
    square = [(n / least) ** 2 for n in index]
    thin = sum(t for t, a2 in zip(layers, square, strict=True) if a2 == 1.0)
    denser = [(t, a2, (a2 - 1.0) * r2) for t, a2 in zip(layers, square, strict=True) if a2 != 1.0]
    # All angles small: phi is concave, so the step from zero stops left of the root.
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
        # The error after a step is at most 1.5 times the square of the step: nothing is left to gain.
        if not (np.abs(step) > 3e-8 * g).any():
            break
    return Stack(layers, index, r2, g)


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
