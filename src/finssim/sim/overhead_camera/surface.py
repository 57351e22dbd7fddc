"""Rippling water surface: a sum of gravity-capillary waves, its slope, and the intersection with a ray.

Surface frame s: z along the interface's normal towards the camera, 0 on the still surface; x and y along its tangents.
"""
# mypy: ignore-errors

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from finssim.sim.overhead_camera.scene import Ripples

GRAVITY = 9.81
"""[m/s²]"""

SURFACE_TENSION = 7.28e-5
"""Surface tension of water at 20 °C over its density, σ/ρ [m³/s²] (IAPWS: 0.0728 N/m)."""


@dataclass(frozen=True)
class Waves:
    """The sines of a surface, h = Σ a sin(k·x - ω t + φ), arrays over the waves."""

    k: NDArray[np.float64]
    """Wave vectors [rad/m], (N, 2)."""
    omega: NDArray[np.float64]
    """[rad/s], (N,)."""
    amplitude: NDArray[np.float64]
    """[m], (N,)."""
    phase: NDArray[np.float64]
    """Phase at the pool's origin and time 0 [rad], (N,)."""

    def height(self, xy: ArrayLike, time: float) -> NDArray[np.float64]:
        """Return the height above the still surface [m], (...,), at points (..., 2) [m]."""
        return np.sin(self._angle(xy, time)) @ self.amplitude

    def slope(self, xy: ArrayLike, time: float) -> NDArray[np.float64]:
        """Return the gradient of the height, (..., 2), at points (..., 2) [m]."""
        return (np.cos(self._angle(xy, time)) * self.amplitude) @ self.k

    def _angle(self, xy: ArrayLike, time: float) -> NDArray[np.float64]:
        return np.asarray(xy, float) @ self.k.T - self.omega * time + self.phase

    @property
    def steepest(self) -> float:
        """Upper bound on the slope of the surface [-]."""
        return float(np.sum(self.amplitude * np.linalg.norm(self.k, axis=1)))


def dispersion(wave_number: ArrayLike) -> NDArray[np.float64]:
    """Return the angular frequency of a wave on deep water, ω² = g k + (σ/ρ) k³ [rad/s].

    Args:
        wave_number: k = 2π / wavelength [rad/m], any shape.
    """
    k = np.asarray(wave_number, float)
    return np.asarray(np.sqrt(GRAVITY * k + SURFACE_TENSION * k**3))


def waves_of(ripples: Ripples) -> Waves:
    """Return the sines of a rippling surface, each with the same mean square slope: a k = sqrt(2/N) s."""
    rng = np.random.default_rng([ripples.seed, 0x5EA])
    n = ripples.waves
    shortest, longest = (math.log(length) for length in ripples.wavelengths)
    wavelength = np.exp(shortest + (longest - shortest) * (np.arange(n) + rng.random(n)) / n)
    # Headings fill the circle evenly, in an order that is independent of the wavelength.
    heading = 2.0 * math.pi * (rng.permutation(n) + rng.random(n)) / n
    k = 2.0 * math.pi / wavelength
    return Waves(
        k=k[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=-1),
        omega=dispersion(k),
        amplitude=ripples.rms_slope * math.sqrt(2.0 / n) / k,
        phase=2.0 * math.pi * rng.random(n),
    )


@wp.struct
class SurfaceWave:
    """One sine of the surface at the picture's time."""

    k: wp.vec2  # [rad/m]
    omega: float  # [rad/s]
    amplitude: float  # [m]
    phase: float  # at the surface frame's origin, mid-exposure [rad]


@wp.struct
class Patch:
    """The surface around one point: a Taylor series in position and time. All zero for a flat surface."""

    x: float  # the point [m]
    y: float  # [m]
    h: float  # height [m]
    hx: float  # slope [-]
    hy: float  # [-]
    hxx: float  # curvature [1/m]
    hxy: float  # [1/m]
    hyy: float  # [1/m]
    ht: float  # vertical speed [m/s]
    hxt: float  # rate of the slope [1/s]
    hyt: float  # [1/s]


@lru_cache
def layout_of(struct: Any) -> np.dtype[Any]:
    """Return the NumPy type of a Warp struct, cached: Warp itself would compute it in 0.4 ms for every picture."""
    return np.dtype(struct.numpy_dtype())


def pack_waves(waves: Waves | None, origin: ArrayLike, time: float) -> NDArray[Any]:
    """Return waves as structs for the kernel, in the units of `SurfaceWave`.

    Args:
        waves: The surface; None for a flat one.
        origin: Origin of the surface frame relative to the pool's origin, in surface axes [m], (2,).
        time: Middle of the exposure [s].
    """
    count = 0 if waves is None else len(waves.omega)
    table = np.zeros(count, dtype=layout_of(SurfaceWave))
    if waves is not None:
        table["k"], table["omega"], table["amplitude"] = waves.k, waves.omega, waves.amplitude
        table["phase"] = np.remainder(waves._angle(origin, time), 2.0 * math.pi)
    return table


@wp.func
def surface_at(waves: wp.array(dtype=SurfaceWave), x: float, y: float) -> Patch:
    """Return the surface around a point (x, y) [m], mid-exposure."""
    p = Patch()
    p.x = x
    p.y = y
    for i in range(waves.shape[0]):
        w = waves[i]
        angle = w.k[0] * x + w.k[1] * y + w.phase
        s = w.amplitude * wp.sin(angle)
        c = w.amplitude * wp.cos(angle)
        p.h += s
        p.hx += w.k[0] * c
        p.hy += w.k[1] * c
        p.hxx -= w.k[0] * w.k[0] * s
        p.hxy -= w.k[0] * w.k[1] * s
        p.hyy -= w.k[1] * w.k[1] * s
        p.ht -= w.omega * c
        p.hxt += w.k[0] * w.omega * s
        p.hyt += w.k[1] * w.omega * s
    return p


@wp.func
def surface_hit(waves: wp.array(dtype=SurfaceWave), height: float, ray: wp.vec3) -> Patch:
    """Return the surface around the point where a ray from the camera hits it, by a Newton step from the still surface.

    Args:
        waves: Waves of the surface.
        height: Height of the camera, at (0, 0, height), above the still surface [m].
        ray: Unit direction, surface frame, with ray_z < 0.
    """
    s = -height / ray[2]
    p = surface_at(waves, s * ray[0], s * ray[1])
    if waves.shape[0] > 0:
        # The remaining error after one step is half a curvature times the square of h tan(view angle): micrometres.
        gap = height + s * ray[2] - p.h
        s -= gap / (ray[2] - p.hx * ray[0] - p.hy * ray[1])
        p = surface_at(waves, s * ray[0], s * ray[1])
    return p


@wp.func
def distance_to(p: Patch, height: float, ray: wp.vec3, t: float) -> float:
    """Return the distance along a ray from the camera to the patch's tangent plane, `t` after mid-exposure [m]."""
    rise = p.h + p.ht * t - p.hx * p.x - p.hy * p.y
    return (rise - height) / (ray[2] - p.hx * ray[0] - p.hy * ray[1])


@wp.func
def normal_of(p: Patch, x: float, y: float, t: float) -> wp.vec3:
    """Return the unit normal towards the camera at a point of the patch, `t` after mid-exposure."""
    dx = x - p.x
    dy = y - p.y
    hx = p.hx + p.hxx * dx + p.hxy * dy + p.hxt * t
    hy = p.hy + p.hxy * dx + p.hyy * dy + p.hyt * t
    return wp.normalize(wp.vec3(-hx, -hy, 1.0))
