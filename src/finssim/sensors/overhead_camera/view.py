"""What the camera's place decides, once: the surface frame, and the direction of view of every pixel corner."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from finssim.geometry.optics import Camera, Interface, Lens
from finssim.geometry.rotations import matrix_to_quat
from finssim.sensors.batch import SensorError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SurfaceFrame:
    """Surface frame s: z along the interface's normal, origin on the still surface right below the camera.

    Coordinates near the camera stay small there, which is what single precision needs.
    """

    origin_p: Array
    """[m], (3,)."""
    R_sp: Array
    """(3, 3)."""
    camera_height: float
    """Of the camera above the plane [m]."""

    def point(self, point_p: ArrayLike) -> Array:
        """A point of the pool frame in the surface frame [m], (..., 3)."""
        return np.asarray((np.asarray(point_p, float) - self.origin_p) @ self.R_sp.T)

    def quaternion(self, R_px: Array) -> Array:
        """Axes of a thing x in the surface frame, q_sx xyzw, (4,)."""
        return matrix_to_quat(self.R_sp @ R_px)

    @property
    def offset(self) -> Array:
        """Origin from the pool's origin along the tangents [m], (2,)."""
        return np.asarray(self.R_sp[:2] @ self.origin_p)


def surface_frame(camera: Camera, interface: Interface) -> SurfaceFrame:
    """The surface frame below a camera.

    Raises:
        SensorError: The camera is not on the side that the interface's normal points to.
    """
    n = np.asarray(interface.normal, float)
    first = np.asarray(interface.tangents()[0], float)
    position = np.asarray(camera.position, float)
    height = float(n @ position + interface.offset)
    if height <= 0.0:
        raise SensorError(
            f"camera stands {-height:.4g} m behind the interface: turn the normal towards the camera"
        )
    return SurfaceFrame(position - height * n, np.stack([first, np.cross(n, first), n]), height)


@lru_cache(maxsize=4)
def corner_rays(lens: Lens) -> Array:
    """Unit directions through the corners of all pixels, optical frame, (height + 1, width + 1, 3).

    Corner (i, j) is at pixel coordinates (j - 0.5, i - 0.5). Zero where the lens sees nothing.

    Note:
        Directions inside a pixel are interpolated between its corners, wrong by at most (1/8) |d²ray/du²|, below
        0.001 px for focal lengths above 100 px.
    """
    u, v = np.meshgrid(np.arange(lens.width + 1) - 0.5, np.arange(lens.height + 1) - 0.5)
    rays, ok = lens.rays(np.stack([u, v], axis=-1))
    rays = np.where(ok[..., None], rays, 0.0)
    rays.setflags(write=False)
    return np.asarray(rays)


def corner_rays_s(camera: Camera, frame: SurfaceFrame) -> NDArray[np.float32]:
    """`corner_rays` in the surface frame, single precision."""
    R_sc = frame.R_sp @ np.asarray(camera.R_pc, float)
    return np.asarray(corner_rays(camera.lens) @ R_sc.T, dtype=np.float32)
