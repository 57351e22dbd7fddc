"""A planar interface between two media, with or without a window of solid layers in it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from finssim.core.optics.lens import OpticsError

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Layer:
    """Solid sheet between the two media, such as the glass of a window."""

    thickness: float
    """Thickness [m]."""
    index: float
    """Refractive index."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.thickness) and self.thickness > 0.0):
            raise OpticsError(
                f"window layer has thickness {self.thickness}, expected a positive length in metres"
            )
        _check_index("window layer has index", self.index)


@dataclass(frozen=True, eq=False)
class Interface:
    """Interface plane Pi: n . X + b = 0 in the pool frame, with the media before and behind it (paper, eq. 8).

    The plane may have any orientation (a water surface, level or tilted, or a wall) and the media any two
    indices: a camera in the air above water, or in the water looking out.

    Raises:
        OpticsError: The normal is not of unit length, a number is not finite, or an index is not positive.
    """

    normal: Array
    """n: unit vector that points to the camera's side, pool frame, (3,)."""
    offset: float
    """b [m]."""
    index_near: float = 1.0003
    """Refractive index on the camera's side."""
    index_far: float = 1.333
    """Refractive index on the side of the points."""
    window: tuple[Layer, ...] = ()
    """Layers between the media, starting next to the camera; the plane is the camera-side face of the first
    layer."""

    def __post_init__(self) -> None:
        normal = np.array(self.normal, float)
        if normal.shape != (3,) or not np.isfinite(normal).all():
            raise OpticsError(f"interface normal is {self.normal}, expected 3 finite numbers")
        length = float(np.linalg.norm(normal))
        if abs(length - 1.0) > 1e-6:
            raise OpticsError(f"interface normal has length {length:.6g}, expected a unit vector")
        normal.setflags(write=False)
        object.__setattr__(self, "normal", normal)
        object.__setattr__(self, "window", tuple(self.window))
        if not math.isfinite(self.offset):
            raise OpticsError(f"interface offset is {self.offset}, expected a finite number of metres")
        _check_index("interface has index_near", self.index_near)
        _check_index("interface has index_far", self.index_far)

    @classmethod
    def water(
        cls,
        height: float,
        *,
        tilt_x: float = 0.0,
        tilt_y: float = 0.0,
        n_air: float = 1.0003,
        n_water: float = 1.333,
    ) -> Interface:
        """Return a water surface seen from the air, in a frame with z up.

        Args:
            height: z of the surface at x = y = 0 [m].
            tilt_x: Tilt of the normal towards +x [rad].
            tilt_y: Tilt of the normal towards +y [rad].
            n_air: Refractive index of the air.
            n_water: Refractive index of the water.
        """
        level = cls(np.array([0.0, 0.0, 1.0]), -height, n_air, n_water).tilted(tilt_x, tilt_y)
        return replace(level, offset=-height * float(level.normal[2]))

    @classmethod
    def through(
        cls,
        point: npt.ArrayLike,
        normal: npt.ArrayLike,
        *,
        index_near: float = 1.0003,
        index_far: float = 1.333,
        window: tuple[Layer, ...] = (),
    ) -> Interface:
        """Return the plane through a point with a given normal.

        Args:
            point: Point on the plane, pool frame [m], (3,).
            normal: Vector of any length [-] to the camera's side, pool frame, (3,).
            index_near: Refractive index on the camera's side.
            index_far: Refractive index on the side of the points.
            window: Layers between the media, starting next to the camera.

        Raises:
            OpticsError: The normal is zero or not finite.
        """
        n, length = np.asarray(normal, float), float(np.linalg.norm(normal))
        if not (math.isfinite(length) and length > 0.0):
            raise OpticsError(f"interface normal is {n}, expected a direction")
        return cls(n / length, -float(n @ np.asarray(point, float)) / length, index_near, index_far, window)

    def height(self, x: npt.ArrayLike, y: npt.ArrayLike) -> Array:
        """Return z of the plane above (x, y) [m], (...).

        Raises:
            OpticsError: The plane is vertical.
        """
        a, b, c = self.normal
        if abs(c) < 1e-9:
            raise OpticsError("the interface is vertical: it has no height")
        return np.asarray(-(a * np.asarray(x, float) + b * np.asarray(y, float) + self.offset) / c)

    def distance(self, points_p: npt.ArrayLike) -> Array:
        """Return the signed distance of points from the plane, positive on the camera's side [m], (..., 3) ->
        (...)."""
        return np.asarray(np.asarray(points_p, float) @ self.normal + self.offset)

    def tangents(self) -> tuple[Array, Array]:
        """Return unit vectors e1, e2 in the plane with e1 x e2 = n: x and y of the pool for level water, (3,)
        each."""
        return self._tangents

    def tilted(self, tilt_x: float, tilt_y: float, offset: float = 0.0) -> Interface:
        """Return the interface with its normal turned by tilt_x e1 + tilt_y e2 [rad] and `offset` [m] added
        to b."""
        angle = math.hypot(tilt_x, tilt_y)
        e1, e2 = self._tangents
        lean = np.sinc(angle / np.pi) * (tilt_x * e1 + tilt_y * e2)
        normal = self.normal if angle == 0.0 else math.cos(angle) * self.normal + lean
        return replace(self, normal=normal, offset=self.offset + offset)

    @property
    def thickness(self) -> float:
        """Thickness of the window [m]; 0 without one."""
        return math.fsum(layer.thickness for layer in self.window)

    @cached_property
    def _tangents(self) -> tuple[Array, Array]:
        n = self.normal
        axis = np.array([1.0, 0.0, 0.0]) if abs(n[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
        e1 = axis - (axis @ n) * n
        e1 = e1 / np.linalg.norm(e1)
        return e1, np.cross(n, e1)


def _check_index(label: str, index: float) -> None:
    if not (math.isfinite(index) and index > 0.0):
        raise OpticsError(f"{label} {index}, expected a positive number (air 1.0003, fresh water 1.333)")
