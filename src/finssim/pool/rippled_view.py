"""Where points in the water appear to a camera above a rippling surface, without drawing a picture."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from finssim.geometry.optics import Camera, Interface
from finssim.sensors.overhead_camera import Ripples
from finssim.sensors.overhead_camera.surface import Waves, waves_of
from finssim.sensors.overhead_camera.view import surface_frame

__all__ = ["RippledView"]

Array = npt.NDArray[np.float64]

STEPS = 4
"""Of Newton's method with the Jacobian of the first step: the last one moves the image by less than 0.001 px."""


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
        self._waves: Waves | None = None if ripples is None or not ripples.rms_slope else waves_of(ripples)
        self._ratio = interface.index_near / interface.index_far
        self._R_cs = camera.R_pc.T @ self._frame.R_sp.T

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
        depth = -points[:, 2]
        place, height = self._crossing(points[:, :2], depth, time)
        direction = np.concatenate([place, (height - self._frame.camera_height)[:, None]], axis=1)
        pixels, seen = self.camera.lens.project(direction @ self._R_cs.T)
        return pixels, seen & (depth > height) & np.isfinite(place).all(axis=1)

    def _crossing(self, target: Array, depth: Array, time: float) -> tuple[Array, Array]:
        """Where the ray from the camera to each point crosses the surface, (N, 2) and (N,), surface frame [m].

        Found as the root of the miss: the ray through a place of the surface, bent by the slope there, lands
        beside the point.
        """
        H, r = self._frame.camera_height, self._ratio
        with np.errstate(all="ignore"):
            place = target * (H / (H + r * np.maximum(depth, 0.0)))[:, None]
            inverse = self._inverse_jacobian(place, depth, time)
            height = np.zeros(len(depth))
            for _ in range(STEPS):
                landing, height = self._landing(place, depth, time)
                place = place + np.einsum("nij,nj->ni", inverse, target - landing)
        return place, height

    def _landing(self, place: Array, depth: Array, time: float) -> tuple[Array, Array]:
        """Where rays through places of the surface come down at a depth, (N, 2), and the surface's height (N,) [m]."""
        r = self._ratio
        height, slope = self._surface(place, time)
        drop = self._frame.camera_height - height
        length = np.sqrt(np.einsum("ni,ni->n", place, place) + drop * drop)
        steep = np.sqrt(1.0 + np.einsum("ni,ni->n", slope, slope))
        cosine = (np.einsum("ni,ni->n", place, slope) + drop) / (length * steep)
        # Snell's law: b = r ray + (r cos - cos') n, with ray = (place, -drop)/length and n = (-slope, 1)/steep.
        turn = (r * cosine - np.sqrt(1.0 - r * r * (1.0 - cosine * cosine))) / steep
        down = r * drop / length - turn
        across = place * (r / length)[:, None] - slope * turn[:, None]
        return place + across * ((depth + height) / down)[:, None], height

    def _inverse_jacobian(self, place: Array, depth: Array, time: float) -> Array:
        """Inverse of d landing / d place, (N, 2, 2): that of flat water, and what curvature adds to it."""
        H, r = self._frame.camera_height, self._ratio
        s2 = np.einsum("ni,ni->n", place, place)
        cosine = H / np.sqrt(H * H + s2)
        beyond = np.sqrt(1.0 - r * r * (1.0 - cosine * cosine))
        along = 1.0 + depth * r * (cosine / beyond) ** 3 / H
        across = 1.0 + depth * r * (cosine / beyond) / H
        unit = place / np.sqrt(np.maximum(s2, 1e-12))[:, None]
        J = (
            across[:, None, None] * np.eye(2)
            + (along - across)[:, None, None] * unit[:, :, None] * unit[:, None]
        )
        if self._waves is not None:
            J = J + (depth * (1.0 - r) / beyond)[:, None, None] * self._curvature(place, time)
        return np.asarray(np.linalg.inv(J))

    def _surface(self, place: Array, time: float) -> tuple[Array, Array]:
        """Height (N,) [m] and slope (N, 2)."""
        if self._waves is None:
            return np.zeros(len(place)), np.zeros_like(place)
        w = self._waves
        angle = self._angle(place, time)
        return np.sin(angle) @ w.amplitude, (np.cos(angle) * w.amplitude) @ w.k

    def _curvature(self, place: Array, time: float) -> Array:
        """Second derivatives of the height [1/m], (N, 2, 2)."""
        assert self._waves is not None
        w = self._waves
        return -np.einsum("nw,wi,wj->nij", np.sin(self._angle(place, time)) * w.amplitude, w.k, w.k)

    def _angle(self, place: Array, time: float) -> Array:
        assert self._waves is not None
        w = self._waves
        return np.asarray((place + self._frame.offset) @ w.k.T - w.omega * time + w.phase)
