"""Meshes and lines of what is drawn: the hull, thrusters, tags, the pool, and forces as arrows."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from finssim.geometry.rotations import quat_to_matrix
from finssim.vehicles import Vehicle, VehicleError
from finssim.viewer.frame import Pose

Array = npt.NDArray[np.float64]

ARROW = 1.2
"""Length of the arrow of the largest thrust, part of the vehicle's length."""
FAINT = 0.002
"""Part of the largest thrust below which no arrow is drawn."""
BOX_FACES = np.array(
    [
        [0, 2, 1],
        [1, 2, 3],
        [4, 5, 6],
        [5, 7, 6],
        [0, 1, 4],
        [1, 5, 4],
        [2, 6, 3],
        [3, 6, 7],
        [0, 4, 2],
        [2, 4, 6],
    ]
    + [[1, 3, 5], [3, 7, 5]]
)
"""Of the corners in the order z, y, x: outwards; -z, +z, -y, +y, -x, +x."""


class Mesh(NamedTuple):
    """Triangles."""

    vertices: Array
    """[m], (v, 3)"""
    faces: npt.NDArray[np.int64]
    """Counter-clockwise seen from outside, (f, 3)."""


def wxyz(quaternion: npt.ArrayLike) -> tuple[float, float, float, float]:
    """A quaternion xyzw, body to world, (4,), in the order that the browser takes."""
    x, y, z, w = np.asarray(quaternion, float).tolist()
    return w, x, y, z


def hull_of(vehicle: Vehicle) -> Mesh:
    """The hull in the body frame; a box of the vehicle's size where its file gives none."""
    try:
        return Mesh(*vehicle.hull_mesh())
    except VehicleError:
        half = 0.5 * np.asarray(vehicle.body.size, float)
        return _box(vehicle.body.center_of_buoyancy - half, vehicle.body.center_of_buoyancy + half)


def tag_plates(vehicle: Vehicle) -> tuple[Mesh, Mesh] | None:
    """White plates and the dark squares on them where tags sit, body frame; None without tags."""
    tags = vehicle.tags
    if tags is None:
        return None
    return tuple(  # type: ignore[return-value]
        _squares(
            [(m.position, quat_to_matrix(m.orientation)) for m in tags.mounts.values()],
            size * tags.edge,
            lift,
        )
        for size, lift in ((1.3, 0.0), (0.9, 0.002))
    )


def wall_mesh(lower: Array, upper: Array) -> Mesh:
    """Floor and four walls of a box, seen from inside alone: those between the eye and the water vanish."""
    box = _box(lower, upper)
    kept = np.r_[0:2, 4:12]  # without the lid
    return Mesh(box.vertices, box.faces[kept][:, ::-1])


def force_arrows(vehicle: Vehicle, force: Array, pose: Pose) -> Array:
    """Start and end of an arrow for each thruster that pushes, world frame [m], (k, 2, 3).

    An arrow points where its thruster pushes the vehicle. Its length grows with the root of the force, as the shaft
    speed does: linear ones would be too small to see while a station is kept.
    """
    if not len(force):
        return np.zeros((0, 2, 3))
    largest = float(np.max(np.abs(vehicle.force_limits)))
    part = np.asarray(force, float) / largest
    length = ARROW * float(np.max(vehicle.body.size))
    at = np.array([t.position for t in vehicle.thrusters.values()], float)
    reach = length * np.sign(part) * np.sqrt(np.abs(part))
    along = np.array([t.axis for t in vehicle.thrusters.values()], float)
    seen = np.isfinite(part) & (np.abs(part) > FAINT)
    ends = np.stack([at, at + reach[:, None] * along], axis=1)[seen]
    return np.asarray(ends @ quat_to_matrix(pose.quaternion).T + pose.position)


def line_of(points: Array) -> Array:
    """Segments of a line through points, (k - 1, 2, 3)."""
    points = points[np.isfinite(points).all(axis=1)] if len(points) else points
    return np.stack([points[:-1], points[1:]], axis=1) if len(points) > 1 else np.zeros((0, 2, 3))


def box_edges(lower: Array, upper: Array) -> Array:
    """The twelve edges of a box, (12, 2, 3)."""
    corners = _box(lower, upper).vertices
    pairs = [(i, i ^ bit) for i in range(8) for bit in (1, 2, 4) if i < i ^ bit]
    return np.array([[corners[a], corners[b]] for a, b in pairs])


def _box(lower: Array, upper: Array) -> Mesh:
    ends = np.stack([lower, upper])
    vertices = np.array(
        [[ends[x, 0], ends[y, 1], ends[z, 2]] for z in (0, 1) for y in (0, 1) for x in (0, 1)]
    )
    return Mesh(vertices, BOX_FACES)


def _squares(places: list[tuple[Array, Array]], edge: float, lift: float) -> Mesh:
    """Squares about the z axes of mounts, seen from both sides."""
    half = 0.5 * edge
    corners = np.array([[-half, -half, lift], [half, -half, lift], [half, half, lift], [-half, half, lift]])
    vertices = [corners @ R.T + np.asarray(position) for position, R in places]
    faces = [np.array([[0, 1, 2], [0, 2, 3]]) + 4 * i for i in range(len(places))]
    return Mesh(np.concatenate(vertices), np.concatenate(faces))
