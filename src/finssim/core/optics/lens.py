"""Lens models: mapping from a direction in the optical frame to a pixel and back, with derivatives.

Optical frame: x right, y down, z along the view. Pixels: u right, v down, integer coordinates at pixel
centres, as in OpenCV. All functions accept leading batch dimensions `...`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from finssim.core.rotations import quat_to_matrix

# Error for impossible optics.


class OpticsError(ValueError):
    """Invalid lens, camera or interface; the message is one sentence that states the expected values."""


# OpenCV's radial and tangential distortion (plumb bob and rational), in complex image coordinates.
#
# With z = x + i y, s = |z|², P = p2 + i p1 and R(s) = (1 + k1 s + k2 s² + k3 s³) / (1 + k4 s + k5 s² + k6 s³), OpenCV's
# two equations (docs.opencv.org, "Camera Calibration and 3D Reconstruction") are one:
#
#     f(z) = z R(s) + 2 s P + conj(P) z²
#     df   = A dz + B conj(dz),   A = R + s R' + 4 Re(conj(P) z) (real),   B = z R' + 2 P  times z
#
# so that its Jacobian is A² - |B|² and its inverse needs no 2x2 solver.

Complex = npt.NDArray[np.complex128]

_WIDEST = np.radians(89.9)
"""Largest half angle that is considered for a lens that maps onto a plane: it never reaches 90 degrees."""

_STEPS = 40
_CLOSE = 2e-8
"""Newton step below which the iteration stops: the error after a step is the square of the step."""


class RadialTangential:
    """Perspective lens with distortion k1, k2, p1, p2[, k3[, k4, k5, k6]]; without coefficients a pinhole."""

    def __init__(self, distortion: tuple[float, ...]) -> None:
        k1, k2, p1, p2, k3, k4, k5, k6 = (*distortion, *(0.0,) * (8 - len(distortion)))
        self._numerator, self._denominator = (k1, k2, k3), (k4, k5, k6)
        self._P = complex(p2, p1)
        self._count = len(distortion)
        self._straight = not any(distortion)

    def project(self, points_c: Array) -> tuple[Array, npt.NDArray[np.bool_]]:
        """Return distorted image coordinates (..., 2) at unit focal length, and whether each point has a
        projection, (...)."""
        z = _plane(points_c)
        ok = points_c[..., 2] > 0.0
        if self.fold < np.inf:
            ok = ok & (np.abs(z) < self.fold)
        return _pairs(z if self._straight else self._distort(z)), ok

    def jacobian(self, points_c: Array) -> Array:
        """Return the derivative of `project` with respect to the point [1/m], (..., 2, 3)."""
        z = _plane(points_c)
        _, A, B = self._evaluate(z)
        # dz = (dX + i dY - z dZ) / Z; columns of df = A dz + B conj(dz).
        inverse = 1.0 / points_c[..., 2]
        columns = np.empty((3, *z.shape), complex)
        columns[0], columns[1] = (A + B) * inverse, (1j * inverse) * (A - B)
        columns[2] = -inverse * (A * z + B * z.conj())
        return np.moveaxis(columns.view(float).reshape(3, *z.shape, 2), 0, -1)

    def parameter_jacobian(self, points_c: Array) -> Array:
        """Return the derivative of `project` with respect to the coefficients of the lens, (..., 2, k) [-]."""
        z = _plane(points_c)
        s = (z * z.conj()).real
        R, _, denominator = self._radial(s)
        scale = z / denominator
        power = [s, s * s, s * s * s]
        tangential = [2j * s - 1j * z * z, 2.0 * s + z * z]  # OpenCV's order: p1, then p2
        columns = [scale * power[0], scale * power[1], *tangential, scale * power[2]]
        columns += [-scale * R * each for each in power]
        out = np.empty((*z.shape, 2, self._count))
        for i, column in enumerate(columns[: self._count]):
            out[..., i] = _pairs(column)
        return out

    def rays(self, image: Array) -> tuple[Array, npt.NDArray[np.bool_]]:
        """Return unit rays (..., 3) of distorted coordinates (..., 2), and whether each pixel has a ray,
        (...)."""
        z, ok = self._undistort(_complex(image))
        out = np.empty((*z.shape, 3))
        out[..., 2] = 1.0 / np.sqrt(1.0 + (z * z.conj()).real)
        out[..., :2] = _pairs(z * out[..., 2])
        return out, ok

    @cached_property
    def fold(self) -> float:
        """Return the undistorted radius, at unit focal length, within which the distortion maps one to one; inf if
        everywhere.

        Beyond it the image folds back towards the centre: two points would appear at the same pixel.
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
        """Return the smallest A² - |B|² on a circle of radius r, over all directions; negative beyond a pole,
        (...)."""
        s, P = r * r, abs(self._P)
        R, slope, denominator = self._radial(s)
        # It is a convex quadratic in the cosine of the angle between z and P: its vertex, limited to [-1, 1].
        vertex = -(2.0 * R + s * slope)
        cosine = np.clip(np.divide(vertex, 8.0 * P * r, out=-np.ones_like(r), where=P * r > 0.0), -1.0, 1.0)
        A = R + s * slope + 4.0 * P * r * cosine
        B2 = s * (s * slope**2 + 4.0 * P**2 + 4.0 * r * slope * P * cosine)
        return np.where((denominator > 0.0) & (A > 0.0), A * A - B2, -1.0)

    @cached_property
    def _table(self) -> tuple[Array, Array, float]:
        """Return a table of distorted radius -> undistorted over distorted radius of the radial part, and the largest
        radius in the image."""
        r = np.tan(np.linspace(0.0, min(_WIDEST, np.arctan(self.fold)), 1025)[1:])
        R, _, _ = self._radial(r * r)
        distorted = r * R
        reach = np.inf
        if self.fold < np.inf:
            reach = float(distorted[-1] + 3.0 * abs(self._P) * r[-1] ** 2)
        return np.concatenate([[0.0], distorted]), np.concatenate([[1.0], 1.0 / R]), reach

    def _undistort(self, image: Complex) -> tuple[Complex, npt.NDArray[np.bool_]]:
        """Solve f(z) = image by Newton's method, started from a table of the radial part."""
        if self._straight:
            return image, np.isfinite(image)
        radius, ratio, reach = self._table
        length = np.abs(image)
        if reach < np.inf:  # pixels that no ray reaches would delay the end of the iteration
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
        """Return f(z)."""
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
        """Return f(z), and A and B of df = A dz + B conj(dz)."""
        s, z2 = (z * z.conj()).real, z * z
        R, slope, _ = self._radial(s)
        f, A, B = z * R, R + s * slope, z2 * slope
        if self._P:
            turned = self._P.conjugate() * z
            f = f + (2.0 * self._P) * s + turned * z
            A, B = A + 4.0 * turned.real, B + (2.0 * self._P) * z
        return f, A, B

    def _radial(self, s: Array) -> tuple[Array, Array, Array | float]:
        """Return R(s), dR/ds and the denominator of R."""
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
    """Return the point projected to unit distance, X/Z + i Y/Z."""
    return np.asarray(_complex(points_c[..., :2]) / points_c[..., 2])


