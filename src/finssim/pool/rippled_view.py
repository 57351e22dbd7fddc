"""Where points in the water appear to a camera above a rippling surface, without drawing a picture."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from finssim.geometry.optics import Camera, Interface
from finssim.sensors.overhead_camera import Ripples
from finssim.sensors.overhead_camera.scene import surface_frame
from finssim.sensors.overhead_camera.surface import waves_of

__all__ = ["RippledView"]

Array = npt.NDArray[np.float64]

FLAT_STEPS = 2
"""Of Newton's method for still water: within 1e-5 px. One is enough to begin with ripples."""
RIPPLE_STEPS = 2
"""For ripples, with the surface's curvature from the first: within 0.001 px rms at a slope of 0.01, 0.03 px at 0.03."""


class RippledView:
    """The same surface and the same law of refraction as the renderer's, solved from the point to the pixel."""

    def __init__(self, camera: Camera, interface: Interface, ripples: Ripples | None = None) -> None:
        """
        Args:
            camera: Above the water.
            interface: Still surface, without a window.
            ripples: As in `sensors.overhead_camera.Scene`; None for a flat surface.
        """
        self.camera = camera
        self._frame = surface_frame(camera, interface)
        self._ratio = interface.index_near / interface.index_far
        self._R_sc = np.ascontiguousarray((camera.R_pc.T @ self._frame.R_sp.T).T)
        self._surface = (
            None if ripples is None or not ripples.rms_slope else _Surface(ripples, self._frame.offset)
        )

    def pixels(self, points_p: Array, time: float) -> tuple[Array, npt.NDArray[np.bool_]]:
        """Pixels at which points appear.

        Args:
            points_p: Pool frame [m], (N, 3).
            time: Middle of the exposure [s].

        Returns:
            Pixels (N, 2), inside the picture or not, and which of them mean something: the point is under water and
            the lens has a place for it, (N,).
        """
        points = self._frame.point(points_p)
        direction = np.empty_like(points)
        with np.errstate(all="ignore"):
            x, y, height = self._crossing(points[:, 0], points[:, 1], -points[:, 2], time)
            direction[:, 0], direction[:, 1], direction[:, 2] = x, y, height - self._frame.camera_height
            pixels, seen = self.camera.lens.project(direction @ self._R_sc)
        return pixels, seen & (points[:, 2] < height) & np.isfinite(x)

    def _crossing(
        self, px: Array, py: Array, depth: Array, time: float
    ) -> tuple[Array, Array, Array | float]:
        """Where the ray from the camera to each point crosses the surface: x, y, height, surface frame [m], (N,).

        Found as the root of the miss: the ray through a place of the surface, bent by the slope there, lands beside
        the point.
        """
        H, r = self._frame.camera_height, self._ratio
        reach = np.hypot(px, py)
        radius = reach * (H / (H + r * depth))
        for _ in range(FLAT_STEPS if self._surface is None else 1):
            cosine = H / np.sqrt(H * H + radius * radius)
            beyond = np.sqrt(1.0 - r * r * (1.0 - cosine * cosine))
            spread = depth * r * cosine / (beyond * H)
            along = 1.0 + spread * (cosine / beyond) ** 2
            radius = radius + (reach - radius * (1.0 + spread)) / along
        share = radius / np.maximum(reach, 1e-12)
        x, y = px * share, py * share
        if self._surface is None:
            return x, y, 0.0
        across = 1.0 + spread
        return self._rippled((x, y), (px, py), depth, (along, across, (1.0 - r) / beyond * depth), time)

    def _rippled(
        self,
        place: tuple[Array, Array],
        target: tuple[Array, Array],
        depth: Array,
        flat: tuple[Array, Array, Array],
        time: float,
    ) -> tuple[Array, Array, Array]:
        """From the place on still water to that on ripples. `flat`: d landing / d place along the radius and across it
        on still water, and by how much curvature adds to them."""
        assert self._surface is not None
        x, y = place
        along, across, by_curvature = flat
        height, sx, sy, hxx, hxy, hyy = self._surface.at(x, y, time)
        pull = (along - across) / np.maximum(x * x + y * y, 1e-12)
        a, b, c = (
            across + pull * x * x + by_curvature * hxx,
            pull * x * y + by_curvature * hxy,
            across + pull * y * y + by_curvature * hyy,
        )
        inverse = 1.0 / (a * c - b * b)
        for k in range(RIPPLE_STEPS):
            if k > 0:
                height, sx, sy, *_ = self._surface.at(x, y, time)
            fx, fy = self._step(x, y, height, sx, sy, depth)
            miss_x, miss_y = (target[0] - x - fx) * inverse, (target[1] - y - fy) * inverse
            x, y = x + c * miss_x - b * miss_y, y + a * miss_y - b * miss_x
        return x, y, height

    def _step(
        self, x: Array, y: Array, height: Array, sx: Array, sy: Array, depth: Array
    ) -> tuple[Array, Array]:
        """How far to the side a ray goes under water before it is at a depth [m], (N,) each."""
        r = self._ratio
        drop = self._frame.camera_height - height
        length = np.sqrt(x * x + y * y + drop * drop)
        steep = 1.0 / np.sqrt(1.0 + sx * sx + sy * sy)
        cosine = (x * sx + y * sy + drop) * steep / length
        # Snell's law: b = r ray + (r cos - cos') n, with ray = (x, y, -drop)/length and n = (-sx, -sy, 1) steep.
        turn = (r * cosine - np.sqrt(1.0 - r * r * (1.0 - cosine * cosine))) * steep
        short = r / length
        scale = (depth + height) / (drop * short - turn)
        return (x * short - sx * turn) * scale, (y * short - sy * turn) * scale


class _Surface:
    """Height, slope and curvature of the ripples, surface frame."""

    def __init__(self, ripples: Ripples, offset: Array) -> None:
        waves = waves_of(ripples)
        self._k = np.ascontiguousarray(waves.k.T)
        self._omega = waves.omega
        self._phase = waves.phase + offset @ self._k
        kx, ky = self._k
        a = waves.amplitude
        self._of_sine = np.stack([a, -a * kx * kx, -a * kx * ky, -a * ky * ky])
        self._of_cosine = np.stack([a * kx, a * ky])

    def at(self, x: Array, y: Array, time: float) -> tuple[Array, Array, Array, Array, Array, Array]:
        """h [m], h_x, h_y, h_xx, h_xy, h_yy [1/m] at places, (N,) each."""
        angle = np.array((x, y)).T @ self._k
        angle += self._phase - self._omega * time
        h, h_xx, h_xy, h_yy = self._of_sine @ np.sin(angle).T
        h_x, h_y = self._of_cosine @ np.cos(angle).T
        return h, h_x, h_y, h_xx, h_xy, h_yy
