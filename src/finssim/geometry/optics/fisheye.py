"""OpenCV's fisheye lens: the equidistant projection with a polynomial of the angle, to and beyond 90 degrees.

    theta = angle between the ray and the optical axis
    d(theta) = theta (1 + k1 theta² + k2 theta⁴ + k3 theta⁶ + k4 theta⁸),   image = d(theta) (X, Y) / |(X, Y)|

(docs.opencv.org, "Fisheye camera model"). OpenCV itself takes points in front of the lens only; here a lens sees as far
round as its polynomial rises.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
import numpy.typing as npt

__all__ = ["Fisheye"]

Array = npt.NDArray[np.float64]


class Fisheye:
    """A fisheye lens with distortion k1, k2, k3, k4; none means exactly equidistant."""

    def __init__(self, distortion: tuple[float, ...]) -> None:
        self._k = (*distortion, *(0.0,) * (4 - len(distortion)))
        self._count = len(distortion)

    def project(self, points_c: Array) -> tuple[Array, npt.NDArray[np.bool_]]:
        """Distorted image coordinates (..., 2) at unit focal length, and which points have any, (...)."""
        _, theta, scale = self._angle(points_c)
        return points_c[..., :2] * (scale * self._ratio(theta * theta))[..., None], theta < self.fold

    def jacobian(self, points_c: Array) -> Array:
        """Derivative of `project` with respect to the point [1/m], (..., 2, 3)."""
        rho, theta, scale = self._angle(points_c)
        t2 = theta * theta
        ratio, slope = self._ratio(t2), self._slope(t2)
        across = points_c[..., :2]
        Z, distance2 = points_c[..., 2], rho * rho + points_c[..., 2] ** 2
        # image = m across with m = d/rho; dm/drho = (slope Z/distance² - m)/rho, finite at the axis.
        m = scale * ratio
        near = rho <= 1e-4 * np.abs(Z)
        series = (6.0 * self._k[0] - 2.0) / 3.0 / Z**3  # (dm/drho)/rho on the axis
        dm = np.where(near, series, (slope * Z / distance2 - m) / np.where(near, 1.0, rho * rho))
        out = np.empty((*rho.shape, 2, 3))
        out[..., :2] = across[..., :, None] * across[..., None, :] * dm[..., None, None]
        out[..., 0, 0] += m
        out[..., 1, 1] += m
        out[..., 2] = across * (-slope / distance2)[..., None]
        return out

    def parameter_jacobian(self, points_c: Array) -> Array:
        """Derivative of `project` with respect to the coefficients that were given, (..., 2, k)."""
        _, theta, scale = self._angle(points_c)
        powers = (theta[..., None] ** 2) ** np.arange(1, self._count + 1)
        return np.asarray((points_c[..., :2] * scale[..., None])[..., :, None] * powers[..., None, :])

    def rays(self, image: Array) -> tuple[Array, npt.NDArray[np.bool_]]:
        """Unit rays (..., 3) of distorted coordinates (..., 2), and which of them have one, (...)."""
        angles, distances = self._table
        d = np.hypot(image[..., 0], image[..., 1])
        # Past the fold there is no angle: NaN from the start, so that nobody waits for it.
        d = np.where(d < distances[-1], d, np.nan)
        theta = np.interp(d, distances, angles)
        for _ in range(40):
            t2 = theta * theta
            step = (d - theta * self._ratio(t2)) / self._slope(t2)
            theta = theta + step
            if not (np.abs(step) > 1e-9).any():  # the next one would be below rounding
                break
        out = np.empty((*d.shape, 3))
        # sin(theta)/d = sinc(theta)/ratio keeps the axis exact.
        out[..., :2] = image * (np.sinc(theta / np.pi) / self._ratio(theta * theta))[..., None]
        out[..., 2] = np.cos(theta)
        return out, theta < self.fold

    @cached_property
    def fold(self) -> float:
        """Angle from the axis up to which the polynomial rises [rad], at most pi."""
        k1, k2, k3, k4 = self._k
        roots = np.roots([9.0 * k4, 7.0 * k3, 5.0 * k2, 3.0 * k1, 1.0])
        real = roots.real[(np.abs(roots.imag) <= 1e-9 * np.abs(roots)) & (roots.real > 0.0)]
        return float(min(np.sqrt(real.min()), np.pi)) if real.size else float(np.pi)

    @cached_property
    def _table(self) -> tuple[Array, Array]:
        theta = np.linspace(0.0, self.fold, 1025)
        return theta, theta * self._ratio(theta * theta)

    def _angle(self, points_c: Array) -> tuple[Array, Array, Array]:
        """Distance from the axis [m], angle from it [rad], and angle over distance [rad/m]: finite on the axis."""
        Z = points_c[..., 2]
        rho = np.hypot(points_c[..., 0], points_c[..., 1])
        theta = np.arctan2(rho, Z)
        near = rho <= 1e-150
        return rho, theta, np.where(near, 1.0 / Z, theta / np.where(near, 1.0, rho))

    def _ratio(self, t2: Array) -> Array:
        """d(theta)/theta."""
        k1, k2, k3, k4 = self._k
        return np.asarray(1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))

    def _slope(self, t2: Array) -> Array:
        """The derivative of d(theta)."""
        k1, k2, k3, k4 = self._k
        return np.asarray(1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * (9.0 * k4)))))