# OpenCV's fisheye lens: the equidistant projection with a polynomial of the angle, to and beyond 90 degrees.
#
#     theta = angle between the ray and the optical axis
#     d(theta) = theta (1 + k1 theta² + k2 theta⁴ + k3 theta⁶ + k4 theta⁸),   image = d(theta) (X, Y) / |(X, Y)|
#
# (docs.opencv.org, "Fisheye camera model"). OpenCV itself accepts only points in front of the lens; here the field of
# view extends as far as the polynomial rises.


class Fisheye:
    """Fisheye lens with distortion k1, k2, k3, k4 [-]; without coefficients exactly equidistant."""

    def __init__(self, distortion: tuple[float, ...]) -> None:
        self._k = (*distortion, *(0.0,) * (4 - len(distortion)))
        self._count = len(distortion)

    def project(self, points_c: Array) -> tuple[Array, npt.NDArray[np.bool_]]:
        """Return distorted image coordinates (..., 2) at unit focal length, and whether each point has a
        projection, (...)."""
        _, theta, scale = self._angle(points_c)
        return points_c[..., :2] * (scale * self._ratio(theta * theta))[..., None], theta < self.fold

    def jacobian(self, points_c: Array) -> Array:
        """Return the derivative of `project` with respect to the point [1/m], (..., 2, 3)."""
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
        """Return the derivative of `project` with respect to the coefficients of the lens, (..., 2, k) [-]."""
        _, theta, scale = self._angle(points_c)
        powers = (theta[..., None] ** 2) ** np.arange(1, self._count + 1)
        return np.asarray((points_c[..., :2] * scale[..., None])[..., :, None] * powers[..., None, :])

    def rays(self, image: Array) -> tuple[Array, npt.NDArray[np.bool_]]:
        """Return unit rays (..., 3) of distorted coordinates (..., 2), and whether each pixel has a ray,
        (...)."""
        angles, distances = self._table
        d = np.hypot(image[..., 0], image[..., 1])
        # Beyond the fold there is no angle: NaN from the start, so that it does not delay the end of the iteration.
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
        """Return the angle from the axis up to which the polynomial rises [rad], at most pi."""
        k1, k2, k3, k4 = self._k
        roots = np.roots([9.0 * k4, 7.0 * k3, 5.0 * k2, 3.0 * k1, 1.0])
        real = roots.real[(np.abs(roots.imag) <= 1e-9 * np.abs(roots)) & (roots.real > 0.0)]
        return float(min(np.sqrt(real.min()), np.pi)) if real.size else float(np.pi)

    @cached_property
    def _table(self) -> tuple[Array, Array]:
        theta = np.linspace(0.0, self.fold, 1025)
        return theta, theta * self._ratio(theta * theta)

    def _angle(self, points_c: Array) -> tuple[Array, Array, Array]:
        """Return the distance from the axis [m], the angle from it [rad], and angle over distance [rad/m],
        finite on the axis."""
        Z = points_c[..., 2]
        rho = np.hypot(points_c[..., 0], points_c[..., 1])
        theta = np.arctan2(rho, Z)
        near = rho <= 1e-150
        return rho, theta, np.where(near, 1.0 / Z, theta / np.where(near, 1.0, rho))

    def _ratio(self, t2: Array) -> Array:
        """Return d(theta)/theta."""
        k1, k2, k3, k4 = self._k
        return np.asarray(1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))

    def _slope(self, t2: Array) -> Array:
        """Return the derivative of d(theta)."""
        k1, k2, k3, k4 = self._k
        return np.asarray(1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * (9.0 * k4)))))


Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

