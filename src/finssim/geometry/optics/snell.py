"""The ray between two points across a stack of plane-parallel layers.

Snell's law keeps n_i sin(theta_i) along the ray. With u = tan(theta) in the medium of least index n_m and
a_i = n_i/n_m, layer i of thickness t_i moves the ray sideways by t_i u / s_i, s_i = sqrt(a_i² + (a_i² - 1) u²). The ray
that moves by r in all is found from g = u/r:

    phi(g) = sum_i t_i g / s_i - 1 = 0

phi rises and is concave in g >= 0, so Newton's method started left of the root walks to it without ever passing it,
from anywhere and for any indices; and as only r² enters, nothing happens at r = 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

__all__ = ["Stack", "StackDerivatives", "solve_stack"]

Array = npt.NDArray[np.float64]

_STEPS = 100
_THINNEST = 1e-15
"""Least thickness of a layer, as a part of the whole path: with none at all a grazing ray would have no angle."""


@dataclass(frozen=True, eq=False)
class Stack:
    """The solution: thicknesses, indices, and the ray through them."""

    thickness: list[Array]
    """t_i [m], (...) each."""
    index: list[float]
    r2: Array
    """Squared sideways distance [m²], (...)."""
    g: Array
    """u/r [1/m], (...)."""
    s: list[Array]
    """s_i, (...) each."""

    def slope(self, i: int) -> Array:
        """k_i = tan(theta_i)/r [1/m], (...)."""
        return np.asarray(self.g / self.s[i])

    def derivatives(self) -> StackDerivatives:
        """How k_0, the slope next to the camera, changes (implicit function theorem).

        With P = sin(theta_i) n_i/r, the same in all layers, c_i = n_i cos(theta_i): k_i = P/c_i and
        sum t_i k_i = 1.
        """
        n_least = min(self.index)
        omega = np.sqrt(1.0 + self.r2 * self.g**2)
        P = n_least * self.g / omega
        c = [n_least * s / omega for s in self.s]
        by_P = sum(t * n**2 / x**3 for t, n, x in zip(self.thickness, self.index, c, strict=True))
        by_r2 = 0.5 * P**3 * sum(t / x**3 for t, x in zip(self.thickness, c, strict=True))
        own = self.index[0] ** 2 / c[0] ** 3
        towards = -own / by_P
        far = self.index[-1]
        return StackDerivatives(
            k=self.slope(0),
            by_r2=0.5 * P**3 / c[0] ** 3 + towards * by_r2,
            by_near=towards * P / c[0],
            by_far=towards * P / c[-1],
            by_far_index=-towards * self.thickness[-1] * P * far / c[-1] ** 3,
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
        thickness: Of each layer, from the camera to the point [m], (...) each or one number; not negative.
        index: Refractive index of each layer.
    """
    least = min(index)
    total = np.asarray(sum(thickness))
    thinnest = _THINNEST * (np.sqrt(r2) + total)
    layers = [np.maximum(t, thinnest) for t in thickness]
    square = [(n / least) ** 2 for n in index]
    spread = [(a2 - 1.0) * r2 for a2 in square]
    g, lowest = _start(r2, layers, square)
    for _ in range(_STEPS):
        g2 = g * g
        value: Array | float = -1.0
        slope: Array | float = 0.0
        for t, a2, b in zip(layers, square, spread, strict=True):
            if a2 == 1.0:
                value, slope = value + t * g, slope + t
            else:
                s2 = a2 + b * g2
                part = t / np.sqrt(s2)
                value, slope = value + part * g, slope + part * (a2 / s2)
        step = value / slope
        g = np.maximum(g - step, lowest)
        # The error after a step is at most 1.5 times the square of the one before: nothing is left to gain.
        if not (np.abs(step) > 1e-8 * g).any():
            break
    g2 = g * g
    return Stack(layers, index, r2, g, [np.sqrt(a2 + b * g2) for a2, b in zip(square, spread, strict=True)])


def _start(r2: Array, layers: list[Array], square: list[float]) -> tuple[Array, Array]:
    """A start left of the root, the better of two: all angles small, or all but the steepest at their limit."""
    flat = sum(t / a2**0.5 for t, a2 in zip(layers, square, strict=True))
    lowest = 1.0 / flat
    denser = [(t, a2) for t, a2 in zip(layers, square, strict=True) if a2 > 1.0]
    if not denser:
        return lowest, lowest
    limit = sum(t / (a2 - 1.0) ** 0.5 for t, a2 in denser)
    thin = sum(t for t, a2 in zip(layers, square, strict=True) if a2 == 1.0)
    return np.maximum(lowest, (1.0 - limit / np.sqrt(np.maximum(r2, 1e-300))) / thin), lowest
