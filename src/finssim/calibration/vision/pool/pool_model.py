"""One camera before one plane: predicted pixels, and how they change with everything that is estimated."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from finssim.geometry.optics import Camera, Interface, Lens, Status, project, projection_jacobians
from finssim.geometry.rotations import matrix_to_quat, quat_from_rotvec, quat_to_matrix, skew

__all__ = ["LENS_NAMES", "NAMES", "POSE_NAMES", "PoolModel", "extended_lens"]

Array = NDArray[np.float64]

POSE_NAMES = ("camera_x", "camera_y", "camera_z", "rotation_x", "rotation_y", "rotation_z")
LENS_NAMES = (
    "focal",
    "center_x",
    "center_y",
    "distortion_1",
    "distortion_2",
    "distortion_3",
    "distortion_4",
    "distortion_5",
)
NAMES = (*POSE_NAMES, "tilt_x", "tilt_y", "depth", "index", *LENS_NAMES)
"""Order of every vector of parameters: camera centre [m], rotation by pool axes [rad], tilt of the plane about the
reference point [rad], distance of the plane from the reference point [m], index beyond it, logarithm of the focal
length, optical centre [px], first five coefficients of distortion as the lens lists them."""

_LENGTHS = {"plumb_bob": 5, "rational": 8, "fisheye": 4}


def extended_lens(lens: Lens) -> Lens:
    """The same lens with room for coefficients of distortion that it leaves out."""
    missing = _LENGTHS[lens.model] - len(lens.distortion)
    return replace(lens, distortion=(*lens.distortion, *([0.0] * missing))) if missing > 0 else lens


@dataclass(frozen=True)
class PoolModel:
    """Camera and plane. All in the pool frame."""

    camera: Camera
    interface: Interface
    reference: Array
    """Point of the survey under water that the plane turns about and is told from, (3,) [m]."""
    refractive: bool = True
    """False: straight lines, as if nothing were between the camera and the points."""

    @property
    def depth(self) -> float:
        """Distance of the plane from the reference point, towards the camera [m]."""
        return -float(self.interface.normal @ self.reference + self.interface.offset)

    @property
    def clearance(self) -> float:
        """Distance of the camera from the plane, on its own side [m]."""
        return float(self.interface.normal @ self.camera.position + self.interface.offset)

    @cached_property
    def tangents(self) -> Array:
        """Directions that the plane's normal tilts towards, (2, 3)."""
        return np.stack([np.asarray(e, float) for e in self.interface.tangents()])

    def predict(self, points: Array, dry: NDArray[np.bool_]) -> Array:
        """Pixels of points, (N, 3) -> (N, 2); NaN where the camera cannot see them or they are beyond no plane.

        Args:
            points: Pool frame [m].
            dry: Points on the camera's side of the plane, seen in a straight line, (N,).
        """
        pixels = np.full((len(points), 2), np.nan)
        wet = ~dry if self.refractive else np.zeros(len(points), bool)
        if wet.any():
            seen = project(self.camera, self.interface, points[wet])
            good = (seen.status == Status.OK) | (seen.status == Status.OUTSIDE_IMAGE)
            pixels[wet] = np.where(good[:, None], seen.pixels, np.nan)
        if not wet.all():
            direct, ok = self.camera.lens.project(self._optical(points[~wet]))
            pixels[~wet] = np.where(ok[:, None], direct, np.nan)
        return pixels

    def jacobians(self, points: Array, dry: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Derivatives of `predict`: by the parameters in the order of `NAMES` (N, 2, 18), by the point (N, 2, 3)."""
        J, J_point = np.zeros((len(points), 2, len(NAMES))), np.zeros((len(points), 2, 3))
        wet = ~dry if self.refractive else np.zeros(len(points), bool)
        if wet.any():
            of = projection_jacobians(self.camera, self.interface, points[wet])
            tilt = of.interface[..., :2] - of.interface[..., 2:] * (self.tangents @ self.reference)
            parts = (of.pose, tilt, -of.interface[..., 2:], of.index[..., None], self._lens_columns(of.lens))
            J[wet], J_point[wet] = np.concatenate(parts, axis=-1), of.point
        if not wet.all():
            J[~wet], J_point[~wet] = self._direct_jacobians(points[~wet])
        return J, J_point

    def moved(self, step: Array) -> PoolModel:
        """The model a small step away, (18,) in the order of `NAMES`."""
        camera, plane = self.camera, self.interface
        turn = quat_to_matrix(quat_from_rotvec(step[3:6]))
        orientation = matrix_to_quat(turn @ np.asarray(camera.R_pc))
        normal = plane.normal + step[6:8] @ self.tangents
        normal = normal / np.linalg.norm(normal)
        offset = -(self.depth + step[8]) - float(normal @ self.reference)
        return replace(
            self,
            camera=Camera(_lens_moved(camera.lens, step[10:]), camera.position + step[:3], orientation),
            interface=replace(
                plane, normal=normal, offset=offset, index_far=float(plane.index_far + step[9])
            ),
        )

    def shifted(self, vector: Array) -> PoolModel:
        """The same model in a frame whose origin is at `-vector` of this one: everything moves by `vector` [m]."""
        plane = self.interface
        return replace(
            self,
            camera=replace(self.camera, position=self.camera.position + vector),
            interface=replace(plane, offset=float(plane.offset - plane.normal @ vector)),
            reference=self.reference + vector,
        )

    def _optical(self, points: Array) -> Array:
        return np.asarray((points - self.camera.position) @ np.asarray(self.camera.R_pc))

    def _lens_columns(self, of_lens: Array) -> Array:
        """Derivatives by fx fy cx cy and distortion as those by log focal, centre and distortion, (N, 2, 8)."""
        lens = self.camera.lens
        focal = of_lens[..., 0] * lens.fx + of_lens[..., 1] * lens.fy
        known = of_lens[..., 4:9]
        zeros = np.zeros((*known.shape[:-1], 5 - known.shape[-1]))
        return np.concatenate([focal[..., None], of_lens[..., 2:4], known, zeros], axis=-1)

    def _direct_jacobians(self, points: Array) -> tuple[Array, Array]:
        optical, R_pc = self._optical(points), np.asarray(self.camera.R_pc)
        by_point = self.camera.lens.project_jacobian(optical) @ R_pc.T
        by_turn = by_point @ skew(points - self.camera.position)
        lens = self._lens_columns(self.camera.lens.parameter_jacobian(optical))
        plane = np.zeros((len(points), 2, 4))
        return np.concatenate([-by_point, by_turn, plane, lens], axis=-1), by_point


def _lens_moved(lens: Lens, step: Array) -> Lens:
    if not step.any():
        return lens
    factor = float(np.exp(step[0]))
    terms = list(lens.distortion)
    for i, change in enumerate(step[3:8]):
        if i < len(terms):
            terms[i] += float(change)
    return replace(
        lens,
        fx=lens.fx * factor,
        fy=lens.fy * factor,
        cx=lens.cx + float(step[1]),
        cy=lens.cy + float(step[2]),
        distortion=tuple(terms),
    )