LENS_MODELS: dict[str, tuple[type[RadialTangential] | type[Fisheye], tuple[int, ...]]] = {
    "plumb_bob": (RadialTangential, (0, 4, 5)),
    "rational": (RadialTangential, (0, 8)),
    "fisheye": (Fisheye, (0, 4)),
}
"""Model -> its distortion class and the allowed numbers of coefficients."""
COEFFICIENTS = {
    "plumb_bob": ("k1", "k2", "p1", "p2", "k3"),
    "rational": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "fisheye": ("k1", "k2", "k3", "k4"),
}
"""Model -> names of its coefficients, in OpenCV's order."""
_WORDS = {
    "plumb_bob": "plumb_bob",
    "radtan": "plumb_bob",
    "rational": "rational",
    "rational_polynomial": "rational",
    "fisheye": "fisheye",
    "equidistant": "fisheye",
    "kannala_brandt": "fisheye",
    "opencv_fisheye": "fisheye",
    "opencv": "plumb_bob",
    "brown_conrady": "plumb_bob",
}
"""Names of models in our files and in other programs -> model."""


def lens_model(word: str) -> str:
    """Return the lens model for a name in a camera file, ours or that of another program.

    Args:
        word: Name such as `plumb_bob`, `radtan` or `equidistant` (an alias of `fisheye`).

    Returns:
        Key of `LENS_MODELS`.

    Raises:
        OpticsError: The name is unknown.
    """
    try:
        return _WORDS[word]
    except KeyError:
        raise OpticsError(f"unknown lens model '{word[:40]}'; available: {', '.join(_WORDS)}") from None


