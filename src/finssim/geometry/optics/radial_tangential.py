"""OpenCV's radial and tangential distortion (plumb bob and rational), in complex image coordinates.

With z = x + i y, s = |z|², P = p2 + i p1 and R(s) = (1 + k1 s + k2 s² + k3 s³) / (1 + k4 s + k5 s² + k6 s³), OpenCV's
two equations (docs.opencv.org, "Camera Calibration and 3D Reconstruction") are one:

    f(z) = z R(s) + 2 s P + conj(P) z²
    df   = A dz + B conj(dz),   A = R + s R' + 4 Re(conj(P) z) (real),   B = z R' + 2 P  times z

so that its Jacobian is A² - |B|² and its inverse needs no 2x2 solver.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
import numpy.typing as npt

__all__ = ["RadialTangential"]

Array = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]

_WIDEST = np.radians(89.9)
"""Half angle up to which a lens that maps onto a plane is looked at: it never reaches 90 degrees."""

_STEPS = 40
_CLOSE = 2e-8
"""A Newton step this small is the last one: the error after it is its square."""


class RadialTangential:
    """A perspective lens with distortion k1, k2, p1, p2[, k3[, k4, k5, k6]]; none means a pinhole."""

    def __init__(self, distortion: tuple[float, ...]) -> None:
        k1, k2, p1, p2, k3, k4, k5, k6 = (*distortion, *(0.0,) * (8 - len(distortion)))
        self._numerator, self._denominator = (k1, k2, k3), (k4, k5, k6)
        self._P = complex(p2, p1)
        self._count = len(distortion)
        self._straight = not any(distortion)

    def project(self, points_c: Array) -> tuple[Array, npt.NDArray[np.bool_]]:
        """Distorted image coordinates (..., 2) at unit focal length, and which points have any, (...)."""
        z = _plane(points_c)
        ok = points_c[..., 2] > 0.0
        if self.fold < np.inf:
            ok = ok & (np.abs(z) < self.fold)
        return _pairs(z if self._straight else self._distort(z)), ok

    def jacobian(self, points_c: Array) -> Array:
        """Derivative of `project` with respect to the point [1/m], (..., 2, 3)."""
        z = _plane(points_c)
        _, A, B = self._evaluate(z)
        # dz = (dX + i dY - z dZ) / Z; columns of df = A dz + B conj(dz).
        inverse = 1.0 / points_c[..., 2]
        columns = np.empty((3, *z.shape), complex)
        columns[0], columns[1] = (A + B) * inverse, (1j * inverse) * (A - B)
        columns[2] = -inverse * (A * z + B * z.conj())
        return np.moveaxis(columns.view(float).reshape(3, *z.shape, 2), 0, -1)

    def parameter_jacobian(self, points_c: Array) -> Array:
        """Derivative of `project` with respect to the coefficients that were given, (..., 2, k)."""
        z = _plane(points_c)
        s = (z * z.conj()).real
        R, _, denominator = self._radial(s)
        one = z / denominator
        power = [s, s * s, s * s * s]
        tangential = [2j * s - 1j * z * z, 2.0 * s + z * z]  # OpenCV's order: p1, then p2
        columns = [one * power[0], one * power[1], *tangential, one * power[2]]
        columns += [-one * R * each for each in power]
        out = np.empty((*z.shape, 2, self._count))
        for i, column in enumerate(columns[: self._count]):
            out[..., i] = _pairs(column)
        return out

    def rays(self, image: Array) -> tuple[Array, npt.NDArray[np.bool_]]:
        """Unit rays (..., 3) of distorted coordinates (..., 2), and which of them have one, (...)."""
        z, ok = self._undistort(_complex(image))
        out = np.empty((*z.shape, 3))
        out[..., 2] = 1.0 / np.sqrt(1.0 + (z * z.conj()).real)
        out[..., :2] = _pairs(z * out[..., 2])
        return out, ok

    @cached_property
    def fold(self) -> float:
        """Undistorted radius within which the distortion maps one to one, in every direction; inf if everywhere.

        Beyond it the image runs back towards the centre: a point there would appear where another one is seen.
        """
        low, high = 0.0, float(np.tan(_WIDEST))
        if self._straight:
            return np.inf
        angle = np.linspace(0.0, _WIDEST, 1024)
        for _ in range(4):
            r = np.tan(angle)
            bad = np.flatnonzero(~(self._least_determinant(r) > 0.0))
            if bad.size == 0:
                return np.inf
            first = max(int(bad[0]), 1)
            low, high = float(r[first - 1]), float(r[first])
            angle = np.linspace(np.arctan(low), np.arctan(high), 256)
        return low

    def _least_determinant(self, r: Array) -> Array:
        """The smallest A² - |B|² on a circle of radius r, over all directions; negative past a pole, (...)."""
        s, P = r * r, abs(self._P)
        R, slope, denominator = self._radial(s)
        # In the cosine of the angle between z and P it is a convex quadratic: its vertex, kept in [-1, 1].
        vertex = -(2.0 * R + s * slope)
        cosine = np.clip(np.divide(vertex, 8.0 * P * r, out=-np.ones_like(r), where=P * r > 0.0), -1.0, 1.0)
        A = R + s * slope + 4.0 * P * r * cosine
        B2 = s * (s * slope**2 + 4.0 * P**2 + 4.0 * r * slope * P * cosine)
        return np.where((denominator > 0.0) & (A > 0.0), A * A - B2, -1.0)

    @cached_property
    def _table(self) -> tuple[Array, Array, float]:
        """Distorted radius -> undistorted over distorted, of the radial part; and the largest radius in the image."""
        r = np.tan(np.linspace(0.0, min(_WIDEST, np.arctan(self.fold)), 1025)[1:])
        R, _, _ = self._radial(r * r)
        distorted = r * R
        reach = np.inf
        if self.fold < np.inf:
            reach = float(distorted[-1] + 3.0 * abs(self._P) * r[-1] ** 2)
        return np.concatenate([[0.0], distorted]), np.concatenate([[1.0], 1.0 / R]), reach

    def _undistort(self, image: Complex) -> tuple[Complex, npt.NDArray[np.bool_]]:
        """Solve f(z) = image by Newton from a table of the radial part."""
        if self._straight:
            return image, np.isfinite(image)
        radius, ratio, reach = self._table
        length = np.abs(image)
        if reach < np.inf:  # what no ray can reach is NaN from the start, so that nobody waits for it
            image = np.where(length <= reach, image, np.nan)
        shrink = np.interp(length, radius, ratio)
        z = image * shrink
        if self._P:
            z = z - shrink * (2.0 * self._P * (z * z.conj()).real + self._P.conjugate() * (z * z))
        for _ in range(_STEPS):
            f, A, B = self._evaluate(z)
            error = image - f
            step = (A * error - B * error.conj()) / (A * A - (B * B.conj()).real)
            z = z + step
            size = np.abs(step)
            if not (size > _CLOSE).any():  # the next step would be below rounding
                break
        return z, (np.abs(z) < self.fold) & (size <= _CLOSE)

    def _distort(self, z: Complex) -> Complex:
        """f(z)."""
        s = (z * z.conj()).real
        k1, k2, k3 = self._numerator
        R = 1.0 + s * (k1 + s * (k2 + s * k3 if k3 else k2))
        if any(self._denominator):
            k4, k5, k6 = self._denominator
            R = R / (1.0 + s * (k4 + s * (k5 + s * k6)))
        if not self._P:
            return np.asarray(z * R)
        return np.asarray(z * R + (2.0 * self._P) * s + self._P.conjugate() * (z * z))

    def _evaluate(self, z: Complex) -> tuple[Complex, Array, Complex]:
        """f(z), and A and B of df = A dz + B conj(dz)."""
        s, z2 = (z * z.conj()).real, z * z
        R, slope, _ = self._radial(s)
        f, A, B = z * R, R + s * slope, z2 * slope
        if self._P:
            turned = self._P.conjugate() * z
            f = f + (2.0 * self._P) * s + turned * z
            A, B = A + 4.0 * turned.real, B + (2.0 * self._P) * z
        return f, A, B

    def _radial(self, s: Array) -> tuple[Array, Array, Array | float]:
        """R(s), dR/ds and the denominator of R."""
        k1, k2, k3 = self._numerator
        R = 1.0 + s * (k1 + s * (k2 + s * k3 if k3 else k2))
        slope = k1 + s * (2.0 * k2 + (3.0 * k3) * s if k3 else 2.0 * k2)
        if not any(self._denominator):
            return R, slope, 1.0
        k4, k5, k6 = self._denominator
        denominator = 1.0 + s * (k4 + s * (k5 + s * k6))
        R = R / denominator
        return R, (slope - R * (k4 + s * (2.0 * k5 + (3.0 * k6) * s))) / denominator, denominator


def _complex(pairs: Array) -> Complex:
    return np.ascontiguousarray(pairs).view(np.complex128)[..., 0]


def _pairs(z: Complex) -> Array:
    return np.ascontiguousarray(z[..., None]).view(np.float64)


def _plane(points_c: Array) -> Complex:
    """The point seen at unit distance, X/Z + i Y/Z."""
    return np.asarray(_complex(points_c[..., :2]) / points_c[..., 2])