@dataclass(frozen=True)
class Lens:
    """Intrinsics of a camera.

    Raises:
        OpticsError: A number is not finite, a size or focal length is not positive, the model is unknown, or
            the number of coefficients is wrong for the model.
    """

    width: int
    """Image width [px]."""
    height: int
    """Image height [px]."""
    fx: float
    """Focal length along u [px]."""
    fy: float
    """Focal length along v [px]."""
    cx: float
    """Principal point, u [px]."""
    cy: float
    """Principal point, v [px]."""
    model: str = "plumb_bob"
    """plumb_bob (k1 k2 p1 p2 [k3]), rational (k1 k2 p1 p2 k3 k4 k5 k6) or fisheye (k1 k2 k3 k4), as in
    OpenCV."""
    distortion: tuple[float, ...] = ()
    """Coefficients [-] in OpenCV's order; none for a lens without distortion."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "distortion", tuple(float(k) for k in self.distortion))
        if self.model not in LENS_MODELS:
            raise OpticsError(f"unknown lens model '{self.model}'; available: {', '.join(LENS_MODELS)}")
        counts = LENS_MODELS[self.model][1]
        if len(self.distortion) not in counts:
            expected = " or ".join(str(n) for n in counts)
            raise OpticsError(
                f"distortion has {len(self.distortion)} coefficients, expected {expected} for {self.model}"
            )
        for name in ("width", "height", "fx", "fy"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise OpticsError(f"{name} is {getattr(self, name)}, expected a positive number of pixels")
        if not all(math.isfinite(x) for x in (self.cx, self.cy, *self.distortion)):
            raise OpticsError(
                f"lens has cx {self.cx}, cy {self.cy}, distortion {self.distortion}, expected finite numbers"
            )

    @property
    def K(self) -> Array:
        """Return the camera matrix [px], (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def project(self, points_c: npt.ArrayLike) -> tuple[Array, Flags]:
        """Return the pixels of points, or of directions of any length.

        Args:
            points_c: Optical frame [m], (..., 3).

        Returns:
            Pixels (..., 2), and whether the lens sees each point, (...). A pixel is NaN if the point is behind the
            camera or beyond the range in which the distortion maps one to one. A pixel may lie outside the image.
        """
        points = np.asarray(points_c, float)
        with np.errstate(all="ignore"):
            image, ok = self._optics.project(points)
            pixels = image * self._focal + self._centre
            if not ok.all():
                pixels[~ok] = np.nan
        return pixels, ok

    def project_jacobian(self, points_c: npt.ArrayLike) -> Array:
        """Return the derivative of the pixel with respect to the point [px/m], (..., 2, 3)."""
        with np.errstate(all="ignore"):
            return np.asarray(self._optics.jacobian(np.asarray(points_c, float)) * self._focal[:, None])

    def parameter_jacobian(self, points_c: npt.ArrayLike) -> Array:
        """Return the derivative of the pixel with respect to fx, fy, cx, cy and the coefficients, (..., 2, 4
        + k)."""
        points = np.asarray(points_c, float)
        with np.errstate(all="ignore"):
            image, _ = self._optics.project(points)
            out = np.zeros((*points.shape[:-1], 2, 4 + len(self.distortion)))
            out[..., 0, 0], out[..., 1, 1] = image[..., 0], image[..., 1]
            out[..., 0, 2] = out[..., 1, 3] = 1.0
            out[..., 4:] = self._optics.parameter_jacobian(points) * self._focal[:, None]
        return out

    def rays(self, pixels: npt.ArrayLike) -> tuple[Array, Flags]:
        """Return the viewing directions of pixels.

        Args:
            pixels: (..., 2), inside the image or not.

        Returns:
            Unit rays in the optical frame (..., 3), and whether each pixel has one, (...). A ray is NaN if no
            ray within the one-to-one range of the distortion reaches the pixel.
        """
        with np.errstate(all="ignore"):
            rays, ok = self._optics.rays((np.asarray(pixels, float) - self._centre) / self._focal)
            if not ok.all():
                rays[~ok] = np.nan
        return rays, ok

    def inside(self, pixels: npt.ArrayLike) -> Flags:
        """Return whether pixels lie within the image, including half a pixel around the outermost pixel
        centres, (...)."""
        scaled = np.abs((np.asarray(pixels, float) - self._middle) / self._half)
        return np.asarray((scaled[..., 0] <= 1.0) & (scaled[..., 1] <= 1.0))

    @property
    def field_of_view(self) -> float:
        """Return the largest angle from the optical axis at which the distortion still maps one to one [rad]."""
        fold = self._optics.fold
        return fold if self.model == "fisheye" else math.atan(fold)

    @cached_property
    def _optics(self) -> RadialTangential | Fisheye:
        return LENS_MODELS[self.model][0](self.distortion)

    @cached_property
    def _focal(self) -> Array:
        return np.array([self.fx, self.fy])

    @cached_property
    def _centre(self) -> Array:
        return np.array([self.cx, self.cy])

    @cached_property
    def _middle(self) -> Array:
        return np.array([0.5 * (self.width - 1), 0.5 * (self.height - 1)])

    @cached_property
    def _half(self) -> Array:
        return np.array([0.5 * self.width, 0.5 * self.height])


# A camera: a lens and its pose.


@dataclass(frozen=True, eq=False)
class Camera:
    """Camera: a lens at a pose T_pc = [R_pc, C_p] in the pool frame.

    Raises:
        OpticsError: Position or orientation is not finite or of the wrong shape, or the quaternion not of unit length.
    """

    lens: Lens
    position: Array
    """C_p: centre of the camera, pool frame [m], (3,)."""
    orientation: Array
    """q_pc (xyzw): optical axes to pool axes, (4,)."""

    def __post_init__(self) -> None:
        for name, size in (("position", 3), ("orientation", 4)):
            value = np.array(getattr(self, name), float)
            if value.shape != (size,) or not np.isfinite(value).all():
                raise OpticsError(f"camera {name} is {getattr(self, name)}, expected {size} finite numbers")
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        length = float(np.linalg.norm(self.orientation))
        if abs(length - 1.0) > 1e-6:
            raise OpticsError(f"camera orientation has length {length:.6g}, expected a unit quaternion xyzw")

    @cached_property
    def R_pc(self) -> Array:
        """Return the rotation matrix from optical axes to pool axes, (3, 3)."""
        return quat_to_matrix(self.orientation / np.linalg.norm(self.orientation))
